"""Triton kernels of the mapping loss beside the photo's: `losses` on a card, value and gradient in one pass.

The sums are atomic additions: their last bits may differ from run to run. The interpreter of Triton (environment
variable TRITON_INTERPRET=1) runs these kernels on CPU tensors.
"""

from __future__ import annotations

import triton
import triton.language as tl

from .photo_kernels import scene_at


@triton.jit
def compare_maps(
    depth: tl.tensor, silhouette: tl.tensor, proxy: tl.tensor, reliability: tl.tensor, scene: tl.tensor,
    loss: tl.tensor, d_depth: tl.tensor, d_silhouette: tl.tensor, pixels: tl.tensor, by_silhouette: tl.tensor,
    by_depth: tl.tensor, NU: tl.constexpr, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Add up the terms of silhouette and depth over a block of pixels, each times its weight and a mean over all."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    is_scene = scene_at(scene, pixel, inside, MASKED)
    missing = tl.where(is_scene, 1.0 - tl.load(silhouette + pixel, mask=inside, other=0.0), 0.0)
    tl.store(d_silhouette + pixel, tl.where(is_scene, -by_silhouette / pixels, 0.0), mask=inside)
    known = tl.load(proxy + pixel, mask=inside, other=0.0)
    trust = tl.minimum(NU * (tl.load(reliability + pixel, mask=inside, other=0).to(tl.float32) / 255), 1.0)
    trust = tl.where(known > 0, trust, 0.0)
    off = tl.load(depth + pixel, mask=inside, other=0.0) - known
    side = tl.where(off > 0, 1.0, 0.0) - tl.where(off < 0, 1.0, 0.0)
    tl.store(d_depth + pixel, by_depth / pixels * trust * side, mask=inside)
    total = by_silhouette * missing + by_depth * trust * tl.abs(off)
    tl.atomic_add(loss, tl.sum(tl.where(inside, total, 0.0), axis=0) / pixels)


@triton.jit
def weigh_sizes(
    log_radii: tl.tensor, in_view: tl.tensor, number: tl.tensor, loss: tl.tensor, d_log_radii: tl.tensor,
    limit: tl.tensor, count: tl.tensor, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The squared excess of log radii over the limit, a mean over the `number` (one number on the card) in view."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    seen = tl.load(in_view + row, mask=inside, other=0) != 0
    excess = tl.maximum(tl.load(log_radii + row, mask=inside, other=0.0) - limit, 0.0)
    share = tl.where(seen, excess, 0.0) / tl.maximum(tl.load(number), 1).to(tl.float32)
    tl.store(d_log_radii + row, 2.0 * share, mask=inside)
    tl.atomic_add(loss, tl.sum(share * excess, axis=0))
