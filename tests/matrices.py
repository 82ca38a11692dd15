"""Poses, and as text for readers of it."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def write_matrices(path: Path, world_from_cam: NDArray[np.float64]) -> None:
    """Write (N, 4, 4) as one row-major matrix of 16 numbers a line, with all digits of float64."""
    lines = (" ".join(repr(float(value)) for value in matrix.ravel()) for matrix in world_from_cam)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))


def random_poses(count: int, seed: int = 0) -> NDArray[np.float64]:
    """(count, 4, 4) motions in all directions, by a few units."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 3, (count, 3))
    return poses
