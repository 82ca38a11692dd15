"""Triton kernels of stereo: the loops of `sweep`, `volume`, `refine` and `consistency` for a GPU.

Pictures and volumes are flat, row by row; (BLOCK, TAPS) is a block of pixels by the pixels of their windows. The
interpreter of Triton (environment variable TRITON_INTERPRET=1) runs these kernels on CPU tensors.
"""

import triton
import triton.language as tl


@triton.jit
def clamp_to(place: tl.tensor, count: tl.tensor) -> tl.tensor:
    """Rows or columns of a picture whose border is repeated outwards."""
    return tl.minimum(tl.maximum(place, 0), count - 1)


@triton.jit
def taps_of(
    pixel: tl.tensor, width: tl.tensor, height: tl.tensor, SIDE: tl.constexpr, STEP: tl.constexpr, RADIUS: tl.constexpr
) -> tuple[tl.tensor, tl.tensor]:
    """Row and column of each pixel of the windows of a block of pixels."""
    tap = tl.arange(0, SIDE * SIDE)
    row = clamp_to((pixel // width)[:, None] + (tap // SIDE * STEP - RADIUS)[None, :], height)
    return row, clamp_to((pixel % width)[:, None] + (tap % SIDE * STEP - RADIUS)[None, :], width)


@triton.jit
def weigh_taps(
    image: tl.tensor, pixel: tl.tensor, inside: tl.tensor, row: tl.tensor, column: tl.tensor, width: tl.tensor,
    narrow: tl.tensor,
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor]:  # fmt: skip
    """The windows' weights, of sum 1, the weights times intensity, and mean and variance of each window."""
    middle = tl.load(image + pixel, mask=inside, other=0.0)
    value = tl.load(image + row * width + column, mask=inside[:, None], other=0.0)
    off = value - middle[:, None]
    weight = tl.exp(narrow * off * off) + 1e-6
    weight = weight / tl.sum(weight, axis=1)[:, None]
    weighted = weight * value
    mean = tl.sum(weighted, axis=1)
    return weight, weighted, mean, tl.maximum(tl.sum(weighted * value, axis=1) - mean * mean, 0.0)


@triton.jit
def warp_to(
    warp: tl.tensor, u: tl.tensor, v: tl.tensor, inverse: tl.tensor
) -> tuple[tl.tensor, tl.tensor, tl.tensor]:  # fmt: skip
    """Where pixels (u, v) of inverse depths lie in another view, and their third coordinate there."""
    x = tl.load(warp) * u + tl.load(warp + 1) * v + tl.load(warp + 2) + tl.load(warp + 3) * inverse
    y = tl.load(warp + 4) * u + tl.load(warp + 5) * v + tl.load(warp + 6) + tl.load(warp + 7) * inverse
    z = tl.load(warp + 8) * u + tl.load(warp + 9) * v + tl.load(warp + 10) + tl.load(warp + 11) * inverse
    scale = 1.0 / tl.maximum(z, 1e-6)
    return x * scale - 0.5, y * scale - 0.5, z


@triton.jit
def sample_at(
    other: tl.tensor, across: tl.tensor, down: tl.tensor, inside: tl.tensor, width: tl.tensor, height: tl.tensor
) -> tl.tensor:
    """Bilinear samples of a picture, its border repeated."""
    across = tl.minimum(tl.maximum(across, 0.0), width - 1.001)
    down = tl.minimum(tl.maximum(down, 0.0), height - 1.001)
    left, up = across.to(tl.int32), down.to(tl.int32)
    at = other + up * width + left
    right, low = across - left.to(tl.float32), down - up.to(tl.float32)
    a, b = tl.load(at, mask=inside, other=0.0), tl.load(at + 1, mask=inside, other=0.0)
    c, d = tl.load(at + width, mask=inside, other=0.0), tl.load(at + width + 1, mask=inside, other=0.0)
    top, bottom = a + right * (b - a), c + right * (d - c)
    return top + low * (bottom - top)


@triton.jit
def best_score(
    others: tl.tensor, warps: tl.tensor, views: tl.tensor, pixel: tl.tensor, inside: tl.tensor, row: tl.tensor,
    column: tl.tensor, own: tl.tensor, inverse: tl.tensor, weight: tl.tensor, weighted: tl.tensor, mean: tl.tensor,
    variance: tl.tensor, width: tl.tensor, height: tl.tensor,
    BEST: tl.constexpr, VIEWS: tl.constexpr, FLOOR: tl.constexpr, OUTSIDE: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """The mean of the BEST largest correlations among the views that see a pixel, 0 where none does; `own` (BLOCK,) and
    `inverse` (BLOCK, TAPS): inverse depths of the pixels and of those of their windows."""
    place = tl.arange(0, VIEWS)
    scores = tl.full((weight.shape[0], VIEWS), OUTSIDE, tl.float32)
    u, v = column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5
    middle_u, middle_v = (pixel % width).to(tl.float32) + 0.5, (pixel // width).to(tl.float32) + 0.5
    for n in range(views):
        across, down, z = warp_to(warps + 12 * n, middle_u, middle_v, own)
        seen = (z > 1e-6) & (across >= -0.5) & (down >= -0.5) & (across <= width - 0.501) & (down <= height - 0.501)
        across, down, _ = warp_to(warps + 12 * n, u, v, inverse)
        value = sample_at(others + n * width * height, across, down, inside[:, None], width, height)
        part = weight * value
        total = tl.sum(part, axis=1)
        spread = tl.maximum(tl.sum(part * value, axis=1) - total * total, 0.0)
        score = tl.sum(weighted * value, axis=1) - total * mean
        score = score / tl.sqrt((spread + FLOOR) * (variance + FLOOR))
        # Samples of what is no scene are NaN, and so is what is made of them: it compares with nothing.
        score = tl.where(seen & (score > OUTSIDE), score, OUTSIDE)
        scores = tl.where((place == n)[None, :], score[:, None], scores)
    total, used = mean * 0.0, mean * 0.0
    for _ in tl.static_range(BEST):
        top, first = tl.max(scores, axis=1), tl.argmax(scores, axis=1)
        total += tl.where(top > OUTSIDE, top, 0.0)
        used += tl.where(top > OUTSIDE, 1.0, 0.0)
        scores = tl.where(place[None, :] == first[:, None], OUTSIDE, scores)
    return total / tl.maximum(used, 1.0)


@triton.jit
def sweep_pixels(
    image: tl.tensor, others: tl.tensor, warps: tl.tensor, planes: tl.tensor, cost: tl.tensor, views: tl.tensor,
    count: tl.tensor, width: tl.tensor, height: tl.tensor, narrow: tl.tensor,
    BEST: tl.constexpr, VIEWS: tl.constexpr, FLOOR: tl.constexpr, OUTSIDE: tl.constexpr, SIDE: tl.constexpr,
    STEP: tl.constexpr, RADIUS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Cost 1 - score of every one of `count` inverse depths, side by side for each of a block of pixels."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < width * height
    row, column = taps_of(pixel, width, height, SIDE, STEP, RADIUS)
    weight, weighted, mean, variance = weigh_taps(image, pixel, inside, row, column, width, narrow)
    for d in range(count):
        plane = tl.load(planes + d)
        score = best_score(
            others, warps, views, pixel, inside, row, column, mean * 0.0 + plane, weight * 0.0 + plane, weight,
            weighted, mean, variance, width, height, BEST, VIEWS, FLOOR, OUTSIDE,
        )  # fmt: skip
        tl.store(cost + pixel.to(tl.int64) * count + d, 1.0 - score, mask=inside)


@triton.jit
def refine_pixels(
    image: tl.tensor, others: tl.tensor, warps: tl.tensor, inverse: tl.tensor, refined: tl.tensor, views: tl.tensor,
    width: tl.tensor, height: tl.tensor, narrow: tl.tensor, step: tl.tensor, stiffness: tl.tensor,
    REACH: tl.constexpr, MOVES: tl.constexpr, BEST: tl.constexpr, VIEWS: tl.constexpr, FLOOR: tl.constexpr,
    OUTSIDE: tl.constexpr, SIDE: tl.constexpr, STEP: tl.constexpr, RADIUS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """`refine_inverse_depth` of a block of pixels; MOVES: a power of two above 2 REACH."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < width * height
    row, column = taps_of(pixel, width, height, SIDE, STEP, RADIUS)
    weight, weighted, mean, variance = weigh_taps(image, pixel, inside, row, column, width, narrow)
    own = tl.load(inverse + pixel, mask=inside, other=0.0)
    around = tl.load(inverse + row * width + column, mask=inside[:, None], other=0.0)
    move = tl.arange(0, MOVES)
    totals = tl.full((BLOCK, MOVES), float("-inf"), tl.float32)
    for d in range(2 * REACH + 1):
        offset = (d - REACH) * step
        score = best_score(
            others, warps, views, pixel, inside, row, column, own + offset, around + offset, weight, weighted, mean,
            variance, width, height, BEST, VIEWS, FLOOR, OUTSIDE,
        )  # fmt: skip
        score -= stiffness * ((d - REACH) * (d - REACH))
        totals = tl.where((move == d)[None, :], score[:, None], totals)
    # The middle counts first where several are as good.
    stay = tl.sum(tl.where((move == REACH)[None, :], totals, 0.0), axis=1)
    best = tl.argmax(totals, axis=1)
    best = tl.where(tl.max(totals, axis=1) > stay, best, REACH)
    left, middle, right = at_move(totals, best - 1), at_move(totals, best), at_move(totals, best + 1)
    bend = 2.0 * middle - left - right
    bends = (best > 0) & (best < 2 * REACH) & (bend > 1e-6)
    offset = (best - REACH).to(tl.float32) + tl.where(bends, 0.5 * (right - left) / tl.where(bends, bend, 1.0), 0.0)
    tl.store(refined + pixel, own + offset * step, mask=inside)


@triton.jit
def at_move(totals: tl.tensor, place: tl.tensor) -> tl.tensor:
    """One of each pixel's totals, 0 beyond them."""
    move = tl.arange(0, totals.shape[1])
    return tl.sum(tl.where(move[None, :] == place[:, None], totals, 0.0), axis=1)


@triton.jit
def scan_paths(
    cost: tl.tensor, image: tl.tensor, starts: tl.tensor, total: tl.tensor, width: tl.tensor, height: tl.tensor,
    down: tl.tensor, across: tl.tensor, count: tl.tensor, small: tl.tensor, large: tl.tensor, edge: tl.tensor,
    PLANES: tl.constexpr,
) -> None:  # fmt: skip
    """`smoothing` along one path: its first pixel is `starts[program]`, the next `down` rows and `across` columns
    on; PLANES: a power of two, at least `count`."""
    first = tl.load(starts + tl.program_id(0))
    y, x = first // width, first % width
    plane = tl.arange(0, PLANES)
    used = plane < count
    before, lowest = tl.where(used, 0.0, 1e9), 0.0
    intensity = tl.load(image + first)
    while (y >= 0) & (y < height) & (x >= 0) & (x < width):
        at = y * width + x
        here = tl.load(image + at)
        jump = lowest + tl.maximum(large / (1.0 + tl.abs(here - intensity) / edge), small)
        intensity = here
        under = tl.where(plane > 0, tl.gather(before, tl.maximum(plane - 1, 0), 0), 1e9)
        over = tl.where(plane < PLANES - 1, tl.gather(before, tl.minimum(plane + 1, PLANES - 1), 0), 1e9)
        way = tl.minimum(tl.minimum(before, jump), tl.minimum(under, over) + small)
        place = at * count + plane
        value = tl.load(cost + place, mask=used, other=0.0) + way - lowest
        tl.store(total + place, tl.load(total + place, mask=used, other=0.0) + value, mask=used)
        before = tl.where(used, value, 1e9)
        lowest = tl.min(before, axis=0)
        y += down
        x += across


@triton.jit
def pick_pixels(
    total: tl.tensor, inverse: tl.tensor, pixels: tl.tensor, count: tl.tensor, nearest: tl.tensor, step: tl.tensor,
    PLANES: tl.constexpr, UNREACHED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The inverse depth of each pixel: a parabola through the lowest sum and its two neighbours, where those are
    below UNREACHED."""
    pixel = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    plane = tl.arange(0, PLANES)
    used = inside[:, None] & (plane < count)[None, :]
    sums = tl.load(total + pixel[:, None] * count + plane[None, :], mask=used, other=float("inf"))
    best = tl.argmin(sums, axis=1)
    rim = (best == 0) | (best == count - 1)
    at = total + pixel * count + best
    a, b = tl.load(at - 1, mask=inside & (rim == 0), other=0.0), tl.load(at, mask=inside, other=0.0)
    c = tl.load(at + 1, mask=inside & (rim == 0), other=0.0)
    bend = a + c - 2.0 * b
    bends = (rim == 0) & (bend > 0) & (tl.maximum(a, c) < UNREACHED)
    offset = tl.where(bends, (a - c) / (2.0 * tl.where(bends, bend, 1.0)), 0.0)
    offset = tl.minimum(tl.maximum(offset, -0.5), 0.5)
    tl.store(inverse + pixel, nearest + (best.to(tl.float32) + offset) * step, mask=inside)


@triton.jit
def soften_pixels(
    values: tl.tensor, out: tl.tensor, width: tl.tensor, height: tl.tensor, by_value: tl.tensor, by_place: tl.tensor,
    REACH: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The bilateral filter of OpenCV over a disk of REACH pixels; the picture is mirrored at its border."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < width * height
    y, x = pixel // width, pixel % width
    middle = tl.load(values + pixel, mask=inside, other=0.0)
    total, weights = middle * 0.0, middle * 0.0
    for j in tl.static_range(2 * REACH + 1):
        for i in tl.static_range(2 * REACH + 1):
            off2 = (j - REACH) * (j - REACH) + (i - REACH) * (i - REACH)
            if off2 <= REACH * REACH:
                row, column = mirror_at(y + j - REACH, height), mirror_at(x + i - REACH, width)
                value = tl.load(values + row * width + column, mask=inside, other=0.0)
                weight = tl.exp(by_value * (value - middle) * (value - middle) + by_place * off2)
                total += weight * value
                weights += weight
    tl.store(out + pixel, total / weights, mask=inside)


@triton.jit
def mirror_at(place: tl.tensor, count: tl.tensor) -> tl.tensor:
    """Places beyond the border as far within it."""
    place = tl.abs(place)
    return tl.maximum(tl.where(place >= count, 2 * (count - 1) - place, place), 0)


@triton.jit
def fuse_pixels(
    depth: tl.tensor, others: tl.tensor, warps: tl.tensor, backs: tl.tensor, fused: tl.tensor, support: tl.tensor,
    conflict: tl.tensor, views: tl.tensor, width: tl.tensor, height: tl.tensor,
    TOLERANCE: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """`fuse_depths` of a block of pixels, in double precision; warps (views, 12), backs (views, 4)."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < width * height
    z = tl.load(depth + pixel, mask=inside, other=0.0).to(tl.float64)
    known = inside & (z > 0)
    u, v = (pixel % width).to(tl.float64) + 0.5, (pixel // width).to(tl.float64) + 0.5
    weights, against = z * 0.0 + 1.0, z * 0.0
    total = tl.where(known, 1.0 / tl.where(known, z, 1.0), 0.0)
    for n in range(views):
        w, b = warps + 12 * n, backs + 4 * n
        x = z * (tl.load(w) * u + tl.load(w + 1) * v + tl.load(w + 2)) + tl.load(w + 3)
        y = z * (tl.load(w + 4) * u + tl.load(w + 5) * v + tl.load(w + 6)) + tl.load(w + 7)
        far = z * (tl.load(w + 8) * u + tl.load(w + 9) * v + tl.load(w + 10)) + tl.load(w + 11)
        shown = known & (far > 0)
        safe = tl.where(shown, far, 1.0)
        across, down = x / safe, y / safe
        shown = shown & (across >= 0) & (down >= 0) & (across < width) & (down < height)
        seen = sample_depth(others + n * width * height, across - 0.5, down - 0.5, shown, width, height, TOLERANCE)
        shown = shown & (seen > 0)
        off = (seen - safe) / safe
        against += tl.where(shown & (off > 4 * TOLERANCE), 1.0, 0.0)
        back = seen * (tl.load(b) * across + tl.load(b + 1) * down + tl.load(b + 2)) + tl.load(b + 3)
        agrees = shown & (tl.abs(off) < 3 * TOLERANCE) & (back > 0)
        weight = tl.where(agrees, tl.exp(-0.5 * (off / TOLERANCE) * (off / TOLERANCE)), 0.0)
        weights += weight
        total += weight / tl.where(agrees, back, 1.0)
    found = tl.where(known, weights / tl.where(known, total, 1.0), 0.0)
    tl.store(fused + pixel, found.to(tl.float32), mask=inside)
    tl.store(support + pixel, (weights - 1.0).to(tl.float32), mask=inside)
    tl.store(conflict + pixel, against.to(tl.float32), mask=inside)


@triton.jit
def sample_depth(
    depth: tl.tensor, across: tl.tensor, down: tl.tensor, inside: tl.tensor, width: tl.tensor, height: tl.tensor,
    TOLERANCE: tl.constexpr,
) -> tl.tensor:  # fmt: skip
    """Inverse-depth interpolation where the four neighbours lie on one surface, else the nearest pixel's depth."""
    across, down = tl.where(inside, across, 0.0), tl.where(inside, down, 0.0)
    near_row, near_column = clamp_to((down + 0.5).to(tl.int32), height), clamp_to((across + 0.5).to(tl.int32), width)
    nearest = tl.load(depth + near_row * width + near_column, mask=inside, other=0.0).to(tl.float64)
    left, up = tl.floor(across).to(tl.int32), tl.floor(down).to(tl.int32)
    whole = inside & (left >= 0) & (up >= 0) & (left + 1 < width) & (up + 1 < height)
    at = depth + up * width + left
    a, b = tl.load(at, mask=whole, other=0.0).to(tl.float64), tl.load(at + 1, mask=whole, other=0.0).to(tl.float64)
    c = tl.load(at + width, mask=whole, other=0.0).to(tl.float64)
    d = tl.load(at + width + 1, mask=whole, other=0.0).to(tl.float64)
    low, high = tl.minimum(tl.minimum(a, b), tl.minimum(c, d)), tl.maximum(tl.maximum(a, b), tl.maximum(c, d))
    whole = whole & (low > 0) & (high - low <= 3 * TOLERANCE * low)
    a, b, c, d = tl.where(whole, a, 1.0), tl.where(whole, b, 1.0), tl.where(whole, c, 1.0), tl.where(whole, d, 1.0)
    right, under = across - left, down - up
    inverse = (1 - under) * ((1 - right) / a + right / b) + under * ((1 - right) / c + right / d)
    return tl.where(whole, 1 / inverse, nearest)
