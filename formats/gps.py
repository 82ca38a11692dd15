"""Places on the Earth: GPS of images and tracks, and the local east-north-up frame."""

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError, iterparse
from xml.parsers.expat import errors

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .image_folder import match_names
from .images import exif_gps
from .reading import parsing, read_bytes
from .textfile import fields_of

Array = NDArray[np.float64]

_Texts = tuple[str | None, str | None, str | None, str | None]
"""Of a row: time or name, latitude, longitude, altitude."""

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
    """T fixes: times (T,) seconds, rising; degrees (T, 2) latitude, longitude; altitude (T,) metres, NaN where unknown;
    how many rows of the file were no fix and are `lost`. Of a table of images: their names (T), and no times (0,)."""

    times: Array
    degrees: Array
    altitude: Array
    lost: int = 0
    names: tuple[str, ...] = ()

    def at(self, times: Array, farthest: float) -> Array:
        """Return (N, 3) latitude, longitude, altitude between fixes; NaN more than `farthest` seconds from one."""
        around = np.unwrap(self.degrees[:, 1], period=360)  # a track may cross 180 degrees
        values = np.column_stack([self.degrees[:, 0], around, self.altitude])
        out = np.stack([np.interp(times, self.times, column) for column in values.T], axis=1)
        after = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        gap = np.minimum(np.abs(self.times[after] - times), np.abs(self.times[np.maximum(after - 1, 0)] - times))
        out[gap > farthest] = np.nan
        out[:, 1] -= 360 * np.round(out[:, 1] / 360)
        return np.asarray(out)

    def of(self, names: Sequence[str]) -> Array:
        """Return (N, 3) latitude, longitude, altitude of images of these names; NaN of those that the table lacks."""
        out = np.full((len(names), 3), np.nan)
        for row, found in zip(out, match_names(names, self.names), strict=True):
            if found is not None:
                row[:] = *self.degrees[found], self.altitude[found]
        return out


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
    """Read a GPX track, the positions in a drone's subtitles, a table with headings that name time, lat, lon and
    perhaps alt (seconds, or ISO 8601), or one with a row an image: name, lat, lon, or OpenDroneMap's geo.txt.

    Rows that are no fix are left out and counted, and of fixes of one time all but one. Raises InputError when the file
    is missing, damaged, of another kind, has fewer than two fixes, or more rows that are none.
    """
    data, named = read_bytes(path, _MAX_TRACK_BYTES), False
    with parsing(path, "GPS track (GPX, or CSV with the columns time, lat, lon)"):
        if data[:100].lstrip(_BEFORE_XML).startswith(b"<"):
            texts = _gpx_rows(data)
        else:
            text = data.decode("utf-8-sig", errors="replace")
            is_subtitles = path.suffix.lower() == ".srt"
            named, texts = (False, list(_subtitle_rows(text))) if is_subtitles else _table_rows(text, path)
    rows = [row for text in texts if (row := _fix(text, named)) is not None]
    lost = len(texts) - len(rows)
    if len(rows) < 2 or lost > len(rows):
        raise InputError(
            f"{path} is no GPS track: of its {len(texts)} rows {len(rows)} are a time or an image's name with a "
            "latitude and longitude: give the right file"
        )
    values = np.array([row[1:] for row in rows], np.float64)
    if named:
        return Track(np.zeros(0), values[:, :2], values[:, 2], lost, tuple(str(row[0]) for row in rows))
    times, first = np.unique(np.array([row[0] for row in rows], np.float64), return_index=True)
    return Track(times, values[first, :2], values[first, 2], lost)


def _fix(row: _Texts, named: bool) -> tuple[float | str, float, float, float] | None:
    """Time or name, latitude, longitude, altitude; None where the texts are none."""
    try:
        when: float | str = row[0] or "" if named else _seconds(row[0] or "")
        lat, lon = float(row[1] or ""), float(row[2] or "")
        altitude = float(row[3]) if row[3] and row[3].strip() else math.nan
    except ValueError:
        return None
    is_known = isinstance(when, str) or math.isfinite(when)
    return (when, lat, lon, altitude) if is_known and abs(lat) <= 90 and abs(lon) <= 180 else None


def _gpx_rows(data: bytes) -> list[_Texts]:
    """The points of a track that have a time; without a track its waypoints. Entities are bounded by expat, external
    ones it does not fetch."""
    points: dict[str, list[_Texts]] = {"trkpt": [], "rtept": [], "wpt": []}
    above: list[Element] = []
    try:
        for event, element in iterparse(io.BytesIO(data), ("start", "end")):
            if event == "start":
                above.append(element)
                if len(above) > _DEEPEST:
                    raise ValueError(f"it is nested more than {_DEEPEST} deep")
                continue
            above.pop()
            if (kind := _bare(element)) in points:
                stated = {_bare(child): (child.text or "").strip() for child in element}
                if "time" in stated:
                    points[kind].append((stated["time"], element.get("lat"), element.get("lon"), stated.get("ele")))
            if above and not any(_bare(outer) in points for outer in above):
                above[-1].clear()  # what has been read is not kept in memory
    except ParseError as error:
        if error.code not in _CUT_SHORT:
            raise
    return next((rows for rows in points.values() if rows), [])


def _bare(element: Element) -> str:
    return element.tag.rpartition("}")[2]


def _subtitle_rows(text: str) -> Iterator[_Texts]:
    """Of a drone's subtitles: seconds since the beginning of the video, and what stands in brackets."""
    time = None
    for line in text.splitlines():
        if found := _SHOWN_FROM.match(line):
            hours, minutes, seconds = (float(part.replace(",", ".")) for part in found.groups())
            time = str(3600 * hours + 60 * minutes + seconds)
        stated = {key.lower(): value for key, value in _IN_BRACKETS.findall(line)}
        if time is not None and "latitude" in stated:
            height = stated.get("abs_alt", stated.get("altitude"))
            yield time, stated["latitude"], stated.get("longitude", stated.get("longtitude")), height


def _table_rows(text: str, path: Path) -> tuple[bool, list[_Texts]]:
    """Whether rows have the names of images in place of times, and the rows."""
    table = fields_of(text, path)
    name, time, lat, lon, alt = (table.column(*names) for names in _COLUMNS)
    if lat is None and lon is None and (system := "".join(table.headings)).startswith(_SYSTEMS):
        if system not in _DEGREES:
            raise InputError(f"{path} is no GPS track in degrees but in another system: convert it to EPSG:4326")
        name, lon, lat, alt = 0, 1, 2, 3
    key = time if name is None else name
    if key is None or lat is None or lon is None:
        raise InputError(
            f"{path} is no GPS track that can be read: its headings are {', '.join(table.headings) or 'missing'}; time "
            "(or the image's name), lat and lon are needed"
        )
    columns = [key, lat, lon, alt]
    rows = [[row[c] if c is not None and c < len(row) else None for c in columns] for row in table.rows]
    return name is not None, [(when, *place) for when, *place in rows]  # type: ignore[misc]


_COLUMNS = (
    ("name", "filename", "image", "imagename", "file", "label", "photo", "sourcefile"),
    ("time", "timestamp", "seconds", "t", "datetime"),
    ("lat", "latitude", "gpslatitude", "ylatitude"),
    ("lon", "lng", "long", "longitude", "gpslongitude", "xlongitude"),
    ("alt", "altitude", "ele", "elevation", "height", "gpsaltitude", "zaltitude"),
)
_SYSTEMS, _DEGREES = ("epsg", "wgs84", "proj", "utm"), ("epsg4326", "wgs84")
"""How OpenDroneMap's geo.txt begins: with the system of its coordinates, east before north."""
_SHOWN_FROM = re.compile(r"\s*(\d+):(\d+):(\d+[,.]\d+)\s*-->")
_IN_BRACKETS = re.compile(r"[\[ ](latitude|longt?itude|abs_alt|altitude) ?: ?([-+.\d]+)", re.IGNORECASE)


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        moment = datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def enu_from_geodetic(places: Array, origin: Array) -> Array:
    """Return (N, 3) metres east, north, up of `origin` (3,) from (N, 3) latitude, longitude, altitude, on WGS 84."""
    earth = ecef_from_enu(origin)
    return np.asarray((_ecef(places) - earth[:3, 3]) @ earth[:3, :3])


def ecef_from_enu(origin: Array) -> Array:
    """Return (4, 4) from metres east, north, up of `origin` (latitude, longitude, altitude) to Earth-centred ones."""
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
