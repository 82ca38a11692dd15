"""The renderer on NVIDIA cards, by Triton, which comes with torch's CUDA builds.

One program per tile, its pixels in registers, some Gaussians at a time in lanes, as a matrix: within a step the light
before each Gaussian is a running product along the matrix. The forward pass blends by matrix products, on tensor cores
with the digits of float32 ("tf32x3"). The backward pass has none: a tile is one warp's, so that its sums over pixels
need no barrier. Gradients leave a tile with one atomic addition per Gaussian and value: their last bits may differ from
run to run. The interpreter of Triton (environment variable TRITON_INTERPRET=1) runs the kernels on CPU tensors.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..system import gpu
from . import rules
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
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, features: Tensor, width: int, height: int,
    near: float, stats: GaussianStats | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
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
        gpu.launch(divide_pixels, -(-depth.numel() // _BLOCK), above, below, depth, depth.numel(), BLOCK=_BLOCK)
        ctx.save_for_backward(depth, below)
        return depth

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        depth, below = ctx.saved_tensors
        pulls = (gradients[0].contiguous(), torch.empty_like(depth), torch.empty_like(depth))
        gpu.launch(divide_back_pixels, -(-depth.numel() // _BLOCK), depth, below, *pulls, depth.numel(), BLOCK=_BLOCK)
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


# tiles ------------------------------------------------------------------------------------------------------------


@triton.jit
def load_step(
    records: tl.tensor, members: tl.tensor, first: tl.tensor, end: tl.tensor, STEP: tl.constexpr
) -> tl.tensor:
    """The next Gaussians of a tile; those past its end get opacity 0."""
    place = first + tl.arange(0, STEP)
    used = place < end
    index = tl.load(members + place, mask=used, other=0)
    at = records + index * 6
    opacity = tl.where(used, tl.load(at + 4), 0.0)
    return index, used, tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3), opacity, tl.load(at + 5)


@triton.jit
def opacities(
    x: tl.tensor, y: tl.tensor, u: tl.tensor, v: tl.tensor, sigma: tl.tensor, opacity: tl.tensor, reach: tl.tensor,
    ALPHA_MAX: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """(pixels, Gaussians): dx, dy, distance² and the opacity at the pixel, 0 beyond the Gaussian's reach."""
    dx = x[:, None] - u[None, :]
    dy = y[:, None] - v[None, :]
    distance2 = dx * dx + dy * dy
    alpha = opacity[None, :] * tl.exp(distance2 * (-0.5 / (sigma * sigma))[None, :])
    alpha = tl.where(distance2 <= (reach * reach)[None, :], tl.minimum(alpha, ALPHA_MAX), 0.0)
    return dx, dy, distance2, alpha


@triton.jit
def transmittance(light: tl.tensor, occlusion: tl.tensor, STEP: tl.constexpr) -> tl.tensor:
    """(pixels, Gaussians) light that reaches each Gaussian, (pixels,) what is left behind all of them, and (pixels,
    Gaussians) the light before each Gaussian by that behind it."""
    passed = light[:, None] * tl.cumprod(1.0 - occlusion, axis=1)
    last = tl.arange(0, STEP) == STEP - 1
    inverse = 1.0 / (1.0 - occlusion)
    return passed * inverse, tl.sum(tl.where(last[None, :], passed, 0.0), axis=1), inverse


@triton.jit
def pixels_of_tile(width: tl.tensor, height: tl.tensor, TILE: tl.constexpr) -> tl.tensor:
    """This program's tile; index, whether it is inside the image, and centre (x, y) of each of its pixels."""
    tile = tl.program_id(0)
    across = (width + TILE - 1) // TILE
    lane = tl.arange(0, TILE * TILE)
    column, row = (tile % across) * TILE + lane % TILE, (tile // across) * TILE + lane // TILE
    inside = (column < width) & (row < height)
    return tile, row * width + column, inside, column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5


@triton.jit
def forward_tile(
    starts: tl.tensor, members: tl.tensor, records: tl.tensor, features: tl.tensor,
    out_features: tl.tensor, out_depth: tl.tensor, out_depth_seen: tl.tensor, out_seen: tl.tensor,
    width: tl.tensor, height: tl.tensor, channels: tl.tensor,
    PADDED: tl.constexpr, STEP: tl.constexpr, TILE: tl.constexpr,
    ALPHA_MAX: tl.constexpr, LIGHT_MIN: tl.constexpr,
) -> None:  # fmt: skip
    """Blends the Gaussians of one tile and stores its four images; depth and silhouette are two channels more."""
    tile, pixel, inside, x, y = pixels_of_tile(width, height, TILE)
    channel = tl.arange(0, PADDED)
    of_depth, of_seen = (channel == channels)[None, :], (channel == channels + 1)[None, :]
    light = tl.where(inside, 1.0, 0.0)
    image = tl.zeros((TILE * TILE, PADDED), tl.float32)
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(light, axis=0) >= LIGHT_MIN):
        index, used, u, v, sigma, z, opacity, reach = load_step(records, members, first, end, STEP)
        _, _, _, alpha = opacities(x, y, u, v, sigma, opacity, reach, ALPHA_MAX)
        before, light, _ = transmittance(light, alpha, STEP)
        weight = tl.where(before >= LIGHT_MIN, alpha * before, 0.0)
        mask = used[:, None] & (channel < channels)[None, :]
        values = tl.load(features + index[:, None] * channels + channel[None, :], mask=mask, other=0.0)
        values = tl.where(of_seen, 1.0, tl.where(of_depth, z[:, None], values))
        image += tl.dot(weight, values, input_precision="tf32x3")
        first += STEP
    pixels, within = pixel[:, None] + 0 * channel[None, :], inside[:, None]
    of_features = within & (channel < channels)[None, :]
    tl.store(out_features + pixels * channels + channel[None, :], image, mask=of_features)
    tl.store(out_depth + pixels, image, mask=within & of_depth)
    tl.store(out_depth_seen + pixels, image, mask=within & of_seen)
    tl.store(out_seen + pixels, image, mask=within & of_seen)


@triton.jit
def backward_tile(
    starts: tl.tensor, members: tl.tensor, records: tl.tensor, features: tl.tensor,
    image: tl.tensor, depth: tl.tensor, depth_seen: tl.tensor, seen: tl.tensor,
    d_image: tl.tensor, d_depth: tl.tensor, d_depth_seen: tl.tensor, d_seen: tl.tensor,
    d_records: tl.tensor, d_features: tl.tensor, width: tl.tensor, height: tl.tensor,
    CHANNELS: tl.constexpr, STEP: tl.constexpr, TILE: tl.constexpr,
    ALPHA_MAX: tl.constexpr, LIGHT_MIN: tl.constexpr,
) -> None:  # fmt: skip
    """Front to back once more; what is behind a Gaussian is the pixel's total minus what has been blended so far."""
    tile, pixel, inside, x, y = pixels_of_tile(width, height, TILE)
    pull_depth = tl.load(d_depth + pixel, mask=inside, other=0.0)
    pull_depth_seen = tl.load(d_depth_seen + pixel, mask=inside, other=0.0)
    pull_seen = tl.load(d_seen + pixel, mask=inside, other=0.0)
    behind = pull_seen * tl.load(seen + pixel, mask=inside, other=0.0)
    behind += pull_depth * tl.load(depth + pixel, mask=inside, other=0.0)
    behind += pull_depth_seen * tl.load(depth_seen + pixel, mask=inside, other=0.0)
    pull_seen += pull_depth_seen
    for c in range(CHANNELS):
        pull = tl.load(d_image + pixel * CHANNELS + c, mask=inside, other=0.0)
        behind += pull * tl.load(image + pixel * CHANNELS + c, mask=inside, other=0.0)
    light = tl.where(inside, 1.0, 0.0)
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(light, axis=0) >= LIGHT_MIN):
        index, _, u, v, sigma, z, opacity, reach = load_step(records, members, first, end, STEP)
        dx, dy, distance2, alpha = opacities(x, y, u, v, sigma, opacity, reach, ALPHA_MAX)
        before, light, inverse = transmittance(light, alpha, STEP)
        live = before >= LIGHT_MIN
        weight = tl.where(live, alpha * before, 0.0)
        q = pull_depth[:, None] * z[None, :] + pull_seen[:, None]
        # The pulls of pixels are read again, from the cache: kept, they would take the registers of the matrices.
        for c in range(CHANNELS):
            pull = tl.load(d_image + pixel * CHANNELS + c, mask=inside, other=0.0)
            q += pull[:, None] * tl.load(features + index * CHANNELS + c)[None, :]
        left = behind[:, None] - tl.cumsum(weight * q, axis=1)
        behind -= tl.sum(weight * q, axis=1)
        m = tl.where(live & (alpha < ALPHA_MAX), (before * q - left * inverse) * alpha, 0.0)
        touched = tl.max(weight, axis=0) > 0.0
        precision = 1.0 / (sigma * sigma)
        target = d_records + index * 6
        tl.atomic_add(target, tl.sum(m * dx, axis=0) * precision, mask=touched, sem="relaxed")
        tl.atomic_add(target + 1, tl.sum(m * dy, axis=0) * precision, mask=touched, sem="relaxed")
        tl.atomic_add(target + 2, tl.sum(m * distance2, axis=0) * precision / sigma, mask=touched, sem="relaxed")
        tl.atomic_add(target + 3, tl.sum(weight * pull_depth[:, None], axis=0), mask=touched, sem="relaxed")
        tl.atomic_add(target + 4, tl.sum(m, axis=0) / tl.where(touched, opacity, 1.0), mask=touched, sem="relaxed")
        for c in range(CHANNELS):
            pull = tl.load(d_image + pixel * CHANNELS + c, mask=inside, other=0.0)
            of_feature = tl.sum(weight * pull[:, None], axis=0)
            tl.atomic_add(d_features + index * CHANNELS + c, of_feature, mask=touched, sem="relaxed")
        first += STEP


@triton.jit
def inspect_tile(
    starts: tl.tensor, members: tl.tensor, records: tl.tensor, counts: tl.tensor,
    median: tl.tensor, sums: tl.tensor, most: tl.tensor, width: tl.tensor, height: tl.tensor,
    COUNTED: tl.constexpr, STEP: tl.constexpr, TILE: tl.constexpr, ALPHA_MAX: tl.constexpr, LIGHT_MIN: tl.constexpr,
) -> None:  # fmt: skip
    """Stores the median depth of one tile, and adds its blending weights to those of the Gaussians."""
    tile, pixel, inside, x, y = pixels_of_tile(width, height, TILE)
    light = tl.where(inside, 1.0, 0.0)
    depth = tl.zeros((TILE * TILE,), tl.float32)
    count = light
    if COUNTED:
        count = tl.load(counts + pixel, mask=inside, other=0.0)
    first, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (first < end) & (tl.max(light, axis=0) >= LIGHT_MIN):
        index, used, u, v, sigma, z, opacity, reach = load_step(records, members, first, end, STEP)
        _, _, _, alpha = opacities(x, y, u, v, sigma, opacity, reach, ALPHA_MAX)
        before, light, _ = transmittance(light, alpha, STEP)
        weight = tl.where(before >= LIGHT_MIN, alpha * before, 0.0)
        crossing = (before >= 0.5) & (before - weight < 0.5)
        depth += tl.sum(tl.where(crossing, z[None, :], 0.0), axis=1)
        tl.atomic_add(sums + index, tl.sum(weight * count[:, None], axis=0), mask=used)
        tl.atomic_max(most + index, tl.max(weight, axis=0), mask=used)
        first += STEP
    tl.store(median + pixel, depth, mask=inside)


@triton.jit
def divide_pixels(
    above: tl.tensor, below: tl.tensor, depth: tl.tensor, count: tl.tensor, BLOCK: tl.constexpr
) -> None:  # fmt: skip
    """The depth of a block of pixels, 0 where no Gaussian is seen."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < count
    seen = tl.load(below + pixel, mask=inside, other=0.0)
    shown = seen > 1e-6
    found = tl.load(above + pixel, mask=inside, other=0.0) / tl.where(shown, seen, 1.0)
    tl.store(depth + pixel, tl.where(shown, found, 0.0), mask=inside)


@triton.jit
def divide_back_pixels(
    depth: tl.tensor, below: tl.tensor, pull: tl.tensor, d_above: tl.tensor, d_below: tl.tensor, count: tl.tensor,
    BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Gradients of both sums by that of the depth."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < count
    seen = tl.load(below + pixel, mask=inside, other=0.0)
    shown = seen > 1e-6
    share = tl.load(pull + pixel, mask=inside, other=0.0) / tl.where(shown, seen, 1.0)
    share = tl.where(shown, share, 0.0)
    tl.store(d_above + pixel, share, mask=inside)
    tl.store(d_below + pixel, -share * tl.load(depth + pixel, mask=inside, other=0.0), mask=inside)
