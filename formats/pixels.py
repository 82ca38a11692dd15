"""Decoded images of every pixel format as 8 bit RGB, and the transparency that some of them have."""

from __future__ import annotations

import io

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

_WHOLE_RANGE = 0.0, 65535.0
_OPAQUE_FROM = 128
"""Of 255: a pixel that is less opaque shows mostly what is not in the image."""
_ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")


def to_rgb8(image: Image.Image, span: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of a loaded image; grey is tripled, alpha dropped.

    `span`: the values of a deep image that become 0 and 255, by default those of 16 bits (of floats the image's own).
    What is not finite becomes 0. Raises ValueError for a pixel format that has no conversion.
    """
    deep = deep_values(image) if span is not None or is_one_deep_channel(image) else None
    if deep is not None:
        scaled = _scaled(deep, _default_span(deep) if span is None else span)
        return scaled if scaled.ndim == 3 else np.repeat(scaled[:, :, None], 3, axis=2)
    if image.mode == "RGB":
        return np.array(image, dtype=np.uint8)
    if image.mode in ("CMYK", "LAB"):
        return np.array(_by_profile(image), dtype=np.uint8)
    if "transparency" in image.info or image.mode in _ALPHA_MODES:
        image = image.convert("RGBA")  # the only way that Pillow goes from all of them
    return np.array(image.convert("RGB"), dtype=np.uint8)


def transparent_pixels(image: Image.Image) -> NDArray[np.bool_] | None:
    """(H, W) pixels that are less than half opaque; None for a format without alpha, or an image that is opaque
    everywhere."""
    if is_one_deep_channel(image) or (image.mode not in _ALPHA_MODES and "transparency" not in image.info):
        return None
    alpha = np.asarray(image.convert("RGBA").getchannel("A"))
    clear = alpha < _OPAQUE_FROM
    return clear if clear.any() else None


def is_one_deep_channel(image: Image.Image) -> bool:
    """Whether the pixels are one number of more than 8 bits."""
    return image.mode.startswith("I") or image.mode == "F"


def deep_values(image: Image.Image) -> NDArray | None:
    """(H, W) of one deep channel, or (H, W, 3) of three of 16 bits; None for other formats."""
    return np.asarray(image) if is_one_deep_channel(image) else None


def is_deep_colour(image: Image.Image) -> bool:
    """Whether an unloaded PNG or TIFF stores three or four channels of 16 bits, of which Pillow keeps the high
    bytes."""
    return (
        image.format in ("PNG", "TIFF") and image.mode in ("RGB", "RGBA") and ";16" in str(getattr(image, "tile", ""))
    )


def decode_deep_colour(data: bytes, span: tuple[float, float]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 of a PNG or TIFF of three or four channels of 16 bits, not turned."""
    return _scaled(decode_16_bits(data), span)


def decode_16_bits(data: bytes) -> NDArray[np.uint16]:
    """(H, W, 3) uint16 RGB of a PNG or TIFF, not turned. Raises ValueError where it cannot be decoded."""
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


def _by_profile(image: Image.Image) -> Image.Image:
    """CMYK by the image's own colour profile, if it has a usable one; LAB as the standard defines it."""
    rgb = ImageCms.createProfile("sRGB")
    if image.mode == "LAB":
        return _transformed(image, ImageCms.createProfile("LAB"), rgb)
    if profile := image.info.get("icc_profile"):
        try:
            return _transformed(image, ImageCms.ImageCmsProfile(io.BytesIO(profile)), rgb)
        except (ImageCms.PyCMSError, OSError):
            pass  # a damaged profile, or one of another colour space
    return image.convert("RGB")


def _transformed(image: Image.Image, source: object, target: object) -> Image.Image:
    made = ImageCms.profileToProfile(image, source, target, outputMode="RGB")  # type: ignore[arg-type]
    if made is None:
        raise ValueError(f"its colours ({image.mode}) cannot be converted")
    return made
