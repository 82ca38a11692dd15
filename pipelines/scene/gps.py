"""Positions of a run's frames on the Earth, from their images' EXIF or a track that the user gives.

The exported world is laid onto them: z is up already, so a turn about it, a scale and a shift are left.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.gps import Track, enu_from_geodetic, photo_places, read_track
from ..config import GPS_AUTO, GPS_OFF
from ..geometry.se3 import Similarity
from ..run.outcome import Outcome
from ..source.recording import FolderRecording, open_recording
from ..system.progress import log
from .world import Georeference, World

_MIN_FIXES = 4
_TRIALS = 500
_MIN_SPAN = 3.0
"""The path must span so many times the residual's deviation: else noise decides scale and heading."""

Array = NDArray[np.float64]
_MIN_GAP = 2.0
"""Seconds from a fix at which a track still gives a position; slower tracks give it within their own step."""


def world_on_earth(outcome: Outcome, world: World, gps: str) -> tuple[World, str]:
    """The upright world turned to x east, y north in metres, and "" or why it is not.

    gps: "auto" for the images' EXIF, "off", or the name of a track. The reason is "" too where nobody asked: of EXIF
    that does not suffice, only the log reports it.
    """
    if gps == GPS_OFF:
        return world, ""
    if gps == GPS_AUTO:
        places: Array | str = _exif_places(outcome)
    else:
        track = read_track(Path(gps))
        if track.lost:
            lacking = "are no time or name with a latitude and longitude, and are left out"
            log.warning("%s: %d of its rows %s", gps, track.lost, lacking)
        places = _track_places(outcome, track)
    found = places if isinstance(places, str) else _laid_out(outcome, world, places)
    if isinstance(found, World):
        return found, ""
    log.info("not georeferenced: %s", found)
    return world, "" if gps == GPS_AUTO else f"{gps}: not georeferenced: {found}"


def _laid_out(outcome: Outcome, world: World, places: Array) -> World | str:
    if world.axes != "up":
        return "the gravity direction is not known"
    posed = outcome.trajectory.is_posed
    centers = world.exported_from_run.apply(outcome.trajectory.centers[posed])
    found = georeference(centers, places[posed], outcome.metric)
    if isinstance(found, str):
        return found
    return replace(world, exported_from_run=found[0] @ world.exported_from_run, earth=found[1])


def _exif_places(outcome: Outcome) -> Array:
    none = np.full((len(outcome.frames), 3), np.nan)
    try:
        source = open_recording(Path(outcome.run.source.path), outcome.config.run.format)
    except InputError:
        return none  # moved away since: its contribution is lost, and nothing else
    if not isinstance(source, FolderRecording):
        return none
    return photo_places([source.file(frame.source_index) for frame in outcome.frames])


def _track_places(outcome: Outcome, track: Track) -> Array | str:
    """By time, or in words why not. A video counts from its beginning: a track of another day is taken to begin with
    it. What lies between two fixes is no fix. A table of images is looked up by their names."""
    if track.names:
        return track.of([frame.name for frame in outcome.frames])
    times = np.array([frame.timestamp for frame in outcome.frames])
    if times[-1] < track.times[0] or times[0] > track.times[-1]:
        track = replace(track, times=track.times - track.times[0] + times[0])
    step = float(np.median(np.diff(track.times))) if len(track.times) > 1 else 0.0
    farthest = max(_MIN_GAP, step)
    fixes = int(((times[0] - farthest <= track.times) & (track.times <= times[-1] + farthest)).sum())
    if fixes < _MIN_FIXES:
        return f"only {fixes} of its fixes are of the time of the recording, {_MIN_FIXES} are needed"
    return track.at(times, farthest)


def georeference(centers: Array, places: Array, metric: bool) -> tuple[Similarity, Georeference] | str:
    """(enu_from_world, how good it is) of camera centres (N, 3), z up, and their places (N, 3), NaN where unknown.

    Heading, scale and shift come from the horizontal coordinates alone: altitudes by GPS are two or three times worse.
    A metric world keeps its scale. Places that fit no common motion are left out. Returns in words why there is none
    where that is so.
    """
    known = np.isfinite(places[:, :2]).all(axis=1)
    if known.sum() < _MIN_FIXES:
        return f"only {int(known.sum())} frames have a place, {_MIN_FIXES} are needed"
    rough = np.append(np.median(places[known, :2], axis=0), 0.0)
    flat = np.column_stack([places[known, :2], np.zeros(int(known.sum()))])
    target = enu_from_geodetic(flat, rough)[:, :2] @ (1, 1j)
    source = centers[known][:, :2] @ (1, 1j)
    inside = _agreeing(source, target)
    turn, shift = _fit(source[inside], target[inside], metric)
    errors = target[inside] - (turn * source[inside] + shift)
    residual = float(np.sqrt((np.abs(errors) ** 2).sum() / max(2 * inside.sum() - 4, 1)))
    spread = float(np.sqrt((np.abs(target[inside] - target[inside].mean()) ** 2).sum()))
    span = float(np.abs(target[inside] - target[inside].mean()).max())
    if span < 1e-6:
        return "all places are the same, as of one fix that the device has kept"
    if span < _MIN_SPAN * residual:
        return f"the path spans {2 * span:.1f} m, too little against places that are {residual:.1f} m off"
    scale = abs(turn)
    rotation = np.array([[turn.real, -turn.imag, 0], [turn.imag, turn.real, 0], [0, 0, scale]]) / scale
    heights = places[known, 2][inside] - scale * centers[known, 2][inside]
    altitude = float(np.nanmedian(heights)) if np.isfinite(heights).any() else 0.0
    move = Similarity(scale, rotation, np.array([shift.real, shift.imag, 0.0]))
    found = Georeference(
        (float(rough[0]), float(rough[1]), altitude), residual, int(inside.sum()), int(known.sum()),
        0.0 if metric else residual / spread,
    )  # fmt: skip
    return move, found


def _agreeing(source: NDArray, target: NDArray) -> NDArray[np.bool_]:
    """(N,) which places one similarity explains: of all through two of them the one with the least median of squares
    (Rousseeuw 1984); all where none is found."""
    from_xy, to_xy = (np.stack([z.real, z.imag], 1) for z in (source, target - target.mean()))
    inside = cv2.estimateAffinePartial2D(from_xy, to_xy, method=cv2.LMEDS, maxIters=_TRIALS, confidence=1 - 1e-9)[1]
    kept = np.ones(len(source), bool) if inside is None else inside.ravel() > 0
    for _ in range(5):
        turn, shift = _fit(source[kept], target[kept])
        off = np.abs(target - (turn * source + shift))
        # The median of a plane's Rayleigh distances is 1.18 deviations; 3.5 deviations lose nothing that is true.
        kept = off <= max(3.5 / 1.18 * float(np.median(off)), 1e-9)
    return kept


def _fit(source: NDArray, target: NDArray, metric: bool = False) -> tuple[complex, complex]:
    """target = turn * source + shift in the complex plane, least squares; |turn| = 1 for a metric world."""
    a, b = source - source.mean(), target - target.mean()
    turn = complex((a.conj() * b).sum() / max(float((np.abs(a) ** 2).sum()), 1e-18))
    if metric:
        turn = turn / abs(turn) if abs(turn) > 1e-12 else 1 + 0j
    return turn, complex(target.mean() - turn * source.mean())
