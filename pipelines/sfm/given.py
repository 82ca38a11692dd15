"""Poses that the user brings: what they say beside those found here, and a model that starts from them."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..geometry import se3
from ..geometry.se3 import Similarity, best_rotation
from .adjust import bundle_adjust, filter_outliers, median_error
from .components import MIN_POINTS, remove_keyframes
from .consistency import unexplained
from .matching import VerifiedPair

_LEFT_OUT_PX = 8.0
"""Median errors within which an observation belongs to a point, at most COLMAP's own limits. Of half, once and twice as
much it is the best on two of four stretches of one made-up walk; COLMAP's four pixels double the error of one."""

Array = NDArray[np.float64]

_TURNS = (8.0, 3.0, 1.0)
"""Degrees by which rays of one point may miss, round after round: poses that are 3 degrees off still make points, and
what is off by more is left out once these have been adjusted."""
_FOCALS = np.geomspace(0.4, 3.0, 41)
_ROUNDS = 20
_FAR_OFF = 5.0
"""Standard deviations from which a given pose is wrong altogether."""
_MIN_SD = 1e-6
_APART_DEGREES, _APART_SHARE, _TURNED_SHARE = 3.0, 0.4, 0.2
"""Scatter of all given poses, in degrees and as a share of their path's extent, beyond which they are not those of the
images. Of phones and of SLAM it is below 2 degrees; positions of other frames scatter by 0.6. Those of a camera that
hardly does more than turn scatter too: directions that agree to less than a fifth of how they turn are its own."""


@dataclass(frozen=True)
class GivenFit:
    """Fit of given poses to found ones: given = `move`(found); standard deviations of the inliers, in the given unit
    and in degrees; `wrong` (N,): outliers; `scale_sd`: relative; `extent` and `extent_degrees`: root mean square
    distance of the given positions, and angle of the directions, from their middle."""

    move: Similarity
    position_sd: float
    degrees_sd: float
    wrong: NDArray[np.bool_]
    scale_sd: float
    extent: float
    extent_degrees: float

    @property
    def is_contradiction(self) -> bool:
        """Return whether the two have so little in common that they cannot be poses of the same images."""
        turns_agree = self.degrees_sd < _TURNED_SHARE * self.extent_degrees
        return self.degrees_sd > _APART_DEGREES or (self.position_sd > _APART_SHARE * self.extent and not turns_agree)


def fit_given_poses(found: Array, given: Array) -> GivenFit | None:
    """Fit cameras (N, 4, 4) in two worlds by iterated reweighting (Cauchy's weights at the median residual); None where
    fewer than three, or cameras that hardly moved, determine no scale."""
    if len(found) < 3:
        return None
    ours, theirs = se3.inverse(found), se3.inverse(given)
    # Started without far outliers: a pose in another town would turn the first fit round.
    apart = np.linalg.norm(theirs[:, :3, 3] - np.median(theirs[:, :3, 3], axis=0), axis=1)
    weight = 1 / (1 + (apart / max(3 * float(np.median(apart)), _MIN_SD)) ** 2)
    for _ in range(_ROUNDS):
        axes = np.repeat(weight, 3)[:, None]
        rotation = best_rotation(axes * ours[:, :3, :3].transpose(0, 2, 1).reshape(-1, 3),
                                 theirs[:, :3, :3].transpose(0, 2, 1).reshape(-1, 3))  # fmt: skip
        mean_a, mean_b = (np.average(c[:, :3, 3], axis=0, weights=weight) for c in (ours, theirs))
        a, b = (ours[:, :3, 3] - mean_a) @ rotation.T, theirs[:, :3, 3] - mean_b
        spread = float(weight @ (a**2).sum(1))
        scale = float(weight @ (a * b).sum(1)) / max(spread, 1e-300)
        if not (scale > 0 and np.isfinite(scale)):
            return None
        away = np.linalg.norm(scale * a - b, axis=1)
        turned = np.degrees(se3.rotation_angle(_turns(ours, theirs, rotation)))
        sds = [max(float(np.median(x)) / 1.54, _MIN_SD) for x in (away, turned)]  # the median norm of three
        weight = 1 / (1 + (away / sds[0] / 3) ** 2 + (turned / sds[1] / 3) ** 2)
    wrong = (away > _FAR_OFF * sds[0] + _MIN_SD) | (turned > _FAR_OFF * sds[1] + _MIN_SD)
    move = Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)
    relative_sd = sds[0] / max(scale * np.sqrt(spread), 1e-12)
    middle = np.average(theirs[:, :3, :3], axis=0, weights=weight)  # |R - middle|² is twice the squared angle
    turned_extent = math.degrees(math.sqrt(max(3 - float((middle**2).sum()), 0) / 2))
    extent = scale * float(np.sqrt(spread / weight.sum()))
    return GivenFit(move, sds[0], sds[1], wrong, relative_sd, extent, turned_extent)


def _turns(ours: Array, theirs: Array, rotation: Array) -> Array:
    """(N, 4, 4) rotations from where ours, turned, look to where theirs do."""
    out = np.tile(np.eye(4), (len(ours), 1, 1))
    out[:, :3, :3] = theirs[:, :3, :3] @ (rotation @ ours[:, :3, :3]).transpose(0, 2, 1)
    return out


def posed_model(
    camera: pycolmap.Camera,
    xy: Sequence[Array],
    cam_from_world: Array,
    pairs: Sequence[VerifiedPair],
    refine_camera: bool,
    seed: int,
) -> pycolmap.Reconstruction | None:
    """Points of the verified matches (of images with pixels xy), triangulated with given poses (K, 4, 4) and adjusted
    together with them, in rounds that ask for more and more; without the images that hardly any point holds. None where
    the poses make no point."""
    model = bare_model(camera, xy, cam_from_world)
    images = sorted(model.reg_image_ids())
    if len(images) < 2:
        return None
    if refine_camera and not camera.has_prior_focal_length:
        set_best_focal(model, pairs, xy)
    for degrees in _TURNS:
        limit = model.cameras[1].mean_focal_length() * np.radians(degrees)
        complete_tracks(model, pairs, seed, limit)
        if model.num_points3D() < 2:
            continue
        bundle_adjust(model, images, refine_camera and degrees == _TURNS[-1], width=max(1.0, limit / 8))
        pycolmap.ObservationManager(model).filter_all_points3D(max(4.0, limit / 2), 1.0)
    filter_outliers(model)
    _remove_unheld(model)
    return model if model.num_points3D() else None


def _remove_unheld(model: pycolmap.Reconstruction) -> None:
    """Remove images that hardly any point holds, in place: COLMAP's mappers cannot add to a model with such."""
    while unheld := [i - 1 for i in sorted(model.reg_image_ids()) if model.images[i].num_points3D < MIN_POINTS]:
        remove_keyframes(model, unheld)


def bare_model(camera: pycolmap.Camera, xy: Sequence[Array], cam_from_world: Array) -> pycolmap.Reconstruction:
    """Images i + 1 with pixels xy[i] at their poses, those of NaN left out, and no points."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for i, (pixels, pose) in enumerate(zip(xy, cam_from_world, strict=True)):
        if np.isfinite(pose).all():
            points = pycolmap.Point2DList([pycolmap.Point2D(at) for at in pixels])
            image = pycolmap.Image(name=f"{i:06d}", points2D=points, camera_id=camera.camera_id, image_id=i + 1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    return model


def set_best_focal(model: pycolmap.Reconstruction, pairs: Sequence[VerifiedPair], xy: Sequence[Array]) -> None:
    """Give the camera the focal length at which the poses explain most of the matches, in place."""
    camera = model.cameras[1]

    def cost(focal: float) -> float:
        camera.params = [focal, *camera.params[1:]]
        return unexplained(model, pairs, xy)

    best = min(_FOCALS * max(camera.width, camera.height), key=cost)
    camera.params = [best, *camera.params[1:]]


def complete_tracks(
    model: pycolmap.Reconstruction, pairs: Iterable[VerifiedPair], seed: int, limit: float | None = None
) -> int:
    """Points of matched features that have none, tracks that go on, and points that are one made one, in place, by
    COLMAP's triangulator; image i + 1 is keyframe i. How many observations were added or merged.

    limit: pixels within which an observation belongs to a point, for poses that are far off."""
    graph = pycolmap.CorrespondenceGraph()
    placed = sorted(model.reg_image_ids())
    for i in placed:
        graph.add_image(i, len(model.images[i].points2D))
    for pair in pairs:
        if graph.exists_image(pair.first + 1) and graph.exists_image(pair.second + 1):
            geometry = pycolmap.TwoViewGeometry(config=pair.config, inlier_matches=pair.matches)
            graph.add_two_view_geometry(pair.first + 1, pair.second + 1, geometry)
    graph.finalize()
    asked, limit = limit, _LEFT_OUT_PX * median_error(model) if limit is None else limit
    triangulator = pycolmap.IncrementalTriangulator(graph, model, pycolmap.ObservationManager(model, graph))
    options = pycolmap.IncrementalTriangulatorOptions()
    options.random_seed = seed
    angle = math.degrees(limit / model.cameras[1].mean_focal_length())
    if asked is None:
        limit, angle = min(limit, options.merge_max_reproj_error), min(angle, options.create_max_angle_error)
    options.merge_max_reproj_error = options.complete_max_reproj_error = limit
    options.create_max_angle_error = options.continue_max_angle_error = angle
    found = sum(triangulator.triangulate_image(options, i) for i in placed)
    return found + triangulator.complete_all_tracks(options) + triangulator.merge_all_tracks(options)
