"""The renderer in plain torch, on any device and in any float type: slow, short, and the judge of the fast ones.

Every (pixel, Gaussian) pair is listed, sorted once, and blended by cumulative log-transmittance and sparse products.

What every backend agrees on, which Gaussian touches which pixel and when a pixel is finished: a Gaussian with opacity o
and image radius s reaches the pixel centres at which f = o exp(-distance² / 2 s²) (MSGS-SLAM eq. 4, 5) is at least
ALPHA_MIN and the distance at most CUT_SIGMAS s; there it counts with min(f, ALPHA_MAX). Gaussians are blended by
increasing depth, ties by index. A pixel takes no more of them once its transmittance before the next one is below
TRANSMITTANCE_MIN.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ...formats.quiet import ignored_warnings
from .notes import Notes

ALPHA_MIN = 1 / 255
"""Opacity at which a Gaussian ends: less cannot be seen in an 8-bit image."""

ALPHA_MAX = 0.99
"""Largest opacity at a pixel: a fully opaque Gaussian would hide all behind it from learning and divide by 0."""

TRANSMITTANCE_MIN = 1e-4

CUT_SIGMAS = 3.0
"""No Gaussian reaches farther than this many radii, however opaque."""


@dataclass(frozen=True)
class Pairs:
    """P pairs, pixel by pixel in raster order, near to far within a pixel.

    gaussian (P,) and pixel (P,) indices; pixel_ends (H*W + 1,) and gaussian_ends (M + 1,): where each one's pairs start
    and end; by_gaussian (P,): the permutation that lists the pairs Gaussian by Gaussian.
    """

    gaussian: Tensor
    pixel: Tensor
    pixel_ends: Tensor
    gaussian_ends: Tensor
    by_gaussian: Tensor


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
    """Feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W): eq. (6)-(9) by autograd; the notes
    are filled when a gradient of the image is asked for."""
    pairs = list_pairs(u, v, sigma_px, z, opacity, width, height, near)
    alpha, _ = pair_opacities(pairs, u, v, sigma_px, z, opacity, width)
    before = transmittance_before(alpha, pairs)
    weights = torch.where(before.detach() >= TRANSMITTANCE_MIN, alpha * before, 0.0)
    ones = torch.ones_like(z).unsqueeze(1)
    blended = _Blend.apply(weights, torch.cat([features, ones], dim=1), pairs)
    depths = _Blend.apply(weights, torch.stack([z, ones[:, 0]], dim=1), pairs)
    shape = (height, width)
    if notes is not None:
        look = partial(inspect, u, v, sigma_px, z, opacity, width, height, near)
        blended.register_hook(lambda _: notes.fill(look))
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
    pairs = list_pairs(u, v, sigma_px, z, opacity, width, height, near)
    alpha, depth = pair_opacities(pairs, u, v, sigma_px, z, opacity, width)
    before = transmittance_before(alpha, pairs)
    weights = torch.where(before >= TRANSMITTANCE_MIN, alpha * before, 0.0)
    crossing = (before >= 0.5) & (before - weights < 0.5)
    median = z.new_zeros(height * width).index_add(0, pairs.pixel[crossing], depth[crossing])
    counted = weights if counts is None else weights * counts.reshape(-1)[pairs.pixel]
    sums = torch.zeros_like(z).index_add(0, pairs.gaussian, counted)
    most = torch.zeros_like(z).scatter_reduce(0, pairs.gaussian, weights, "amax")
    return median.view(height, width), sums, most


def list_pairs(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float
) -> Pairs:
    """Rows each Gaussian crosses, then the pixels of each row, then one stable sort by pixel."""
    u, v, sigma_px, z, opacity = (x.detach() for x in (u, v, sigma_px, z, opacity))
    reach = (2 * torch.log((opacity / ALPHA_MIN).clamp(min=1.0))).clamp(max=CUT_SIGMAS**2).sqrt() * sigma_px
    seen = (z > near) & (reach > 0) & (u + reach >= 0.5) & (u - reach <= width - 0.5)
    order = torch.nonzero(seen & (v + reach >= 0.5) & (v - reach <= height - 0.5))[:, 0]
    order = order[torch.argsort(z[order], stable=True)]
    u, v, reach = u[order], v[order], reach[order]
    of_row, row = _ranges((v - reach - 0.5).ceil().clamp(min=0), (v + reach - 0.5).floor().clamp(max=height - 1))
    half = (reach[of_row] ** 2 - (row + 0.5 - v[of_row]) ** 2).clamp(min=0).sqrt()
    left, right = u[of_row] - half - 0.5, u[of_row] + half - 0.5
    of_pair, column = _ranges(left.ceil().clamp(min=0), right.floor().clamp(max=width - 1))
    pixel, permutation = torch.sort(row[of_pair] * width + column, stable=True)
    gaussian = order[of_row[of_pair]]
    by_gaussian = torch.empty_like(permutation)
    by_gaussian[permutation] = torch.arange(len(permutation), device=u.device)
    rank = torch.argsort(gaussian, stable=True)
    return Pairs(gaussian[permutation], pixel, _ends(pixel, width * height), _ends(gaussian, len(z)), by_gaussian[rank])


def pair_opacities(
    pairs: Pairs, u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int
) -> tuple[Tensor, Tensor]:
    """f and d of every pair, (P,) each."""
    table = torch.stack([u, v, sigma_px, z, opacity], dim=1)
    u, v, sigma_px, depth, opacity = table.index_select(0, pairs.gaussian).unbind(1)
    dx = pairs.pixel % width + 0.5 - u
    dy = torch.div(pairs.pixel, width, rounding_mode="floor") + 0.5 - v
    alpha = opacity * torch.exp(-0.5 * (dx * dx + dy * dy) / (sigma_px * sigma_px))
    return alpha.clamp(max=ALPHA_MAX), depth


def transmittance_before(occlusion: Tensor, pairs: Pairs) -> Tensor:
    """(P,) the light that reaches each pair: product of 1 - occlusion of the nearer pairs of its pixel."""
    # One running sum over the whole image: float32 would lose the digits of the late pixels.
    total = torch.cumsum(torch.log1p(-occlusion.double()), 0)
    exclusive = torch.cat([total.new_zeros(1), total])
    starts = pairs.pixel_ends[:-1]
    at_pixel_start = exclusive.index_select(0, starts).repeat_interleave(pairs.pixel_ends.diff())
    return torch.exp(exclusive[:-1] - at_pixel_start).to(occlusion.dtype)


def _ranges(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Lists first[i]..last[i] for every i: (index i, number), empty where last < first."""
    first = first.long()
    counts = (last.long() - first + 1).clamp(min=0)
    index = torch.repeat_interleave(torch.arange(len(first), device=first.device), counts)
    starts = torch.cumsum(counts, 0) - counts
    return index, torch.arange(len(index), device=first.device) - starts[index] + first[index]


def _ends(index: Tensor, count: int) -> Tensor:
    return torch.cat([index.new_zeros(1), torch.cumsum(torch.bincount(index, minlength=count), 0)])


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
        pixel, listed = pairs.pixel[pairs.by_gaussian], weights[pairs.by_gaussian]
        transposed = _sparse_rows(pairs.gaussian_ends, pixel, listed, (size[1], size[0]))
        return d_weights, transposed @ gradient, None


def _sparse_rows(ends: Tensor, columns: Tensor, values: Tensor, size: tuple[int, int]) -> Tensor:
    with ignored_warnings("Sparse CSR tensor support is in beta"):
        return torch.sparse_csr_tensor(ends, columns, values, size, check_invariants=False)
