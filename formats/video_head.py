"""Heads of video files, read without decoding: boxes of MP4 and MOV (ISO/IEC 14496-12), elements of Matroska and WebM
(RFC 9559)."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from .errors import InputError
from .image_tags import plausible_equivalent, positive
from .reading import parsing

WHOLE, PART = "equirectangular", "part of a sphere"
_MAX_HEAD_BYTES = 64 << 20
_MAX_MATROSKA_BYTES = 1 << 20
"""The tracks stand before the frames."""
_MAX_BOXES = 10_000
_FIRST_BOXES = (b"ftyp", b"styp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot", b"uuid")
"""One of these is at the start of an MP4 or MOV; a raw stream of H.264 or HEVC looks like a box of another kind."""
_PROJECTION = re.compile(rb"ProjectionType\W{1,4}([a-z]+)")
_SECOND_EYE = re.compile(rb"GSpherical:StereoMode>\s*(?!mono)\w")
_COLOURS = re.compile(rb"colrncl[xc]..(..)", re.DOTALL)

TRANSFERS = {16: "PQ", 18: "HLG"}
"""Of ITU-T H.273, table 3: those of HDR."""
_EQUIVALENT = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"
_TEXT, _FLOATS = 1, {23: ">f", 24: ">d"}
"""Types of a metadata value; others are whole numbers."""
_IDENTITY = (1, 0, 0, 1)
_SQUARE = 0.002
"""Sides that differ by less come from a size that was rounded to whole pixels."""
_LONGEST_PIXEL = 5.0
"""Length of a pixel's sides to each other; what is beyond is a damaged number."""
_WITH_ALPHA = 32
"""Bits of a pixel in a sample entry that has red, green, blue and alpha."""
_EBML, _SEGMENT, _TRACKS, _TRACK = 0x1A45DFA3, 0x18538067, 0x1654AE6B, 0xAE
_TYPE, _DEFAULT, _VIDEO, _WIDTH, _HEIGHT = 0x83, 0x88, 0xE0, 0xB0, 0xBA
_ALPHA, _COLOUR, _TRANSFER = 0x53C0, 0x55B0, 0x55BA


@dataclass(frozen=True)
class VideoTrack:
    """A video track: its size as stored, whether it is marked to be shown, "HLG", "PQ" or "" as its transfer function,
    whether it has an alpha channel, the share of its frames that its edit list shows, the number of these (0 = not
    said), and the matrix (a, b, c, d) by which it is shown: x' = a x + c y, y' = b x + d y."""

    width: int
    height: int
    is_default: bool = True
    transfer: str = ""
    has_alpha: bool = False
    shown: float = 1.0
    samples: int = 0
    matrix: tuple[int, int, int, int] = _IDENTITY


def read_tracks(path: Path) -> list[VideoTrack]:
    """Read the video tracks of an MP4, MOV, Matroska or WebM in their order; none of other files or a damaged head."""
    if moov := read_moov(path):
        return _tracks_of_moov(moov)
    with open(path, "rb") as file:
        return _tracks_of_matroska(file.read(_MAX_MATROSKA_BYTES))


def main_track(tracks: list[VideoTrack]) -> int:
    """Return the number of the track to show: of those marked so and of more than one image, the largest."""
    return max(
        range(len(tracks)),
        key=lambda i: (tracks[i].samples != 1, tracks[i].is_default, tracks[i].width * tracks[i].height, -i),
        default=0,
    )


@dataclass(frozen=True)
class Display:
    """Steps that are left to do after the decoder's turn, in this order: swap the axes, mirror left to right (-1) and
    top to bottom, and lengthen pixels: `aspect` is their width by their height as they are then, 1 for squares."""

    swaps: bool = False
    mirror: tuple[int, int] = (1, 1)
    aspect: float = 1.0

    @property
    def is_mirrored(self) -> bool:
        """Whether the file asks for a mirrored picture, which no turn gives."""
        return self.swaps or self.mirror != (1, 1)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height in which a decoded frame of that size is shown; none becomes less."""
        width, height = (height, width) if self.swaps else (width, height)
        if self.aspect >= 1:
            return round(width * self.aspect), height
        return width, round(height / self.aspect)

    def shown(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return (H, W, ...) in the size that `size` says."""
        size = self.size(image.shape[1], image.shape[0])
        image = np.swapaxes(image, 0, 1) if self.swaps else image
        image = np.ascontiguousarray(image[:: self.mirror[1], :: self.mirror[0]])
        if size == (image.shape[1], image.shape[0]):
            return image
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def mirror_of(matrix: tuple[int, int, int, int]) -> Display:
    """Return the Display of a matrix (a, b, c, d; see `VideoTrack`) that mirrors the picture; one that leaves all as it
    is where it only turns, which decoders do."""
    a, b, c, d = matrix
    if a * d - b * c >= 0:
        return Display()
    swaps = abs(a) < abs(b)
    across, down = (c, b) if swaps else (a, d)
    return Display(swaps, (1 if across > 0 else -1, 1 if down > 0 else -1))


def pixel_aspect(wide: float, high: float) -> float:
    """Return the width by height of a pixel; 1 where it is not said (0), damaged, or a square but for rounding."""
    aspect = wide / high if wide > 0 and high > 0 else 1.0
    is_square = abs(aspect - 1) < _SQUARE or not 1 / _LONGEST_PIXEL <= aspect <= _LONGEST_PIXEL
    return 1.0 if is_square else aspect


# MP4 and MOV -----------------------------------------------------------------------------------------------------


def read_moov(path: Path) -> bytes:
    """Read the head of an MP4 or MOV, at most 64 MB of it; nothing for any other file, or where a length is damaged."""
    end = path.stat().st_size
    with open(path, "rb") as file:
        for _ in range(_MAX_BOXES):
            start = file.tell()
            head = file.read(8)
            size, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
            if start == 0 and kind not in _FIRST_BOXES:
                break
            if size == 1:
                size = int.from_bytes(file.read(8), "big")
            if kind == b"moov":
                return file.read(min(max(0, start + size - file.tell()), _MAX_HEAD_BYTES))
            if size < file.tell() - start or start + size >= end:
                break
            file.seek(start + size)
    return b""


def _boxes(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and content of the boxes in a content, up to a damaged one."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack(">I4s", data[at : at + 8])
        head = 16 if size == 1 else 8
        size = int.from_bytes(data[at + 8 : at + 16], "big") if size == 1 else size or len(data) - at
        if size < head:
            return
        yield kind, data[at + head : at + size]
        at += size


def _box(data: memoryview, *kinds: bytes) -> bytes:
    """The content of the first box along a way of kinds; nothing where there is none."""
    for kind in kinds:
        data = next((content for found, content in _boxes(data) if found == kind), memoryview(b""))
    return bytes(data)


def _number(box: bytes, short: int, long: int, wide: bool = False) -> int:
    """A number of a box at the one place in version 0 (4 bytes), at the other in version 1 (8 bytes where `wide`)."""
    place, size = (long, 8 if wide else 4) if box[:1] == b"\1" else (short, 4)
    return int.from_bytes(box[place : place + size], "big")


def _tracks_of_moov(moov: bytes) -> list[VideoTrack]:
    whole = memoryview(moov)
    traks = [content for kind, content in _boxes(whole) if kind == b"trak"]
    scale = _number(_box(whole, b"mvhd"), 12, 20)
    return [_track_of(t, scale) for t in traks if _box(t, b"mdia", b"hdlr")[8:12] == b"vide"]


def _track_of(trak: memoryview, movie_scale: int) -> VideoTrack:
    head, media = _box(trak, b"tkhd"), _box(trak, b"mdia", b"mdhd")
    entries = _box(trak, b"mdia", b"minf", b"stbl", b"stsd")
    entry = entries[16:]  # of the first description, behind its length and kind
    found = _COLOURS.search(entry)
    at = 52 if head[:1] == b"\1" else 40
    numbers = struct.unpack(">5i", head[at : at + 20]) if len(head) >= at + 20 else (1, 0, 0, 0, 1)
    length, scale = _number(media, 16, 24, wide=True), _number(media, 12, 20)
    return VideoTrack(
        int.from_bytes(entry[24:26], "big"), int.from_bytes(entry[26:28], "big"),
        bool(head[3:4]) and bool(head[3] & 1),
        TRANSFERS.get(int.from_bytes(found[1], "big"), "") if found else "",
        int.from_bytes(entry[74:76], "big") == _WITH_ALPHA,
        _shown(_box(trak, b"edts", b"elst"), movie_scale, length, scale),
        int.from_bytes(_box(trak, b"mdia", b"minf", b"stbl", b"stsz")[8:12], "big"),
        (numbers[0], numbers[1], numbers[3], numbers[4]),
    )  # fmt: skip


def _shown(edits: bytes, movie_scale: int, length: int, scale: int) -> float:
    """Share of a track's length (in 1/scale seconds) that its edit list shows; 1 where that is not said."""
    row = ">Qq4x" if edits[:1] == b"\1" else ">Ii4x"
    rows = edits[8 : 8 + len(edits[8:]) // struct.calcsize(row) * struct.calcsize(row)]
    parts = [(span, start) for span, start in struct.iter_unpack(row, rows) if span and start >= 0]
    if not parts or not movie_scale or not length:
        return 1.0
    shown = sum(max(0.0, min(span / movie_scale * scale, length - start)) for span, start in parts)
    return min(1.0, shown / length)


def read_equivalent(path: Path) -> float | None:
    """Read the focal length in mm at 35 mm film from the metadata of an MP4 or MOV or of one of its tracks (`keys` and
    `ilst` of Apple's QuickTime File Format); None where none is stated."""
    moov = memoryview(read_moov(path))
    for content in (moov, *(content for kind, content in _boxes(moov) if kind in (b"trak", b"udta"))):
        meta = memoryview(_box(content, b"meta"))
        meta = meta if bytes(meta[4:8]) == b"hdlr" else meta[4:]  # in MP4 version and flags come first
        keys, at, number = _box(meta, b"keys")[8:], 0, 0
        while at + 8 <= len(keys):
            size, number = int.from_bytes(keys[at : at + 4], "big"), number + 1
            if keys[at + 8 : at + size] == _EQUIVALENT:
                return plausible_equivalent(_metadata_number(_box(meta, b"ilst", number.to_bytes(4, "big"), b"data")))
            at += max(size, 8)
    return None


def _metadata_number(data: bytes) -> float | None:
    kind, value = int.from_bytes(data[:4], "big"), data[8:]
    if kind in _FLOATS and len(value) == struct.calcsize(_FLOATS[kind]):
        return float(struct.unpack(_FLOATS[kind], value)[0])
    if kind == _TEXT:
        return positive(value)
    return float(int.from_bytes(value, "big")) if 0 < len(value) <= 8 else None


# Matroska and WebM -----------------------------------------------------------------------------------------------


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Identifier and content of the elements; of one that is cut off, or of unknown length, what is there."""
    at = 0
    while at < len(data) and data[at]:
        length = 9 - data[at].bit_length()
        name, at = int.from_bytes(data[at : at + length], "big"), at + length
        if at >= len(data) or not data[at]:
            return
        length = 9 - data[at].bit_length()
        size = int.from_bytes(data[at : at + length], "big") & ((1 << 7 * length) - 1)
        at += length
        yield name, data[at : at + size]
        at += size


def _tracks_of_matroska(data: bytes) -> list[VideoTrack]:
    whole = memoryview(data)
    if int.from_bytes(data[:4], "big") != _EBML:
        return []
    segment = next((content for name, content in _elements(whole) if name == _SEGMENT), memoryview(b""))
    tracks = next((content for name, content in _elements(segment) if name == _TRACKS), memoryview(b""))
    return [
        track
        for name, content in _elements(tracks)
        if name == _TRACK and (track := _track_of_matroska(dict(_elements(content))))
    ]


def _track_of_matroska(entry: dict[int, memoryview]) -> VideoTrack | None:
    def number(found: dict[int, memoryview], name: int, default: int) -> int:
        return int.from_bytes(found[name][:8], "big") if name in found else default

    if number(entry, _TYPE, 0) != 1:
        return None
    video = dict(_elements(entry.get(_VIDEO, memoryview(b""))))
    colour = dict(_elements(video.get(_COLOUR, memoryview(b""))))
    return VideoTrack(
        number(video, _WIDTH, 0), number(video, _HEIGHT, 0), bool(number(entry, _DEFAULT, 1)),
        TRANSFERS.get(number(colour, _TRANSFER, 0), ""), bool(number(video, _ALPHA, 0)),
    )  # fmt: skip


# spheres ---------------------------------------------------------------------------------------------------------


def video_sphere(path: Path) -> str:
    """Return WHOLE, PART (one eye of two, half a sphere, a cube map) or "" for what says nothing of the kind.

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
    kind = _projection(moov) if b"GSpherical" in moov else ""
    return PART if kind and _SECOND_EYE.search(moov) else kind


def image_sphere(path: Path) -> str:
    """Return WHOLE, PART or "" for an image, by its Photo Sphere XMP (Google), which a crop may have kept unchanged."""
    try:
        with parsing(path, "image"), Image.open(path) as image:
            xmp = image.info.get("xmp", b"")
    except InputError:
        return ""
    return _projection(xmp if isinstance(xmp, bytes) else str(xmp).encode())


def _projection(xmp: bytes) -> str:
    found = _PROJECTION.search(xmp)
    return "" if found is None else WHOLE if found[1] == WHOLE.encode() else PART
