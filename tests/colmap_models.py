"""COLMAP models for tests."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.colmap import ColmapModel


def posed_images(
    names: Sequence[str], cam_from_world: NDArray[np.float64], width: int, height: int, *pinhole: float
) -> ColmapModel:
    """Images by one camera, without points."""
    none, camera = np.zeros(0, np.int64), ("PINHOLE", width, height, pinhole)
    points = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none, np.zeros((0, 2)))
    return ColmapModel(tuple(names), cam_from_world, (camera,), *points)
