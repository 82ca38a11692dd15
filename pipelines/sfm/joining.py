"""Windows of a long recording become one; loops between them are closed in tracking, by their links.

A mapper's memory grows by half a megabyte to two a keyframe, nearly all of it in its adjustments, so that no more than
one window is in work at any time. What is joined is adjusted by `pipelines.sfm.bundle`, which needs a tenth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import pose_of, set_pose
from ..geometry import se3
from ..geometry.se3 import Similarity, best_rotation
from .adjust import LOSS_SD, filter_outliers, median_error
from .bundle import adjust_bundle
from .components import remove_keyframes
from .given import bare_model
from .rolling import MIN_GAIN, NO_READOUT, Readout, RollingModel, estimate

_SUREST_PX = 1e-3
"""No window is surer of its focal length."""

Array = NDArray[np.float64]

_MIN_SHARED = 30
_READOUT_ROUNDS = 3
"""Each step falls a little short."""


@dataclass
class Joined:
    """Poses by image, points, observations (O, 3) of window after window: image, feature, point; and which point an
    observation (image, feature) of the last window sees: no image is in three windows, see `windows_of`."""

    poses: dict[int, Array] = field(default_factory=dict)
    points: list[Array] = field(default_factory=list)
    observations: list[NDArray[np.int32]] = field(default_factory=list)
    seen: dict[tuple[int, int], int] = field(default_factory=dict)

    def add(self, model: pycolmap.Reconstruction, first: int) -> bool:
        """Add one more model, of images counted from `first`, moved by a similarity to where it shares images and
        points with the one before; False where these are too few."""
        points = {p: model.points3D[p] for p in sorted(model.point3D_ids())}
        tracks = {p: [(first + e.image_id, e.point2D_idx) for e in q.track.elements] for p, q in points.items()}
        known = {p: self.seen[o] for p, track in tracks.items() for o in reversed(track) if o in self.seen}
        ids = sorted(model.reg_image_ids())
        found = {first + i: pose_of(model.images[i]) for i in ids}
        both = [i for i in found if i in self.poses]
        move = Similarity(1.0, np.eye(3), np.zeros(3))
        if self.poses:
            if not both or len(known) < _MIN_SHARED:
                return False
            poses = np.array([found[i] for i in both]), np.array([self.poses[i] for i in both])
            seen = np.array([points[p].xyz for p in known]), np.array([self.points[at] for at in known.values()])
            move = align_views(*poses, *seen)
        moved = move.apply_to_poses(np.array(list(found.values())))
        self.poses = dict(zip(found, moved, strict=True)) | self.poses
        before, self.seen, new = self.seen, {}, []
        for p, track in tracks.items():
            if p not in known:
                known[p] = len(self.points)
                self.points.append(move.apply(points[p].xyz))
            self.seen.update(dict.fromkeys(track, known[p]))
            new += [(*o, known[p]) for o in track if o not in before]
        self.observations.append(np.array(new, np.int32).reshape(-1, 3))
        return True

    def model(self, camera: pycolmap.Camera, xy: Sequence[Array]) -> pycolmap.Reconstruction:
        """Convert to a pycolmap model of all keyframes; image i + 1 has the pixels xy[i]."""
        nowhere = np.full((4, 4), np.nan)
        model = bare_model(camera, xy, np.array([self.poses.get(i + 1, nowhere) for i in range(len(xy))]))
        observations = np.concatenate(self.observations)
        observations = observations[np.argsort(observations[:, 2], kind="stable")]
        starts = np.searchsorted(observations[:, 2], np.arange(len(self.points) + 1))
        for xyz, a, b in zip(self.points, starts[:-1], starts[1:], strict=True):
            elements = [pycolmap.TrackElement(int(i), int(f)) for i, f, _ in observations[a:b]]
            model.add_point3D(xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
        return model


def align_views(source: Array, target: Array, source_points: Array, target_points: Array) -> Similarity:
    """Fit the similarity that takes cameras cam_from_source (N, 4, 4) and the points (P, 3) they see to cam_from_target
    and where these points are there: rotation by all axes of the cameras, then medians, for points may be far off."""
    rotation = best_rotation(source[:, :3, :3].reshape(-1, 3), target[:, :3, :3].reshape(-1, 3))
    centers, wanted = se3.inverse(source)[:, :3, 3], se3.inverse(target)[:, :3, 3]
    away, there = (
        np.linalg.norm(p - c[:, None], axis=2) for p, c in ((source_points, centers), (target_points, wanted))
    )
    scale = float(np.median(there / np.maximum(away, 1e-12)))
    return Similarity(scale, rotation, np.median(wanted - scale * centers @ rotation.T, axis=0))


def adjust_joined(
    model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array, readout: Readout, narrowly: bool,
    find_readout: bool = False,
) -> Readout:  # fmt: skip
    """Adjust the joined windows as one, in place; `narrowly` as of `adjust`. Returns the readout: that given, or with
    `find_readout` what all keyframes together tell."""
    adjust_together(model, xy, times, readout)
    if find_readout and any(readout):
        readout = found_readout(model, xy, times, readout)
    if narrowly:
        adjust_together(model, xy, times, readout, median_error(model) / LOSS_SD)
    filter_outliers(model)
    return readout


def found_readout(model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array, start: Readout) -> Readout:
    """Find the readout of a model from a first guess; none where it explains too little. The model is adjusted with it,
    in place."""
    seconds = math.hypot(*start)
    axis, share = (start[0] / seconds, start[1] / seconds), 0.0
    for _ in range(_READOUT_ROUNDS):
        rolling = RollingModel(model, xy, times)
        bundle, plain, pinhole = rolling.bundle()
        straight = rolling.rectified(bundle, plain, pinhole, (axis[0] * seconds, axis[1] * seconds))
        step, share = estimate(straight, plain, pinhole, rolling.times, axis)
        seconds += step
        adjust_together(model, xy, times, (axis[0] * seconds, axis[1] * seconds))
    if seconds**2 * share >= MIN_GAIN:
        return axis[0] * seconds, axis[1] * seconds
    adjust_together(model, xy, times, NO_READOUT)
    return NO_READOUT


def adjust_together(
    model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array, readout: Readout, width: float = 2.0
) -> None:  # fmt: skip
    """Adjust poses and points in place, with the camera as it is; see `adjust_bundle` for the width of the loss."""
    rolling = RollingModel(model, xy, times)
    images, point_ids = rolling.arrays.image_ids.tolist(), rolling.arrays.point_ids.tolist()
    bundle, plain, pinhole = rolling.bundle()
    if any(readout):
        bundle = rolling.rectified(bundle, plain, pinhole, readout)
    del rolling, plain  # pixels of all observations once more
    adjusted = adjust_bundle(bundle, pinhole, width=width).bundle
    for i, pose in zip(images, adjusted.cam_from_world, strict=True):
        set_pose(model, i, pose)
    for p, xyz in zip(point_ids, adjusted.points, strict=True):
        model.points3D[p].xyz = xyz


@dataclass
class WindowModels:
    """`components`: the windows joined one to the next; where one has no model, or shares too little with the one
    before, a new one begins. For each window its camera's parameters (P,), the standard deviation of the focal length,
    the readout and the number of observations."""

    components: list[Joined] = field(default_factory=list)
    cameras: list[Array] = field(default_factory=list)
    focal_sds: list[float] = field(default_factory=list)
    readouts: list[Readout] = field(default_factory=list)
    observations: list[int] = field(default_factory=list)

    def add(self, model: pycolmap.Reconstruction, first: int, focal_sd: float, readout: Readout) -> None:
        """Add the model of the next window, whose images are counted from `first`."""
        if not self.components or not self.components[-1].add(model, first):
            self.components.append(Joined())
            self.components[-1].add(model, first)
        self.cameras.append(np.array(model.cameras[1].params))
        self.focal_sds.append(focal_sd)
        self.readouts.append(readout)
        self.observations.append(model.compute_num_observations())

    def calibrate(self, camera: pycolmap.Camera) -> float:
        """Set the camera to the mean of all windows', weighted by the variance of each focal length. Returns the mean's
        standard deviation: from those of the windows, and from the spread between them."""
        weights = 1 / np.maximum(self.focal_sds, _SUREST_PX) ** 2
        camera.params = np.average(self.cameras, axis=0, weights=weights).tolist()
        focal = np.array([c[0] for c in self.cameras])
        apart = np.average((focal - camera.params[0]) ** 2, weights=weights) / len(focal)
        return float(np.sqrt(1 / weights.sum() + apart))

    def readout(self) -> Readout:
        """Return the mean of all windows', weighted by observations: a start for that of the whole."""
        first, second = np.average(self.readouts, axis=0, weights=self.observations).tolist()
        return first, second

    def largest(self) -> Joined:
        """Return the part with most keyframes, the first of equal ones."""
        return max(self.components, key=lambda component: len(component.poses))

    def others(
        self, camera: pycolmap.Camera, xy: Sequence[Array], whole: pycolmap.Reconstruction, least: int
    ) -> list[pycolmap.Reconstruction]:
        """Return the other components with at least `least` keyframes that `whole` lacks, without those it has."""
        found, placed = [], set(whole.reg_image_ids())
        for component in self.components:
            if component is not self.largest() and len(component.poses.keys() - placed) >= least:
                model = component.model(camera, xy)
                remove_keyframes(model, [i - 1 for i in sorted(component.poses.keys() & placed)])
                placed |= component.poses.keys()
                found.append(model)
        return found
