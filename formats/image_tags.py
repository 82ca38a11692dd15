"""Statements of image files beside the pixels: lens, place, time and orientation in EXIF; colours, brought to sRGB, in
an ICC profile or as HEIF's primaries."""

import functools
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

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

_FINE = 1 << 14
_ALIKE = 4
"""Of 255: a profile that changes no colour by more is sRGB, in one of its many spellings."""
_SAMPLED = np.linspace(0, 255, 9).astype(np.uint8)
_SPACES = {"RGB ": "RGB", "GRAY": "L", "CMYK": "CMYK"}
"""An ICC profile's colour space and the mode of an image in it."""
RGB_FROM_2020 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
"""Linear RGB of BT.2020 to that of sRGB (ITU-R BT.2087)."""
_RGB_FROM = {
    9: RGB_FROM_2020,
    12: np.array([[1.2249, -0.2249, 0.0], [-0.0420, 1.0420, 0.0], [-0.0196, -0.0786, 1.0982]]),
}
"""The same by ITU-T H.273's number of the primaries; 12 is Display P3 (SMPTE EG 432-1)."""
_HDR = (16, 18)
"""H.273's transfer functions of HDR, whose numbers are no sRGB."""
_KNEE = 0.75
"""Up to this part of diffuse white light stays as it is; all that is brighter shares the rest."""


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


def tags_of(image: Image.Image, ifd: int | None = None) -> dict[int, Any]:
    """Return EXIF's tags, of one of its directories or the base ones; none where they are damaged, for the image may be
    whole beside them."""
    try:
        exif = image.getexif()
        return dict(exif if ifd is None else exif.get_ifd(ifd))
    except Exception:  # Pillow raises whatever its parser meets
        return {}


def orientation_of(image: Image.Image) -> int:
    """Return 1 to 8 as EXIF defines them; 1 for every other value: text, lists, other numbers."""
    value = tags_of(image).get(ExifTags.Base.Orientation, 1)
    return int(value) if isinstance(value, int | float) and value in TURNS else 1


def turned_before(image: Image.Image) -> int:
    """Return the orientation that has been applied by the decoder: HEIF comes turned."""
    value = image.info.get("original_orientation")
    return value if isinstance(value, int) and value in TURNS else 1


def time_of(tags: _Tags) -> float | None:
    """Return the seconds (of the camera's own clock, since 1970) when the image was taken; None when missing."""
    text = tags.get(ExifTags.Base.DateTimeOriginal)
    fraction = str(tags.get(ExifTags.Base.SubsecTimeOriginal, "")).strip("\0 ")
    try:
        moment = datetime.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    seconds = (moment - datetime(1970, 1, 1)).total_seconds()
    return seconds + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)


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
    """Return latitude, longitude (degrees), altitude (m) of EXIF's GPS tags; altitude NaN, all None where missing."""
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


# colours ------------------------------------------------------------------------------------------------------------


class UnusableProfile(ValueError):
    """An ICC profile that is damaged, or of another kind of colours than its image."""


def has_other_colours(image: Image.Image) -> bool:
    """Return whether an image states colours that are not sRGB's. Raises UnusableProfile."""
    if profile := image.info.get("icc_profile"):
        return _conversion(profile, _mode(image)) is not None
    return _primaries(image) is not None


def in_srgb(image: Image.Image) -> Image.Image:
    """Convert a loaded image to mode RGB in sRGB, by what it states of its colours; alpha is dropped.

    Where its profile is unusable, and where it states nothing, its numbers are taken for sRGB's.
    """
    mode, profile = _mode(image), image.info.get("icc_profile")
    if image.mode == "LAB":
        lab = ImageCms.buildTransform(ImageCms.createProfile("LAB"), _srgb_profile(), "LAB", "RGB")
        return ImageCms.applyTransform(image, lab) or image
    primaries = _primaries(image)
    if image.mode != mode:  # with alpha by RGBA, the only way that Pillow goes from all of them to RGB
        has_alpha = "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")
        image = (image.convert("RGBA") if has_alpha else image).convert(mode)
    if profile:
        try:
            conversion = _conversion(profile, mode)
        except UnusableProfile:
            conversion = None
        if conversion is not None:
            space, transform = conversion
            return ImageCms.applyTransform(image.convert(space), transform) or image
    elif primaries is not None:
        light = cv2.transform(light_of_srgb(np.arange(256) / 255)[np.asarray(image.convert("RGB"))], primaries)
        return Image.fromarray(srgb_of(np.asarray(light, np.float32)))
    return image.convert("RGB")


def srgb_of(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return sRGB's bytes of linear light (...), 0 to 1; what is beyond is clipped."""
    return _srgb()[(light * (_FINE - 1) + 0.5).clip(0, _FINE - 1).astype(np.uint16)]


def tone_mapped(rgb: NDArray[np.uint16], transfer: str) -> NDArray[np.uint8]:
    """Convert to (H, W, 3) sRGB BT.2020 images with that transfer function, full range.

    Diffuse white (ITU-R BT.2408: 203 cd/m2 in PQ, 75 % in HLG, whose light is taken as the scene's) stays near white;
    above `_KNEE` the largest channel bends towards 1 and takes the others along, so that hues stay.
    """
    light = cv2.transform(_light(transfer)[rgb], RGB_FROM_2020.astype(np.float32)).clip(0)
    largest = light.max(axis=2, keepdims=True)
    over = (largest - _KNEE).clip(0) / (1 - _KNEE)
    bent = np.minimum(largest, _KNEE) + (1 - _KNEE) * over / (1 + over)
    light *= bent / np.maximum(largest, np.float32(1e-6))
    return srgb_of(light)


@functools.cache
def _light(transfer: str) -> NDArray[np.float32]:
    """(65536,) light of a channel's values, 1 = diffuse white (ITU-R BT.2100)."""
    signal = np.arange(65536) / 65535
    if transfer == "HLG":
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        return (scene / ((np.exp((0.75 - c) / a) + b) / 12)).astype(np.float32)
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    root = signal ** (1 / m2)
    return (10000 / 203 * ((root - c1).clip(0) / (c2 - c3 * root)) ** (1 / m1)).astype(np.float32)


def _mode(image: Image.Image) -> str:
    return image.mode if image.mode in ("L", "CMYK", "LAB") else "L" if image.mode in ("LA", "La") else "RGB"


def _primaries(image: Image.Image) -> NDArray[np.float64] | None:
    """The matrix from the primaries that HEIF states without a profile; None for those of sRGB, and for HDR."""
    stated = image.info.get("nclx_profile")
    if not isinstance(stated, dict) or image.info.get("icc_profile") or stated.get("transfer_characteristics") in _HDR:
        return None
    return _RGB_FROM.get(int(stated.get("color_primaries", 0)))


@functools.lru_cache(maxsize=16)
def _conversion(profile: bytes, mode: str) -> tuple[str, ImageCms.ImageCmsTransform] | None:
    """The mode that the profile's colours need, and how they become sRGB; None where they are that already."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        space = _SPACES.get(source.profile.xcolor_space, "")
        if space != mode and (space, mode) != ("RGB", "L"):
            raise UnusableProfile("its colour profile is of another kind of colours")
        intent = ImageCms.Intent.PERCEPTUAL if space == "CMYK" else ImageCms.Intent.RELATIVE_COLORIMETRIC
        transform = ImageCms.buildTransform(source, _srgb_profile(), space, "RGB", intent)
    except UnusableProfile:
        raise
    except (ImageCms.PyCMSError, OSError, TypeError, AttributeError, ValueError) as error:
        raise UnusableProfile("its colour profile is damaged") from error
    return None if space != "CMYK" and _is_identity(transform, space) else (space, transform)


def _is_identity(transform: ImageCms.ImageCmsTransform, space: str) -> bool:
    axes = np.meshgrid(*[_SAMPLED] * len(space), indexing="ij")
    colours = np.stack(axes, axis=-1).reshape(1, -1, len(space))
    made = ImageCms.applyTransform(Image.fromarray(colours[..., 0] if space == "L" else colours), transform)
    return made is not None and int(np.abs(np.asarray(made).astype(int) - colours).max()) <= _ALIKE


@functools.cache
def _srgb_profile() -> ImageCms.core.CmsProfile:
    return ImageCms.createProfile("sRGB")


@functools.cache
def _srgb() -> NDArray[np.uint8]:
    """(_FINE,) sRGB's byte of light 0..1 (IEC 61966-2-1)."""
    light = np.arange(_FINE) / (_FINE - 1)
    curved = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.round(curved * 255).astype(np.uint8)


def light_of_srgb(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Return the linear light of sRGB colours, both from 0 to 1 (IEC 61966-2-1)."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4).astype(np.float32)
