"""Places on the Earth: GPS of images and tracks, and the local east-north-up frame."""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import exif_gps
from msgs_slam.formats.reading import parsing, read_bytes

Array = NDArray[np.float64]

_MAX_TRACK_BYTES = 200_000_000
_EQUATOR = 6_378_137.0
_FLATTENING = 1 / 298.257223563
"""The ellipsoid of WGS 84."""


@dataclass(frozen=True)
class Track:
    """times (T,) seconds, rising; degrees (T, 2) latitude, longitude; altitude (T,) metres, NaN where untold."""

    times: Array
    degrees: Array
    altitude: Array

    def at(self, times: Array, farthest: float) -> Array:
        """(N, 3) latitude, longitude, altitude at other times, between fixes; NaN more than `farthest` s from one."""
        values = np.column_stack([self.degrees, self.altitude])
        out = np.stack([np.interp(times, self.times, column) for column in values.T], axis=1)
        after = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        gap = np.minimum(np.abs(self.times[after] - times), np.abs(self.times[np.maximum(after - 1, 0)] - times))
        out[gap > farthest] = np.nan
        return np.asarray(out)


def photo_places(photos: list[Path | None]) -> Array:
    """(N, 3) latitude, longitude, altitude from the EXIF of images; NaN where it does not or cannot be read."""
    out = np.full((len(photos), 3), np.nan)
    for i, photo in enumerate(photos):
        try:
            place = None if photo is None else exif_gps(photo)
        except InputError:
            continue
        if place is not None:
            out[i] = place
    return out


def read_track(path: Path) -> Track:
    """A GPX track, or a CSV with a header that names time, lat, lon and perhaps alt (seconds, or ISO 8601).

    Raises InputError when it is missing, damaged, of another kind, or has fewer than two fixes.
    """
    text = read_bytes(path, _MAX_TRACK_BYTES).decode("utf-8-sig", errors="replace")
    with parsing(path, "GPS track (GPX, or CSV with the columns time, lat, lon)"):
        rows = _gpx_rows(text) if "<gpx" in text[:2000] else _csv_rows(text)
        if len(rows) < 2:
            raise ValueError(f"it has {len(rows)} fixes with a time, two are needed")
        values = np.array(sorted(rows), np.float64)
        if not (np.isfinite(values[:, :3]).all() and (np.abs(values[:, 1:3]) <= (90, 180)).all()):
            raise ValueError("a latitude or longitude is out of range")
        return Track(values[:, 0], values[:, 1:3], values[:, 3])


def _gpx_rows(text: str) -> list[tuple[float, float, float, float]]:
    """By patterns, so that no entity of the XML is ever expanded."""
    rows = []
    for found in re.finditer(r"<trkpt\b([^>]*)>(.*?)</trkpt>", text, re.DOTALL):
        place = dict(re.findall(r"(lat|lon)\s*=\s*[\"']([^\"']+)[\"']", found[1]))
        time = re.search(r"<time>\s*([^<]+?)\s*</time>", found[2])
        height = re.search(r"<ele>\s*([^<]+?)\s*</ele>", found[2])
        if time:
            altitude = float(height[1]) if height else math.nan
            rows.append((_seconds(time[1]), float(place["lat"]), float(place["lon"]), altitude))
    return rows


def _csv_rows(text: str) -> list[tuple[float, float, float, float]]:
    table = csv.DictReader(io.StringIO(text))
    names = {(n or "").strip().lower(): n for n in table.fieldnames or ()}
    columns = [next((names[n] for n in options if n in names), None) for options in _COLUMNS]
    if None in columns[:3]:
        raise ValueError(f"its header is {', '.join(names) or 'empty'}; time, lat and lon are needed")
    rows = []
    for row in table:
        time, lat, lon = (row[c] for c in columns[:3] if c is not None)
        height = row[columns[3]] if columns[3] is not None else ""
        rows.append((_seconds(time), float(lat), float(lon), float(height) if height else math.nan))
    return rows


_COLUMNS = (
    ("time", "timestamp", "seconds", "t"), ("lat", "latitude"), ("lon", "lng", "longitude"),
    ("alt", "altitude", "ele", "elevation", "height"),
)  # fmt: skip


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        moment = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def enu_from_geodetic(places: Array, origin: Array) -> Array:
    """(N, 3) latitude, longitude (degrees), altitude -> (N, 3) metres east, north, up of `origin` (3,), on WGS 84."""
    earth = ecef_from_enu(origin)
    return np.asarray((_ecef(places) - earth[:3, 3]) @ earth[:3, :3])


def ecef_from_enu(origin: Array) -> Array:
    """(4, 4) from metres east, north, up of `origin` (3,) latitude, longitude, altitude to Earth-centred metres."""
    lat, lon = np.radians(origin[0]), np.radians(origin[1])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    move = np.eye(4)
    move[:3] = np.column_stack([east, np.cross(up, east), up, _ecef(origin[None])[0]])
    return move


def _ecef(places: Array) -> Array:
    """Earth-centred, earth-fixed metres."""
    lat, lon, height = np.radians(places[:, 0]), np.radians(places[:, 1]), places[:, 2]
    squared = _FLATTENING * (2 - _FLATTENING)
    normal = _EQUATOR / np.sqrt(1 - squared * np.sin(lat) ** 2)
    x = (normal + height) * np.cos(lat)
    return np.stack([x * np.cos(lon), x * np.sin(lon), (normal * (1 - squared) + height) * np.sin(lat)], axis=1)
