"""Up as those who hold cameras hold them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def cameras_up(world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) unit vector across the cameras' right axes, which people hold level, on the side of their upward axes.

    world_from_cam (N, 4, 4), at least one.
    """
    right = world_from_cam[:, :3, 0]
    # Alone, the mean upward axis leans as the cameras look down; the little weight settles what one direction of view
    # leaves open.
    up = np.linalg.solve(right.T @ right / len(right) + 0.01 * np.eye(3), -world_from_cam[:, :3, 1].mean(axis=0))
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-12))
