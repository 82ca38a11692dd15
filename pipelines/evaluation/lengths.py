"""Lengths measured in the exported world, described as the viewer's measuring tape does."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..export.stage import on_earth
from ..geometry.rig import rig_of
from ..geometry.tape import tape_text
from ..outcome import Outcome
from ..scene.world import WORLD

Array = NDArray[np.float64]

_ENDS = (0.01, 0.99)
"""Quantiles of the solid Gaussians between which something is: beyond are floaters, and views through windows."""
_UNSHARP = 0.005
"""The end is as unsharp as it moves when the share does by so much, either way."""
_LEAST_GAUSSIANS, _LEAST_FRAMES = 1000, 5


def found_lengths(outcome: Outcome) -> list[tuple[str, str]]:
    """(what, how long) of a run that is exported, in its own world; only the camera's path where nothing says which way
    is up, and nothing before the export."""
    if outcome.move is not None or "export" not in outcome.records or (world := outcome.run.find(WORLD)) is None:
        return []
    shown = on_earth(outcome.moved(world.exported_from_run), world)
    rows = [("length of the path", path_length(shown))]
    if world.has_floor:
        rows.append(("height of the camera over the floor", camera_height(shown)))
    if world.axes == "up" and shown.gaussian_map is not None:
        rows += list(zip(("length", "width", "height"), extents(shown), strict=False))
    texts = [(what, tape_text(*found, shown.metric, shown.metres)) for what, found in rows if found is not None]
    return [(what if what not in ("length", "width", "height") else f"map extent, {what}", t) for what, t in texts]


def path_length(outcome: Outcome) -> tuple[float, float] | None:
    """Return the length of the camera path and its standard deviation: that of the two ends, estimated from how far
    positions stray from the line between their neighbours. Lost frames are bridged by straight lines."""
    t = outcome.trajectory
    directions = rig_of(outcome.calibration.directions, len(outcome.frames))
    centers = t.centers[t.is_posed & (t.frame_ids < directions.stations)]
    if len(centers) < _LEAST_FRAMES:
        return None
    steps = np.diff(centers, axis=0)
    # A second difference of independent errors has six times their variance; walking bends it too, so it is a bound.
    stray = float(np.sqrt((np.diff(steps, axis=0) ** 2).sum(1).mean() / 6))
    return float(np.linalg.norm(steps, axis=1).sum()), np.sqrt(2) * stray


def camera_height(outcome: Outcome) -> tuple[float, float]:
    """Median over the floor, which is at 0, and how it goes up and down (16th to 84th percentile, halved)."""
    low, middle, high = np.quantile(outcome.trajectory.centers[outcome.trajectory.is_posed, 2], (0.16, 0.5, 0.84))
    return float(middle), float(high - low) / 2


def extents(outcome: Outcome) -> list[tuple[float, float]]:
    """Length, width and height, each with its deviation, of the box about the solid Gaussians; its level sides are
    those of the smallest rectangle. Nothing of a map that is hardly there."""
    gaussian_map = outcome.require_map()
    means = gaussian_map.means[gaussian_map.opacity_logits > 0].cpu().numpy().astype(np.float64)
    if len(means) < _LEAST_GAUSSIANS:
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
