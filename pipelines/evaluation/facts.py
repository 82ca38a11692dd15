"""Facts about the capture, frame by frame, lengths measured in it, and advice for the next one, in plain words."""

import re
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import rig_of
from ..geometry.sparse_model import SparseModel
from ..outcome import Outcome
from ..scene.world import WORLD, in_world
from ..types import Array, LoopEdge, Metres

_ENDS = (0.01, 0.99)
"""Quantiles of the solid Gaussians between which something is: beyond are floaters, and views through windows."""
_UNSHARP = 0.005
"""The end is as unsharp as it moves when the share does by so much, either way."""
_MIN_GAUSSIANS, _MIN_FRAMES = 1000, 5

_BLURRED = 0.35
_DARK, _BRIGHT = 35.0, 225.0


@dataclass(frozen=True)
class Capture:
    """Per chosen frame: sharpness (N,) relative to the median, brightness (N,) 0..255; points (F,) that each posed
    frame of the sparse model sees."""

    sharpness: NDArray[np.float64]
    brightness: NDArray[np.float64]
    points: NDArray[np.int64]


def read_capture(outcome: Outcome, sparse: SparseModel | None) -> Capture:
    """Read every frame once."""
    sharpness = np.array([f.sharpness for f in outcome.frames], np.float64)
    brightness = np.array([float(outcome.run.image(f)[::8, ::8].mean()) for f in outcome.frames])
    points = np.zeros(0, np.int64)
    if sparse is not None:
        points = np.bincount(sparse.obs_frame, minlength=len(sparse.frame_ids))
    return Capture(sharpness / max(float(np.median(sharpness)), 1e-9), brightness, points)


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames that are lost for one reason, or in one other piece; seconds in the source."""

    first: int
    last: int
    start: float
    end: float
    reason: str


def lost_stretches(outcome: Outcome) -> list[Stretch]:
    """Lost frames, neighbours with the same reason together, whatever its counts of points are."""
    t = outcome.trajectory
    stretches: list[Stretch] = []
    for row, reason in enumerate(t.lost_reasons):
        if not reason:
            continue
        frame, time = int(t.frame_ids[row]), float(t.timestamps[row])
        previous = stretches[-1] if stretches else None
        if previous and previous.last == frame - 1 and _kind(previous.reason) == _kind(reason):
            stretches[-1] = Stretch(previous.first, frame, previous.start, time, previous.reason)
        else:
            stretches.append(Stretch(frame, frame, time, time, reason))
    return stretches


def _kind(reason: str) -> str:
    return re.sub(r"(?<!piece_)\d+", "", reason)


def advice(
    outcome: Outcome, capture: Capture, sparse: SparseModel | None, loops: list[LoopEdge], psnr: float | None
) -> list[str]:
    """Sentences for whoever holds the camera; empty when there is nothing to say."""
    found = [
        *_about_pictures(capture),
        *_about_motion(outcome, sparse, loops),
        *_about_texture(capture),
        *_about_camera(outcome),
    ]
    if psnr is not None and psnr < 20:
        found.append(
            f"The map shows its own keyframes at {psnr:.1f} dB only: moving people, mirrors and changing light are "
            "usual causes."
        )
    return found


def _about_pictures(capture: Capture) -> list[str]:
    found = []
    blurred = int((capture.sharpness < _BLURRED).sum())
    if blurred > 0.05 * len(capture.sharpness):
        found.append(
            f"{blurred} of {len(capture.sharpness)} frames are blurred (less than a third as sharp as usual): move "
            "more slowly, or put on more light so that the shutter is shorter."
        )
    swing = float(np.quantile(capture.brightness, 0.95) - np.quantile(capture.brightness, 0.05))
    if swing > 0.35 * float(capture.brightness.mean()):
        found.append(
            f"The brightness changes by {swing:.0f} of 255 along the way: lock the exposure of the camera "
            "(a long press on most phones)."
        )
    dark, bright = (float((capture.brightness < _DARK).mean()), float((capture.brightness > _BRIGHT).mean()))
    if dark > 0.2:
        found.append(f"{dark:.0%} of the frames are very dark: put on more light.")
    if bright > 0.2:
        found.append(f"{bright:.0%} of the frames are burnt out: lower the exposure.")
    return found


def _about_motion(outcome: Outcome, sparse: SparseModel | None, loops: list[LoopEdge]) -> list[str]:
    found = []
    t = outcome.trajectory
    lost = int((~t.is_posed).sum())
    if lost:
        found.append(
            f"{lost} of {len(t.frame_ids)} frames have no pose here. The stretches are listed below: walk there again "
            "slowly, and look back at what is already known."
        )
    centers = t.centers[t.is_posed]
    if len(centers) < 3:
        return found
    extent = float(np.linalg.norm(centers.max(axis=0) - centers.min(axis=0)))
    depth = _median_depth(sparse)
    if depth and extent < 0.2 * depth:
        found.append(
            f"The camera moved by {extent / depth:.0%} of the distance to the scene only: walk, do not just turn; "
            "depth comes from seeing things from different places."
        )
    length = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    if depth and not loops and length > 8 * depth:
        found.append(
            "The walk never came back to a place it had seen before: end where you began, then drift can be taken out."
        )
    return found


def _median_depth(sparse: SparseModel | None) -> float | None:
    """Usual distance from a camera to the points it sees."""
    if sparse is None or len(sparse.obs_frame) == 0:
        return None
    away = sparse.points_in_world[sparse.obs_point] - sparse.centers[sparse.obs_frame]
    return float(np.median(np.linalg.norm(away, axis=1)))


def _about_texture(capture: Capture) -> list[str]:
    found = []
    if len(capture.points) and (poor := int((capture.points < 60).sum())) > 0.15 * len(capture.points):
        found.append(
            f"{poor} of {len(capture.points)} keyframes see fewer than 60 points. Possible causes: bare walls, blur or "
            "little overlap; keep furniture, corners or pictures in view, and move slowly."
        )
    return found


def _about_camera(outcome: Outcome) -> list[str]:
    found = []
    c = outcome.calibration
    if c.origin != "given" and c.focal_sd > 0.01 * c.intrinsics.fx:
        found.append(
            f"The focal length is uncertain by {c.focal_sd / c.intrinsics.fx:.1%}: give it with --intrinsics if you "
            "know it, or film with more movement to the side."
        )
    return found


def found_lengths(outcome: Outcome) -> list[tuple[str, str]]:
    """(what, how long) of a run that is exported, in its own world; only the camera's path where nothing says which way
    is up, and nothing before the export."""
    if outcome.move is not None or "export" not in outcome.records or (world := outcome.run.find(WORLD)) is None:
        return []
    shown = in_world(outcome, world)
    rows = [("length of the path", path_length(shown))]
    if world.has_floor:
        rows.append(("camera height above the floor", measured_camera_height(shown)))
    if world.axes == "up" and shown.gaussian_map is not None:
        rows += list(zip(("length", "width", "height"), extents(shown), strict=False))
    texts = [(what, length_text(*found, shown.metric, shown.metres)) for what, found in rows if found is not None]
    return [(what if what not in ("length", "width", "height") else f"map extent, {what}", t) for what, t in texts]


def path_length(outcome: Outcome) -> tuple[float, float] | None:
    """Return the length of the camera path and its standard deviation: that of the two ends, estimated from how far
    positions stray from the line between their neighbours. Lost frames are bridged by straight lines."""
    t = outcome.trajectory
    directions = rig_of(outcome.calibration.directions, len(outcome.frames))
    centers = t.centers[t.is_posed & (t.frame_ids < directions.stations)]
    if len(centers) < _MIN_FRAMES:
        return None
    steps = np.diff(centers, axis=0)
    # A second difference of independent errors has six times their variance; walking bends it too, so it is a bound.
    stray = float(np.sqrt((np.diff(steps, axis=0) ** 2).sum(1).mean() / 6))
    return float(np.linalg.norm(steps, axis=1).sum()), np.sqrt(2) * stray


def measured_camera_height(outcome: Outcome) -> tuple[float, float]:
    """Median over the floor, which is at 0, and how it goes up and down (16th to 84th percentile, halved)."""
    low, middle, high = np.quantile(outcome.trajectory.centers[outcome.trajectory.is_posed, 2], (0.16, 0.5, 0.84))
    return float(middle), float(high - low) / 2


def extents(outcome: Outcome) -> list[tuple[float, float]]:
    """Length, width and height, each with its deviation, of the box about the solid Gaussians; its level sides are
    those of the smallest rectangle. Nothing of a map that is hardly there."""
    gaussian_map = outcome.require_map()
    means = gaussian_map.means[gaussian_map.opacity_logits > 0].cpu().numpy().astype(np.float64)
    if len(means) < _MIN_GAUSSIANS:
        return []
    inside = np.all([_between(means[:, k]) for k in range(3)], axis=0)
    _, _, degrees = cv2.minAreaRect(means[inside, :2].astype(np.float32))
    turn = np.radians(degrees)
    level = means[:, :2] @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    sides = sorted((_extent(level[:, 0]), _extent(level[:, 1])), reverse=True)
    return [*sides, _extent(means[:, 2])]


def _between(values: Array) -> NDArray[np.bool_]:
    low, high = np.quantile(values, _ENDS)
    return np.asarray((values >= low) & (values <= high))


def _extent(values: Array) -> tuple[float, float]:
    around = [np.quantile(values, (q - _UNSHARP, q, q + _UNSHARP)) for q in _ENDS]
    moved = [(a[2] - a[0]) / 2 for a in around]
    return float(around[1][1] - around[0][1]), float(np.hypot(*moved))


def length_text(length: float, sd: float, is_metric: bool, metres: Metres | None) -> str:
    """A distance in words: metres where the world has them, else units with the metres that they are guessed to be."""
    unit_sd = metres.relative_sd if metres is not None else 0.0
    if is_metric:
        return f"{_with_sd(length, np.hypot(sd, unit_sd * length))} m"
    text = f"{_with_sd(length, sd)} units"
    if metres is None:
        return text
    guess = metres.per_unit * length, metres.per_unit * np.hypot(sd, unit_sd * length)
    return f"{text} ≈ {_with_sd(*guess)} m"


def _with_sd(value: float, sd: float) -> str:
    """1.234 ± 0.012: two digits of the deviation, the value to the same place."""
    digits = int(np.clip(1 - np.floor(np.log10(max(sd, 1e-6))), 0, 6))
    return f"{value:.{digits}f} ± {sd:.{digits}f}"
