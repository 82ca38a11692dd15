"""A data set as a source: images, times and camera as its reader gives them; names of frames, and files that can
serve as them unchanged."""

import unicodedata
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets import Camera, Sequence, open_sequence, recognise_source
from ...formats.errors import InputError
from ...formats.images import Reading, is_plain, read_rgb, read_transparent
from ...formats.video import VideoFrame
from .one_camera import Headers, common_span, read_headers, require_one_lens

WRITTEN_SUFFIXES = (".jpg", ".jpeg", ".png")
_LONGEST_NAME = 255
_NOT_IN_NAMES = frozenset({"Cc", "Cs", "Zl", "Zp"})
"""Unicode's control characters, halves of pairs (so Python shows bytes that are no UTF-8), and line breaks."""

Warn = Callable[[str], None]


def open_recording(path: Path, format: str) -> Sequence | None:
    """The data set that a source is; None for a video and for plain images.

    format: `auto` looks for what the path is; `images` takes it for a video or plain images in any case. Raises
    InputError where the path is no such data set.
    """
    found = recognise_source(path) if format == "auto" else format
    return None if found is None or found == "images" else open_sequence(path, found)


@dataclass
class RecordingSource:
    """The frames of a data set; a `Source`. Where the recording has depth or labels is no matter here."""

    sequence: Sequence
    path: Path = field(init=False)
    width: int = field(init=False)
    height: int = field(init=False)
    expected_frames: int = field(init=False)
    has_times: bool = field(init=False)
    _names: tuple[str, ...] = field(init=False)
    _headers: Headers | None = field(init=False)
    _reading: Reading = field(init=False)

    def __post_init__(self) -> None:
        s = self.sequence
        self.path, self.expected_frames, self.has_times = s.root, len(s), s.timed
        self._names = written_names(s.names, s.root)
        self._headers, self._reading = None, Reading()
        if not s.image_paths:
            self.height, self.width = s.rgb(0).shape[:2]
            return
        images = dict(zip(s.names, s.image_paths, strict=True))
        self._headers = read_headers(s.root, images)
        if s.camera is None:
            require_one_lens(s.root, self._headers)
        first = next(iter(self._headers.of.values()))
        common = self._headers.common_orientation()
        if (
            common is None
            and s.camera is not None
            and _is_shape_of(first.stored, s.camera)
            and first.size != first.stored
        ):
            common = 1  # the program that made the data set has not turned its images
        self._reading = Reading(common, common_span(self._headers, images))
        self.width, self.height = first.size if common is None else replace(first, orientation=common).size

    def read(self, wanted: Container[int] | None = None, warn: Warn | None = None) -> Iterator[VideoFrame]:
        """See `Source.read`; what the reader notes of the data set, and images that cannot be read, are reported."""
        if warn is not None:
            if self._headers is not None:
                self._headers.warn(warn)
            for note in self.sequence.notes:
                warn(f"{self.sequence.format}: {note}")
        for index in range(len(self.sequence)):
            if wanted is not None and index not in wanted:
                continue
            try:
                rgb = self._rgb(index)
            except InputError as error:
                if warn is not None:
                    warn(f"left out: {error}")
                continue
            if rgb.shape[:2] != (self.height, self.width):
                raise InputError(
                    f"{self.sequence.names[index]} of {self.path} is {rgb.shape[1]}x{rgb.shape[0]}, the first image is "
                    f"{self.width}x{self.height}: a recording has images of one size; resize or remove it"
                )
            yield VideoFrame(index, float(self.sequence.timestamps[index]), rgb)

    def name(self, frame_id: int, index: int) -> str:
        """The image's own name; formats that are not written here become .png."""
        return self._names[index]

    def original(self, index: int) -> Path | None:
        """The image's file, unless other programs would see it turned, transparent or not at all."""
        path = self.sequence.image_paths[index] if self.sequence.image_paths else None
        return path if path is not None and reusable(path) and self._reading.orientation in (None, 1) else None

    def transparent(self, index: int) -> NDArray[np.bool_] | None:
        """Return the transparent pixels of image `index`, see `Source.transparent`."""
        paths = self.sequence.image_paths
        return read_transparent(paths[index], self._reading) if paths else None

    def exif_focal(self) -> float | None:
        """Return the focal length in pixels that the images state, if any do."""
        return None if self._headers is None else self._headers.focal_px(self.width, self.height)

    def _rgb(self, index: int) -> NDArray[np.uint8]:
        paths = self.sequence.image_paths
        return read_rgb(paths[index], self._reading) if paths else self.sequence.rgb(index)

    def known_camera(self) -> Camera | None:
        """The data set's camera at the size of its images."""
        camera = self.sequence.camera
        return None if camera is None else camera.resized(self.width, self.height)


def _is_shape_of(size: tuple[int, int], camera: Camera) -> bool:
    """Whether images of the size (width, height) are wide or high as the camera's are."""
    return camera.width != camera.height and (size[0] > size[1]) == (camera.width > camera.height)


def written_name(name: str) -> str:
    """The name under which a frame is written: its own; formats that are not written here become .png."""
    return name if Path(name).suffix.lower() in WRITTEN_SUFFIXES else f"{name}.png"


def written_names(names: Iterable[str], root: Path) -> tuple[str, ...]:
    """`written_name` of each. Raises InputError, naming the file, where a run could not keep one of them.

    A run stores names as UTF-8 in JSON and in COLMAP's files, one a line, and each frame in a file of its name.
    """
    written: dict[str, str] = {}
    for name in names:
        frame = written_name(name)
        if any(unicodedata.category(c) in _NOT_IN_NAMES for c in frame):
            raise InputError(
                f"{root}: the name {name!r} holds a line break, a control character or no UTF-8: rename it"
            )
        if len(frame.encode("utf-8")) > _LONGEST_NAME:
            raise InputError(f"{root}: the name {name!r} is longer than {_LONGEST_NAME} bytes: rename the image")
        if frame in written:
            raise InputError(f"{root}: {written[frame]!r} and {name!r} would both become {frame!r}: rename one of them")
        written[frame] = name
    return tuple(written)


def reusable(path: Path) -> bool:
    """Whether the file itself can be the frame: other programs see it as it is seen here."""
    return path.suffix.lower() in WRITTEN_SUFFIXES and is_plain(path)
