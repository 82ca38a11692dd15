"""Procedural pictures for the faces of a world: rich enough for corners and stereo, different on every face.

Every function returns linear albedo (h, w, 3) float32 in 0..1 for a face of `size` = (height, width) metres.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Color = tuple[float, float, float]
Image = NDArray[np.float32]
Painter = Callable[[tuple[int, int], float, Color, Generator], Image]


def fractal_noise(
    shape: tuple[int, int], texel: float, coarsest: float, octaves: int, rng: Generator, stretch: float = 1.0
) -> NDArray[np.float32]:
    """(h, w) noise of about unit spread; cells from `coarsest` metres downwards, `stretch` times longer in u."""
    total = np.zeros(shape, np.float32)
    power = 0.0
    for octave in range(octaves):
        cell = coarsest / 2**octave / texel
        if cell < 1:
            break
        weight = 0.65**octave
        total += weight * _value_noise(shape, cell, cell * stretch, rng)
        power += weight**2
    return total / np.float32(np.sqrt(max(power, 1e-9)))


def _value_noise(shape: tuple[int, int], cell_v: float, cell_u: float, rng: Generator) -> NDArray[np.float32]:
    rows, columns = int(shape[0] / cell_v) + 3, int(shape[1] / cell_u) + 3
    grid = rng.standard_normal((rows, columns), dtype=np.float32)
    scale = np.array([[1 / cell_u, 0, 1], [0, 1 / cell_v, 1]], np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    # Interpolated noise loses variance between its nodes; 1.4 gives back unit spread on average.
    return 1.4 * cv2.warpAffine(grid, scale, (shape[1], shape[0]), flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _tinted(color: Color, brightness: NDArray[np.float32]) -> Image:
    return np.clip(np.asarray(color, np.float32) * brightness[..., None], 0.01, 0.95)


def plain(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Painted wall with hardly any texture."""
    return _tinted(color, 1 + 0.012 * fractal_noise(shape, texel, 0.8, 4, rng))


def plaster(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Rough, stained plaster."""
    rough = fractal_noise(shape, texel, 0.25, 6, rng)
    stains = fractal_noise(shape, texel, 0.6, 5, rng)
    spots = np.clip(fractal_noise(shape, texel, 0.06, 3, rng) - 1.4, 0, 1)
    return _tinted(color, np.clip(1 + 0.13 * rough + 0.1 * np.tanh(2 * stains) - 0.5 * spots, 0.2, 1.6))


def speckle(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Stone: veins and grains."""
    vein = np.abs(fractal_noise(shape, texel, 0.2, 6, rng))
    grain = fractal_noise(shape, texel, 0.02, 3, rng)
    return _tinted(color, np.clip(0.65 + 0.5 * np.sqrt(vein) + 0.15 * grain, 0.15, 1.6))


def wallpaper(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Scattered leaves and dots on a mottled ground."""
    picture = _tinted(color, 1 + 0.1 * fractal_noise(shape, texel, 0.3, 5, rng))
    area = shape[0] * shape[1] * texel**2
    for _ in range(int(55 * area)):
        tone = np.clip(np.asarray(color) * rng.uniform(0.35, 1.5) + rng.uniform(-0.12, 0.12, 3), 0.03, 0.9)
        at = (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        axes = (int(rng.uniform(0.015, 0.07) / texel) + 1, int(rng.uniform(0.008, 0.025) / texel) + 1)
        cv2.ellipse(picture, at, axes, float(rng.uniform(0, 180)), 0, 360, tone.tolist(), -1, cv2.LINE_AA)
    return picture


def bricks(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """A brick wall: every brick of its own tint, pale mortar."""
    return _cells(shape, texel, color, rng, (0.085, 0.24), 0.012, 0.22, (0.5, 0.48, 0.45), 0.16)


def tiles(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Tiles with joints."""
    return _cells(shape, texel, color, rng, (0.3, 0.3), 0.008, 0.2, (0.25, 0.24, 0.23), 0.12, offset=0.0)


def _cells(
    shape: tuple[int, int],
    texel: float,
    color: Color,
    rng: Generator,
    cell: tuple[float, float],
    joint: float,
    tint: float,
    joint_color: Color,
    roughness: float,
    offset: float = 0.5,
) -> Image:
    v = (np.arange(shape[0], dtype=np.float32) + 0.5)[:, None] * texel
    u = (np.arange(shape[1], dtype=np.float32) + 0.5)[None, :] * texel
    row = np.floor(v / cell[0]).astype(np.int32)
    shifted = u + offset * cell[1] * (row % 2)
    column = np.floor(shifted / cell[1]).astype(np.int32)
    table = 1 + tint * rng.standard_normal((int(row.max()) + 1, int(column.max()) + 1, 3)).astype(np.float32)
    table = table.mean(axis=2, keepdims=True) * 0.7 + table * 0.3
    picture = np.asarray(color, np.float32) * table[row, column]
    picture *= (1 + roughness * fractal_noise(shape, texel, 0.12, 5, rng))[..., None]
    gap = np.minimum(v % cell[0], shifted % cell[1])
    in_joint = (gap < joint)[..., None]
    mortar = np.asarray(joint_color, np.float32) * (1 + 0.15 * fractal_noise(shape, texel, 0.05, 3, rng))[..., None]
    return np.clip(np.where(in_joint, mortar, picture), 0.01, 0.95)


def planks(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Floor boards along u: grain, knots, joints at random places."""
    width, length = 0.12, 1.1
    v = (np.arange(shape[0], dtype=np.float32) + 0.5)[:, None] * texel
    u = (np.arange(shape[1], dtype=np.float32) + 0.5)[None, :] * texel
    row = np.floor(v / width).astype(np.int32)
    starts = rng.uniform(0, length, int(row.max()) + 1).astype(np.float32)
    along = u + starts[row]
    board = np.floor(along / length).astype(np.int32)
    tint = 1 + 0.2 * rng.standard_normal((int(row.max()) + 1, int(board.max()) + 1)).astype(np.float32)
    brightness = tint[row, board] * _grain(shape, texel, rng)
    joint = (v % width < 0.005) | (along % length < 0.006)
    return _tinted(color, np.where(joint, 0.35, np.clip(brightness, 0.25, 1.7)))


def wood(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """One piece of wood."""
    return _tinted(color, np.clip(_grain(shape, texel, rng), 0.3, 1.6))


def _grain(shape: tuple[int, int], texel: float, rng: Generator) -> NDArray[np.float32]:
    rings = np.sin(7 * fractal_noise(shape, texel, 0.16, 3, rng, stretch=6))
    fibre = fractal_noise(shape, texel, 0.02, 3, rng, stretch=12)
    knots = np.clip(fractal_noise(shape, texel, 0.09, 2, rng) - 1.6, 0, 1)
    return 1 + 0.13 * rings + 0.1 * fibre - 0.9 * knots


def fabric(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Woven cloth with stripes of uneven width."""
    stripes = np.sign(np.sin(np.cumsum(rng.uniform(0.2, 1.2, shape[1])) * texel * 60)).astype(np.float32)
    mottle = fractal_noise(shape, texel, 0.15, 5, rng)
    fold = fractal_noise(shape, texel, 0.5, 2, rng)
    return _tinted(color, np.clip(1 + 0.12 * stripes[None] + 0.16 * mottle + 0.1 * fold, 0.2, 1.7))


def foliage(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Leaves: overlapping strokes of many greens."""
    picture = _tinted(color, np.full(shape, 0.45, np.float32))
    for _ in range(int(2200 * shape[0] * shape[1] * texel**2) + 40):
        tone = np.clip(np.asarray(color) * rng.uniform(0.4, 2.0) + rng.uniform(-0.02, 0.03, 3), 0.01, 0.9)
        at = (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        axes = (int(rng.uniform(0.015, 0.04) / texel) + 1, int(rng.uniform(0.004, 0.012) / texel) + 1)
        cv2.ellipse(picture, at, axes, float(rng.uniform(0, 180)), 0, 360, tone.tolist(), -1, cv2.LINE_AA)
    return picture


def rug(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Borders of ornaments round a field of diamonds."""
    picture = _tinted(color, 1 + 0.12 * fractal_noise(shape, texel, 0.1, 4, rng))
    edge = int(0.07 / texel)
    for ring in range(5):
        low, high = ring * edge, (ring + 1) * edge
        if 2 * high >= min(shape):
            break
        tone = np.clip(rng.uniform(0.3, 1.4) * np.roll(np.asarray(color), ring), 0.03, 0.9).tolist()
        cv2.rectangle(picture, (low, low), (shape[1] - 1 - low, shape[0] - 1 - low), tone, edge // 2)
    for _ in range(int(70 * shape[0] * shape[1] * texel**2)):
        at = np.array([rng.integers(shape[1]), rng.integers(shape[0])])
        reach = int(rng.uniform(0.02, 0.08) / texel) + 2
        corners = at + reach * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
        tone = np.clip(rng.permutation(np.asarray(color)) * rng.uniform(0.3, 2.2), 0.03, 0.9).tolist()
        cv2.fillConvexPoly(picture, corners.astype(np.int32), tone, cv2.LINE_AA)
    weave = 1 + 0.1 * fractal_noise(shape, texel, 0.015, 2, rng)
    return np.clip(picture * weave[..., None], 0.01, 0.95)
