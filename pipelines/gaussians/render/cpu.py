"""The renderer on CPUs: compiled band kernels behind one autograd operation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.gaussians.render.cpu_backward import backward_band, merge_gradients
from pipelines.gaussians.render.cpu_bands import bin_gaussians
from pipelines.gaussians.render.cpu_forward import forward_band
from pipelines.gaussians.render.cpu_inspect import inspect
from pipelines.gaussians.render.threads import for_each

__all__ = ["composite", "inspect"]

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
    proxy_depth: Tensor | None,
    kappa: float,
    near: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of float32 CPU tensors."""
    return _Composite.apply(u, v, sigma_px, z, opacity, features, width, height, proxy_depth, kappa, near)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        tensors, (width, height, proxy_depth, kappa, near) = arguments[:6], arguments[6:]
        inputs = [_array(tensor) for tensor in tensors]
        if proxy_depth is None:
            kappa = 0.0
        proxy = np.zeros((1, 1), F32) if kappa == 0 else _array(proxy_depth)
        reach, starts, entries, slots = bin_gaussians(*inputs[:5], width, height, F32(near))
        features = np.empty((height, width, inputs[5].shape[1]), F32)
        images = [features, *(np.empty((height, width), F32) for _ in range(3))]
        vectors = channel_vectors(features.shape[2])
        job = (starts, entries, reach, *inputs, proxy, F32(kappa))
        for_each(lambda band: forward_band(vectors, band, *job, *images), len(starts) - 1)
        outputs = tuple(torch.from_numpy(image) for image in images)
        ctx.save_for_backward(*tensors, *outputs)
        ctx.job, ctx.slots = (starts, entries, reach, proxy, F32(kappa)), slots
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = [_array(tensor) for tensor in ctx.saved_tensors]
        inputs, images = saved[:6], saved[6:]
        upstream = [
            np.zeros_like(image) if gradient is None else _array(gradient)
            for image, gradient in zip(images, gradients, strict=True)
        ]
        starts, entries, reach, proxy, kappa = ctx.job
        d_geometry, d_features = np.empty((5, len(inputs[0])), F32), np.empty_like(inputs[5])
        shared = np.empty((int(ctx.slots[-1]), 5 + inputs[5].shape[1]), F32)
        vectors = channel_vectors(inputs[5].shape[1])
        job = (starts, entries, reach, ctx.slots, *inputs, proxy, kappa, *images, *upstream)
        results = (d_geometry, d_features, shared)
        for_each(lambda band: backward_band(vectors, band, *job, *results), len(starts) - 1)
        chunks = 16
        for_each(lambda chunk: merge_gradients(chunk, chunks, reach, ctx.slots, *results), chunks)
        return (*torch.from_numpy(d_geometry).unbind(0), torch.from_numpy(d_features), *[None] * 5)


def channel_vectors(channels: int) -> tuple[int, ...]:
    """A tuple with one 0 per sixteen channels: its type tells the kernels how many vectors a pixel has."""
    return (0,) * max(1, (channels + 15) // 16)


def _array(tensor: Tensor) -> NDArray[np.float32]:
    array = tensor.detach().contiguous().numpy()
    if array.dtype != np.float32:
        raise ValueError(f"the cpu backend renders float32, got {array.dtype}")
    return array
