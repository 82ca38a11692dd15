"""Places on the Earth: GPS of images and tracks, and the local east-north-up frame."""

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, iterparse
from xml.parsers.expat import errors

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .images import exif_gps
from .reading import parsing, read_bytes

Array = NDArray[np.float64]

_Texts = tuple[str | None, str | None, str | None, str | None]

_MAX_TRACK_BYTES = 200_000_000
_DEEPEST = 64
_BEFORE_XML = b"\xef\xbb\xbf\xff\xfe\0 \t\r\n"
_CUT_SHORT = tuple(errors.codes[e] for e in (errors.XML_ERROR_NO_ELEMENTS, errors.XML_ERROR_UNCLOSED_TOKEN))
"""Of a logger that was switched off: what it wrote before is read."""
_EQUATOR = 6_378_137.0
_FLATTENING = 1 / 298.257223563
"""The ellipsoid of WGS 84."""


@dataclass(frozen=True)
class Track:
    """times (T,) seconds, rising; degrees (T, 2) latitude, longitude; altitude (T,) metres, NaN where untold; how many
    rows of the file were no fix and are `lost`."""

    times: Array
    degrees: Array
    altitude: Array
    lost: int = 0

    def at(self, times: Array, farthest: float) -> Array:
        """Return (N, 3) latitude, longitude, altitude at other times, between fixes; NaN more than `farthest` s from
        one."""
        values = np.column_stack([self.degrees, self.altitude])
        out = np.stack([np.interp(times, self.times, column) for column in values.T], axis=1)
        after = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        gap = np.minimum(np.abs(self.times[after] - times), np.abs(self.times[np.maximum(after - 1, 0)] - times))
        out[gap > farthest] = np.nan
        return np.asarray(out)


def photo_places(photos: list[Path | None]) -> Array:
    """Return (N, 3) latitude, longitude, altitude from the EXIF of images; NaN where it does not or cannot be read."""
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
    """Read a GPX track, or a CSV with a header that names time, lat, lon and perhaps alt (seconds, or ISO 8601).

    Rows that are no fix are left out and counted, and of fixes of one time all but one. Raises InputError when the file
    is missing, damaged, of another kind, has fewer than two fixes, or more rows that are none.
    """
    data = read_bytes(path, _MAX_TRACK_BYTES)
    with parsing(path, "GPS track (GPX, or CSV with the columns time, lat, lon)"):
        is_xml = data[:100].lstrip(_BEFORE_XML).startswith(b"<")
        texts = list(_gpx_rows(data)) if is_xml else _csv_rows(data.decode("utf-8-sig", errors="replace"))
        rows = [row for row in map(_fix, texts) if row is not None]
        lost = len(texts) - len(rows)
        if len(rows) < 2:
            raise ValueError(f"it has {len(rows)} fixes with a time, two are needed")
        if lost > len(rows):
            raise ValueError(f"{lost} of its {len(texts)} rows are no time with a latitude and longitude")
        values = np.array(rows, np.float64)
        values = values[np.unique(values[:, 0], return_index=True)[1]]
        return Track(values[:, 0], values[:, 1:3], values[:, 3], lost)


def _fix(row: _Texts) -> tuple[float, float, float, float] | None:
    """Time, latitude, longitude, altitude; None where the texts are none."""
    try:
        time, lat, lon = _seconds(row[0] or ""), float(row[1] or ""), float(row[2] or "")
        altitude = float(row[3]) if row[3] and row[3].strip() else math.nan
    except ValueError:
        return None
    return (time, lat, lon, altitude) if math.isfinite(time) and abs(lat) <= 90 and abs(lon) <= 180 else None


def _gpx_rows(data: bytes) -> Iterator[_Texts]:
    """The points of a track that have a time. Entities are bounded by expat, external ones it does not fetch."""
    above: list[Element] = []
    try:
        for event, element in iterparse(io.BytesIO(data), ("start", "end")):
            if event == "start":
                above.append(element)
                if len(above) > _DEEPEST:
                    raise ValueError(f"it is nested more than {_DEEPEST} deep")
                continue
            above.pop()
            if _bare(element) == "trkpt":
                told = {_bare(child): (child.text or "").strip() for child in element}
                if "time" in told:
                    yield told["time"], element.get("lat"), element.get("lon"), told.get("ele")
            if above and not any(_bare(outer) == "trkpt" for outer in above):
                above[-1].clear()  # what has been read is not kept in memory
    except ParseError as error:
        if error.code not in _CUT_SHORT:
            raise


def _bare(element: Element) -> str:
    return element.tag.rpartition("}")[2]


def _csv_rows(text: str) -> list[_Texts]:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = max(",;\t", key=lines[0].count) if lines else ","
    table = csv.DictReader(lines, delimiter=separator)
    names = {(n or "").strip().lower(): n for n in table.fieldnames or ()}
    columns = [next((names[n] for n in options if n in names), None) for options in _COLUMNS]
    if None in columns[:3]:
        raise ValueError(f"its header is {', '.join(names) or 'empty'}; time, lat and lon are needed")
    time, lat, lon, height = (c or "" for c in columns)
    return [(row[time], row[lat], row[lon], row.get(height)) for row in table]


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
    """Return (N, 3) latitude, longitude (degrees), altitude -> (N, 3) metres east, north, up of `origin` (3,), on WGS
    84."""
    earth = ecef_from_enu(origin)
    return np.asarray((_ecef(places) - earth[:3, 3]) @ earth[:3, :3])


def ecef_from_enu(origin: Array) -> Array:
    """Return (4, 4) from metres east, north, up of `origin` (3,) latitude, longitude, altitude to Earth-centred
    metres."""
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
