"""The renderer in plain torch, on any device and in any float type: slow, short, and the judge of the fast ones.

Every (pixel, Gaussian) pair is listed, sorted once, and blended by cumulative log-transmittance and sparse products.
Functions of the renderer take this module as their backend.
"""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from msgs_slam.formats.errors import ignored_warnings
from msgs_slam.pipelines.paper.rendering import Pairs, ends_of, pair_opacities, pixel_pairs, transmittance_before
from msgs_slam.pipelines.render.rules import TRANSMITTANCE_MIN, GaussianStats


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
    stats: GaussianStats | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W): eq. (6)-(9) by autograd; the stats
    are filled when a gradient of the image is asked for."""
    pairs = pixel_pairs(u, v, sigma_px, z, opacity, width, height, near)
    alpha, _ = pair_opacities(pairs, u, v, sigma_px, z, opacity, width)
    before = transmittance_before(alpha, pairs)
    weights = torch.where(before.detach() >= TRANSMITTANCE_MIN, alpha * before, 0.0)
    ones = torch.ones_like(z).unsqueeze(1)
    blended = _Blend.apply(weights, torch.cat([features, ones], dim=1), pairs)
    depths = _Blend.apply(weights, torch.stack([z, ones[:, 0]], dim=1), pairs)
    shape = (height, width)
    if stats is not None:
        inspected = partial(inspect, u, v, sigma_px, z, opacity, width, height, near)
        blended.register_hook(lambda _: stats.fill(inspected))
    return (
        blended[:, :-1].reshape(*shape, -1),
        depths[:, 0].view(shape),
        depths[:, 1].view(shape),
        blended[:, -1].view(shape),
    )


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Median depth (H, W), and summed and largest blending weight of each Gaussian, (M,) each; in the sums a pixel
    counts as counts (H, W) says."""
    u, v, sigma_px, z, opacity = (x.detach() for x in (u, v, sigma_px, z, opacity))
    pairs = pixel_pairs(u, v, sigma_px, z, opacity, width, height, near)
    alpha, depth = pair_opacities(pairs, u, v, sigma_px, z, opacity, width)
    before = transmittance_before(alpha, pairs)
    weights = torch.where(before >= TRANSMITTANCE_MIN, alpha * before, 0.0)
    crossing = (before >= 0.5) & (before - weights < 0.5)
    median = z.new_zeros(height * width).index_add(0, pairs.pixel[crossing], depth[crossing])
    counted = weights if counts is None else weights * counts.reshape(-1)[pairs.pixel]
    sums = torch.zeros_like(z).index_add(0, pairs.gaussian, counted)
    most = torch.zeros_like(z).scatter_reduce(0, pairs.gaussian, weights, "amax")
    return median.view(height, width), sums, most


class _Blend(torch.autograd.Function):
    """(P,) weights and (M, C) features -> (H*W, C) weighted sums, without ever storing a (P, C) array."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, features: Tensor, pairs: Pairs) -> Tensor:
        ctx.save_for_backward(weights, features)
        ctx.pairs = pairs
        size = (len(pairs.pixel_ends) - 1, len(features))
        return _sparse_rows(pairs.pixel_ends, pairs.gaussian, weights, size) @ features

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        weights, features = ctx.saved_tensors
        pairs: Pairs = ctx.pairs
        gradient = gradients[0].contiguous()
        size = (len(gradient), len(features))
        pattern = _sparse_rows(pairs.pixel_ends, pairs.gaussian, torch.zeros_like(weights), size)
        d_weights = torch.sparse.sampled_addmm(pattern, gradient, features.t(), beta=0.0).values()
        by_gaussian = torch.argsort(pairs.gaussian, stable=True)
        pixel, listed = pairs.pixel[by_gaussian], weights[by_gaussian]
        transposed = _sparse_rows(ends_of(pairs.gaussian, size[1]), pixel, listed, (size[1], size[0]))
        return d_weights, transposed @ gradient, None


def _sparse_rows(ends: Tensor, columns: Tensor, values: Tensor, size: tuple[int, int]) -> Tensor:
    with ignored_warnings("Sparse CSR tensor support is in beta"):
        return torch.sparse_csr_tensor(ends, columns, values, size, check_invariants=False)
