"""Which Gaussian goes where: bands of rows, the unit of work of a thread, their tiles, and the walk over these.

Everything is sized by a first counting pass, so a Gaussian may cover any number of bands and tiles. A tile keeps the
state of its pixels in planes of `PIXELS` numbers, row after row of `TILE`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from ..system.lanes import any_lane, iota, lane_exp, load, maximum, min_scalar, splat, store, where
from ..system.threads import PART, Floats, Ints, Longs, for_each, fused_kernel, inner
from . import rules

F32 = np.float32
TILE = 16
PIXELS = TILE * TILE
BAND_ROWS = 32  # two rows of tiles: more would leave threads idle at the end, fewer would split more Gaussians
RECORD = 6
"""Numbers kept per Gaussian of a band: u, v, sigma_px, z, opacity, reach."""

Vectors: TypeAlias = tuple[int, ...] | None
"""A tuple with one 0 per sixteen channels of a pixel, which lie side by side: its type tells the kernels how many
vectors a pixel has. None for three channels, which lie in planes as the rest of a tile's state does:
one vector is sixteen pixels of a channel instead of a pixel's sixteen channels, at two thirds of the time."""

CHECK_EVERY = 32
"""Gaussians between two looks at whether the whole tile is opaque."""

_ALPHA_MIN, _CUT2 = F32(rules.ALPHA_MIN), F32(rules.CUT_SIGMAS**2)
_ALPHA_MAX, _MIN_TRANSMITTANCE = F32(rules.ALPHA_MAX), F32(rules.TRANSMITTANCE_MIN)
_HALF, _ZERO, _ONE, _TWO = F32(0.5), F32(0), F32(1), F32(2)
_WIDE, _CUT = F32(1.001 * rules.ALPHA_MIN * math.exp(rules.CUT_SIGMAS**2 / 2)), F32(rules.CUT_SIGMAS)
"""Gaussians more opaque than the first reach as far as any: to so many deviations."""


def vectors_for(channels: int) -> Vectors:
    """Return how so many channels of a pixel lie."""
    return None if channels == 3 else (0,) * max(1, (channels + 15) // 16)


def padded_channels(channels: int) -> int:
    """Return how many numbers a tile keeps of a pixel's channels, and a band of a Gaussian's."""
    vectors = vectors_for(channels)
    return 3 if vectors is None else 16 * len(vectors)


@inner
def first_pixel(low: np.float32) -> np.int32:
    """The first pixel whose centre is >= low; at least 0."""
    return np.int32(math.ceil(max(low - _HALF, _ZERO)))


@inner
def last_pixel(high: np.float32, size: int) -> np.int32:
    """The last pixel below `size` whose centre is <= high; -1 if there is none."""
    return np.int32(math.floor(max(min(high - _HALF, F32(size - 1)), -_ONE)))


@dataclass(frozen=True)
class ImageBands:
    """Gaussians by the bands of an image that see them: band b sees entries[starts[b]:starts[b + 1]], near to far.

    first (M,): the first band of a Gaussian; slots (M + 1,): Gaussians in several bands own the places
    slots[i]:slots[i + 1], one a band, for what each of them has to say; prepared: per band its records and padded
    features (`gather_band`) and where its tiles look in them (`list_tiles`).
    """

    first: Ints
    starts: Longs
    entries: Ints
    slots: Longs
    prepared: list[tuple[Floats, Floats, Longs, Ints]]

    def __len__(self) -> int:
        return len(self.prepared)

    def own(self, band: int) -> Ints:
        """Indices of the Gaussians of a band, in the order of its records."""
        return self.entries[self.starts[band] : self.starts[band + 1]]

    @property
    def straddling(self) -> Longs:
        """Indices of the Gaussians in several bands."""
        return np.flatnonzero(np.diff(self.slots))


def for_each_band(task: Callable[[int], None], starts: Longs) -> None:
    """Call task(0) .. task(B - 1), those of the most Gaussians first: at the end no thread waits long for another."""
    order = np.argsort(starts[:-1] - starts[1:], kind="stable").tolist()
    for_each(lambda n: task(order[n]), len(order))


def split_into_bands(
    projected: tuple[Floats, ...],
    features: Floats,
    channels: int,
    width: int,
    height: int,
    near: float,
) -> ImageBands:
    """Sort out all about the Gaussians u, v, sigma_px, z, opacity (M,) and features (M, C) that bands need to know."""
    reach, first, starts, entries, slots = bin_gaussians(projected, width, height, near)
    bands = ImageBands(first, starts, entries, slots, [None] * (len(starts) - 1))  # type: ignore[list-item]

    def prepare(band: int) -> None:
        top = band * BAND_ROWS
        own = bands.own(band)
        own[:] = near_to_far(own, projected[3])
        records, padded = gather_band(own, *projected, reach, features, channels)
        bands.prepared[band] = (records, padded, *list_tiles(records, top, width, min(BAND_ROWS, height - top)))

    for_each_band(prepare, starts)
    return bands


def bin_gaussians(
    projected: tuple[Floats, ...], width: int, height: int, near: float
) -> tuple[Floats, Ints, Longs, Ints, Longs]:
    """Find how far from its centre each Gaussian is seen, in pixels (M,), 0 where it is not seen at all; and the first
    four fields of `ImageBands`, entries in the order of their indices."""
    count, bands, parts = len(projected[0]), -(-height // BAND_ROWS), -(-len(projected[0]) // PART)
    reach, (first, last) = np.empty(count, np.float32), np.empty((2, count), np.int32)
    counts = np.zeros((parts, bands), np.int64)

    def own(part: int) -> slice:
        return slice(part * PART, (part + 1) * PART)

    def find(part: int) -> None:
        here, size = own(part), (width, height, F32(near))
        find_bands(*(x[here] for x in projected), *size, reach[here], first[here], last[here], counts[part])

    for_each(find, parts)
    spans = last.astype(np.int64) - first + 1
    slots = np.concatenate([[0], np.cumsum(np.where(spans > 1, spans, 0))])
    starts = np.concatenate([[0], np.cumsum(counts.sum(0))])
    # Of each band the part's own place follows those of the parts before it.
    places = starts[:-1] + np.cumsum(counts, axis=0) - counts
    entries = np.empty(starts[-1], np.int32)
    for_each(lambda part: list_bands(part * PART, first[own(part)], last[own(part)], places[part], entries), parts)
    return reach, first, starts, entries, slots


@fused_kernel
def find_bands(
    u: Floats, v: Floats, sigma_px: Floats, z: Floats, opacity: Floats, width: int, height: int, near: np.float32,
    reach: Floats, first: Ints, last: Ints, counts: Longs,
) -> None:  # fmt: skip
    """Fill in `reach`, 0 where it is not seen, and the `first` and `last` band, 0 and -1 there; counts (B,): how many
    are seen in each band. Nothing branches on what is seen, so that loops become vector instructions."""
    right, bottom = F32(width) - _HALF, F32(height) - _HALF
    for i in range(len(u)):
        reach[i] = sigma_px[i] * _CUT
        if opacity[i] <= _WIDE:
            reach[i] = sigma_px[i] * np.sqrt(min(_CUT2, _TWO * np.log(max(opacity[i], _ALPHA_MIN) / _ALPHA_MIN)))
    for i in range(len(u)):
        r = reach[i]
        top, low = first_pixel(min(v[i] - r, bottom + _ONE)), last_pixel(v[i] + r, height)
        seen = (z[i] > near) & (opacity[i] > _ALPHA_MIN) & (r > 0) & (low >= top)  # else between two rows of pixels
        seen &= (u[i] + r >= _HALF) & (u[i] - r <= right) & (v[i] + r >= _HALF) & (v[i] - r <= bottom)
        reach[i] = r if seen else _ZERO
        first[i], last[i] = top // BAND_ROWS if seen else 0, low // BAND_ROWS if seen else -1
    steps = np.zeros(len(counts) + 1, np.int64)
    for i in range(len(u)):
        steps[first[i]] += 1
        steps[last[i] + 1] -= 1
    for band in range(len(counts)):
        counts[band] = steps[band]
        if band > 0:
            counts[band] += counts[band - 1]


@fused_kernel
def list_bands(start: int, first: Ints, last: Ints, places: Longs, entries: Ints) -> None:
    """Enter the indices, from `start` on, of Gaussians with a `first` and `last` band into the `entries` of those,
    from the band's own of `places` (B,) on, which move along."""
    for i in range(len(first)):
        for band in range(first[i], last[i] + 1):
            entries[places[band]] = start + i
            places[band] += 1


def near_to_far(entries: Ints, z: Floats) -> Ints:
    """Sort indices by z > 0, equal depths in the order of their indices.

    The bits of positive floats sort as the floats do: with the index behind them all keys differ, and numpy's fastest
    sort, which is not stable, gives one result.
    """
    keys = z[entries].view(np.uint32).astype(np.uint64) << np.uint64(32) | entries.astype(np.uint64)
    keys.sort()
    return keys.astype(np.uint32).view(np.int32)


@fused_kernel
def gather_band(
    entries: Ints, u: Floats, v: Floats, sigma_px: Floats, z: Floats, opacity: Floats, reach: Floats, features: Floats,
    channels: int,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Copy the band's Gaussians side by side: records (n * RECORD,) and features padded with 0 to (n * channels,)."""
    records = np.empty(len(entries) * RECORD, np.float32)
    padded = np.zeros(len(entries) * channels, np.float32)
    for k in range(len(entries)):
        i, at = entries[k], k * RECORD
        records[at], records[at + 1], records[at + 2] = u[i], v[i], sigma_px[i]
        records[at + 3], records[at + 4], records[at + 5] = z[i], opacity[i], reach[i]
        for c in range(features.shape[1]):
            padded[k * channels + c] = features[i, c]
    return records, padded


@fused_kernel
def list_tiles(records: Floats, top: int, width: int, rows: int) -> tuple[Longs, Ints]:
    """List who may touch tile t of a band from row `top`, near to far: members[starts[t]:starts[t + 1]]."""
    count = len(records) // RECORD
    across, down = (width + TILE - 1) // TILE, (rows + TILE - 1) // TILE
    boxes = np.empty((4, count), np.int32)
    for k in range(count):
        x, y, r = records[k * RECORD], records[k * RECORD + 1] - F32(top), records[k * RECORD + 5]
        boxes[0, k], boxes[1, k] = first_pixel(x - r) // TILE, last_pixel(x + r, width) // TILE
        boxes[2, k], boxes[3, k] = first_pixel(y - r) // TILE, last_pixel(y + r, rows) // TILE
    starts = _tile_starts(boxes, across, down)
    # Most touch two by two tiles or fewer: a loop of so many steps would be guessed wrongly. What is none of them goes
    # to a place behind all.
    nowhere, ends = starts[across * down], starts.copy()
    members = np.empty(nowhere + 1, np.int32)
    for k in range(count):
        x0, x1, y0, y1 = boxes[0, k], boxes[1, k], boxes[2, k], boxes[3, k]
        if x1 - x0 > 1 or y1 - y0 > 1:
            for y_tile in range(y0, y1 + 1):
                for x_tile in range(x0, x1 + 1):
                    members[ends[y_tile * across + x_tile]] = k
                    ends[y_tile * across + x_tile] += 1
        elif x1 >= x0 and y1 >= y0:
            for tile, touched in (
                (y0 * across + x0, True), (y0 * across + x1, x1 > x0), (y1 * across + x0, y1 > y0),
                (y1 * across + x1, x1 > x0 and y1 > y0),
            ):  # fmt: skip
                members[ends[tile] if touched else nowhere] = k
                ends[tile] += touched
    return starts, members[:nowhere]


@inner
def _tile_starts(boxes: Ints, across: int, down: int) -> Longs:
    """Starts of the tiles' members, row by row, and the end (T + 1,): a box x0, x1, y0, y1 of tiles is counted at its
    corners, which are then summed up along both axes."""
    wide = across + 1
    corners = np.zeros((down + 1) * wide, np.int64)
    for k in range(boxes.shape[1]):
        x0, x1, y0, y1 = boxes[0, k], boxes[1, k] + 1, wide * boxes[2, k], wide * (boxes[3, k] + 1)
        corners[y0 + x0] += 1
        corners[y0 + x1] -= 1
        corners[y1 + x0] -= 1
        corners[y1 + x1] += 1
    starts = np.zeros(across * down + 1, np.int64)
    for y in range(down):
        row = 0
        for x in range(across):
            row += corners[wide * y + x]
            above = corners[wide * (y - 1) + x] if y > 0 else 0
            corners[wide * y + x] = row + above
            starts[across * y + x + 1] = starts[across * y + x] + row + above
    return starts


@inner
def clear(numbers: Floats) -> None:
    """Fill with zeros. A slice assignment does the same but takes long to compile."""
    for i in range(len(numbers)):
        numbers[i] = _ZERO


@inner
def is_opaque(light: Floats) -> bool:
    """Whether no pixel of the tile takes any more light."""
    most = load(light, 0)
    for y in range(1, TILE):
        most = maximum(most, load(light, TILE * y))
    return not any_lane(most >= _MIN_TRANSMITTANCE)


@inner
def row_opacity(y: int, light: Any, falloff_y: Floats, pair: tuple[Any, ...]) -> Any:
    """Return the opacity of a Gaussian in row y of a tile, 0 where it ends or no light arrives; see `walk_tiles`."""
    falloff_x, _, dx2, center, reach2, _ = pair
    dy = F32(y) + _HALF - center
    alpha = min_scalar(falloff_x * falloff_y[y], _ALPHA_MAX)
    return where((dx2 <= splat(reach2 - dy * dy)) & (light >= _MIN_TRANSMITTANCE), alpha)


@inner
def walk_tiles(
    visitors: tuple[Any, ...], job: tuple[Any, ...], kind: Any, band: int, tile_starts: Longs, members: Ints,
    records: Floats, width: int, height: int,
) -> None:  # fmt: skip
    """Walk over the tiles of a band, and over each one's Gaussians near to far, until the tile is opaque.

    An isotropic Gaussian is a product of a function of x and one of y: a tile needs two vectors of exponentials for it,
    not one per row.

    Args:
        visitors: functions that become part of the loop: open(job, kind, light, tile) and close(job, kind, light, tile)
            of a tile = (left, top, columns, rows) of the image, and visit(job, kind, light, falloff_y, i, box, pair) of
            the Gaussian of record i. It reaches the box = (x0, x1, y0, y1) of the tile, both ends included; pair =
            (falloff_x, dx, dx2, centre's y in the tile, reach², depth), the first three of 16 columns; the opacity is
            falloff_x * falloff_y[y], see `row_opacity`. It takes the light (PIXELS,) that the Gaussian stops.
        job: what the visitors work on.
        kind: handed to them apart from the job: its type may decide which of their branches are compiled.
        band: number of the band.
        tile_starts, members, records: of the band, see `ImageBands`.
        width, height: of the image.
    """
    open_tile, visit, close_tile = visitors
    band_top, across = band * BAND_ROWS, (width + TILE - 1) // TILE
    light, falloff_y = np.empty(PIXELS, np.float32), np.empty(TILE, np.float32)
    for tile in range(len(tile_starts) - 1):
        left, top = TILE * (tile % across), band_top + TILE * (tile // across)
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        # No light for what is no part of the image, so that nothing is blended there.
        clear(light)
        for y in range(rows):
            for x in range(columns):
                light[TILE * y + x] = _ONE
        open_tile(job, kind, light, (left, top, columns, rows))
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = members[k]
            at = RECORD * i
            u, v, reach = records[at] - F32(left), records[at + 1] - F32(top), records[at + 5]
            x0, x1 = first_pixel(u - reach), last_pixel(u + reach, columns)
            y0, y1 = first_pixel(v - reach), last_pixel(v + reach, rows)
            if x1 < x0 or y1 < y0:
                continue
            sharpness = -_HALF / (records[at + 2] * records[at + 2])
            dx, dy = iota(_HALF - u), iota(_HALF - v)
            dx2 = dx * dx
            store(falloff_y, 0, lane_exp(dy * dy * sharpness) * records[at + 4])
            pair = (lane_exp(dx2 * sharpness), dx, dx2, v, reach * reach, records[at + 3])
            visit(job, kind, light, falloff_y, i, (x0, x1, y0, y1), pair)
            if k % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(light):
                break
        close_tile(job, kind, light, (left, top, columns, rows))
