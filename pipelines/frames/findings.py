"""Findings of structure from motion for the user: gaps, contradictions, and what became of given poses and cameras."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import ModelArrays, pose_of
from ...formats.errors import InputError
from ..geometry.sparse_model import SparseModel
from ..run.stages import StageContext
from ..sfm.adjust import focals_of_halves
from ..sfm.candidates import GIVEN, GIVEN_ONLY
from ..sfm.consistency import MAX_DRIFT
from ..sfm.driver import Structure
from ..sfm.given import GivenFit, fit_given_poses
from ..sfm.lens import Lens
from ..source.given import numbering
from ..system.wording import frames_text, stretches
from ..types import Frame, GivenPoses

_MIN_PART = 3
_FEW_WRONG = 0.25
_APART, _ZOOM, _OFF = 5.0, 0.03, 0.05
"""Standard deviations by which two focal lengths contradict each other, if they are also so far apart relatively: those
of two halves of a recording, and one found beside one known before. Halves of five recordings without zoom: up to 3.2.
"""

_COSTLY = 1 / 3
"""Share of the matches that masks of people may cost unmentioned."""
_NOISY = 0.03
"""Standard deviation of the noise over the contrast of an image. Fifteen recordings by day: up to 0.012; one with a
seventh of the light 0.09."""
_SHIFTED, _MIN_GAIN = 0.004, 0.1
"""Of the longer side, by how much images are shifted; and the share of the residuals that the shifts explain. Eleven
recordings: up to 0.004 and 0.03; one whose crop wanders 0.015 and 0.19."""
_MIN_OBSERVATIONS = 30
_ROUNDS = 4
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6


def settled_origin(context: StageContext, origin: str, camera: pycolmap.Camera, structure: Structure) -> str:
    """Return the camera's final origin: a stated one counts as given unless the images refuted it."""
    if origin != "stated":
        return origin
    found = structure.model.cameras[1]
    if list(found.params) == list(camera.params):
        return "given"
    context.warn(
        f"the camera that the data set states (focal length {camera.mean_focal_length():.0f} px) explains the images "
        f"worse than one found from them ({found.mean_focal_length():.0f} px), which is used instead. To hold a "
        "camera in any case give it with --intrinsics"
    )
    return "self-calibrated"


def warn_of_focal(
    context: StageContext,
    origin: str,
    camera: pycolmap.Camera,
    structure: Structure,
    straight: pycolmap.Reconstruction,
    has_times: bool,
) -> str:
    """Warn of a focal length that changes or that the images contradict; return the camera's final origin, of which
    EXIF is none whose focal length the adjustment has left far behind.

    `camera` is the prior; `straight` the structure's model with what it would observe without a rolling shutter,
    which was looked for only where the images of the source have times.
    """
    if structure.mapper == GIVEN_ONLY:
        return origin
    known, found = camera.mean_focal_length(), structure.model.cameras[1].mean_focal_length()
    halves = focals_of_halves(straight)
    (first, first_sd), (last, last_sd) = halves[0], halves[-1]
    deviations = abs(last - first) / math.hypot(first_sd, last_sd)
    if deviations > _APART and abs(last - first) > _ZOOM * first:
        context.warn(
            f"the focal length seems to change: halves of the recording disagree, {first:.0f} px against {last:.0f} px "
            f"by {deviations:.0f} standard deviations. Record without zoom, or split the recording where it zooms"
            + (
                ""
                if has_times
                else "; if the images are from a video, give the video: a rolling shutter looks the same"
            )
        )
    elif origin == "given" and all(abs(f - known) > max(_APART * sd, _OFF * known) for f, sd in halves):
        context.warn(
            f"the camera of --intrinsics (focal length {known:.0f} px) contradicts the images, which say {first:.0f} ± "
            f"{first_sd:.0f} px; it is held as you gave it. Check its numbers and the image size they are of, or omit "
            "--intrinsics"
        )
    if origin == "exif" and abs(found - known) > max(_APART * structure.focal_sd, _OFF * known):
        context.warn(
            f"the focal length that the metadata state ({known:.0f} px) is far from what the images say ({found:.0f} ± "
            f"{structure.focal_sd:.0f} px), which is used"
        )
        return "self-calibrated"
    return origin


def warn_of_structure(context: StageContext, structure: Structure, ids: list[int]) -> None:
    """Warn of gaps in the structure and of contradictions with the images; ids[k] is the frame of keyframe k."""
    report = structure.report
    if report.registered < report.total:
        context.warn(
            f"structure from motion could not place {report.total - report.registered} of {report.total} keyframes"
        )
    if structure.loose:
        named = frames_text([ids[k] for k in structure.loose])
        context.warn(
            f"too little is in view to determine the pose of {named}, such as a strip of floor below a bare wall: left "
            "out, and searched for again by tracking"
        )
    for piece in structure.pieces:
        inside = sorted(ids[i - 1] for i in piece.reg_image_ids())
        context.warn(
            f"{len(inside)} of them, frames {inside[0]}-{inside[-1]}, are consistent with each other: unless tracking "
            "connects them, they become a separate piece"
        )
    components = [p for p in report.components if len(p) >= _MIN_PART]
    if len(components) > 1:
        named = ", ".join(f"{ids[p[0]]}-{ids[p[-1]]}" for p in components)
        context.warn(
            f"structure from motion gave {len(components)} disconnected components (frames {named}): "
            "tracking joins those it recognises"
        )
    small = sorted(ids[k] for p in report.components if len(p) < _MIN_PART for k in p)
    if small:
        context.warn(
            f"hardly any points connect {frames_text(small)} with the other keyframes: tracking searches again"
        )
    folds = ", ".join(f"{ids[s.before]}-{ids[s.after]}" for s in report.contradicted)
    agreeing = f"{report.pairs_agreeing:.0%} of the matched pairs of views agree with it (mapper: {structure.mapper})"
    if folds:
        context.warn(
            f"the camera's path may be folded between frames {folds}, where neighbouring images contradict it: "
            f"{agreeing}"
        )
    if report.drift.factor >= MAX_DRIFT:
        context.warn(
            f"the scale of the camera's path changes by a factor of {report.drift.factor:.2g} or more between frames "
            f"{ids[report.drift.first]} and {ids[report.drift.last]}: what is near either end is measured in another "
            "unit. Poses there are not to be relied on"
        )
    if not folds and report.pairs_agreeing < 0.9:
        context.warn(
            f"images taken far apart contradict the camera's path: {agreeing}. Either repeated structures were "
            "confused, which is harmless, or a loop is not closed"
        )


def warn_of_people(context: StageContext, judged: Mapping[str, int] | None, structure: Structure) -> None:
    """Warn of what looks like people and stands still (`judged`: see `FrameMasks`), and where a structure without those
    who move has lost many matches."""
    if judged is None:
        return
    if judged["still"]:
        context.warn(
            f"{judged['still']} of {judged['named']} regions of keyframes that look like people stand as still as the "
            "scene and are kept as part of it. To leave them out, set frames.people=mask"
        )
    left = sum(len(p.matches) for p in structure.pairs)
    if left < (1 - _COSTLY) * judged["matches"]:
        context.warn(
            f"people who move are left out, and with them {1 - left / judged['matches']:.0%} of the matches between "
            "keyframes: poses rest on what is left. Film with fewer people in view, or set frames.people=keep"
        )


def warn_of_given(
    context: StageContext, structure: Structure, given: GivenPoses, frames: Sequence[Frame], keyframes: Sequence[int]
) -> dict[str, Any]:
    """Figures of how the given poses agree with those found, with a warning where they carry them or some contradict.

    Raises InputError where all of them contradict the images.
    """
    placed = [i for i in sorted(structure.model.reg_image_ids()) if structure.model.images[i].num_points3D]
    ids = [i - 1 for i in placed if given.known[keyframes[i - 1]]]
    figures: dict[str, Any] = {"given_poses": int(given.known.sum()), "given_metric": given.is_metric}
    if structure.mapper == GIVEN_ONLY:
        context.warn(
            f"structure from motion found nothing in the images: {structure.report.registered} keyframes have the "
            f"poses of --poses ({given.what}), unchecked"
        )
        return figures
    if structure.mapper.startswith(GIVEN):
        context.warn(
            f"the poses rest on those given with --poses ({given.what}), adjusted to the images: without them "
            "structure from motion found less"
        )
    rows = [keyframes[k] for k in ids]
    found = np.array([pose_of(structure.model.images[k + 1]) for k in ids]).reshape(-1, 4, 4)
    agreed = fit_given_poses(found, given.cam_from_world[rows])
    if agreed is None:
        context.warn("the given poses cannot be compared with those found: too few, or they hardly move")
        return figures
    _require_same_images(context, structure, given, found, [frames[row] for row in rows], ids)
    wrong = [row for row, is_wrong in zip(rows, agreed.wrong, strict=True) if is_wrong]
    unit = " m" if given.is_metric else ""
    if wrong:
        context.warn(
            f"{len(wrong)} given poses are far from where the images say (frames {stretches(wrong)}), and are left "
            f"out; the others agree to {agreed.position_sd:.3g}{unit} and {agreed.degrees_sd:.2g} degrees"
        )
    return figures | {
        "given_position_sd": round(agreed.position_sd, 6),
        "given_degrees_sd": round(agreed.degrees_sd, 4),
        "given_wrong": wrong,
    }


def _require_same_images(
    context: StageContext,
    structure: Structure,
    given: GivenPoses,
    found: NDArray[np.float64],
    frames: list[Frame],
    ids: list[int],
) -> None:
    """Raise InputError for given poses that the largest part of the structure contradicts; where images contradict the
    structure too, warn of it. `frames` are those of keyframes `ids`, which have poses `found` (N, 4, 4)."""
    inside = [n for n, k in enumerate(ids) if k in structure.report.largest]
    frames, found = [frames[n] for n in inside], found[inside]
    agreed = fit_given_poses(found, given.cam_from_world[[frame.id for frame in frames]])
    if agreed is None or not agreed.is_contradiction:
        return
    complaint = _other_poses(context, agreed, found, frames)
    if structure.report.is_consistent:
        raise InputError(complaint)
    context.warn(complaint)


def _other_poses(context: StageContext, agreed: GivenFit, found: NDArray[np.float64], frames: Sequence[Frame]) -> str:
    def fits(given: NDArray[np.float64]) -> bool:
        known = np.isfinite(given).all(axis=(1, 2))
        again = fit_given_poses(found[known], given[known]) if 2 * int(known.sum()) > len(given) else None
        return again is not None and not again.is_contradiction and not again.wrong.mean() > _FEW_WRONG

    settings = context.config.frames
    why = (
        f"--poses {settings.poses}: the poses contradict the images, by {agreed.degrees_sd:.2g} degrees and "
        f"{agreed.position_sd / agreed.extent:.0%} of the extent of their path: they belong to other images"
    )
    if named := numbering(settings, frames, fits):
        return (
            f"{why}. As poses of {named}, they agree: the images that they were made from are a selection, numbered "
            "anew. Give that folder of images as the source, or name the poses by the numbers of the video's frames "
            "(from 0)"
        )
    return (
        f"{why}, or their camera axes are not those of their format. Check that their names, numbers or times are "
        "those of this source, or omit --poses"
    )


def in_world_of(given: GivenPoses, model: SparseModel) -> SparseModel:
    """Move, turn and scale the model to where the given poses have its keyframes; as it is where none tells that."""
    rows = model.frame_ids[given.known[model.frame_ids]]
    agreed = fit_given_poses(model.cam_from_world[given.known[model.frame_ids]], given.cam_from_world[rows])
    return model if agreed is None else model.moved(agreed.move)


def to_sparse_model(
    model: pycolmap.Reconstruction,
    keyframe_ids: Sequence[int],
    lens: Lens,
    load_rgb: Callable[[int], NDArray[np.uint8]],
) -> SparseModel:
    """Keyframes, points and observations in undistorted pixels.

    The world is the camera of the first registered keyframe, and its unit the median depth of all observations, or the
    model's own where there are none.
    keyframe_ids[i] is the frame id of the image with id i + 1; load_rgb(frame_id) gives (H, W, 3) of the frame before
    undistortion, one at a time.
    """
    found = ModelArrays.of(model)
    observed = [(found.obs_point[r], found.obs_xy[r]) for r in found.rows()]
    frame_ids = np.array([keyframe_ids[i - 1] for i in found.image_ids], dtype=np.int64)
    colors = _mean_colors(observed, len(found.points), (load_rgb(int(i)) for i in frame_ids))
    obs_xy = np.concatenate([lens.undistort_points(xy) for _, xy in observed])
    poses, points = _rebased(found.cam_from_world, found.points, found.obs_cam, found.obs_point)
    return SparseModel(frame_ids, poses, points, colors, found.obs_cam, found.obs_point, obs_xy)


def _mean_colors(
    observed: Iterable[tuple[NDArray[np.int64], NDArray[np.float64]]], count: int, images: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    total, seen = np.zeros((count, 3)), np.zeros(count)
    for (point, xy), rgb in zip(observed, images, strict=True):
        column = np.clip(xy[:, 0].astype(np.int64), 0, rgb.shape[1] - 1)
        line = np.clip(xy[:, 1].astype(np.int64), 0, rgb.shape[0] - 1)
        np.add.at(total, point, rgb[line, column])
        np.add.at(seen, point, 1)
    return np.round(total / np.maximum(seen, 1)[:, None]).astype(np.uint8)


def _rebased(
    cam_from_world: NDArray[np.float64],
    points: NDArray[np.float64],
    obs_frame: NDArray[np.int64],
    obs_point: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses and points with the first camera as the world, and the median depth as its unit."""
    first = cam_from_world[0]
    world_from_first = np.eye(4)
    world_from_first[:3, :3], world_from_first[:3, 3] = first[:3, :3].T, -first[:3, :3].T @ first[:3, 3]
    poses = cam_from_world @ world_from_first
    moved = points @ first[:3, :3].T + first[:3, 3]
    depth = (poses[obs_frame, 2, :3] * moved[obs_point]).sum(1) + poses[obs_frame, 2, 3]
    unit = float(np.median(depth)) if len(depth) else 1.0
    poses[:, :3, 3] /= unit
    poses[0] = np.eye(4)
    return poses, moved / unit


# defects -----------------------------------------------------------------------------------------------------------


def warn_of_defects(
    context: StageContext, images: Sequence[NDArray[np.uint8]], straight: pycolmap.Reconstruction
) -> float:
    """Warn of noisy images, and of ones shifted against the lens; return the relative standard deviation by which noise
    makes the focal length less certain than the residuals say.

    Args:
        context: takes the warnings.
        images: some of the grey images (H, W).
        straight: the model, with its observations where frames taken at once would have them.
    """
    noise = float(np.median([noise_of(image) for image in images])) if len(images) else 0.0
    if noise > _NOISY:
        context.warn(
            f"the images are noisy ({noise:.0%} of their contrast): too little light. Features are off together, so "
            "that the camera's path and focal length are less certain than the residuals say. Film with more light"
        )
    shift, gain = shift_of_images(straight)
    camera = straight.cameras[1]
    if gain > _MIN_GAIN and shift > _SHIFTED * max(camera.width, camera.height):
        context.warn(
            f"images are shifted relative to the lens, each differently, by about {shift:.0f} pixels: by electronic "
            "stabilisation, or by a rolling shutter if their times are unknown. The camera's path is less certain "
            "than it looks. Switch stabilisation off; give the video itself, not images of it"
        )
    return noise if noise > _NOISY else 0.0


def noise_of(gray: NDArray[np.uint8]) -> float:
    """Estimate the standard deviation of the noise of an image (H, W), as a share of its contrast, by the median of a
    Laplacian that edges hardly change (Immerkaer, Fast noise variance estimation, 1996)."""
    response = np.abs(cv2.filter2D(gray.astype(np.float32), -1, _LAPLACIAN))
    dark, bright = np.percentile(gray, (5, 95))
    return float(np.median(response) / 0.6745 / max(bright - dark, 1.0))


def shift_of_images(model: pycolmap.Reconstruction) -> tuple[float, float]:
    """Estimate by how many pixels each image is shifted against the lens, beyond what a motion of its camera explains,
    as a root mean square over the images; and the mean share of their squared residuals that this explains."""
    found, camera = ModelArrays.of(model), model.cameras[1]
    focal, shifts, gains = camera.mean_focal_length(), [], []
    for pose, own in zip(found.cam_from_world, found.rows(), strict=True):
        if own.stop - own.start < _MIN_OBSERVATIONS:
            continue
        points = found.points[found.obs_point[own]] @ pose[:3, :3].T + pose[:3, 3]
        rays = points[:, :2] / points[:, 2:]
        residual = (np.asarray(camera.cam_from_img(found.obs_xy[own])) - rays) * focal
        shift, gain = _shift(rays, focal / points[:, 2], residual, focal)
        shifts.append(shift)
        gains.append(gain)
    if not shifts:
        return 0.0, 0.0
    apart = np.array(shifts) - np.mean(shifts, axis=0)
    return float(np.sqrt((apart**2).sum(1).mean())), float(np.mean(gains))


def _shift(
    rays: NDArray[np.float64], near: NDArray[np.float64], residual: NDArray[np.float64], focal: float
) -> tuple[NDArray[np.float64], float]:
    """The shift (2,) of an image beside a motion of its camera that explains its residuals (M, 2) in pixels best, and
    by what share it lowers their squares; `near` (M,): pixels by which a point moves for a unit of length."""
    x, y = rays.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    across = [near, zero, -near * x, -focal * x * y, focal * (1 + x**2), -focal * y, one, zero]
    down = [zero, near, -near * y, -focal * (1 + y**2), focal * x * y, focal * x, zero, one]
    system = np.stack([np.stack(across, 1), np.stack(down, 1)], 1).reshape(-1, 8)
    wanted, weight = residual.ravel(), np.ones(2 * len(x))
    for _ in range(_ROUNDS):  # Cauchy's weights at a pixel
        solved = np.linalg.lstsq(system * weight[:, None], wanted * weight, rcond=None)[0]
        left = wanted - system @ solved
        weight = np.repeat(1 / np.sqrt(1 + (left.reshape(-1, 2) ** 2).sum(1)), 2)
    held = np.linalg.lstsq(system[:, :6] * weight[:, None], wanted * weight, rcond=None)[0]
    before = float((((wanted - system[:, :6] @ held) * weight) ** 2).sum())
    return np.asarray(solved[6:], np.float64), 1 - float(((left * weight) ** 2).sum()) / max(before, 1e-12)
