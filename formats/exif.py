"""The tags of EXIF as numbers that can be used: the lens, the place, the orientation."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from PIL import ExifTags, Image

_FULL_FRAME_WIDTH_MM = 36.0
_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
_MM_PER_RESOLUTION_UNIT = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0}
_EQUIVALENTS = 7.0, 1200.0
"""Focal lengths in mm at 35 mm film, from the widest lens without a fisheye's distortion to the longest that is sold:
what lies outside is a slip of the writing program."""
TURNS = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Turns that make an image upright, by EXIF's orientation."""
QUARTER_TURNS = {1: 0, 8: 1, 3: 2, 6: 3}
"""Anticlockwise quarter turns of those of them that do not mirror."""
ANTICLOCKWISE = (None, Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_180, Image.Transpose.ROTATE_270)
_Tags = Mapping[int, object]


@dataclass(frozen=True)
class ExifLens:
    """Statements of EXIF on camera and lens; None or "" where it makes none.

    `equivalent`: focal length in mm at 35 mm film, over the image's diagonal; `by_pitch`: the same from the focal
    length and the sensor's pixel pitch; `focal_mm`: the focal length itself; `zoom`: digital zoom, 1 where none is
    stated; `camera`: its make and model.
    """

    equivalent: float | None = None
    by_pitch: float | None = None
    focal_mm: float | None = None
    zoom: float = 1.0
    camera: str = ""

    def focal_px(self, width: int, height: int) -> float | None:
        """Return the focal length in pixels of an image of width x height that was resized, but not cropped."""
        stated = self.equivalent or self.by_pitch
        return None if stated is None else stated / _FULL_FRAME_DIAGONAL_MM * math.hypot(width, height)


def lens_of(base: _Tags, tags: _Tags, size: tuple[int, int]) -> ExifLens:
    """Read the lens from EXIF's base tags and its own, of an image stored as size = (width, height)."""
    names = (_text(base.get(tag)) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    return ExifLens(
        plausible_equivalent(positive(tags.get(ExifTags.Base.FocalLengthIn35mmFilm))),
        plausible_equivalent(_by_pitch(tags, size)),
        positive(tags.get(ExifTags.Base.FocalLength)),
        positive(tags.get(ExifTags.Base.DigitalZoomRatio)) or 1.0,
        " ".join(name for name in names if name),
    )


def _by_pitch(tags: _Tags, size: tuple[int, int]) -> float | None:
    focal_mm = positive(tags.get(ExifTags.Base.FocalLength))
    pitch = positive(tags.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _MM_PER_RESOLUTION_UNIT.get(positive(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2)) or 0)
    if focal_mm is None or pitch is None or unit is None:
        return None
    sensor_width = positive(tags.get(ExifTags.Base.ExifImageWidth)) or max(size)
    sensor_mm = sensor_width * unit / pitch
    if not 1.0 < sensor_mm < 2 * _FULL_FRAME_WIDTH_MM:
        return None  # some cameras fill the pitch with the image's print resolution
    return focal_mm / sensor_mm * max(size) / math.hypot(*size) * _FULL_FRAME_DIAGONAL_MM


def place_of(tags: _Tags) -> tuple[float, float, float] | None:
    """Return (latitude, longitude, altitude) in degrees and metres of EXIF's GPS tags; altitude NaN, all None where
    missing."""
    angles = []
    for key, negative in ((ExifTags.GPS.GPSLatitude, "S"), (ExifTags.GPS.GPSLongitude, "W")):
        try:
            stored = tags[key]  # three numbers by the standard, of which some programs write only one or two
            parts = stored if isinstance(stored, list | tuple) else (stored,)
            degrees, minutes, seconds = (*(float(v) for v in parts), 0.0, 0.0)[:3]
        except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
            return None
        angle = degrees + minutes / 60 + seconds / 3600
        angles.append(-abs(angle) if _text(tags.get(key - 1)).upper().startswith(negative) else angle)
    latitude, longitude = angles
    # Phones without a fix write zeros.
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or (latitude == 0 and longitude == 0):
        return None
    height = positive(tags.get(ExifTags.GPS.GPSAltitude))
    below = tags.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01")
    return latitude, longitude, math.nan if height is None else -height if below else height


def positive(value: object) -> float | None:
    """Return an EXIF number (int or rational) when it is a usable one."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def plausible_equivalent(equivalent: float | None) -> float | None:
    """Return a focal length in mm at 35 mm film, None where no lens has it."""
    low, high = _EQUIVALENTS
    return equivalent if equivalent is not None and low <= equivalent <= high else None


def _text(value: object) -> str:
    """Text of a tag, which some programs write as bytes."""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else "" if value is None else str(value)
    return text.strip("\0 ")
