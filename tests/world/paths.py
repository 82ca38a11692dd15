"""Walks of a hand-held camera: smooth, closed, and never a turn on the spot."""

import numpy as np
from numpy.typing import NDArray

EYE_HEIGHT = 1.45


def room_walk(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam of a walk round the table; `steps` (N,) counts laps, 1 = back at the start.

    The camera looks over the table at the other side of the room, so that near and far things move differently.
    The hand goes up and down too: edges along the motion have no parallax of their own. A second lap passes a hand's
    breadth beside the first.
    """
    angle = 2 * np.pi * steps
    swing = 1 + 0.05 * np.sin(2 * angle + 0.7) + 0.02 * np.sin(0.5 * angle)
    center = np.stack(
        [1.85 * swing * np.cos(angle), 1.5 * swing * np.sin(angle), EYE_HEIGHT + 0.14 * np.sin(5 * angle)], axis=1
    )
    target = np.stack(
        [-0.35 * np.cos(angle + 0.5), -0.3 * np.sin(angle + 0.5), 0.95 + 0.14 * np.sin(2 * angle + 1.0)], axis=1
    )
    return look_at(center, target, roll=0.03 * np.sin(4 * angle))


def look_at(center: NDArray[np.float64], target: NDArray[np.float64], roll: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam of cameras at `center` (N, 3) that look at `target` (N, 3); world z is up."""
    forward = target - center
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    world_from_cam = np.tile(np.eye(4), (len(center), 1, 1))
    world_from_cam[:, :3, 0] = c * right + s * down
    world_from_cam[:, :3, 1] = c * down - s * right
    world_from_cam[:, :3, 2] = forward
    world_from_cam[:, :3, 3] = center
    return world_from_cam
