"""The renderer on CPUs: compiled band kernels behind one autograd operation."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..compute.threads import as_array
from .cpu_backward import pull_back
from .cpu_bands import split_into_bands
from .cpu_forward import draw_bands, padded_channels
from .cpu_inspect import class_weights, inspect, look
from .notes import Notes

__all__ = ["class_weights", "composite", "inspect", "look"]


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
    notes: Notes | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of float32 CPU tensors;
    the backward pass fills the notes."""
    return _Composite.apply(u, v, sigma_px, z, opacity, features, width, height, near, notes)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *projected, values = (as_array(tensor) for tensor in arguments[:6])
        width, height, near, ctx.notes = arguments[6:]
        bands = split_into_bands(tuple(projected), values, padded_channels(values.shape[1]), width, height, near)
        features, planes = draw_bands(bands, values.shape[1], width, height)
        outputs = (torch.from_numpy(features), *torch.from_numpy(planes).unbind(0))
        ctx.save_for_backward(outputs[0])
        ctx.state = (bands, planes)
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        bands, planes = ctx.state
        features = as_array(ctx.saved_tensors[0])
        upstream = [
            np.zeros_like(image) if gradient is None else as_array(gradient)
            for image, gradient in zip((features, *planes), gradients, strict=True)
        ]
        marks = None if ctx.notes is None else ctx.notes.marks()
        d_geometry, d_features, noted = pull_back(bands, features, planes, upstream[0], np.stack(upstream[1:]), marks)
        if ctx.notes is not None:
            ctx.notes.largest, ctx.notes.answered = torch.from_numpy(noted).unbind(1)
        return (*torch.from_numpy(d_geometry).unbind(0), torch.from_numpy(d_features), *[None] * 4)
