"""Normal equations of a camera pose, by carrying six derivatives through the blending next to every value.

A dual number is eight lanes: the derivatives by the six numbers of a left twist (translation first), the value, and one
lane unused. Two dual numbers share a vector: red and green, blue and light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..compute.jit import inner, kernel
from ..compute.lanes import add_products, at_most, counting, exp, halves, load, load_twice, splat, store, where
from ..compute.threads import for_each
from . import reference
from .cpu_bands import BAND_ROWS, RECORD, TILE, first_pixel, last_pixel, split_into_bands
from .cpu_forward import CHECK_EVERY, LIGHT, PIXELS, clear, is_opaque

F32 = np.float32
ALPHA, PLANES = PIXELS, 2
"""Where the plane of a Gaussian's opacities starts in a tile's state, behind that of light, and how many there are."""
VALUE = 6
"""The lane of a dual number that holds its value."""
_ALPHA_MAX, _LIGHT_MIN = F32(reference.ALPHA_MAX), F32(reference.TRANSMITTANCE_MIN)
_HALF, _ZERO, _ONE = F32(0.5), F32(0), F32(1)
_DUAL = 32  # floats per pixel: red and green, blue and light
_JACOBIAN = 24  # floats per Gaussian: derivatives of u/s², v/s², and of the exponent by distance²


def normal_equations(
    projected: tuple[NDArray[np.float32], ...],
    points_in_cam: NDArray[np.float32],
    colors: NDArray[np.float32],
    image: NDArray[np.float32],
    focal: tuple[float, float],
    floor: float,
    min_silhouette: float,
    near: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, int]:
    """JᵀWJ (6, 6), JᵀWr (6,), Σ weight |r| and the number of pixels of |C - I|.

    W makes the absolute values quadratic about the present residuals, `floor` being the least residual divided by.
    projected: u, v, sigma_px, z, opacity (M,); pixels with a silhouette below `min_silhouette` do not count. The same
    bytes for any number of threads.
    """
    height, width = image.shape[:2]
    bands = split_into_bands(projected, colors, 3, width, height, near)
    sums, costs = np.zeros((len(bands), 6, 8)), np.zeros((len(bands), 2))
    settings = (F32(focal[0]), F32(focal[1]), F32(floor), F32(min_silhouette))
    job = (points_in_cam, image, *settings, sums, costs)
    for_each(lambda b: normal_equations_of_band(b, bands.own(b), *bands.prepared[b], *job), len(bands))
    total, (cost, pixels) = sums.sum(axis=0), costs.sum(axis=0)
    return total[:, :6], total[:, VALUE], float(cost), int(pixels)


@inner
def fill_jacobian(
    jacobian: NDArray[np.float32],
    point: NDArray[np.float32],
    fx: np.float32,
    fy: np.float32,
    sigma_px: np.float32,
) -> None:
    """d exponent = dx * jacobian[0:8] + dy * jacobian[8:16] + distance² * jacobian[16:24].

    A left twist (ρ, φ) moves a point P of the camera by ρ + φ x P.
    """
    clear(jacobian)
    x, y, z = point[0], point[1], point[2]
    scale = _ONE / (z * sigma_px * sigma_px)
    du, dv, ds = jacobian[0:8], jacobian[8:16], jacobian[16:24]
    du[0], du[4], du[5] = fx * scale, fx * scale * z, -fx * scale * y
    dv[1], dv[3], dv[5] = fy * scale, -fy * scale * z, fy * scale * x
    for p, dz in ((2, _ONE), (3, y), (4, -x)):
        du[p] -= fx * scale * x / z * dz
        dv[p] -= fy * scale * y / z * dz
        ds[p] = -scale * dz


@inner
def shade_rows(
    state: NDArray[np.float32],
    falloff_y: NDArray[np.float32],
    falloff_x: object,
    dx2: object,
    y_center: np.float32,
    reach2: np.float32,
    first: int,
    last: int,
) -> None:
    """Opacity of one Gaussian in rows first..last of a tile, as in the forward pass."""
    for y in range(first, last + 1):
        row = TILE * y
        dy = F32(y) + _HALF - y_center
        alpha = at_most(falloff_x * falloff_y[y], _ALPHA_MAX)
        inside = (dx2 <= splat(reach2 - dy * dy)) & (load(state, LIGHT + row) >= _LIGHT_MIN)
        store(state, ALPHA + row, where(inside, alpha))


@inner
def blend_duals(
    duals: NDArray[np.float32],
    state: NDArray[np.float32],
    jacobian: NDArray[np.float32],
    color: NDArray[np.float32],
    u_tile: np.float32,
    v_tile: np.float32,
    y0: int,
    y1: int,
    x0: int,
    x1: int,
) -> None:
    """Blends one Gaussian, whose opacities stand in the plane ALPHA, into a box of a tile's dual numbers."""
    du, dv, ds = load_twice(jacobian, 0), load_twice(jacobian, 8), load_twice(jacobian, 16)
    red_green, blue_light = halves(color[0], color[1]), halves(color[2], -_ONE)
    for y in range(y0, y1 + 1):
        dy = F32(y) + _HALF - v_tile
        for x in range(x0, x1 + 1):
            pixel = TILE * y + x
            alpha, light = state[ALPHA + pixel], state[LIGHT + pixel]
            if alpha == _ZERO:
                continue
            dx = F32(x) + _HALF - u_tile
            slope = alpha if alpha < _ALPHA_MAX else _ZERO
            d_alpha = (du * dx + dv * dy + ds * (dx * dx + dy * dy)) * slope
            at = _DUAL * pixel
            weight = load_twice(duals, at + 24) * alpha + d_alpha * light
            store(duals, at, load(duals, at) + weight * red_green)
            store(duals, at + 16, load(duals, at + 16) + weight * blue_light)
            state[LIGHT + pixel] = light - alpha * light


@inner
def add_pixel(
    normal: NDArray[np.float32], duals: NDArray[np.float32], color: NDArray[np.float32], floor: np.float32
) -> np.float32:
    """Turns a pixel's dual numbers into residuals, adds their products, gives back Σ |residual|."""
    duals[VALUE] -= color[0]
    duals[8 + VALUE] -= color[1]
    duals[16 + VALUE] -= color[2]
    red, green, blue = abs(duals[VALUE]), abs(duals[8 + VALUE]), abs(duals[16 + VALUE])
    add_products(normal, load(duals, 0), halves(_ONE / max(red, floor), _ONE / max(green, floor)))
    add_products(normal, load(duals, 16), halves(_ONE / max(blue, floor), _ZERO))
    return red + green + blue


@kernel
def normal_equations_of_band(
    band: int,
    own: NDArray[np.int32],
    records: NDArray[np.float32],
    colors: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    members: NDArray[np.int32],
    points_in_cam: NDArray[np.float32],
    target: NDArray[np.float32],
    fx: np.float32,
    fy: np.float32,
    floor: np.float32,
    min_silhouette: np.float32,
    sums: NDArray[np.float64],
    costs: NDArray[np.float64],
) -> None:
    """Adds the pixels of one band to sums[band] (6, 8) and costs[band] (2,)."""
    height, width = target.shape[:2]
    jacobians = np.empty(len(own) * _JACOBIAN, np.float32)
    for k in range(len(own)):
        jacobian = jacobians[k * _JACOBIAN : (k + 1) * _JACOBIAN]
        fill_jacobian(jacobian, points_in_cam[own[k]], fx, fy, records[RECORD * k + 2])
    band_top = band * BAND_ROWS
    across = (width + TILE - 1) // TILE
    state, falloff_y = np.empty(PIXELS * PLANES, np.float32), np.empty(TILE, np.float32)
    duals, normal = np.empty(PIXELS * _DUAL, np.float32), np.empty(6 * 16, np.float32)
    for tile in range(len(tile_starts) - 1):
        left, top = TILE * (tile % across), band_top + TILE * (tile // across)
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        open_tile(state, duals, columns, rows)
        for k in range(tile_starts[tile], tile_starts[tile + 1]):
            i = members[k]
            at = RECORD * i
            u_tile, v_tile, r = records[at] - F32(left), records[at + 1] - F32(top), records[at + 5]
            x0, x1 = first_pixel(u_tile - r), last_pixel(u_tile + r, columns)
            y0, y1 = first_pixel(v_tile - r), last_pixel(v_tile + r, rows)
            if x1 < x0 or y1 < y0:
                continue
            sharpness = -_HALF / (records[at + 2] * records[at + 2])
            dx, dy = counting(_HALF - u_tile), counting(_HALF - v_tile)
            dx2 = dx * dx
            store(falloff_y, 0, exp(dy * dy * sharpness) * records[at + 4])
            shade_rows(state, falloff_y, exp(dx2 * sharpness), dx2, v_tile, r * r, y0, y1)
            jacobian, color = jacobians[i * _JACOBIAN : (i + 1) * _JACOBIAN], colors[3 * i : 3 * i + 3]
            blend_duals(duals, state, jacobian, color, u_tile, v_tile, y0, y1, x0, x1)
            if k % CHECK_EVERY == CHECK_EVERY - 1 and is_opaque(state, LIGHT):
                break
        clear(normal)
        for y in range(rows):
            for x in range(columns):
                pixel, row, column = TILE * y + x, top + y, left + x
                seen = _ONE - state[LIGHT + pixel]
                if seen >= min_silhouette and seen > _ZERO:
                    own_duals = duals[pixel * _DUAL : (pixel + 1) * _DUAL]
                    costs[band, 0] += add_pixel(normal, own_duals, target[row, column], floor)
                    costs[band, 1] += 1
        for p in range(6):
            for q in range(8):
                sums[band, p, q] += normal[16 * p + q] + normal[16 * p + 8 + q]


@inner
def open_tile(state: NDArray[np.float32], duals: NDArray[np.float32], columns: int, rows: int) -> None:
    """Full light without derivatives for the pixels of the image, none for the rest of the tile."""
    clear(state)
    clear(duals)
    for y in range(rows):
        for x in range(columns):
            pixel = TILE * y + x
            state[LIGHT + pixel] = _ONE
            duals[pixel * _DUAL + 24 + VALUE] = _ONE
