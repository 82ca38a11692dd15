"""Features and matches of made-up views round a table in a room of points, seen through any lens."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.sfm.bundle import Bundle
from msgs_slam.pipelines.sfm.candidates import KeyframeSet
from msgs_slam.pipelines.sfm.driver import StructureFromMotion
from msgs_slam.pipelines.sfm.flow import Picture
from msgs_slam.pipelines.sfm.given import bare_model
from msgs_slam.pipelines.sfm.matching import VerifiedPair, verify_matches
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.system.parallel import LruSequence
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Features

Array = NDArray[np.float64]
REACH, _POINTS, _NOISE_PX = 6, 900, 0.3


@dataclass(frozen=True)
class MadeViews:
    """cam_from_world (N, 4, 4) in metres, the views' features, and the points (F,) that these are."""

    cam_from_world: Array
    features: list[Features]
    seen: list[NDArray[np.int64]]

    @property
    def centers(self) -> Array:
        """(N, 3)."""
        return se3.inverse(self.cam_from_world)[:, :3, 3]

    def pairs(self, camera: pycolmap.Camera) -> list[VerifiedPair]:
        """Neighbours' matches, verified with a `camera` that may be another one than they were seen with."""
        found = []
        for i in range(len(self.features)):
            for j in range(i + 1, min(i + REACH + 1, len(self.features))):
                _, a, b = np.intersect1d(self.seen[i], self.seen[j], return_indices=True)
                xy, matches = (self.features[i].xy, self.features[j].xy), np.stack([a, b], 1).astype(np.uint32)
                if len(a) >= 15 and (pair := verify_matches((i, j), matches, xy, camera, 0)):
                    found.append(pair)
        return found

    def views(self, given: Array | None = None) -> KeyframeSet:
        """As structure from motion has them, with poses (N, 4, 4) by another program."""
        streamed = LruSequence(len(self.features), self.features.__getitem__, lambda f: f.nbytes, 1e9)
        times = np.arange(len(self.features), dtype=float)
        return KeyframeSet(streamed, [f.xy for f in self.features], 10 * times, [], given)

    def off(self, model: pycolmap.Reconstruction) -> float:
        """Metres by which the model's worst camera is off after a similarity."""
        ids = sorted(model.reg_image_ids())
        placed, true = np.array([model.images[i].projection_center() for i in ids]), self.centers[[i - 1 for i in ids]]
        moved = align_points(placed, true, with_scale=True).apply(placed)
        return float(np.linalg.norm(moved - true, axis=1).max())


def walk_round(camera: pycolmap.Camera, views: int = 20, blank: range = range(0)) -> MadeViews:
    """Views from an arc through the room, as `camera` sees them; those of `blank` see a wall without a feature."""
    rng = np.random.default_rng(0)
    angle, far, height = (
        rng.uniform(0, 2 * np.pi, _POINTS),
        rng.uniform(2.0, 4.5, _POINTS),
        rng.uniform(-1.2, 1.2, _POINTS),
    )
    world = np.stack([far * np.sin(angle), height, far * np.cos(angle)], 1)
    poses = []
    for turn in np.linspace(0, 1.8, views):
        center = np.array([1.1 * np.sin(turn), 0.15 * np.sin(5 * turn), 0.8 * np.cos(turn)])
        cos, sin = np.cos(turn), np.sin(turn)
        poses.append(_pose(np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]), center))
    return _seen_from(camera, poses, world, rng, blank)


def walk_along_bare_wall(camera: pycolmap.Camera, views: int = 28) -> MadeViews:
    """Views of a hand-held walk: the first show a strip of the floor below a bare wall, the others a room besides."""
    rng = np.random.default_rng(0)
    strip = np.column_stack([rng.uniform(-1.5, 5, 500), np.full(500, 0.72), rng.uniform(1.76, 1.82, 500)])
    room = rng.uniform([2.6, -0.6, 1.4], [6, 0.6, 2.4], (_POINTS, 3))
    poses = []
    for n in range(views):
        turn = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
        poses.append(_pose(turn, np.array([0.1 * n, 0, 0]) + rng.normal(0, 0.01, 3)))
    return _seen_from(camera, poses, np.concatenate([strip, room]), rng)


def _seen_from(
    camera: pycolmap.Camera, poses: list[Array], world: Array, rng: np.random.Generator, blank: range = range(0)
) -> MadeViews:
    features, seen = [], []
    for n, pose in enumerate(poses):
        local = world @ pose[:3, :3].T + pose[:3, 3]
        ahead = np.flatnonzero((local[:, 2] > 0.5) & (np.abs(local[:, 0]) < 0.9 * local[:, 2]))
        pixels = np.asarray(camera.img_from_cam(local[ahead]))
        inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1) & (n not in blank)
        mine = ahead[inside]
        noisy = pixels[inside] + rng.normal(0, _NOISE_PX, (len(mine), 2))
        keypoints = np.column_stack([noisy, np.ones((len(mine), 2))]).astype(np.float32)
        features.append(Features(keypoints, np.zeros((len(mine), 128), np.uint8)))
        seen.append(mine)
    return MadeViews(np.array(poses), features, seen)


def _pose(rotation: Array, center: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return pose


def structure_of(made: MadeViews, camera: pycolmap.Camera, folder: Path, **named: Any) -> StructureFromMotion:
    """Structure from motion with this camera; `named`: further fields of it."""

    def no_picture(frame_id: int) -> Picture:
        raise AssertionError(f"nobody needs the picture of frame {frame_id}")

    arguments = {"is_fixed": True} | named
    return StructureFromMotion(
        config=FramesConfig(overlap=REACH), camera=camera, extract=made.features.__getitem__, picture=no_picture,
        time=lambda k: 10.0 * k, match=lambda *_: np.zeros((0, 2), np.uint32), snapshots=Snapshots(folder),
        progress=SilentProgress(), threads=1, seed=0, **arguments,
    )  # fmt: skip


def model_of_bundle(bundle: Bundle, camera: pycolmap.Camera) -> tuple[pycolmap.Reconstruction, list[Array]]:
    """The bundle as structure from motion would have it; pixels by keyframe."""
    pixels = [bundle.obs_xy[bundle.obs_cam == k] for k in range(len(bundle.cam_from_world))]
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in bundle.points]
    for k in range(len(pixels)):
        for n, p in enumerate(bundle.obs_point[bundle.obs_cam == k]):
            tracks[p].append(pycolmap.TrackElement(k + 1, n))
    model = bare_model(camera, pixels, bundle.cam_from_world)
    for xyz, elements in zip(bundle.points, tracks, strict=True):
        if len(elements) >= 2:
            model.add_point3D(xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
    return model, pixels
