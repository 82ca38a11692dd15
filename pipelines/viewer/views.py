"""The view of a browser, in the size of the scene as shown."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def client_view(client: Any) -> Array:
    """(4, 4) pose of a client's camera as shown, x right, y down, z forward: viser's convention is ours."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.asarray(client.camera.wxyz)[[1, 2, 3, 0]]).as_matrix()
    pose[:3, 3] = client.camera.position
    return pose


def shown_pose(world_from_cam: Array, scale: float) -> tuple[Array, Array]:
    """(wxyz, position) as shown of a pose (4, 4) in the scene's world."""
    quat_xyzw = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
    return quat_xyzw[[3, 0, 1, 2]], world_from_cam[:3, 3] * scale


def move_client(client: Any, world_from_cam: Array, scale: float, fov: float) -> None:
    """Let a client look from a pose (4, 4) in the scene's world; fov: vertical, in radians."""
    wxyz, position = shown_pose(world_from_cam, scale)
    with client.atomic():
        client.camera.wxyz, client.camera.position = wxyz, position
        client.camera.fov = fov
