"""When the file of an image can serve as a frame as it is."""

from __future__ import annotations

from pathlib import Path

from PIL import ExifTags, Image

WRITTEN_SUFFIXES = (".jpg", ".jpeg", ".png")


def written_name(name: str) -> str:
    """The name under which a frame is written: its own; formats that are not written here become .png."""
    return name if Path(name).suffix.lower() in WRITTEN_SUFFIXES else f"{name}.png"


def is_plain(path: Path) -> bool:
    """Whether other programs see the image as it is seen here: neither turned nor transparent, 8 bits a channel."""
    if path.suffix.lower() not in WRITTEN_SUFFIXES:
        return False
    with Image.open(path) as image:
        return image.mode in ("RGB", "L") and image.getexif().get(ExifTags.Base.Orientation, 1) == 1
