"""Rolling shutter: a sensor reads its rows one after the other, and the camera moves on meanwhile.

A frame's pose is that of its middle row. What is seen `late` seconds after it appears, to first order, `late` times its
velocity in the image farther on; the camera's velocity comes from the poses of the frames beside it (as in Hedborg
et al., Rolling Shutter Bundle Adjustment, CVPR 2012, whose poses between frames are interpolated). Pixels from which
that displacement is taken away are adjusted as if they had been seen at once. How long the readout takes is one number
of the camera, found in closed form beside all poses and points.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import ModelArrays
from ...formats.errors import InputError
from ..geometry import se3
from ..system.parallel import parallel_map
from ..system.threads import get_threads
from ..types import Array, Intrinsics
from . import bundle_kernels as kernels
from .adjust import LOSS_SD, adjust_model, bundle_adjust, robust_cost
from .bundle import Bundle, Problem, adjust_bundle

Readout = tuple[float, float]
"""Seconds by which the right and the lower border of a frame are taken later than the left and the upper one. Sensors
read row by row; of a video that was filmed upright and turned these are columns."""
NO_READOUT = (0.0, 0.0)

LONGEST_STEP = 1.0
"""Seconds: frames farther apart say nothing about the camera's velocity at either."""
MIN_STEP = 1e-4
"""Seconds: frames of nearly one time (duplicated or repaired timestamps) make a derivative of noise alone."""
FILM = 0.5
"""Seconds from one image to the next: of photos taken more slowly the speed tells nothing."""
MIN_GAIN = 0.01
"""Share of the robust cost that a readout must explain. Of three cameras that take all rows at once it was less than
0.00002, of a phone that holds still 0.001; of a Kinect 0.03 at first and 0.054 in the end."""
REACH = (-2, -1, 1, 2)
MIN_HELD_OUT_GAIN, MAX_SCALE_CHANGE = 0.02, 2.0
"""Of the robust cost of observations held out, the share that a readout must explain; and the factor by which it may
change the scale of one stretch of the path against another. Seven recordings of rolling shutters: 0.07 to 0.23, and
1.01 to 1.05, but 1.54 where the camera hardly does more than turn."""
_LONG_TRACK = 4
"""Views of a point from which on an observation of it may be held out."""
_ROUNDS = 3
"""Of readout and rough adjustment by turns; the last adjustment comes after them."""


@dataclass(frozen=True)
class Shutter:
    """Timing of a recording: the readout, and the time (F,) of each frame in seconds."""

    readout: Readout = NO_READOUT
    times: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def is_rolling(self) -> bool:
        """Return whether rows are taken one after the other."""
        return any(self.readout)


def read_readout(text: str) -> Readout | None:
    """Parse the setting `frames.rolling_shutter`: None for auto. Raises InputError for what is no time."""
    if text == "auto":
        return None
    try:
        seconds = 0.0 if text == "off" else float(text)
    except ValueError:
        seconds = math.nan
    if not abs(seconds) <= 1:
        raise InputError(
            f"frames.rolling_shutter is auto, off or the seconds from a frame's first row to its last; got {text!r:.40}"
        )
    return 0.0, seconds


def velocities(cam_from_world: Array, times: Array, worlds: NDArray[np.int64] | None = None) -> Array:
    """(N, 6) twists a second of cameras (N, 4, 4) in order, at times (N,): the derivative of the polynomial through the
    poses of up to two frames before and two after. Frames more than LONGEST_STEP away, or in another of the `worlds`
    (N,), or of a clock that was set back, or within MIN_STEP of the frame between or of this one, do not count;
    without any the velocity is zero."""
    count = len(times)
    steps, twists = np.zeros((len(REACH), count)), np.zeros((len(REACH), count, 6))
    for row, offset in enumerate(REACH):
        here = np.arange(max(0, -offset), count - max(0, offset))
        apart = (times[here + offset] - times[here]) * np.sign(offset)
        nearer = here + offset - np.sign(offset)
        known = (apart >= MIN_STEP) & (apart <= LONGEST_STEP) & (abs(times[here + offset] - times[nearer]) >= MIN_STEP)
        if worlds is not None:
            known &= worlds[here + offset] == worlds[here]
        here = here[known]
        steps[row, here] = apart[known] * np.sign(offset)
        twists[row, here] = se3.log(cam_from_world[here + offset] @ se3.inverse(cam_from_world[here]))
    out = np.zeros((count, 6))
    for row, step in enumerate(steps):
        # Lagrange's weight of one of the poses in the derivative where all twists are zero.
        others = [np.where(s != 0, s / np.where(s == step, 1.0, s - step), 1.0) for s in np.delete(steps, row, axis=0)]
        weight = np.where(step != 0, np.prod(others, axis=0) / np.where(step != 0, step, 1.0), 0.0)
        out += weight[:, None] * twists[row]
    return out


def rectified_bundle(bundle: Bundle, xy: Array, camera: Intrinsics, velocity: Array, readout: Readout) -> Bundle:
    """Return the bundle with its observations where they would be in frames taken at once; xy (O, 2) are those in the
    frames, velocity (N, 6) those of its cameras."""
    seen = bundle.obs_cam, bundle.obs_point
    return replace(
        bundle, obs_xy=xy - _moved(bundle.cam_from_world, bundle.points, seen, xy, camera, velocity, readout)
    )


def rectified_pixels(
    cam_from_world: Array, points: Array, xy: Array, camera: Intrinsics, velocity: Array, readout: Readout
) -> Array:
    """(Q, 2) likewise, of one camera (4, 4) of velocity (6,) that sees points (Q, 3) at xy (Q, 2)."""
    seen = np.zeros(len(xy), np.int64), np.arange(len(xy))
    return xy - _moved(np.ascontiguousarray(cam_from_world)[None], points, seen, xy, camera, velocity[None], readout)


def _moved(
    cam_from_world: Array, points: Array, seen: tuple[NDArray[np.int64], NDArray[np.int64]], xy: Array,
    camera: Intrinsics, velocity: Array, readout: Readout,
) -> Array:  # fmt: skip
    late = (xy / [camera.width, camera.height] - 0.5) @ np.array(readout)
    return kernels.displacement(cam_from_world, points, camera.numbers, *seen, velocity, late)


def estimate(bundle: Bundle, xy: Array, camera: Intrinsics, times: Array, direction: Readout) -> tuple[float, float]:
    """Estimate by how much the readout in this `direction` (of one second) should grow, and the share of the robust
    cost that a second of it makes: it grows by the square. See `rectified_bundle` for the arguments.

    One Gauss-Newton step of it together with all poses and points, which are eliminated. Since observations far off
    weigh less, it falls short by a fixed share, and is repeated.
    """
    order = np.lexsort((bundle.obs_cam, bundle.obs_point))
    bundle = bundle.select(order)
    velocity, seen = velocities(bundle.cam_from_world, times), (bundle.obs_cam, bundle.obs_point)
    moved = _moved(bundle.cam_from_world, bundle.points, seen, xy[order], camera, velocity, direction)
    problem = Problem(bundle, camera)
    at = bundle.cam_from_world, bundle.points
    blocks, cam_right, point_blocks, point_right = problem.linearise(*at)
    cams, points, own, right = kernels.border(bundle.cam_from_world, bundle.points, problem.data, moved)
    solved = problem.solve(at, (blocks, cams, point_blocks, points), 1e-7)
    if solved is None:
        return 0.0, 0.0
    information = own - float((solved[0] * cams).sum() + (solved[1] * points).sum())
    if not information > 1e-9 * own:
        return 0.0, 0.0
    step = (right - float((solved[0] * cam_right).sum() + (solved[1] * point_right).sum())) / information
    return step, information / max(problem.cost(bundle.cam_from_world, bundle.points), 1e-12)


class RollingModel:
    """A reconstruction, its keyframes' features xy (F, 2) in pixels and times (K,): image i + 1 is keyframe i.

    What sees what is read once: an adjustment moves points, and takes none away.
    """

    def __init__(self, model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array) -> None:
        self.model, self.arrays = model, ModelArrays.of(model)
        self.images = self.arrays.image_ids.tolist()
        self.times = times[self.arrays.image_ids - 1]
        self.features = [self.arrays.obs_feature[own] for own in self.arrays.rows()]
        plain = [xy[i - 1][f] for i, f in zip(self.images, self.features, strict=True)]
        self.raw_xy: Array = np.concatenate([np.zeros((0, 2)), *plain])
        self.rectified_xy = self.raw_xy

    def bundle(self) -> tuple[Bundle, Array, Intrinsics]:
        """Return the bundle in a pinhole's pixels, as the model has them; (O, 2) as the frames do; and the pinhole."""
        camera, count = self.model.cameras[1], len(self.rectified_xy)
        focal, half = camera.mean_focal_length(), np.array([camera.width, camera.height]) / 2
        pinhole = Intrinsics(camera.width, camera.height, focal, focal, *half)
        at = self.arrays.reread(self.model)
        bundle = Bundle(
            np.ascontiguousarray(at.cam_from_world), at.points, at.obs_cam, at.obs_point,
            np.asarray(camera.cam_from_img(self.rectified_xy)) * focal + half,
            *(np.broadcast_to(value, count) for value in (LOSS_SD, 0.0, 1.0, -1)),
        )  # fmt: skip
        return bundle, np.asarray(camera.cam_from_img(self.raw_xy)) * focal + half, pinhole

    def rectified(self, bundle: Bundle, xy: Array, pinhole: Intrinsics, readout: Readout) -> Bundle:
        """Return `rectified_bundle` by the velocities of the bundle's own poses."""
        return rectified_bundle(bundle, xy, pinhole, velocities(bundle.cam_from_world, self.times), readout)

    def rectify_observations(self, bundle: Bundle, xy: Array, pinhole: Intrinsics, readout: Readout) -> None:
        """Put the model's observations where they would be in frames taken at once, by `bundle`'s poses and points."""
        now: Array = self.rectified(bundle, xy, pinhole, readout).obs_xy
        rays = (now - [pinhole.cx, pinhole.cy]) / pinhole.fx
        self.set_observations(
            np.asarray(self.model.cameras[1].img_from_cam(np.column_stack([rays, np.ones(len(rays))])))
        )

    def set_observations(self, pixels: Array) -> None:
        """Make (O, 2) `pixels` the model's observations."""
        self.rectified_xy, ordered = pixels, iter(pixels)
        for i, features in zip(self.images, self.features, strict=True):
            points = self.model.images[i].points2D
            for k in features.tolist():
                points[k].xy = next(ordered)


def straight_copy(
    model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array, readout: Readout
) -> pycolmap.Reconstruction:
    """Copy the model with its observations where they would be in frames taken at once."""
    rolling = RollingModel(pycolmap.Reconstruction(model), xy, times)
    if any(readout):
        rolling.rectify_observations(*rolling.bundle(), readout)
    return rolling.model


def frame_interval(times: Array, numbers: NDArray[np.int64]) -> float:
    """Estimate the seconds from one image of the source to the next, from times (N,) of the images of these `numbers`
    (N,); 0 where they tell none."""
    steps, apart = np.diff(numbers), np.diff(times)
    known = (steps > 0) & (apart > 0)
    return float(np.median(apart[known] / steps[known])) if known.any() else 0.0


@dataclass(frozen=True)
class ReadoutEvidence:
    """Evidence for a readout: by what share of the robust cost of held-out observations it is better than a global
    shutter, and by what factor it changes the scale of one stretch of the path against another."""

    held_out_gain: float
    scale_change: float

    @property
    def is_convincing(self) -> bool:
        """Return whether the observations are explained better by a path that is not bent."""
        return self.held_out_gain > MIN_HELD_OUT_GAIN and self.scale_change < MAX_SCALE_CHANGE


def weigh_readout(rolling: RollingModel, readout: Readout) -> ReadoutEvidence:
    """Adjust poses and points with this readout and with none to the same observations, and compare both.

    One observation of each second long track is held out of both adjustments.
    """
    bundle, xy, pinhole = rolling.bundle()
    held = _held_out(bundle)

    def adjusted(tried: Readout) -> tuple[float, Array]:
        found = bundle
        for _ in range(_ROUNDS - 1 if any(tried) else 1):
            found = rolling.rectified(found, xy, pinhole, tried)
            kept = adjust_bundle(found.select(~held), pinhole).bundle
            found = replace(found, cam_from_world=kept.cam_from_world, points=kept.points)
        errors = rolling.rectified(found, xy, pinhole, tried).select(held).reprojection_errors(pinhole)
        return robust_cost(errors), np.maximum(found.points_in_cam()[:, 2], 1e-9)

    costs, depths = zip(*parallel_map(adjusted, (NO_READOUT, readout), get_threads()), strict=True)
    change = np.log(depths[1] / depths[0])
    by_camera = np.array([np.median(change[bundle.obs_cam == c]) for c in np.unique(bundle.obs_cam)])
    low, high = np.percentile(by_camera, (2, 98))
    return ReadoutEvidence(1 - costs[1] / max(costs[0], 1e-12), math.exp(high - low))


def _held_out(bundle: Bundle) -> NDArray[np.bool_]:
    """(O,) one observation, in turn an early and a late one, of each second point that many cameras see."""
    order = np.lexsort((bundle.obs_cam, bundle.obs_point))
    points, first, length = np.unique(bundle.obs_point[order], return_index=True, return_counts=True)
    chosen = (length >= _LONG_TRACK) & (points % 2 == 0)
    held = np.zeros(len(order), np.bool_)
    held[order[(first + points // 2 % length)[chosen]]] = True
    return held


def rectified_features(
    model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array, readout: Readout
) -> Sequence[Array]:
    """Pixels (F, 2) of each keyframe's features where they would be in frames taken at once; NaN for those whose depth
    no point of the model tells."""
    if not any(readout):
        return xy
    seen, out = ModelArrays.of(straight_copy(model, xy, times, readout)), [np.full(p.shape, np.nan) for p in xy]
    for i, own in zip(seen.image_ids.tolist(), seen.rows(), strict=True):
        out[i - 1][seen.obs_feature[own]] = seen.obs_xy[own]
    return out


def adjust_rolling(
    model: pycolmap.Reconstruction, xy: Sequence[Array], times: Array, readout: Readout | None, refine_camera: bool,
    narrowly: bool = False, longest: float = LONGEST_STEP,
) -> tuple[pycolmap.Reconstruction, Readout, float] | None:  # fmt: skip
    """Return the model adjusted with the `readout` given, or found where it is None, and the standard deviation of its
    focal length; None where there is no readout, or where the one found is longer than the `longest` possible
    (seconds), explains too little, or bends the path. The model given stays as it is, and pixels are those in the
    frames before and after."""
    if readout is not None and not any(readout):
        return None
    rolling = RollingModel(pycolmap.Reconstruction(model), xy, times)
    seen = rolling.bundle()
    if readout is None:
        (seconds, share), axis = max(
            ((estimate(*seen, rolling.times, axis), axis) for axis in ((1.0, 0.0), (0.0, 1.0))),
            key=lambda f: f[0][0] ** 2 * f[0][1],
        )
        if seconds**2 * share < MIN_GAIN:
            return None
    else:
        seconds = math.hypot(*readout)
        axis = readout[0] / seconds, readout[1] / seconds
    for _ in range(_ROUNDS):
        rolling.rectify_observations(*seen, (axis[0] * seconds, axis[1] * seconds))
        bundle_adjust(rolling.model, rolling.images, refine_camera, roughly=True)
        seen = rolling.bundle()
        if readout is None:
            step, share = estimate(*seen, rolling.times, axis)
            seconds += step
    found = axis[0] * seconds, axis[1] * seconds
    if readout is None and (
        seconds**2 * share < MIN_GAIN or abs(seconds) > longest or not weigh_readout(rolling, found).is_convincing
    ):
        return None
    rolling.rectify_observations(*seen, found)
    focal_sd = adjust_model(rolling.model, refine_camera, narrowly)
    rolling.set_observations(rolling.raw_xy)
    return rolling.model, found, focal_sd
