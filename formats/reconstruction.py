"""pycolmap's reconstruction as arrays, for whatever computes with all of its observations at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelArrays:
    """Images, points and observations of a reconstruction.

    image_ids (N,), cam_from_world (N, 4, 4); point_ids (P,) in ascending order, points (P, 3) in the world; the
    observations of image after image: obs_cam (O,) int index into image_ids, obs_point (O,) int index into points,
    obs_feature (O,) int index into the image's features, obs_xy (O, 2) pixels.
    """

    image_ids: NDArray[np.int64]
    cam_from_world: Array
    point_ids: NDArray[np.int64]
    points: Array
    obs_cam: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_feature: NDArray[np.int64]
    obs_xy: Array

    @staticmethod
    def of(model: pycolmap.Reconstruction, image_ids: Sequence[int] | None = None) -> ModelArrays:
        """Read these images, or all that are registered in the order of their ids."""
        ids = sorted(model.reg_image_ids()) if image_ids is None else image_ids
        point_ids = np.array(sorted(model.point3D_ids()), np.int64)
        features, seen, xy = [], [], []
        for i in ids:
            features.append(model.images[i].get_observation_point2D_idxs())
            observed = model.images[i].get_observation_points2D()
            seen += [p.point3D_id for p in observed]
            xy += [p.xy for p in observed]
        return ModelArrays(
            np.array(ids, np.int64),
            _poses(model, ids),
            point_ids,
            _positions(model, point_ids.tolist()),
            np.repeat(np.arange(len(ids)), [len(f) for f in features]),
            np.searchsorted(point_ids, np.array(seen, np.int64)),
            np.array([k for f in features for k in f], np.int64),
            np.array(xy, np.float64).reshape(-1, 2),
        )

    def reread(self, model: pycolmap.Reconstruction) -> ModelArrays:
        """Read the poses and points that the model has by now; the observations stay."""
        poses, points = _poses(model, self.image_ids.tolist()), _positions(model, self.point_ids.tolist())
        return replace(self, cam_from_world=poses, points=points)

    def rows(self) -> list[slice]:
        """The observations of each image."""
        ends = np.searchsorted(self.obs_cam, np.arange(len(self.image_ids) + 1)).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]


def _poses(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> Array:
    poses = [pose_of(model.images[i]) for i in image_ids]
    return np.stack(poses) if poses else np.zeros((0, 4, 4))


def _positions(model: pycolmap.Reconstruction, point_ids: Sequence[int]) -> Array:
    return np.array([model.points3D[p].xyz for p in point_ids], np.float64).reshape(-1, 3)


def pose_of(image: pycolmap.Image) -> Array:
    """(4, 4) camera from world."""
    return np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])


def set_pose(model: pycolmap.Reconstruction, image_id: int, cam_from_world: Array) -> None:
    """Move an image of a model whose images are each a frame of their own; cam_from_world is (3, 4) or (4, 4)."""
    model.frames[model.images[image_id].frame_id].rig_from_world = pycolmap.Rigid3d(cam_from_world[:3])
