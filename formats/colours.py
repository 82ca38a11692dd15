"""Colours brought to sRGB: from what an ICC profile describes, or the primaries that HEIF states."""

import functools
import io

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

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
    image = image if image.mode == mode else _opaque(image).convert(mode)
    if profile:
        try:
            conversion = _conversion(profile, mode)
        except UnusableProfile:
            conversion = None
        if conversion is not None:
            space, transform = conversion
            return ImageCms.applyTransform(image.convert(space), transform) or image
    elif primaries is not None:
        light = cv2.transform(_light_of_srgb()[np.asarray(image.convert("RGB"))], primaries)
        return Image.fromarray(srgb_of(np.asarray(light, np.float32)))
    return image.convert("RGB")


def srgb_of(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return sRGB's bytes of linear light (...), 0 to 1; what is beyond is clipped."""
    return _srgb()[(light * (_FINE - 1) + 0.5).clip(0, _FINE - 1).astype(np.uint16)]


def _mode(image: Image.Image) -> str:
    return image.mode if image.mode in ("L", "CMYK", "LAB") else "L" if image.mode in ("LA", "La") else "RGB"


def _opaque(image: Image.Image) -> Image.Image:
    """The image with an alpha channel where it has any: the only way that Pillow goes from all of them to RGB."""
    has_alpha = "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")
    return image.convert("RGBA") if has_alpha else image


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


@functools.cache
def _light_of_srgb() -> NDArray[np.float32]:
    """(256,) light of sRGB's bytes."""
    signal = np.arange(256) / 255
    return np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4).astype(np.float32)
