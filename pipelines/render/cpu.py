"""The renderer on CPUs: compiled band kernels behind one autograd operation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..compute.jit import as_array
from ..compute.threads import PART, for_each
from .cpu_backward import COLORS, backward_band, sum_shared
from .cpu_bands import for_each_band, split_into_bands
from .cpu_forward import draw_bands
from .cpu_inspect import class_weights, inspect, weighted_errors

__all__ = ["class_weights", "composite", "inspect", "weighted_errors"]

F32 = np.float32


def composite(
    u: Tensor,
    v: Tensor,
    sigma_px: Tensor,
    z: Tensor,
    opacity: Tensor,
    features: Tensor,
    width: int,
    height: int,
    near: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of float32 CPU tensors."""
    return _Composite.apply(u, v, sigma_px, z, opacity, features, width, height, near)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *projected, values = (as_array(tensor) for tensor in arguments[:6])
        width, height, near = arguments[6:]
        vectors = None if values.shape[1] == 3 else channel_vectors(values.shape[1])
        channels = 3 if vectors is None else 16 * len(vectors)
        bands = split_into_bands(tuple(projected), values, channels, width, height, near)
        features, planes = draw_bands(bands, vectors, values.shape[1], width, height)
        outputs = (torch.from_numpy(features), *torch.from_numpy(planes).unbind(0))
        ctx.save_for_backward(outputs[0])
        ctx.state = (bands, planes)
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        bands, planes = ctx.state
        features = as_array(ctx.saved_tensors[0])
        if features.shape[2] != COLORS:
            raise ValueError(f"the cpu backend has gradients of {COLORS} features, got {features.shape[2]}")
        images = (features, *planes)
        upstream = [
            np.zeros_like(image) if gradient is None else as_array(gradient)
            for image, gradient in zip(images, gradients, strict=True)
        ]
        job = (features, planes, upstream[0], np.stack(upstream[1:]))
        count = len(bands.first)
        d_geometry, d_features = np.zeros((5, count), F32), np.zeros((count, COLORS), F32)
        shared = np.empty((int(bands.slots[-1]), 5 + COLORS), F32)
        results = (d_geometry, d_features, shared)
        places = (bands.first, bands.slots)
        for_each_band(
            lambda b: backward_band(b, bands.own(b), *places, *bands.prepared[b], *job, *results), bands.starts
        )
        for_each(lambda n: sum_shared(n * PART, PART, bands.slots, shared, d_geometry, d_features), -(-count // PART))
        return (*torch.from_numpy(d_geometry).unbind(0), torch.from_numpy(d_features), *[None] * 3)


def channel_vectors(channels: int) -> tuple[int, ...]:
    """See `cpu_forward.Vectors`."""
    return (0,) * max(1, (channels + 15) // 16)
