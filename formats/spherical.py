"""Metadata of panoramas: whether a video or image says that it shows the whole sphere."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from PIL import Image

from .errors import InputError
from .reading import parsing

WHOLE, PART = "equirectangular", "part of a sphere"
_MOST_OF_MOOV = 64 << 20
_MOST_BOXES = 10_000
_FIRST_BOXES = (b"ftyp", b"styp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot", b"uuid")
"""One of these is at the start of an MP4 or MOV; a raw stream of H.264 or HEVC looks like a box of another kind."""
_PROJECTION = re.compile(rb"ProjectionType\W{1,4}([a-z]+)")
_SECOND_EYE = re.compile(rb"GSpherical:StereoMode>\s*(?!mono)\w")


def read_moov(path: Path) -> bytes:
    """The head of an MP4 or MOV, at most 64 MB of it; nothing for any other file, or where a length is damaged."""
    end = path.stat().st_size
    with open(path, "rb") as file:
        for _ in range(_MOST_BOXES):
            start = file.tell()
            head = file.read(8)
            size, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
            if start == 0 and kind not in _FIRST_BOXES:
                break
            if size == 1:
                size = int.from_bytes(file.read(8), "big")
            if kind == b"moov":
                return file.read(min(max(0, start + size - file.tell()), _MOST_OF_MOOV))
            if size < file.tell() - start or start + size >= end:
                break
            file.seek(start + size)
    return b""


def video_sphere(path: Path) -> str:
    """WHOLE, PART (one eye of two, half a sphere, a cube map) or "" for what says nothing of the kind.

    By the boxes of the Spherical Video RFC (github.com/google/spatial-media): its second version's `st3d` and `sv3d`,
    or the XML of its first.
    """
    moov = read_moov(path)
    if (place := moov.find(b"sv3d")) >= 0:
        whole = moov.find(b"equi", place)
        # equi: version and flags, then how much is cut off at the top, bottom, left and right
        is_whole = whole >= 0 and not any(moov[whole + 8 : whole + 24])
        eyes = moov.find(b"st3d")
        return WHOLE if is_whole and (eyes < 0 or moov[eyes + 8 : eyes + 9] in (b"", b"\0")) else PART
    found = _PROJECTION.search(moov) if b"GSpherical" in moov else None
    if found is None:
        return ""
    return WHOLE if found[1] == WHOLE.encode() and not _SECOND_EYE.search(moov) else PART


def image_sphere(path: Path) -> str:
    """Return WHOLE, PART or "" for an image, by its Photo Sphere XMP (Google), which a crop may have kept unchanged."""
    try:
        with parsing(path, "image"), Image.open(path) as image:
            xmp = image.info.get("xmp", b"")
    except InputError:
        return ""
    found = _PROJECTION.search(xmp if isinstance(xmp, bytes) else str(xmp).encode())
    return "" if found is None else WHOLE if found[1] == WHOLE.encode() else PART
