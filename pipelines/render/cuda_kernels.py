"""Triton kernels: one program per tile, its pixels in registers, some Gaussians at a time in lanes, as a matrix.

Within a step the light before each Gaussian is a running product along the matrix. The forward pass blends by matrix
products, on tensor cores with the digits of float32 ("tf32x3"). The backward pass has none: a tile is one warp's, so
that its sums over pixels need no barrier. Gradients leave a tile with one atomic addition per Gaussian and value.
The interpreter of Triton (environment variable TRITON_INTERPRET=1) runs these kernels on CPU tensors.
"""

import triton
import triton.language as tl


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
    x: tl.tensor,
    y: tl.tensor,
    u: tl.tensor,
    v: tl.tensor,
    sigma: tl.tensor,
    opacity: tl.tensor,
    reach: tl.tensor,
    ALPHA_MAX: tl.constexpr,
) -> tl.tensor:
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
