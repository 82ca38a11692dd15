"""Poses as text, for readers of it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_matrices(path: Path, world_from_cam: NDArray[np.float64]) -> None:
    """Write (N, 4, 4) as one row-major matrix of 16 numbers a line, with all digits of float64."""
    lines = (" ".join(repr(float(value)) for value in matrix.ravel()) for matrix in world_from_cam)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))
