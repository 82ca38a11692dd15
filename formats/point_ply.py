"""A cloud of coloured points as a PLY, in the one layout that every trainer of Gaussian splatting can start from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ply_table import Rows, slices, write_ply

_VERTEX = np.dtype([
    *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((name, "u1") for name in ("red", "green", "blue"))
])  # fmt: skip


def write_point_ply(path: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> None:
    """Write points (P, 3) and colors (P, 3) uint8 with normals of zero, which the original trainer insists on.

    Raises ValueError for shapes that do not fit, InputError when the disk refuses.
    """
    if points.shape != (len(colors), 3) or colors.shape != points.shape:
        raise ValueError(f"write_point_ply: got points {points.shape} and colors {colors.shape}, expected (P, 3) both")
    write_ply(path, {"vertex": Rows(_VERTEX, len(points), _blocks(points, colors))}, [])


def _blocks(points: NDArray[np.float64], colors: NDArray[np.uint8]) -> Iterator[NDArray[Any]]:
    for rows in slices(len(points)):
        block = np.zeros(len(points[rows]), _VERTEX)
        for i, (axis, color) in enumerate((("x", "red"), ("y", "green"), ("z", "blue"))):
            block[axis], block[color] = points[rows, i], colors[rows, i]
        yield block
