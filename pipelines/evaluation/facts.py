"""Facts about the capture, frame by frame, lengths measured in it, and advice for the next one, in plain words."""

import re
from dataclasses import dataclass
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import rig_of
from ..geometry.sparse_model import SparseModel
from ..run.outcome import Outcome
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


def lost_stretches(outcome: Outcome) -> list[str]:
    """Describe lost frames, neighbours with the same reason together, whatever its counts of points are."""
    t = outcome.trajectory
    lost = [row for row in zip(t.frame_ids.tolist(), t.timestamps.tolist(), t.lost_reasons, strict=True) if row[2]]
    lines = []
    for _, group in groupby(enumerate(lost), lambda item: (item[1][0] - item[0], _kind(item[1][2]))):
        frames = [frame for _, frame in group]
        (first, start, reason), (last, end, _) = frames[0], frames[-1]
        lines.append(f"frames {first}–{last} ({start:.2f}–{end:.2f} s): {reason}")
    return lines


def _kind(reason: str) -> str:
    return re.sub(r"(?<!piece_)\d+", "", reason)


def advice(
    outcome: Outcome, capture: Capture, sparse: SparseModel | None, loops: list[LoopEdge], psnr: float | None
) -> list[str]:
    """Sentences for whoever holds the camera; empty when there is nothing to say."""
    t, calibration = outcome.trajectory, outcome.calibration
    frames, lost, keyframes = len(capture.sharpness), int((~t.is_posed).sum()), len(capture.points)
    blurred, poor = int((capture.sharpness < _BLURRED).sum()), int((capture.points < 60).sum())
    low, high = np.quantile(capture.brightness, (0.05, 0.95))
    dark, bright = (float(x.mean()) for x in (capture.brightness < _DARK, capture.brightness > _BRIGHT))
    depth, centers = _median_depth(sparse), t.centers[t.is_posed]
    extent = float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) > 2 else float("nan")
    length = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    unsure = calibration.focal_sd / calibration.intrinsics.fx
    findings = (
        (blurred > 0.05 * frames,
         f"{blurred} of {frames} frames are blurred (less than a third as sharp as usual): move more slowly, or put on "
         "more light so that the shutter is shorter."),
        (high - low > 0.35 * float(capture.brightness.mean()),
         f"The brightness changes by {high - low:.0f} of 255 along the way: lock the exposure of the camera (a long "
         "press on most phones)."),
        (dark > 0.2, f"{dark:.0%} of the frames are very dark: put on more light."),
        (bright > 0.2, f"{bright:.0%} of the frames are burnt out: lower the exposure."),
        (lost > 0,
         f"{lost} of {len(t.frame_ids)} frames have no pose here. The stretches are listed below: walk there again "
         "slowly, and look back at what is already known."),
        (extent < 0.2 * depth,
         f"The camera moved by {extent / depth:.0%} of the distance to the scene only: walk, do not just turn; depth "
         "comes from seeing things from different places."),
        (not loops and length > 8 * depth and len(centers) > 2,
         "The walk never came back to a place it had seen before: end where you began, then drift can be taken out."),
        (poor > 0.15 * keyframes,
         f"{poor} of {keyframes} keyframes see fewer than 60 points. Possible causes: bare walls, blur or little "
         "overlap; keep furniture, corners or pictures in view, and move slowly."),
        (calibration.origin != "given" and unsure > 0.01,
         f"The focal length is uncertain by {unsure:.1%}: give it with --intrinsics if you know it, or film with more "
         "movement to the side."),
        (psnr is not None and psnr < 20,
         f"The map shows its own keyframes at {psnr or 0:.1f} dB only: moving people, mirrors and changing light are "
         "usual causes."),
    )  # fmt: skip
    return [text for is_so, text in findings if is_so]


def _median_depth(sparse: SparseModel | None) -> float:
    """Usual distance from a camera to the points it sees; NaN, which is no more than anything, where it sees none."""
    if sparse is None or len(sparse.obs_frame) == 0:
        return float("nan")
    away = sparse.points_in_world[sparse.obs_point] - sparse.centers[sparse.obs_frame]
    return float(np.median(np.linalg.norm(away, axis=1)))


def found_lengths(outcome: Outcome) -> list[tuple[str, str]]:
    """(what, how long) of an exported run in its own world; the camera's path alone where up is unknown."""
    if outcome.move is not None or "export" not in outcome.records or (world := outcome.run.find(WORLD)) is None:
        return []
    shown = in_world(outcome, world)
    rows = [("length of the path", path_length(shown))]
    if world.has_floor:
        rows.append(("camera height above the floor", measured_camera_height(shown)))
    if world.axes == "up" and shown.gaussian_map is not None:
        names = (f"map extent, {side}" for side in ("length", "width", "height"))
        rows += list(zip(names, extents(shown), strict=False))
    return [(what, length_text(*found, shown.metric, shown.metres)) for what, found in rows if found is not None]


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
