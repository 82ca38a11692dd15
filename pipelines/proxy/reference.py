"""Source of the run's metres: the depth itself, something that the user knows, or none.

The user knows a distance in one image, how high the camera was held, or poses in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.images import to_grey
from ..config import Config
from ..depth.fused import DepthScale
from ..geometry.camera import unproject
from ..geometry.sequence import resize_area
from ..labels.segments import Segments
from ..providers import DepthEstimate, DepthProvider
from ..run.files import BACKBONE, GIVEN_POSES
from ..run.folder import RunFolder
from ..sfm.flow import follow
from ..sfm.given import fit_given_poses
from ..source.recording import Recording, VideoRecording, open_recording
from ..types import Frame

if TYPE_CHECKING:
    from .tasks import ProxyWork

_POSES = "poses"
_HOW = (
    "IMAGE:X1,Y1,X2,Y2=METRES (two pixels of one image of the source), height=METRES (camera over the floor) or "
    "poses (those given with --poses)"
)
_MIN_APART = 8.0
_KEYFRAMES = 5
_PATCH = 2
_MIN_CONFIDENCE = 0.14
"""Of depth that is expected to be off by less than 10 %."""
_PIXEL_SD = 1.0
"""How exactly a person points at a pixel of the proxy maps."""


@dataclass(frozen=True)
class Reference:
    """metres between two `pixels` (x1, y1, x2, y2) of `picture` of the source, without these the camera's height."""

    metres: float
    picture: str = ""
    pixels: tuple[float, ...] = ()


@dataclass(frozen=True)
class ReferenceScale:
    """Metres per unit of the depth, its relative standard deviation, and how many keyframes it was measured in."""

    factor: float
    relative_sd: float
    keyframes: int


def parse_reference(text: str) -> Reference | None:
    """The length a setting describes, None for "" and for poses. Raises InputError for a malformed one."""
    if text.strip() in ("", _POSES):
        return None
    what, _, length = text.strip().removesuffix("m").rpartition("=")
    picture, _, pixels = what.rpartition(":")
    try:
        metres = float(length)
        x: tuple[float, ...] = () if what.strip() == "height" else tuple(map(float, pixels.split(",")))
        if x and (len(x) != 4 or not picture.strip()):
            raise ValueError
    except ValueError:
        raise InputError(f"--scale-ref {text}: expected {_HOW}") from None
    if not 0 < metres < 1e4:
        raise InputError(f"--scale-ref {text}: {metres} metres make no sense; give the length in metres")
    if x and np.hypot(x[2] - x[0], x[3] - x[1]) < _MIN_APART:
        raise InputError(f"--scale-ref {text}: the two pixels are nearly the same; take points farther apart")
    return Reference(metres, picture.strip(), x)


def require_reference(source: Path, config: Config) -> None:
    """Raise InputError for a reference that is malformed, to an image the source does not have or outside it, or to
    poses that are not given."""
    text = config.proxy.scale_ref
    if text.strip() == _POSES and not config.frames.poses:
        raise InputError("--scale-ref poses needs poses: give them with --poses FILE|FOLDER")
    if (known := parse_reference(text)) is None or not known.picture:
        return
    recording = open_recording(source, config.run.format)
    _picture_index(recording, known.picture)
    width, height = recording.width, recording.height
    if not all(0 <= x <= size for x, size in zip(known.pixels, (width, height) * 2, strict=True)):
        raise InputError(f"--scale-ref {text}: a pixel lies outside the image ({width}x{height})")


def _picture_index(source: Recording, picture: str) -> int:
    """Index in the source of an image: by its name, or the number of the video's frame."""
    if isinstance(source, VideoRecording):
        # Headers of videos may promise no frames at all.
        if picture.isdecimal() and not 0 < source.expected_frames <= int(picture):
            return int(picture)
        last = source.expected_frames - 1
        raise InputError(f"--scale-ref: {picture} is no frame of {source.path}; give its number, from 0 to {last}")
    names = [source.name(i, i) for i in range(source.expected_frames)]
    if found := [i for i, name in enumerate(names) if picture in (name, Path(name).stem)]:
        return found[0]
    raise InputError(f"--scale-ref: the source has no image {picture}; give its name, for example {names[0]}")


def reference_scale(work: ProxyWork, frames: list[Frame], scale: DepthScale) -> ReferenceScale | None:
    """Find the metres per unit of the depth by what the user knows; None without that, and where the depth is metric.

    Raises InputError when the reference cannot be measured in this scene.
    """
    text, depths = work.context.config.proxy.scale_ref, work.depths
    if (known := parse_reference(text)) is None:
        return None if depths.metric else _by_poses(work.context.run, scale, text.strip() == _POSES)
    if known.picture:
        lengths, pixel_sds = _distances(known, work, frames)
        spread = 1.4826 * float(np.median(np.abs(lengths / np.median(lengths) - 1)))
        relative_sd = np.hypot(spread, np.median(pixel_sds))
    else:
        segments = Segments(work.sequence, work.context.progress)
        lengths = segments.heights(frames, lambda frame: scale.in_backbone_unit(work.depth(frame))) * scale.value
        if len(lengths) == 0 or np.median(lengths) <= 0:
            raise InputError(f"--scale-ref {text}: no floor was found in the scene. Give a distance between two points")
        relative_sd = np.std(lengths) / np.median(lengths)
    factor = known.metres / float(np.median(lengths))
    if not depths.metric:
        return ReferenceScale(factor, float(relative_sd), len(lengths))
    work.context.warn(
        f"{depths.name} is metric, so the reference {text} is not used; it would make lengths {factor - 1:+.1%} longer"
    )
    return None


def _distances(known: Reference, work: ProxyWork, frames: list[Frame]) -> NDArray[np.float64]:
    """(2, K): how far apart the two points are by the depth of each of the nearest keyframes, into which they are
    followed, and the part of it that is unsure because the user points at pixels.

    Raises InputError when no keyframe near the image sees both with reliable depth.
    """
    source = open_recording(work.context.source, work.context.config.run.format)
    index, camera = _picture_index(source, known.picture), work.sequence.intrinsics
    picture = next(iter(source.read({index})), None)
    if picture is None:
        raise InputError(f"--scale-ref: the source has no image {known.picture}")
    points = np.reshape(known.pixels, (2, 2)) * np.divide((camera.width, camera.height), picture.rgb.shape[1::-1])
    grey = to_grey(resize_area(picture.rgb, camera.width, camera.height))
    found: list[list[float]] = []
    for frame in sorted(frames, key=lambda f: (abs(f.source_index - index), f.id))[:_KEYFRAMES]:
        # The one is an image of the source, the other without lens distortion: of one instant, too, points move.
        other, at, is_followed = to_grey(work.sequence.image(frame)), points, np.ones(2, bool)
        if not np.array_equal(grey, other):
            at, is_followed = follow(grey, other, points, points, levels=4)
        depth = np.array([_depth_near(xy, work.depth(frame)) for xy in at[is_followed]])
        if np.isfinite(depth).sum() == 2:
            ends = unproject(at, depth, camera)
            length, pixels = (float(np.linalg.norm(pair[1] - pair[0])) for pair in (ends, at))
            found.append([length, _PIXEL_SD * np.sqrt(2) / pixels])
    if not found:
        raise InputError(
            f"--scale-ref: no keyframe near image {known.picture} has reliable depth at both points. Choose corners of "
            "objects, in an image that was taken while moving"
        )
    return np.array(found).T


def _depth_near(xy: NDArray[np.float64], estimate: DepthEstimate) -> float:
    """Depth around a pixel; NaN where it is not reliable."""
    rows, columns = (slice(max(int(v) - _PATCH, 0), int(v) + _PATCH + 1) for v in xy[::-1])
    sure = estimate.depth[rows, columns][estimate.confidence[rows, columns] >= _MIN_CONFIDENCE]
    return float(np.median(sure)) if min(xy) >= 0 and len(sure) >= _PATCH**2 else np.nan


def _by_poses(run: RunFolder, scale: DepthScale, is_said: bool) -> ReferenceScale | None:
    """By poses that the user gave in metres, by their kind or as it `is_said`; None where these tell none."""
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
    found: dict[str, Any] = {"scale_from": "depth" if depths.metric else "nothing: lengths have no unit"}
    if reference is not None:
        found = {
            "metric": True,
            "scale_from": "reference",
            "metres_per_unit": round(reference.factor * scale.value, 6),
            "reference_relative_sd": round(reference.relative_sd, 5),
            "reference_keyframes": reference.keyframes,
        }
    elif depths.metric and scale.of_frame:
        found |= {"metres_per_unit": round(scale.value, 6), "scale_spread": round(scale.spread, 5)}
    return {"independent_depth": depths.metric, **found}
