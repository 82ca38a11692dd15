"""The source of a run, a video, a folder of images or a data set: opened once, read alike, known by one digest.

What it may not know has to be asked for: `camera`, `is_timed`, `dataset`.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Container, Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets import Camera, Dataset, open_sequence, recognise_source
from ...formats.errors import InputError
from ...formats.image_folder import list_images, read_image_times, times_file, unused_pictures
from ...formats.image_tags import ExifLens
from ...formats.images import Header, Reading, is_depth_map, is_plain, read_rgb, read_transparent
from ...formats.reading import (
    LONGEST_NAME,
    FileStamps,
    files_sha256,
    is_plain_name,
    known_sha256,
    noting_files,
    reaching,
    require_file,
)
from ...formats.video import VideoFrame, VideoReader, probe_video
from ...formats.video_head import read_equivalent
from ..run.folder import RunFolder
from ..run.reads import cover_files
from .files import Headers, Warn, common_span, read_headers, require_one_lens, video_files, warn_of_video

WRITTEN_SUFFIXES = (".jpg", ".jpeg", ".png")

_PAUSE = 10.0
"""Seconds on the clock of the run between two videos: no velocity goes on from one to the next."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""Begins an address; a path has lost one of its slashes."""


class Recording(ABC):
    """Images of one camera in the order of time, as `open_recording` finds them.

    `width` and `height` are those of every image that `read` gives; `expected_frames` is an estimate before reading,
    0 = unknown.
    """

    path: Path
    width: int
    height: int
    expected_frames: int

    @property
    @abstractmethod
    def digest(self) -> str:
        """Identity of the content: a video's bytes; names and bytes of images, their times, and a data set's camera.
        Other files in the folder do not count. Taken when it is first asked for."""

    @abstractmethod
    def read(self, wanted: Container[int] | None = None, warn: Warn | None = None) -> Iterator[VideoFrame]:
        """Decode from start to end, and hand out the wanted images (None = all) one at a time, their time NaN unless
        `is_timed`; damage, and what was left out, is reported to `warn`."""

    @abstractmethod
    def name(self, frame_id: int, index: int) -> str:
        """Return the file name of a frame made of image `index`."""

    def place(self, index: int) -> str:
        """Return the path by which other programs may name image `index`, its name where it is no file."""
        return self.name(index, index)

    def is_timed(self) -> bool:
        """Return whether it says when each of its images was taken."""
        return True

    def camera(self) -> Camera | None:
        """Return the camera that a data set states, at the size of its images; None without."""
        return None

    def dataset(self) -> Dataset | None:
        """Return the data set with its depth, labels and poses; None for a video and for plain images."""
        return None

    def masks(self) -> dict[int, Path]:
        """Return the masks that a data set names, by the images' numbers."""
        return {}

    def original(self, index: int) -> Path | None:
        """Return the file of image `index`, unless other programs would see it turned, transparent or not at all."""
        return None

    def transparent(self, index: int) -> NDArray[np.bool_] | None:
        """Return (height, width) the pixels that an image's alpha channel makes transparent; None without any."""
        return None

    def turns_from_upright(self, index: int) -> int:
        """Return the anticlockwise quarter turns by which image `index` differs from its upright view."""
        return 0

    def exif_focal(self) -> float | None:
        """Return the focal length in pixels that the images or videos state; None without."""
        return None


_opened: dict[tuple[Path, str], tuple[FileStamps, list[Path], Recording]] = {}
"""The last one that was opened, and the files that this has read."""


def open_recording(path: Path, format: str = "auto") -> Recording:
    """Open a video file, a folder of images or a data set; the same object again as long as its files stay.

    format: `auto` looks for what the path is; `images` takes it for a video or plain images in any case; else a data
    set's. Raises InputError when there is no such file, it is no video, it holds no image, or images differ in size.
    """
    key = (path.absolute(), format)
    with noting_files() as files:
        require_source(path)
        if (known := _opened.get(key)) is None or not known[0].are_current():
            found = recognise_source(path) if format == "auto" else format
            recording: Recording
            if found is not None and found != "images":
                recording = DatasetRecording(open_sequence(path, found))
            else:
                recording = FolderRecording(path) if path.is_dir() else VideoRecording(path)
            images = recording.sequence.image_paths if isinstance(recording, ImageRecording) else ()
            folders = [] if isinstance(recording, VideoRecording) else [path, *(file.parent for file in files)]
            _opened.clear()
            known = _opened[key] = FileStamps.of([*files, *folders]), [*files, *images], recording
    cover_files(known[1])
    return known[2]


def require_source(path: Path) -> None:
    """Raise InputError unless the path is a folder or a file with something in it, and may be read."""
    if _URL.match(str(path)) and not path.exists():
        address = str(path).replace(":/", "://", 1)
        raise InputError(f"{address} is a URL: download it first, then give the file (nothing is fetched)")
    with reaching(path):
        if path.is_dir():
            next(path.iterdir(), None)
            return
    require_file(path)


# videos -----------------------------------------------------------------------------------------------------------


class VideoRecording(Recording):
    """A video file, or several of one place by one camera: see `video_files`. Their frames are counted on."""

    def __init__(self, path: Path) -> None:
        """Probe the files. Raises InputError for what is no video, and for videos of several sizes."""
        self.path, self.files = path, video_files(path)
        found = {str(file): probe_video(file) for file in self.files}
        _require_one_size(path, {name: (i.width, i.height) for name, i in found.items()}, "videos")
        self.width, self.height = next((i.width, i.height) for i in found.values())
        self.expected_frames = sum(i.frame_count_claimed for i in found.values())

    @cached_property
    def digest(self) -> str:
        if self.files == (self.path,):
            return known_sha256(self.path)
        return files_sha256(((str(i), f) for i, f in enumerate(self.files)), of_file=known_sha256)

    def read(self, wanted: Container[int] | None = None, warn: Warn | None = None) -> Iterator[VideoFrame]:
        """Do as `Recording` says; a truncated or damaged file is reported at its end."""
        first, start = 0, 0.0
        for file in self.files:
            with VideoReader(file, None if wanted is None else lambda i, n=first: n + i in wanted) as reader:  # type: ignore[misc]
                for index, time, rgb in reader:
                    _require_size(rgb, self, f"frame {index} of {file}")
                    yield VideoFrame(first + index, start + time, rgb)
                if warn is not None:
                    warn_of_video(file, reader, warn)
                first, start = first + len(reader.timestamps), start + reader.timestamps[-1] + _PAUSE

    def name(self, frame_id: int, index: int) -> str:
        """Return 000000.jpg, 000001.jpg, ..."""
        return f"{frame_id:06d}.jpg"

    def exif_focal(self) -> float | None:
        """Do as `Recording` says: what the metadata of all files states alike."""
        stated = {read_equivalent(file) for file in self.files}
        return ExifLens(equivalent=stated.pop()).focal_px(self.width, self.height) if len(stated) == 1 else None


def is_of_source(path: Path, run: RunFolder) -> bool:
    """Return whether something that exists is a video that a run was made from, its folder of images, or in that."""
    if (manifest := run.manifest()) is None or not path.exists():
        return False
    source = Path(manifest.source.path)
    files = video_files(source) if source.is_file() else (source,)
    return any(path.resolve().is_relative_to(file.resolve()) for file in files)


# images -----------------------------------------------------------------------------------------------------------


class ImageRecording(Recording):
    """Images of one size; `headers` are those of the images that can be read."""

    def __init__(self, sequence: Dataset) -> None:
        """Read the headers. Raises InputError where they are not of one camera."""
        self.sequence = s = sequence
        self.path, self.expected_frames = s.root, len(s)
        self._names = written_names(s.names, s.root)
        self.headers, self._common = Headers({}), None
        if not s.image_paths:
            self.height, self.width = s.rgb(0).shape[:2]
            return
        self.headers = self._of_one_size(read_headers(s.root, dict(zip(s.names, s.image_paths, strict=True))))
        self._common = self._orientation()
        self._require_one_camera()
        self.width, self.height = self._size(next(iter(self.headers.of.values())))

    def is_timed(self) -> bool:
        return self.sequence.timestamps is not None

    def _of_one_size(self, headers: Headers) -> Headers:
        """The headers without those of images that are to be left out for their size."""
        return headers

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
        """Do as `Recording` says; images that cannot be read are left out and reported, as is what the headers and the
        reader of a data set note."""
        if warn is not None:
            self.headers.warn(warn)
            for note in self.sequence.notes:
                warn(f"{self.sequence.format}: {note}")
        times = self.sequence.timestamps
        for index in range(len(self.sequence)):
            if (wanted is not None and index not in wanted) or self.sequence.names[index] in self.headers.odd:
                continue
            try:
                rgb = self._rgb(index)
            except InputError as error:
                if warn is not None:
                    warn(f"left out: {error}")
                continue
            _require_size(rgb, self, f"{self.sequence.names[index]} of {self.path}")
            yield VideoFrame(index, math.nan if times is None else float(times[index]), rgb)

    def name(self, frame_id: int, index: int) -> str:
        """Return the image's own name; formats that are not written here become .png."""
        return self._names[index]

    def place(self, index: int) -> str:
        paths = self.sequence.image_paths
        return str(paths[index]) if paths else self.sequence.names[index]

    def masks(self) -> dict[int, Path]:
        return {i: path for i, path in enumerate(self.sequence.mask_paths) if path is not None}

    def original(self, index: int) -> Path | None:
        path = self.sequence.image_paths[index] if self.sequence.image_paths else None
        if path is None or path.suffix.lower() not in WRITTEN_SUFFIXES or not is_plain(path):
            return None
        return path if self.reading.orientation in (None, 1) else None

    def transparent(self, index: int) -> NDArray[np.bool_] | None:
        paths = self.sequence.image_paths
        return read_transparent(paths[index], self.reading) if paths else None

    def exif_focal(self) -> float | None:
        return self.headers.focal_px(self.width, self.height)

    def _rgb(self, index: int) -> NDArray[np.uint8]:
        paths = self.sequence.image_paths
        return read_rgb(paths[index], self.reading) if paths else self.sequence.rgb(index)


class FolderRecording(ImageRecording):
    """The images directly in a folder, in natural order of their names; depth maps among them, and a few of another
    size than the rest, are left out."""

    def __init__(self, path: Path) -> None:
        listed = list_images(path)
        # Some data sets keep depth beside colour, as images of 16 bits in one channel.
        images = [p for p in listed if p.suffix.lower() not in (".png", ".tif", ".tiff") or not is_depth_map(p)]
        images, notes = images or listed, unused_pictures(listed)
        if len(images) < len(listed):
            notes += (f"{len(listed) - len(images)} depth maps among the images are left out",)
        names = tuple(image.name for image in images)
        super().__init__(Dataset("images", path, names, read_image_times(images), tuple(images), notes=notes))

    @cached_property
    def digest(self) -> str:
        files = [*list_images(self.path), *filter(None, [times_file(self.path)])]
        return files_sha256(sorted((p.name, p) for p in files), of_file=known_sha256)

    def _of_one_size(self, headers: Headers) -> Headers:
        headers = headers.of_most(lambda header: (min(header.stored), max(header.stored)))
        common = headers.common_orientation()
        return headers if common is not None else headers.of_most(lambda header: header.size)

    def _require_one_camera(self) -> None:
        sizes = {name: self._size(header) for name, header in self.headers.of.items()}
        _require_one_size(self.path, sizes, "images")
        super()._require_one_camera()

    def turns_from_upright(self, index: int) -> int:
        return self.headers.turns_from_upright(self.sequence.names[index], self._common)

    def file(self, index: int) -> Path:
        """The image of that number, however it is turned."""
        return self.sequence.image_paths[index]


class DatasetRecording(ImageRecording):
    """The frames of a data set."""

    @cached_property
    def digest(self) -> str:
        s = self.sequence
        if not s.image_paths:
            return known_sha256(self.path)
        head = f"{s.format} {s.camera}".encode() + (b"" if s.timestamps is None else s.timestamps.tobytes())
        return files_sha256(zip(s.names, s.image_paths, strict=True), head, known_sha256)

    def _orientation(self) -> int | None:
        common, camera = super()._orientation(), self.sequence.camera
        first = next(iter(self.headers.of.values()))
        if common is not None or camera is None or first.size == first.stored or camera.width == camera.height:
            return common
        # The program that made the data set has not turned its images.
        return 1 if (first.stored[0] > first.stored[1]) == (camera.width > camera.height) else None

    def _require_one_camera(self) -> None:
        if self.sequence.camera is None:
            super()._require_one_camera()

    def camera(self) -> Camera | None:
        camera = self.sequence.camera
        return None if camera is None else camera.resized(self.width, self.height)

    def dataset(self) -> Dataset:
        return self.sequence


def written_name(name: str) -> str:
    """The name under which a frame is written: its own; formats that are not written here become .png."""
    return name if Path(name).suffix.lower() in WRITTEN_SUFFIXES else f"{name}.png"


def written_names(names: Iterable[str], root: Path) -> tuple[str, ...]:
    """`written_name` of each. Raises InputError, naming the file, where a run could not keep one of them: it stores
    names as UTF-8 in JSON and in COLMAP's files, one a line, and each frame in a file of its name."""
    written: dict[str, str] = {}
    for name in names:
        frame = written_name(name)
        if len(frame.encode("utf-8", "surrogatepass")) > LONGEST_NAME:
            raise InputError(f"{root}: the name {name!r} is longer than {LONGEST_NAME} bytes: rename the image")
        if not is_plain_name(frame):
            raise InputError(
                f"{root}: the name {name!r} holds a line break, a control character, a slash, a drive or no UTF-8: "
                "rename it"
            )
        # The run may be copied to a disk that does not tell cases apart (NTFS, APFS).
        if (alike := frame.casefold()) in written:
            raise InputError(f"{root}: {written[alike]!r} and {name!r} would both become {frame!r}: rename one of them")
        written[alike] = name
    return tuple(map(written_name, written.values()))


# sizes and warnings -----------------------------------------------------------------------------------------------


def _require_size(rgb: NDArray[np.uint8], source: Recording, what: str) -> None:
    height, width = rgb.shape[:2]
    if (width, height) != (source.width, source.height):
        raise InputError(
            f"{what} is {width}x{height}, the images before it are {source.width}x{source.height}: convert the source "
            "to one size first"
        )


def _require_one_size(folder: Path, sizes: dict[str, tuple[int, int]], what: str) -> None:
    first_name, first = next(iter(sizes.items()))
    others = [name for name, size in sizes.items() if size != first]
    if others:
        width, height = sizes[others[0]]
        raise InputError(
            f"the {what} of {folder} differ in size: {first_name} is {first[0]}x{first[1]}, {others[0]} is "
            f"{width}x{height} ({len(others)} of {len(sizes)} differ from the first): keep the {what} of one camera "
            "and one orientation together"
        )
