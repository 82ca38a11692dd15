"""The renderer on NVIDIA cards, by Triton, which comes with torch's CUDA builds.

Gradients are summed by atomic additions: their last bits may differ from run to run.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..system import gpu
from . import rules
from .cuda_kernels import backward_tile, divide_back_pixels, divide_pixels, forward_tile, inspect_tile
from .cuda_projection import project, record
from .rules import GaussianStats

__all__ = ["composite", "composite_records", "depth_ratio", "inspect", "inspect_records", "list_tiles", "project"]

STEP, STEP_BACK = 16, 4
"""Gaussians at a time, forward and backward."""
TILE = 8
"""Pixels along a tile."""
_WARPS, _WARPS_BACK = 2, 1
_BLOCK, _TILE_BLOCK = 1024, 256


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
    """Return the feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of tensors on one GPU."""
    records = record((u, v, sigma_px, z, opacity), width, height, near)
    return composite_records(records, features, width, height, stats)


def composite_records(
    records: Tensor, features: Tensor, width: int, height: int, stats: GaussianStats | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same of the Gaussians' records (M, 6); the backward pass fills the stats."""
    if features.dtype != torch.float32:
        raise ValueError(f"the cuda backend renders float32, got {features.dtype}")
    return _Composite.apply(records, features, width, height, stats)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Median depth (H, W), and summed and largest blending weight of each Gaussian, (M,) each, of float32 tensors on
    one card. In the sums a pixel counts as counts (H, W) says, as 1 where None."""
    return inspect_records(record((u, v, sigma_px, z, opacity), width, height, near), width, height, counts)


def inspect_records(
    records: Tensor, width: int, height: int, counts: Tensor | None, tiles: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The same of the Gaussians' records (M, 6)."""
    records = records.detach()
    starts, members = tiles or list_tiles(records, width, height)
    counted = records if counts is None else counts.to(records).contiguous()
    median, weights = records.new_empty(height, width), records.new_zeros(2, len(records))
    settings = {key: value for key, value in _settings(1).items() if key != "PADDED"}
    gpu.launch(
        inspect_tile, len(starts) - 1, starts, members, records, counted, median, *weights.unbind(0), width, height,
        COUNTED=counts is not None, **settings,
    )  # fmt: skip
    return median, weights[0], weights[1]


def depth_ratio(depth_sum: Tensor, depth_silhouette: Tensor) -> Tensor:
    """Divide sums as `api.depth_ratio`, of tensors on one GPU."""
    return _Ratio.apply(depth_sum, depth_silhouette)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        records, features = (x.detach().contiguous() for x in arguments[:2])
        width, height, ctx.stats = arguments[2:]
        starts, members = list_tiles(records, width, height)
        image = features.new_empty(height, width, features.shape[1])
        planes = [features.new_empty(height, width) for _ in range(3)]
        inputs = (starts, members, records, features)
        settings = _settings(features.shape[1])
        size = (width, height, features.shape[1])
        gpu.launch(forward_tile, len(starts) - 1, *inputs, image, *planes, *size, **settings)
        ctx.save_for_backward(*inputs, image, *planes)
        ctx.size = size
        ctx.set_materialize_grads(False)
        return (image, *planes)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs, images = saved[:4], saved[4:]
        starts, members, records, features = inputs
        if ctx.stats is not None:
            width, height, _ = ctx.size
            ctx.stats.fill(lambda counts: inspect_records(records, width, height, counts, (starts, members)))
        upstream = [
            torch.zeros_like(image) if gradient is None else gradient.contiguous()
            for image, gradient in zip(images, gradients, strict=True)
        ]
        results = features.new_zeros(records.numel() + features.numel()).split([records.numel(), features.numel()])
        given = (*results, *ctx.size[:2])
        gpu.launch(backward_tile, len(starts) - 1, *inputs, *images, *upstream, *given, **_back_settings(ctx.size[2]))
        return results[0].view_as(records), results[1].view_as(features), *[None] * 3


class _Ratio(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> Tensor:
        above, below = (x.detach().contiguous() for x in arguments)
        depth = torch.empty_like(above)
        gpu.launch(
            divide_pixels, -(-depth.numel() // _BLOCK), above, below, depth, depth.numel(), BLOCK=_BLOCK
        )  # fmt: skip
        ctx.save_for_backward(depth, below)
        return depth

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        depth, below = ctx.saved_tensors
        pulls = (gradients[0].contiguous(), torch.empty_like(depth), torch.empty_like(depth))
        gpu.launch(
            divide_back_pixels, -(-depth.numel() // _BLOCK), depth, below, *pulls, depth.numel(), BLOCK=_BLOCK
        )  # fmt: skip
        return pulls[1], pulls[2]


def _settings(channels: int) -> dict[str, Any]:
    """Compile-time numbers; matrix products want powers of two, at least 16, and depth and silhouette are channels."""
    padded = max(16, 1 << (channels + 1).bit_length())
    return {
        "PADDED": padded,
        "STEP": STEP,
        "TILE": TILE,
        "ALPHA_MAX": rules.ALPHA_MAX,
        "LIGHT_MIN": rules.TRANSMITTANCE_MIN,
        "num_warps": _WARPS,
    }


def _back_settings(channels: int) -> dict[str, Any]:
    """The same of the backward pass, which pads no channels."""
    rest = {key: value for key, value in _settings(channels).items() if key != "PADDED"}
    return rest | {"CHANNELS": channels, "STEP": STEP_BACK, "num_warps": _WARPS_BACK}


def list_tiles(records: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The Gaussians (of records (M, 6)) that may touch tile t, near to far, ties by index:
    members[starts[t]:starts[t + 1]].

    How many pairs there are is the one number that the host has to know.
    """
    count, tiles = len(records), -(-width // TILE) * -(-height // TILE)
    touched = torch.empty(count, dtype=torch.int64, device=records.device)
    settings = {"TILE": TILE, "BLOCK": _TILE_BLOCK}
    gpu.launch(count_tiles, -(-count // _TILE_BLOCK), records, touched, width, height, count, **settings)
    ends = torch.cumsum(touched, 0)
    pairs = int(ends[-1]) if count else 0
    keys, owners, members = torch.empty(3, pairs, dtype=torch.int64, device=records.device).unbind(0)
    gpu.launch(
        list_pairs, -(-pairs // _TILE_BLOCK), records, ends, keys, owners, width, height, count, pairs, **settings
    )  # fmt: skip
    keys, order = torch.sort(keys, stable=True)
    starts = torch.empty(tiles + 1, dtype=torch.int64, device=records.device)
    programs = -(-max(pairs, tiles + 1) // _TILE_BLOCK)
    gpu.launch(order_members, programs, keys, order, owners, members, starts, pairs, tiles, BLOCK=_TILE_BLOCK)
    return starts, members


@triton.jit
def tiles_around(
    records: tl.tensor, row: tl.tensor, inside: tl.tensor, width: tl.tensor, height: tl.tensor, TILE: tl.constexpr
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor, tl.tensor]:
    """Left column and top row of the tiles that Gaussians may touch, how many across and down, and their reaches."""
    at = records + row * 6
    u, v = tl.load(at, mask=inside, other=0.0), tl.load(at + 1, mask=inside, other=0.0)
    reach = tl.load(at + 5, mask=inside, other=0.0)
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    left, right = tile_of(u - reach - 0.5, across, TILE), tile_of(u + reach - 0.5, across, TILE)
    top, bottom = tile_of(v - reach - 0.5, down, TILE), tile_of(v + reach - 0.5, down, TILE)
    return left, top, right - left + 1, bottom - top + 1, reach


@triton.jit
def tile_of(pixel: tl.tensor, count: tl.tensor, TILE: tl.constexpr) -> tl.tensor:
    """The tile of a pixel coordinate; clamped before it becomes an integer, which huge floats do not fit."""
    return tl.minimum(tl.maximum(tl.floor(pixel / TILE), 0.0), count - 1.0).to(tl.int32)


@triton.jit
def count_tiles(
    records: tl.tensor, touched: tl.tensor, width: tl.tensor, height: tl.tensor, count: tl.tensor,
    TILE: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Count the tiles that each Gaussian may touch."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    _, _, wide, tall, reach = tiles_around(records, row, inside, width, height, TILE)
    tl.store(touched + row, tl.where(reach > 0, wide * tall, 0).to(tl.int64), mask=inside)


@triton.jit
def entries_up_to(ascending: tl.tensor, count: tl.tensor, value: tl.tensor) -> tl.tensor:
    """Count the ascending numbers that are at most each value, by halving."""
    low = value * 0
    high = low + count
    while tl.max(high - low, axis=0) > 0:
        middle = (low + high) // 2
        searched = low < high
        below = searched & (tl.load(ascending + middle, mask=searched, other=0) <= value)
        high = tl.where(searched & (below == 0), middle, high)
        low = tl.where(below, middle + 1, low)
    return low


@triton.jit
def list_pairs(
    records: tl.tensor, ends: tl.tensor, keys: tl.tensor, owners: tl.tensor, width: tl.tensor, height: tl.tensor,
    count: tl.tensor, pairs: tl.tensor, TILE: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Of a block of pairs of a tile and a Gaussian: the Gaussian, and a key that sorts by tile, then by depth."""
    pair = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = pair < pairs
    owner = tl.where(inside, entries_up_to(ends, count, tl.where(inside, pair, 0)), 0)
    left, top, wide, _, _ = tiles_around(records, owner, inside, width, height, TILE)
    nth = pair - tl.load(ends + owner - 1, mask=inside & (owner > 0), other=0)
    tile = (top + nth // wide) * ((width + TILE - 1) // TILE) + left + nth % wide
    # As integers the bits of floats ascend, but for those of negative ones.
    bits = tl.load(records + owner * 6 + 3, mask=inside, other=0.0).to(tl.int32, bitcast=True)
    bits = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    tl.store(keys + pair, (tile.to(tl.int64) << 32) + (bits.to(tl.int64) + 0x80000000), mask=inside)
    tl.store(owners + pair, owner, mask=inside)


@triton.jit
def order_members(
    keys: tl.tensor, order: tl.tensor, owners: tl.tensor, members: tl.tensor, starts: tl.tensor, pairs: tl.tensor,
    tiles: tl.tensor, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The Gaussians of a block of sorted pairs, and where a block of tiles starts among them."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = place < pairs
    taken = tl.load(order + place, mask=inside, other=0)
    tl.store(members + place, tl.load(owners + taken, mask=inside, other=0), mask=inside)
    tl.store(starts + place, entries_up_to(keys, pairs, (place << 32) - 1), mask=place <= tiles)
