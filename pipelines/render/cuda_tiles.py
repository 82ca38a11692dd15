"""Which Gaussians may touch which tile of an image, near to far: lists made and sorted on the card."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..compute import gpu

TILE = 16
"""Pixels along a tile."""
_BLOCK = 256


def list_tiles(records: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """The Gaussians (of records (M, 6)) that may touch tile t, near to far, ties by index:
    members[starts[t]:starts[t + 1]].

    How many pairs there are is the one number that the host has to know.
    """
    count, tiles = len(records), -(-width // TILE) * -(-height // TILE)
    touched = torch.empty(count, dtype=torch.int64, device=records.device)
    settings = {"TILE": TILE, "BLOCK": _BLOCK}
    gpu.launch(count_tiles, -(-count // _BLOCK), records, touched, width, height, count, **settings)
    ends = torch.cumsum(touched, 0)
    pairs = int(ends[-1]) if count else 0
    keys, owners, members = torch.empty(3, pairs, dtype=torch.int64, device=records.device).unbind(0)
    gpu.launch(
        list_pairs, -(-pairs // _BLOCK), records, ends, keys, owners, width, height, count, pairs, **settings
    )  # fmt: skip
    keys, order = torch.sort(keys, stable=True)
    starts = torch.empty(tiles + 1, dtype=torch.int64, device=records.device)
    programs = -(-max(pairs, tiles + 1) // _BLOCK)
    gpu.launch(order_members, programs, keys, order, owners, members, starts, pairs, tiles, BLOCK=_BLOCK)
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
    """How many tiles each Gaussian may touch."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    _, _, wide, tall, reach = tiles_around(records, row, inside, width, height, TILE)
    tl.store(touched + row, tl.where(reach > 0, wide * tall, 0).to(tl.int64), mask=inside)


@triton.jit
def entries_up_to(ascending: tl.tensor, count: tl.tensor, value: tl.tensor) -> tl.tensor:
    """How many of the ascending numbers are at most each value, by halving."""
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
