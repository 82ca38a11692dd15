"""Baked diffuse light: area lights with soft shadows and one bounce, on a coarse grid over every face."""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray

from msgs_slam.pipelines.system.jit import kernel
from tests.world.cast import SolidArrays, point_on_face, surface, trace
from tests.world.shapes import FACE_COUNT, Solid

LIGHT_TEXEL = 0.09
_AMBIENT = 0.12


@dataclass(frozen=True)
class Light:
    """A shining rectangle: centre, two half edges (metres) and linear RGB radiance. `facing` its normal, or zero for
    a lamp that shines to all sides."""

    center: tuple[float, float, float]
    edge1: tuple[float, float, float]
    edge2: tuple[float, float, float]
    facing: tuple[float, float, float]
    radiance: tuple[float, float, float]


def bake_light(
    solids: list[Solid], arrays: SolidArrays, lights: list[Light], albedo: NDArray[np.float64], samples: int = 32
) -> list[NDArray[np.float32]]:
    """Irradiance over pi of every face, each (h, w, 3): multiplied by the albedo it is the light that leaves.

    albedo (F, 3): mean albedo of every face, for the bounce.
    """
    grid, sizes = _light_grid(solids)
    offsets = np.concatenate([[0], np.cumsum(sizes[:, 0] * sizes[:, 1])])
    lamps = np.array([[*x.center, *x.edge1, *x.edge2, *x.facing, *x.radiance] for x in lights], np.float64)
    caster = np.array([i for i, s in enumerate(solids) if s.material.emission == 0], np.int32)
    scene = arrays.arguments
    direct = np.zeros((len(grid), 3))
    _direct(grid, lamps, caster, *scene, direct)
    total = direct.copy()
    directions = _cosine_directions(samples)
    faces = (arrays.first_face, offsets, sizes)
    _bounce(grid, directions, caster, *faces, albedo, direct, *scene, total)
    total += _AMBIENT
    return [_smoothed(total[offsets[i] : offsets[i + 1]].reshape(h, w, 3)) for i, (h, w) in enumerate(sizes.tolist())]


def _smoothed(light: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(light.astype(np.float32), (3, 3), 0.8), np.float32).reshape(light.shape)


def _light_grid(solids: list[Solid]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(T, 4) rows solid, face, u, v of all light texels, and (F, 2) their numbers along v and u."""
    rows, sizes = [], []
    for i, solid in enumerate(solids):
        for face in range(FACE_COUNT[solid.shape]):
            h, w = (int(np.clip(round(x / LIGHT_TEXEL), 1, 160)) for x in solid.face_size(face))
            v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
            rows.append(np.stack([np.full(h * w, i), np.full(h * w, face), u.ravel(), v.ravel()], axis=1))
            sizes.append((h, w))
    return np.concatenate(rows).astype(np.float64), np.array(sizes, np.int64)


def _cosine_directions(count: int) -> NDArray[np.float64]:
    """(count, 3) directions round +z, dense as the cosine: a Fibonacci spiral on the disc, lifted."""
    k = np.arange(count)
    radius = np.sqrt((k + 0.5) / count)
    angle = k * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)


@kernel
def _texel_point(row, shape, center, half, turn):  # type: ignore[no-untyped-def]
    """Position just above a light texel, and its normal."""
    s, face = int(row[0]), int(row[1])
    x, y, z = point_on_face(row[2], row[3], s, face, shape, center, half, turn)
    _, _, nx, ny, nz = surface(x, y, z, s, face, shape, center, half, turn)
    return x + 1e-3 * nx, y + 1e-3 * ny, z + 1e-3 * nz, nx, ny, nz


@kernel(parallel=True)
def _direct(grid, lamps, caster, shape, center, half, turn, bound, out):  # type: ignore[no-untyped-def]
    side = 3
    for i in prange(grid.shape[0]):
        x, y, z, nx, ny, nz = _texel_point(grid[i], shape, center, half, turn)
        for k in range(lamps.shape[0]):
            lamp = lamps[k]
            area = 4 * np.sqrt((lamp[3:6] ** 2).sum() * (lamp[6:9] ** 2).sum()) / (np.pi * side * side)
            for sample in range(side * side):
                a, b = ((sample // side) + 0.5) / side * 2 - 1, ((sample % side) + 0.5) / side * 2 - 1
                dx = lamp[0] + a * lamp[3] + b * lamp[6] - x
                dy = lamp[1] + a * lamp[4] + b * lamp[7] - y
                dz = lamp[2] + a * lamp[5] + b * lamp[8] - z
                d2 = max(dx * dx + dy * dy + dz * dz, 0.02)
                towards = nx * dx + ny * dy + nz * dz
                leaving = -(lamp[9] * dx + lamp[10] * dy + lamp[11] * dz)
                if lamp[9] == 0 and lamp[10] == 0 and lamp[11] == 0:
                    leaving = np.sqrt(d2)
                if towards <= 0 or leaving <= 0:
                    continue
                t, s, _ = trace(x, y, z, dx, dy, dz, caster, caster.shape[0], shape, center, half, turn, bound)
                if s >= 0 and t < 0.999:
                    continue
                for c in range(3):
                    out[i, c] += lamp[12 + c] * area * towards * leaving / (d2 * d2)


@kernel(parallel=True)
def _bounce(  # type: ignore[no-untyped-def]
    grid, directions, caster, first_face, offsets, sizes, albedo, direct, shape, center, half, turn, bound, out
):
    for i in prange(grid.shape[0]):
        x, y, z, nx, ny, nz = _texel_point(grid[i], shape, center, half, turn)
        # Any frame round the normal; turned from texel to texel so that few directions leave noise and not bands.
        spin = (i * 0.6180339887) % 1.0 * 2 * np.pi
        tx, ty, tz = (0.0, -nz, ny) if abs(nx) < 0.7 else (nz, 0.0, -nx)
        length = np.sqrt(tx * tx + ty * ty + tz * tz)
        tx, ty, tz = tx / length, ty / length, tz / length
        bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        for k in range(directions.shape[0]):
            a = np.cos(spin) * directions[k, 0] - np.sin(spin) * directions[k, 1]
            b = np.sin(spin) * directions[k, 0] + np.cos(spin) * directions[k, 1]
            c = directions[k, 2]
            dx, dy, dz = a * tx + b * bx + c * nx, a * ty + b * by + c * ny, a * tz + b * bz + c * nz
            t, s, face = trace(x, y, z, dx, dy, dz, caster, caster.shape[0], shape, center, half, turn, bound)
            if s < 0:
                continue
            u, v, _, _, _ = surface(x + t * dx, y + t * dy, z + t * dz, s, face, shape, center, half, turn)
            f = first_face[s] + face
            row = min(int(v * sizes[f, 0]), sizes[f, 0] - 1)
            column = min(int(u * sizes[f, 1]), sizes[f, 1] - 1)
            for channel in range(3):
                leaving = direct[offsets[f] + row * sizes[f, 1] + column, channel] * albedo[f, channel]
                out[i, channel] += leaving / directions.shape[0]
