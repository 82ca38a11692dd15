"""Images and data sets as a source: images, times and camera as a reader gives them; names of frames, and files that
can serve as them unchanged."""

import unicodedata
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets import Camera, Sequence, open_sequence, recognise_source
from ...formats.errors import InputError
from ...formats.images import Header, Reading, is_plain, read_rgb, read_transparent
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


class ImageSource:
    """Images of one size in the order of time: those of a sequence, whatever else that holds.

    `has_times` says whether the timestamps are real; `headers` are those of the images that can be read.
    """

    def __init__(self, sequence: Sequence) -> None:
        """Read the headers. Raises InputError where they are not of one camera."""
        self.sequence = s = sequence
        self.path, self.expected_frames, self.has_times = s.root, len(s), s.timed
        self._names = written_names(s.names, s.root)
        self.headers, self._common = Headers({}, {}), None
        if not s.image_paths:
            self.height, self.width = s.rgb(0).shape[:2]
            return
        self.headers = read_headers(s.root, dict(zip(s.names, s.image_paths, strict=True)))
        self._common = self._orientation()
        self._require_one_camera()
        self.width, self.height = self._size(next(iter(self.headers.of.values())))

    def _orientation(self) -> int | None:
        """The EXIF orientation by which all images are turned; None where each is turned by its own."""
        return self.headers.common_orientation()

    def _require_one_camera(self) -> None:
        require_one_lens(self.path, self.headers)

    def _size(self, header: Header) -> tuple[int, int]:
        return header.size if self._common is None else replace(header, orientation=self._common).size

    @cached_property
    def reading(self) -> Reading:
        """The rule by which all images become pixels."""
        images = dict(zip(self.sequence.names, self.sequence.image_paths, strict=False))
        return Reading(self._common, common_span(self.headers, images))

    def read(self, wanted: Container[int] | None = None, warn: Warn | None = None) -> Iterator[VideoFrame]:
        """Decode from start to end, and hand out the wanted images (None = all) one at a time; those that cannot be
        read are left out and reported to `warn`, as is what the headers and the reader of a data set note."""
        if warn is not None:
            self.headers.warn(warn)
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
            require_size(rgb, self.width, self.height, f"{self.sequence.names[index]} of {self.path}")
            yield VideoFrame(index, float(self.sequence.timestamps[index]), rgb)

    def name(self, frame_id: int, index: int) -> str:
        """The image's own name; formats that are not written here become .png."""
        return self._names[index]

    def original(self, index: int) -> Path | None:
        """The image's file, unless other programs would see it turned, transparent or not at all."""
        path = self.sequence.image_paths[index] if self.sequence.image_paths else None
        return path if path is not None and reusable(path) and self.reading.orientation in (None, 1) else None

    def transparent(self, index: int) -> NDArray[np.bool_] | None:
        """(height, width) pixels of image `index` that its alpha channel makes transparent; None without any."""
        paths = self.sequence.image_paths
        return read_transparent(paths[index], self.reading) if paths else None

    def exif_focal(self) -> float | None:
        """Return the focal length in pixels that the images state, if any do."""
        return self.headers.focal_px(self.width, self.height)

    def _rgb(self, index: int) -> NDArray[np.uint8]:
        paths = self.sequence.image_paths
        return read_rgb(paths[index], self.reading) if paths else self.sequence.rgb(index)


class RecordingSource(ImageSource):
    """The frames of a data set. Where the recording has depth or labels is no matter here."""

    def _orientation(self) -> int | None:
        common, camera = super()._orientation(), self.sequence.camera
        first = next(iter(self.headers.of.values()))
        is_turned = common is None and camera is not None and first.size != first.stored
        # The program that made the data set has not turned its images.
        return 1 if is_turned and camera is not None and _is_shape_of(first.stored, camera) else common

    def _require_one_camera(self) -> None:
        if self.sequence.camera is None:
            super()._require_one_camera()

    def known_camera(self) -> Camera | None:
        """The data set's camera at the size of its images."""
        camera = self.sequence.camera
        return None if camera is None else camera.resized(self.width, self.height)


def require_size(rgb: NDArray[np.uint8], width: int, height: int, what: str) -> None:
    """Raise InputError for an image of another size than those before it."""
    if rgb.shape[:2] != (height, width):
        raise InputError(
            f"{what} is {rgb.shape[1]}x{rgb.shape[0]}, the images before it are {width}x{height}: convert the source "
            "to one size first"
        )


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
