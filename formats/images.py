"""Image files to arrays and back: colour, depth, labels, and what the camera wrote beside the image."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from . import image_tags as tags
from .atomic import write_bytes
from .errors import InputError, ignored_warnings
from .image_tags import ExifLens
from .reading import opened, parsing, read_bytes

MAX_IMAGE_PIXELS = 120_000_000
"""A larger image is refused by its header, before memory is spent on it (phones go to 108 million)."""

IMAGE_SUFFIXES = frozenset((
    ".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".bmp", ".tif", ".tiff", ".webp", ".heic", ".heif", ".hif", ".avif",
))  # fmt: skip
VIDEO_SUFFIXES = frozenset((
    ".264", ".265", ".360", ".3g2", ".3gp", ".asf", ".avi", ".divx", ".dv", ".flv", ".gif", ".h264", ".h265", ".hevc",
    ".insv", ".ivf", ".m2t", ".m2ts", ".m2v", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg",
    ".mts", ".mxf", ".nut", ".ogg", ".ogv", ".qt", ".sens", ".ts", ".videos", ".vob", ".webm", ".wmv", ".y4m",
))  # fmt: skip
UNREAD_SUFFIXES = frozenset((
    ".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".gpr", ".iiq", ".kdc", ".mrw", ".nef", ".nrw", ".orf",
    ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
    ".jxl", ".jp2", ".j2k", ".jxr", ".exr", ".hdr", ".psd", ".tga", ".ppm", ".pgm", ".pnm",
))  # fmt: skip
"""Of images that are not read: raw sensor data and others."""
_WHOLE_RANGE = 0.0, 65535.0
_OPAQUE_FROM = 128
"""Of 255: a pixel that is less opaque shows mostly what is not in the image."""
_ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")
_FORMATS = ("JPEG", "PNG", "BMP", "DIB", "TIFF", "WEBP", "GIF", "HEIF", "AVIF")
_PLAIN_FORMATS = ("JPEG", "MPO", "PNG")
_SEVERAL_IMAGES = ("TIFF", "WEBP", "PNG", "GIF")
SRGB, OTHER, UNUSABLE = "sRGB", "by a profile", "by an unusable profile"
_ADVICE = "copy it again or remove it"


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) from the header, after EXIF's rotation. Raises InputError as `read_rgb` does."""
    return read_header(path).size


def first_readable(paths: Sequence[Path]) -> Path:
    """Return the first of some images whose header can be read; where none can, the first."""
    for path in paths:
        with suppress(InputError):
            image_size(path)
            return path
    return paths[0]


def is_depth_map(path: Path) -> bool:
    """Return whether the header says one channel of more than 8 bits; False for a file that cannot be read."""
    try:
        with _opened(Path(path)) as image:
            return _is_one_deep_channel(image)
    except InputError:
        return False


def is_plain(path: Path) -> bool:
    """Return whether other programs see the image as it is seen here: a JPEG or PNG, whatever it is called, neither
    turned nor transparent, 8 bits a channel, in sRGB.

    Raises InputError as `read_rgb` does.
    """
    with _opened(Path(path)) as image:
        if image.format not in _PLAIN_FORMATS or image.mode not in ("RGB", "L") or tags.orientation_of(image) != 1:
            return False
        return _colours(image) == SRGB


@dataclass(frozen=True)
class Reading:
    """Rule by which files become pixels, the same for all images of one camera.

    orientation: that of EXIF (1 to 8) by which all are turned, None: each by its own. span: values of images of more
    than 8 bits that become 0 and 255, None: the whole 16 bits.
    """

    orientation: int | None = None
    span: tuple[float, float] | None = None


AS_STATED = Reading()


def read_rgb(path: Path, reading: Reading = AS_STATED) -> NDArray[np.uint8]:
    """Read (H, W, 3) uint8 sRGB, turned upright as EXIF or HEIF says; more bits become 8, grey is tripled, alpha
    dropped, and colours of another profile converted.

    Raises InputError for a missing, truncated, oversized or unreadable file.
    """
    with _opened(Path(path)) as image:
        is_wide = reading.span is not None and _is_deep_colour(image)  # first: asking a PNG for EXIF loads it
        turn = _turn(image, reading)
        if is_wide and reading.span is not None:
            profile = image.info.get("icc_profile")
            image = Image.fromarray(_scaled(_decode_16_bits(read_bytes(Path(path))), reading.span))
            image.info["icc_profile"] = profile
        image.load()
        return _to_rgb8(image if turn is None else image.transpose(turn), reading.span)


def read_transparent(path: Path, reading: Reading = AS_STATED) -> NDArray[np.bool_] | None:
    """Read (H, W) pixels of `read_rgb` that are less than half opaque; None where all are opaque. Raises the same."""
    with _opened(Path(path)) as image:
        if image.mode not in _ALPHA_MODES and "transparency" not in image.info:
            return None
        turn = _turn(image, reading)
        image.load()
        turned = image if turn is None else image.transpose(turn)
        if _is_one_deep_channel(turned) or (turned.mode not in _ALPHA_MODES and "transparency" not in turned.info):
            return None
        clear = np.asarray(turned.convert("RGBA").getchannel("A")) < _OPAQUE_FROM
        return clear if clear.any() else None


def read_deep(path: Path) -> NDArray | None:
    """Read (H, W) or (H, W, 3) values of more than 8 bits as stored; None for other images. Raises as `read_rgb`."""
    with _opened(Path(path)) as image:
        if _is_deep_colour(image):
            return _decode_16_bits(read_bytes(Path(path)))
        image.load()
        return np.asarray(image) if _is_one_deep_channel(image) else None


def read_depth_png(path: Path) -> NDArray[np.uint16]:
    """Read (H, W) uint16 depth in the file's own unit. Raises InputError for other than one channel of 16 bits."""
    values = _read_one_channel(Path(path), "depth")
    if values.dtype == np.uint8:
        raise InputError(f"{path} has 8 bits a pixel, depth needs 16: was it saved as a preview image?")
    return values.astype(np.uint16)


def read_label_png(path: Path) -> NDArray[np.uint16]:
    """Read (H, W) uint16 label ids as stored; of a palette image the indices. Raises InputError for a colour image."""
    return _read_one_channel(Path(path), "labels").astype(np.uint16)


def read_grey_png(path: Path) -> NDArray[np.float32]:
    """Read (H, W) float32 in [0, 1] of an 8 or 16 bit one-channel image, such as a confidence map."""
    values = _read_one_channel(Path(path), "confidence")
    return values.astype(np.float32) / np.float32(255 if values.dtype == np.uint8 else 65535)


def write_rgb(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write (H, W, 3) uint8 atomically: .jpg with quality 95 and full colour resolution, .png, or .bmp, which is
    twice as large and forty times as fast.

    Raises ValueError for another array or suffix, InputError when the disk refuses.
    """
    path = Path(path)
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"write_rgb: got {rgb.dtype} {rgb.shape}, expected uint8 (H, W, 3)")
    image = Image.fromarray(np.ascontiguousarray(rgb))
    if path.suffix.lower() in (".jpg", ".jpeg"):
        _save(path, image, format="JPEG", quality=95, subsampling=0)
    elif path.suffix.lower() == ".png":
        _save(path, image, format="PNG", compress_level=3)
    elif path.suffix.lower() == ".bmp":
        _save(path, image, format="BMP")
    else:
        raise ValueError(f"write_rgb: {path.name} is none of .jpg, .png and .bmp")


def write_grey_png(path: Path, values: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write (H, W) uint8 or uint16 (labels, depth) as a lossless PNG, atomically."""
    if values.dtype not in (np.uint8, np.uint16) or values.ndim != 2:
        raise ValueError(f"write_grey_png: got {values.dtype} {values.shape}, expected uint8 or uint16 (H, W)")
    _save(Path(path), Image.fromarray(np.ascontiguousarray(values)), format="PNG", compress_level=3)


def _save(path: Path, image: Image.Image, **options: Any) -> None:
    """Encoded in memory first: Pillow's encoders do not notice when a disk takes only a part of what they write."""
    write_bytes(path, _encoded(image, **options))


def jpeg_bytes(rgb: NDArray[np.uint8], quality: int = 90) -> bytes:
    """Encode (H, W, 3) uint8 as a JPEG with full colour resolution, for files that hold others."""
    return _encoded(Image.fromarray(np.ascontiguousarray(rgb)), format="JPEG", quality=quality, subsampling=0)


def _encoded(image: Image.Image, **options: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, **options)
    return buffer.getvalue()


def decode_rgb(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode an image held in memory as `read_rgb` does; `name` is what errors call it."""
    with parsing(name, "image", _ADVICE), _quiet_open(io.BytesIO(data), name) as image:
        _require_sane_size(image, name)
        return _to_rgb8(image)


@dataclass(frozen=True)
class Header:
    """An image's size (width, height) as stored, the orientation that EXIF states (1 to 8), the lens; whether it has
    more than 8 bits a channel, how many images the file holds, and its colours: SRGB, OTHER or UNUSABLE."""

    stored: tuple[int, int]
    orientation: int
    lens: ExifLens
    is_deep: bool = False
    images: int = 1
    colours: str = SRGB

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) after the rotation stated in EXIF."""
        return self.stored[::-1] if self.orientation >= 5 else self.stored


def read_header(path: Path) -> Header:
    """Read the header of an image. Raises InputError as `read_rgb` does."""
    with _opened(Path(path)) as image:
        deep = _is_one_deep_channel(image) or _is_deep_colour(image)  # first: asking a PNG for EXIF loads it
        lens = tags.lens_of(tags.tags_of(image), tags.tags_of(image, ExifTags.IFD.Exif), image.size)
        images = int(getattr(image, "n_frames", 1)) if image.format in _SEVERAL_IMAGES else 1
        before = tags.turned_before(image)
        stored = image.size[::-1] if before >= 5 else image.size
        return Header(
            stored, tags.orientation_of(image) if before == 1 else before, lens, deep, images, _colours(image)
        )


def exif_time(path: Path) -> float | None:
    """Return the seconds since 1970 (on the camera's clock) when it was taken, from EXIF; None when missing."""
    with _opened(Path(path)) as image:
        return tags.time_of(tags.tags_of(image, ExifTags.IFD.Exif))


def exif_gps(path: Path) -> tuple[float, float, float] | None:
    """Return latitude, longitude (degrees), altitude (m) that EXIF states; altitude NaN, all None where missing."""
    with _opened(Path(path)) as image:
        return tags.place_of(tags.tags_of(image, ExifTags.IFD.GPSInfo))


def _colours(image: Image.Image) -> str:
    try:
        return OTHER if tags.has_other_colours(image) else SRGB
    except tags.UnusableProfile:
        return UNUSABLE


def _turn(image: Image.Image, reading: Reading) -> Image.Transpose | None:
    """The turn from the image as Pillow decodes it to that of the rule; HEIF comes turned already."""
    if reading.orientation is None or reading.orientation not in tags.QUARTER_TURNS:
        return tags.TURNS[tags.orientation_of(image)]
    done = tags.QUARTER_TURNS.get(tags.turned_before(image), 0)
    return tags.ANTICLOCKWISE[(tags.QUARTER_TURNS[reading.orientation] - done) % 4]


def _read_one_channel(path: Path, what: str) -> NDArray:
    with _opened(path) as image:
        image.load()
        if image.mode not in ("L", "P", "I", "1") and not image.mode.startswith("I;16"):
            raise InputError(f"{path} is a colour image ({image.mode}), {what} need one channel: give the raw maps")
        values = np.asarray(image)
    if values.dtype == bool:
        return values.astype(np.uint8)
    if values.dtype.itemsize > 2 and values.size and not 0 <= values.min() <= values.max() <= 65535:
        raise InputError(f"{path} holds values outside 0..65535: save the {what} as 16 bit integers")
    return values.astype(np.uint8 if values.dtype == np.uint8 else np.uint16)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image whose header is read and checked; whatever goes wrong inside the block is explained."""
    with opened(path) as file, parsing(path, "image", _ADVICE), _quiet_open(file, str(path)) as image:
        _require_sane_size(image, str(path))
        yield image


def _quiet_open(file: IO[bytes], name: str) -> Image.Image:
    from pi_heif import register_heif_opener  # takes as long to import as all the rest of a command that opens none

    register_heif_opener()
    with ignored_warnings(category=Image.DecompressionBombWarning):  # our own limit follows
        try:
            return Image.open(file, formats=_FORMATS)
        except Image.DecompressionBombError:
            raise _too_large(name) from None
        except UnidentifiedImageError:  # whose own text shows Python's file object
            raise ValueError("its header is of no image format that can be read here") from None


def _require_sane_size(image: Image.Image, name: str) -> None:
    if image.width * image.height > MAX_IMAGE_PIXELS:
        raise _too_large(name, f" ({image.width}x{image.height})")


def _too_large(name: str, size: str = "") -> InputError:
    return InputError(
        f"{name}{size} is over the limit of {MAX_IMAGE_PIXELS / 1e6:.0f} million pixels: scale it down, or set the "
        "camera to fewer"
    )


def _to_rgb8(image: Image.Image, span: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB of a loaded image; `span`: the values of a deep one that become 0 and 255, by default those of 16
    bits (of floats the image's own)."""
    if not _is_one_deep_channel(image):
        return np.array(tags.in_srgb(image), dtype=np.uint8)
    values = np.asarray(image)
    scaled = _scaled(values, _default_span(values) if span is None else span)
    return np.repeat(scaled[:, :, None], 3, axis=2)


def _is_one_deep_channel(image: Image.Image) -> bool:
    return image.mode.startswith("I") or image.mode == "F"


def _is_deep_colour(image: Image.Image) -> bool:
    """Whether an unloaded PNG or TIFF stores three or four channels of 16 bits: Pillow keeps the high bytes."""
    return (
        image.format in ("PNG", "TIFF") and image.mode in ("RGB", "RGBA") and ";16" in str(getattr(image, "tile", ""))
    )


def _decode_16_bits(data: bytes) -> NDArray[np.uint16]:
    """(H, W, 3) RGB of a PNG or TIFF, not turned."""
    found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None or found.ndim != 3 or found.dtype != np.uint16:
        raise ValueError("its 16 bit channels cannot be decoded")
    return np.asarray(found[:, :, 2::-1])


def _default_span(values: NDArray) -> tuple[float, float]:
    if values.dtype.kind != "f":
        return _WHOLE_RANGE
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def _scaled(values: NDArray, span: tuple[float, float]) -> NDArray[np.uint8]:
    low, high = span
    if span == _WHOLE_RANGE:
        return (np.clip(values, 0, 65535).astype(np.uint16) >> 8).astype(np.uint8)
    known = np.nan_to_num(values.astype(np.float32), nan=low, posinf=high, neginf=low)
    return np.asarray(((known - low) / max(high - low, 1e-12) * 255).clip(0, 255).round().astype(np.uint8))


def to_grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert (H, W, 3) RGB to (H, W) grey."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
