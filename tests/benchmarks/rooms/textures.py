"""Textures of made rooms: 256 x 256 RGB that repeat without a seam, with the metres that each spans; and pictures."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

SIDE = 256
Random = np.random.Generator
Texture = tuple[NDArray[np.uint8], float]
WOODS = ((0.76, 0.6, 0.42), (0.55, 0.38, 0.25), (0.85, 0.74, 0.58), (0.35, 0.22, 0.14), (0.66, 0.47, 0.3))


def linear(srgb: NDArray | tuple[float, ...]) -> NDArray[np.float32]:
    """sRGB in 0..255 to linear light in 0..1."""
    x = np.asarray(srgb, np.float32) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def noise(r: Random, *octaves: tuple[int, float]) -> NDArray[np.float32]:
    """(256, 256) sum of smooth noises: (cells a side, amplitude) each."""
    out = np.zeros((SIDE, SIDE), np.float32)
    for cells, amplitude in octaves:
        grid = np.pad(r.normal(size=(cells, cells)).astype(np.float32), 2, mode="wrap")
        k = SIDE // cells
        large = cv2.resize(grid, ((cells + 4) * k, (cells + 4) * k), interpolation=cv2.INTER_CUBIC)
        out += amplitude * large[2 * k : 2 * k + SIDE, 2 * k : 2 * k + SIDE]
    return out


def _tinted(rgb: NDArray, factor: NDArray) -> NDArray[np.uint8]:
    return np.clip(np.asarray(rgb, np.float32) * 255 * (1 + factor[..., None]), 0, 255).astype(np.uint8)


def grain(r: Random, rgb: NDArray) -> Texture:
    """Plaster: faint unevenness of several sizes."""
    a = r.choice([0.006, 0.015, 0.03, 0.06])
    return _tinted(rgb, noise(r, (128, a), (32, a * 0.7), (8, a))), r.uniform(0.5, 2)


def carpet(r: Random, rgb: NDArray) -> Texture:
    """Fine and strong."""
    a = r.choice([0.03, 0.06, 0.12])
    return _tinted(rgb, noise(r, (256, a), (128, a), (16, a * 0.3))), r.uniform(0.4, 1.2)


def stains(r: Random, rgb: NDArray) -> Texture:
    """Marble, concrete, worn paint: smooth large spots, some veins."""
    a = r.choice([0.02, 0.05, 0.1])
    veins = np.abs(noise(r, (4, 1.0), (8, 0.6), (16, 0.4)))
    return _tinted(rgb, noise(r, (4, a), (16, a), (64, a * 0.5)) - a * np.exp(-veins * 12)), r.uniform(0.8, 2.5)


def tiles(r: Random, rgb: NDArray) -> Texture:
    """A grid of joints; tiles may differ."""
    n = int(r.choice([2, 4, 8]))
    k, width = SIDE // n, int(r.integers(1, 4))
    each = np.kron(r.normal(size=(n, n)).astype(np.float32) * r.choice([0, 0.02, 0.05]), np.ones((k, k), np.float32))
    image = _tinted(rgb, each + noise(r, (64, r.choice([0.0, 0.01, 0.03]))))
    joint = np.clip(np.asarray(rgb) * 255 * r.choice([0.6, 0.8, 0.93, 1.05]), 0, 255)
    for i in range(n):
        image[i * k : i * k + width] = joint
        image[:, i * k : i * k + width] = joint
    return image, n * r.uniform(0.1, 0.5)


def wood(r: Random, rgb: NDArray) -> Texture:
    """Boards with grain along them."""
    n, a = int(r.choice([4, 8])), r.choice([0.015, 0.04, 0.08])
    k = SIDE // n
    fine = cv2.resize(r.normal(size=(SIDE, 8)).astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    grains = a * fine + a * cv2.resize(r.normal(size=(SIDE // 4, 4)).astype(np.float32), (SIDE, SIDE))
    grains[:, :16] = grains[:, :16] * np.linspace(0, 1, 16) + grains[:, -16:][:, ::-1] * np.linspace(1, 0, 16)
    for i in range(n):
        board = slice(i * k, (i + 1) * k)
        grains[board] = np.roll(grains[board], int(r.integers(SIDE)), 1) + r.normal() * a * 1.2
        grains[i * k] -= r.choice([0.03, 0.15, 0.3])
        grains[board, int(r.integers(SIDE))] -= 0.2
    return _tinted(rgb, grains), r.uniform(0.5, 1.6)


def brick(r: Random, rgb: NDArray) -> Texture:
    """Rows of bricks, each second one shifted."""
    image, k = _tinted(rgb, noise(r, (64, 0.06), (128, 0.05))), SIDE // 8
    joint = np.clip(np.asarray(rgb) * 255 * r.uniform(0.7, 1.3), 0, 255)
    for i in range(8):
        row = slice(i * k, (i + 1) * k)
        image[row] = np.clip(image[row] * r.uniform(0.9, 1.1), 0, 255)
        image[i * k : i * k + 3] = joint
        for j in range(4):
            c = (j * SIDE // 4 + (i % 2) * SIDE // 8) % SIDE
            image[row, c : c + 3] = joint
    return image, r.uniform(0.5, 1)


def paper(r: Random, rgb: NDArray) -> Texture:
    """Wallpaper: stripes or a lattice that repeats exactly."""
    x = np.arange(SIDE) * 2 * np.pi * int(r.choice([4, 8, 16])) / SIDE
    a = r.choice([0.03, 0.08, 0.2])
    stripes = np.sign(np.sin(x))[None] * np.ones((SIDE, 1))
    pattern = stripes if r.random() < 0.5 else np.sin(x)[None] * np.sin(x)[:, None]
    return _tinted(rgb, (a * pattern).astype(np.float32) + noise(r, (64, 0.008))), r.uniform(0.4, 1.5)


def picture(r: Random, given: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What hangs on walls, lies on floors or is outside of windows: one of the `given` (T, ...), or shapes on noise."""
    if len(given) and r.random() < 0.35:
        return given[r.integers(len(given))]
    ground = r.uniform(30, 230, 3) + noise(r, (4, 40), (16, 25), (64, 15))[..., None] * r.uniform(0.3, 1, 3)
    image = np.clip(ground, 0, 255).astype(np.uint8)
    for _ in range(int(r.integers(2, 25))):
        ink = tuple(int(v) for v in r.integers(0, 255, 3))
        p, kind = r.integers(0, SIDE, (4, 2)).astype(np.int32), r.integers(3)
        if kind == 0:
            cv2.circle(image, tuple(map(int, p[0])), int(r.integers(4, 60)), ink, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.fillPoly(image, [p], ink, cv2.LINE_AA)
        else:
            cv2.line(image, tuple(map(int, p[0])), tuple(map(int, p[1])), ink, int(r.integers(1, 10)), cv2.LINE_AA)
    return image


def color(r: Random, kind: str) -> NDArray[np.float64]:
    """(3,) sRGB in 0..1 of a wall, a floor or another thing."""
    if kind == "wall":
        base = r.choice([0.55, 0.72, 0.82, 0.88, 0.92], p=[0.1, 0.15, 0.25, 0.3, 0.2])
        tint = r.choice([0.01, 0.04, 0.12, 0.3], p=[0.35, 0.35, 0.2, 0.1])
    elif kind == "floor":
        base, tint = r.uniform(0.2, 0.8), r.choice([0.02, 0.1, 0.3])
    else:
        base = r.choice([r.uniform(0.08, 0.3), r.uniform(0.3, 0.8), 0.9], p=[0.25, 0.5, 0.25])
        tint = r.choice([0.02, 0.15, 0.5])
    hue = r.uniform(0, 2 * np.pi) if r.random() < 0.4 else r.uniform(0.2, 1.2)
    direction = np.array([np.cos(hue), np.cos(hue - 2.1), np.cos(hue + 2.1)])
    return np.clip(base * (1 + tint * direction), 0.03, 0.95)


def pick(r: Random, kind: str) -> Callable[[Random, NDArray], Texture] | None:
    """A texture for a wall, floor or thing; None is plain."""
    choices: dict[str, tuple[tuple[Callable[[Random, NDArray], Texture] | None, float], ...]] = {
        "wall": ((None, 0.12), (grain, 0.42), (stains, 0.18), (paper, 0.14), (brick, 0.07), (tiles, 0.07)),
        "floor": ((None, 0.06), (grain, 0.1), (stains, 0.16), (carpet, 0.2), (wood, 0.33), (tiles, 0.15)),
        "thing": ((None, 0.4), (grain, 0.2), (carpet, 0.15), (paper, 0.1), (stains, 0.15)),
    }
    kinds, weights = zip(*choices[kind], strict=True)
    return kinds[int(r.choice(len(kinds), p=np.array(weights) / sum(weights)))]
