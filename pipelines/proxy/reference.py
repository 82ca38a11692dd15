"""Source of the run's metres: the depth itself, something that the user knows, or none.

The user knows a distance in one image, how high the camera was held, or poses in metres.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.images import to_grey
from ..depth.fused import DepthScale
from ..geometry.camera import unproject
from ..geometry.sequence import Sequence, resize_area
from ..labels.segments import SegmentLabels
from ..providers import MAX_CLASSES, DepthEstimate, DepthProvider
from ..run.files import BACKBONE, GIVEN_POSES
from ..run.folder import RunFolder
from ..run.stages import StageContext
from ..sfm.flow import follow
from ..sfm.given import fit_given_poses
from ..source.recording import Recording, VideoRecording, open_recording
from ..types import Frame, Intrinsics

Array = NDArray[np.float64]
DepthOf = Callable[[Frame], DepthEstimate]

_NUMBER = r"\s*(\d+\.?\d*|\.\d+)\s*"
_DISTANCE = re.compile(rf"(.+):{_NUMBER},{_NUMBER},{_NUMBER},{_NUMBER}={_NUMBER}m?")
_HEIGHT = re.compile(rf"height\s*={_NUMBER}m?")
POSES = "poses"
"""The reference that says that given poses are in metres."""
_HOW = (
    "IMAGE:X1,Y1,X2,Y2=METRES (two pixels of one image of the source), height=METRES (camera over the floor) or "
    "poses (those given with --poses)"
)
_MIN_APART = 8.0
_KEYFRAMES = 5
_PATCH = 2
_MIN_CONFIDENCE = 0.3
_PIXEL_SD = 1.0
"""How exactly a person points at a pixel of the proxy maps."""


@dataclass(frozen=True)
class Reference:
    """metres between `points` (2, 2), pixels of `picture` of the source; the camera's height where that is ""."""

    metres: float
    picture: str = ""
    points: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True)
class ReferenceScale:
    """Metres per unit of the depth, its relative standard deviation, and how many keyframes it was measured in."""

    factor: float
    relative_sd: float
    keyframes: int


def parse_reference(text: str) -> Reference | None:
    """The length a setting describes, None for "" and for poses. Raises InputError for a malformed one."""
    text = text.strip()
    if text in ("", POSES):
        return None
    height, distance = _HEIGHT.fullmatch(text), _DISTANCE.fullmatch(text)
    if height:
        reference = Reference(float(height[1]))
    elif distance:
        x1, y1, x2, y2, metres = map(float, distance.groups()[1:])
        reference = Reference(metres, distance[1].strip(), ((x1, y1), (x2, y2)))
        if np.hypot(x2 - x1, y2 - y1) < _MIN_APART:
            raise InputError(f"--scale-ref {text}: the two pixels are nearly the same; take points farther apart")
    else:
        raise InputError(f"--scale-ref {text}: expected {_HOW}")
    if not 0 < reference.metres < 1e4:
        raise InputError(f"--scale-ref {text}: {reference.metres} metres make no sense; give the length in metres")
    return reference


def require_reference_in(source: Recording, text: str) -> None:
    """Raise InputError for a reference that is malformed, to an image the source does not have, or outside it."""
    reference = parse_reference(text)
    if reference is None or not reference.picture:
        return
    _picture_index(source, reference.picture)
    inside = all(0 <= x <= source.width and 0 <= y <= source.height for x, y in reference.points)
    if not inside:
        raise InputError(f"--scale-ref {text}: a pixel lies outside the image ({source.width}x{source.height})")


def distance_scale(
    reference: Reference, source: Recording, sequence: Sequence, frames: list[Frame], depth_of: DepthOf
) -> ReferenceScale:
    """The scale that makes the two points as far apart as they are known to be.

    They are followed into the nearest keyframes and measured in each by its depth; the median counts. Raises
    InputError when no keyframe near the image sees both with reliable depth.
    """
    index, camera = _picture_index(source, reference.picture), sequence.intrinsics
    picture = next(iter(source.read({index})), None)
    if picture is None:
        raise InputError(f"--scale-ref: the source has no image {reference.picture}")
    full_height, full_width = picture.rgb.shape[:2]
    points = np.array(reference.points) * [camera.width / full_width, camera.height / full_height]
    grey = to_grey(resize_area(picture.rgb, camera.width, camera.height))
    lengths, relative_sds = [], []
    for frame in sorted(frames, key=lambda f: (abs(f.source_index - index), f.id))[:_KEYFRAMES]:
        other, found = to_grey(sequence.image(frame)), np.ones(2, bool)
        # The one is an image of the source, the other without lens distortion: of one instant, too, points move.
        at = points
        if not np.array_equal(grey, other):
            at, found = follow(grey, other, points, points, levels=4)
        length = _length(at, depth_of(frame), camera) if found.all() else None
        if length is not None:
            lengths.append(length)
            relative_sds.append(_PIXEL_SD * np.sqrt(2) / float(np.linalg.norm(at[1] - at[0])))
    if not lengths:
        raise InputError(
            f"--scale-ref: no keyframe near image {reference.picture} has reliable depth at both points. Choose "
            "corners of objects, in an image that was taken while moving"
        )
    length = float(np.median(lengths))
    spread = 1.4826 * float(np.median(np.abs(np.array(lengths) / length - 1)))
    return ReferenceScale(reference.metres / length, float(np.hypot(spread, np.median(relative_sds))), len(lengths))


def _picture_index(source: Recording, picture: str) -> int:
    """Index in the source of an image: by its name, or the number of the video's frame."""
    if isinstance(source, VideoRecording):
        # Headers of videos may promise no frames at all.
        if not picture.isdecimal() or 0 < source.expected_frames <= int(picture):
            last = source.expected_frames - 1
            raise InputError(f"--scale-ref: {picture} is no frame of {source.path}; give its number, from 0 to {last}")
        return int(picture)
    names = [source.name(i, i) for i in range(source.expected_frames)]
    for i, name in enumerate(names):
        if picture in (name, Path(name).stem):
            return i
    raise InputError(f"--scale-ref: the source has no image {picture}; give its name, for example {names[0]}")


def _length(points: Array, estimate: DepthEstimate, camera: Intrinsics) -> float | None:
    """Distance of two pixels (2, 2) in the depth's unit; None where a depth is not reliable."""
    depths = []
    for x, y in points.tolist():
        rows = slice(max(int(y) - _PATCH, 0), int(y) + _PATCH + 1)
        columns = slice(max(int(x) - _PATCH, 0), int(x) + _PATCH + 1)
        sure = estimate.depth[rows, columns][estimate.confidence[rows, columns] >= _MIN_CONFIDENCE]
        if x < 0 or y < 0 or len(sure) < _PATCH**2:
            return None
        depths.append(float(np.median(sure)))
    first, second = unproject(points, np.array(depths), camera)
    return float(np.linalg.norm(second - first))


def reference_scale(
    context: StageContext,
    sequence: Sequence,
    frames: list[Frame],
    depths: DepthProvider,
    scale: DepthScale,
    depth_of: Callable[[Frame], DepthEstimate],
) -> ReferenceScale | None:
    """Find the metres per unit of the depth by what the user knows; None without that, and where the depth is metric.

    Raises InputError when the reference cannot be measured in this scene.
    """
    config = context.config.proxy
    known = parse_reference(config.scale_ref)
    if known is None:
        return None if depths.metric else given_scale(context.run, scale, config.scale_ref.strip() == POSES)
    if known.picture:
        source = open_recording(context.source, context.config.run.format)
        found = distance_scale(known, source, sequence, frames, depth_of)
    else:
        segments = SegmentLabels(sequence, MAX_CLASSES, context.progress)
        heights = segments.heights(frames, lambda frame: scale.in_backbone_unit(depth_of(frame)))
        if len(heights) == 0 or np.median(heights) <= 0:
            raise InputError(
                f"--scale-ref {config.scale_ref}: no floor was found in the scene. Give a distance between two points"
            )
        heights = heights * scale.value
        height = float(np.median(heights))
        found = ReferenceScale(known.metres / height, float(np.std(heights)) / height, len(heights))
    if depths.metric:
        context.warn(
            f"{depths.name} is metric, so the reference {config.scale_ref} is not used; it would make lengths "
            f"{found.factor - 1:+.1%} longer"
        )
        return None
    return found


def given_scale(run: RunFolder, scale: DepthScale, is_said: bool) -> ReferenceScale | None:
    """Metres per unit of the depth by poses that the user gave in metres, by their kind or as it `is_said`; None where
    these tell none."""
    given, backbone = run.find(GIVEN_POSES), run.find(BACKBONE)
    if given is None or not (given.is_metric or is_said) or backbone is None:
        return None
    rows = np.flatnonzero(given.known[backbone.frame_ids])
    agreed = fit_given_poses(backbone.cam_from_world[rows], given.cam_from_world[backbone.frame_ids[rows]])
    if agreed is None:
        return None
    return ReferenceScale(agreed.move.scale / scale.value, agreed.scale_sd, len(rows))


def scale_figures(depths: DepthProvider, scale: DepthScale, reference: ReferenceScale | None) -> dict[str, Any]:
    """Report the source of the metres, and the backbone's unit in metres.

    independent_depth: whether depth adds to what tracking knows from the correspondences of the images.
    """
    figures: dict[str, Any] = {"independent_depth": depths.metric}
    if reference is not None:
        return figures | {
            "metric": True,
            "scale_from": "reference",
            "metres_per_unit": round(reference.factor * scale.value, 6),
            "reference_relative_sd": round(reference.relative_sd, 5),
            "reference_keyframes": reference.keyframes,
        }
    if not depths.metric:
        return figures | {"scale_from": "nothing: lengths have no unit"}
    figures["scale_from"] = "depth"
    if scale.of_frame:
        figures |= {"metres_per_unit": round(scale.value, 6), "scale_spread": round(scale.spread, 5)}
    return figures
