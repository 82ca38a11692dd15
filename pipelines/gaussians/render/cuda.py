"""The renderer on NVIDIA cards, by Triton, which comes with torch's CUDA builds.

Gradients are summed by atomic additions: their last bits may differ from run to run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import msgs_slam.pipelines.gaussians.render.cards as cards
import msgs_slam.pipelines.gaussians.render.rules as rules
from msgs_slam.pipelines.gaussians.render.cuda_kernels import backward_tile, forward_tile, inspect_tile

__all__ = ["composite", "inspect"]

TILE, STEP = 16, 16


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
    """Feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of float32 tensors on one card."""
    if features.dtype != torch.float32:
        raise ValueError(f"the cuda backend renders float32, got {features.dtype}")
    return _Composite.apply(u, v, sigma_px, z, opacity, features, width, height, proxy_depth, kappa, near)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Median depth (H, W), and summed and largest blending weight of each Gaussian, (M,) each, of float32 tensors on
    one card. In the sums a pixel counts as counts (H, W) says, as 1 where None."""
    geometry = [x.detach() for x in (u, v, sigma_px, z, opacity)]
    starts, members, records = _tiled(geometry, width, height, near)
    counted = records if counts is None else counts.to(records).contiguous()
    median, weights = records.new_empty(height, width), records.new_zeros(2, len(records))
    settings = {key: value for key, value in _settings(False, 1).items() if key not in ("GUIDED", "PADDED")}
    cards.launch(
        inspect_tile, len(starts) - 1, starts, members, records, counted, median, *weights.unbind(0), width, height,
        COUNTED=counts is not None, **settings,
    )  # fmt: skip
    return median, weights[0], weights[1]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        geometry, features = [x.detach() for x in arguments[:5]], arguments[5].detach().contiguous()
        width, height, proxy_depth, kappa, near = arguments[6:]
        guided = proxy_depth is not None and kappa > 0
        proxy = proxy_depth.to(features).contiguous() if guided else features.new_zeros(1)
        starts, members, records = _tiled(geometry, width, height, near)
        image = features.new_empty(height, width, features.shape[1])
        planes = [features.new_empty(height, width) for _ in range(3)]
        inputs = (starts, members, records, features, proxy, kappa)
        settings = _settings(guided, features.shape[1])
        size = (width, height, features.shape[1])
        cards.launch(forward_tile, len(starts) - 1, *inputs, image, *planes, *size, **settings)
        ctx.save_for_backward(*inputs[:5], image, *planes)
        ctx.kappa, ctx.size, ctx.settings = kappa, size, settings
        ctx.set_materialize_grads(False)
        return (image, *planes)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs, images = saved[:5], saved[5:]
        starts, _, records, features, _ = inputs
        upstream = [
            torch.zeros_like(image) if gradient is None else gradient.contiguous()
            for image, gradient in zip(images, gradients, strict=True)
        ]
        d_records, d_features = features.new_zeros(len(records), 5), torch.zeros_like(features)
        results = (d_records, d_features, *ctx.size)
        cards.launch(backward_tile, len(starts) - 1, *inputs, ctx.kappa, *images, *upstream, *results, **ctx.settings)
        return (*d_records.t().contiguous().unbind(0), d_features, *[None] * 5)


def _settings(guided: bool, channels: int) -> dict[str, Any]:
    """Compile-time numbers; matrix products want powers of two, at least 16."""
    padded = max(16, 1 << (channels - 1).bit_length())
    return {
        "GUIDED": guided,
        "PADDED": padded,
        "STEP": STEP,
        "TILE": TILE,
        "ALPHA_MAX": rules.ALPHA_MAX,
        "LIGHT_MIN": rules.TRANSMITTANCE_MIN,
        "num_warps": 8,
    }


def _tiled(geometry: Sequence[Tensor], width: int, height: int, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Starts and members of `list_tiles`, and the Gaussians' records (M, 6)."""
    u, v, sigma_px, z, opacity = geometry
    reach = reach_of(u, v, sigma_px, z, opacity, width, height, near)
    return *list_tiles(u, v, z, reach, width, height), torch.stack([*geometry, reach], dim=1)


def reach_of(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float
) -> Tensor:
    """(M,) pixels from its centre to where a Gaussian ends, 0 where it is not in the image."""
    reach2 = (2 * torch.log((opacity / rules.ALPHA_MIN).clamp(min=1.0))).clamp(max=rules.CUT_SIGMAS**2)
    reach = sigma_px.clamp(min=0) * reach2.sqrt()
    seen = (z > near) & (u + reach >= 0.5) & (u - reach <= width - 0.5)
    return torch.where(seen & (v + reach >= 0.5) & (v - reach <= height - 0.5), reach, 0.0)


def list_tiles(u: Tensor, v: Tensor, z: Tensor, reach: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The Gaussians that may touch tile t, near to far: members[starts[t]:starts[t + 1]]."""
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    order = torch.argsort(z, stable=True)
    x, y, r = u[order], v[order], reach[order]
    left, right = _tile(x - r - 0.5, across), _tile(x + r - 0.5, across)
    top, bottom = _tile(y - r - 0.5, down), _tile(y + r - 0.5, down)
    wide = right - left + 1
    counts = wide * (bottom - top + 1) * (r > 0)
    ends = torch.cumsum(counts, 0)
    # How many pairs there are is the one number that the host has to know.
    pairs = int(ends[-1]) if len(ends) else 0
    owner = torch.repeat_interleave(torch.arange(len(order), device=u.device), counts, output_size=pairs)
    nth = torch.arange(pairs, device=u.device) - (ends - counts)[owner]
    tile = (top[owner] + torch.div(nth, wide[owner], rounding_mode="floor")) * across + left[owner] + nth % wide[owner]
    tile, permutation = torch.sort(tile, stable=True)
    starts = torch.searchsorted(tile, torch.arange(across * down + 1, device=u.device))
    return starts, order[owner[permutation]]


def _tile(pixel: Tensor, count: int) -> Tensor:
    """The tile of a pixel coordinate; clamped before it becomes an integer, which huge floats do not fit."""
    return (pixel / TILE).floor().clamp(0, count - 1).long()
