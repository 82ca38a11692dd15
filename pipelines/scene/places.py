"""Positions of a run's frames on the Earth, from their images' EXIF or a track that the user gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.gps import Track, photo_places, read_track
from ..outcome import Outcome
from ..run.records import load_source
from ..source.opening import FolderSource, open_source
from ..system.progress import log
from .georeference import georeference
from .world import World

Array = NDArray[np.float64]
OFF, AUTO = "off", "auto"
_LEAST_GAP = 2.0
"""Seconds from a fix at which a track still gives a position; slower tracks give it within their own step."""


def world_on_earth(outcome: Outcome, world: World, gps: str) -> tuple[World, str]:
    """The upright world turned to x east, y north in metres, and "" or why it is not.

    gps: "auto" for the images' EXIF, "off", or the name of a track. The reason is "" too where nobody asked: of EXIF
    that does not suffice, only the log reports it.
    """
    if gps == OFF:
        return world, ""
    places = _exif_places(outcome) if gps == AUTO else _track_places(outcome, _track(gps))
    found = _laid_out(outcome, world, places)
    if isinstance(found, World):
        return found, ""
    log.info("not georeferenced: %s", found)
    return world, "" if gps == AUTO else f"{gps}: not georeferenced: {found}"


def _track(gps: str) -> Track:
    track = read_track(Path(gps))
    if track.lost:
        log.warning("%s: %d of its rows are no time with a latitude and longitude, and are left out", gps, track.lost)
    return track


def _laid_out(outcome: Outcome, world: World, places: Array) -> World | str:
    if world.axes != "up":
        return "the gravity direction is not known"
    posed = outcome.trajectory.is_placed
    centers = world.exported_from_run.apply(outcome.trajectory.centers[posed])
    found = georeference(centers, places[posed], outcome.metric)
    if isinstance(found, str):
        return found
    return replace(world, exported_from_run=found[0] @ world.exported_from_run, earth=found[1])


def _exif_places(outcome: Outcome) -> Array:
    none = np.full((len(outcome.frames), 3), np.nan)
    try:
        source = open_source(Path(load_source(outcome.run).path), outcome.config.run.format)
    except InputError:
        return none  # moved away since: its contribution is lost, and nothing else
    if not isinstance(source, FolderSource):
        return none
    return photo_places([source.file(frame.source_index) for frame in outcome.frames])


def _track_places(outcome: Outcome, track: Track) -> Array:
    """By time. A video counts from its beginning: a track of another day is taken to begin with it."""
    times = np.array([frame.timestamp for frame in outcome.frames])
    if times[-1] < track.times[0] or times[0] > track.times[-1]:
        track = replace(track, times=track.times - track.times[0] + times[0])
    step = float(np.median(np.diff(track.times))) if len(track.times) > 1 else 0.0
    return track.at(times, max(_LEAST_GAP, step))
