"""The kinds of source, a video file, a folder of images or a data set, read alike."""

import re
import shlex
from collections import Counter
from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ...formats.datasets import Sequence
from ...formats.errors import InputError, install_extra
from ...formats.image_folder import list_images, read_image_times, times_file, unread_images
from ...formats.images import is_depth_map
from ...formats.reading import files_sha256, known_sha256, opened, reaching, require_file
from ...formats.textfile import read_text
from ...formats.video import VideoFrame, VideoReader, probe_video
from ...formats.video_head import main_track
from ..run.folder import RunFolder
from .recording import Headers, ImageSource, RecordingSource, Warn, open_recording, require_size

LIST_SUFFIX = ".videos"
_LONGEST_LIST = 100_000
_FEWEST_OF_ONE_SIZE, _RARE = 4, 10
"""Images of one size, beside which one, or a tenth as many, may be of others."""
_PAUSE = 10.0
"""Seconds on the clock of the run between two videos: no velocity goes on from one to the next."""


@dataclass
class VideoSource:
    """A video file, or several of one place by one camera: see `video_files`. Their frames are counted on."""

    path: Path
    files: tuple[Path, ...] = field(init=False)
    width: int = field(init=False)
    height: int = field(init=False)
    expected_frames: int = field(init=False)
    has_times: bool = field(init=False, default=True)

    def __post_init__(self) -> None:
        self.files = video_files(self.path)
        found = {str(file): probe_video(file) for file in self.files}
        _require_one_size(self.path, {name: (i.width, i.height) for name, i in found.items()}, "videos")
        self.width, self.height = next((i.width, i.height) for i in found.values())
        self.expected_frames = sum(i.frame_count_claimed for i in found.values())

    def read(self, wanted: Container[int] | None = None, warn: Warn | None = None) -> Iterator[VideoFrame]:
        """Decode from start to end, and hand out the wanted frames (None = all) one at a time; a truncated or damaged
        file is reported to `warn` at the end."""
        first, start = 0, 0.0
        for file in self.files:
            with VideoReader(file, None if wanted is None else lambda i, n=first: n + i in wanted) as reader:  # type: ignore[misc]
                for index, time, rgb in reader:
                    require_size(rgb, self.width, self.height, f"frame {index} of {file}")
                    yield VideoFrame(first + index, start + time, rgb)
                if warn is not None:
                    _warn_of_the_file(file, reader, warn)
                first, start = first + len(reader.timestamps), start + reader.timestamps[-1] + _PAUSE

    def name(self, frame_id: int, index: int) -> str:
        """Return the name of a frame: 000000.jpg, 000001.jpg, ..."""
        return f"{frame_id:06d}.jpg"

    def original(self, index: int) -> Path | None:
        """Return None: a video has no files of single frames."""
        return None

    def exif_focal(self) -> float | None:
        """Return None: videos state no focal length."""
        return None

    def transparent(self, index: int) -> None:
        """Return None: the alpha channel of videos is not read."""
        return


def video_files(path: Path) -> tuple[Path, ...]:
    """The videos that a text file of the suffix .videos names, one a line, seen from its folder; of any other file
    itself."""
    if path.suffix != LIST_SUFFIX:
        return (path,)
    lines = [line.strip() for line in read_text(path, _LONGEST_LIST).splitlines()]
    files = tuple(path.parent / line for line in lines if line)
    if not files or LIST_SUFFIX in {file.suffix for file in files}:
        raise InputError(f"{path} names no videos: write the name of one on each line")
    return files


class FolderSource(ImageSource):
    """The images directly in a folder, in natural order of their names; depth maps among them, and a few of another
    size than the rest, are left out."""

    def __init__(self, path: Path) -> None:
        listed = list_images(path)
        images = _without_depth_maps(listed)
        names, notes = tuple(image.name for image in images), _notes_on_unread(path)
        if len(images) < len(listed):
            notes += (f"{len(listed) - len(images)} depth maps among the images are left out",)
        super().__init__(Sequence("images", path, names, read_image_times(images), tuple(images), notes=notes))

    def _of_one_size(self, headers: Headers) -> Headers:
        headers = headers.of_most(lambda header: (min(header.stored), max(header.stored)))
        common = headers.common_orientation()
        return headers if common is not None else headers.of_most(lambda header: header.size)

    def _require_one_camera(self) -> None:
        sizes = {name: self._size(header) for name, header in self.headers.of.items()}
        _require_one_size(self.path, sizes, "images")
        super()._require_one_camera()

    def turns_from_upright(self, index: int) -> int:
        """Return the anticlockwise quarter turns by which image `index` differs from its upright view."""
        return self.headers.turns_from_upright(self.sequence.names[index], self._common)

    def file(self, index: int) -> Path:
        """The image of that number, however it is turned."""
        return self.sequence.image_paths[index]


Source = VideoSource | FolderSource | RecordingSource
"""`expected_frames` is an estimate before reading, 0 = unknown."""


def _without_depth_maps(images: list[Path]) -> list[Path]:
    """All but images of 16 bits in one channel, if there are others: some data sets keep depth beside colour."""
    depth = {path for path in images if path.suffix.lower() in (".png", ".tif", ".tiff") and is_depth_map(path)}
    return images if len(depth) == len(images) else [path for path in images if path not in depth]


def _notes_on_unread(folder: Path) -> tuple[str, ...]:
    unread = unread_images(folder)
    if not unread:
        return ()
    kinds = ", ".join(sorted({path.suffix.lower() for path in unread}))
    return (
        f"{len(unread)} files of a format that is not read ({kinds}) are left out, {unread[0].name} first: export them "
        "as JPEG or PNG",
    )


def open_source(path: Path, format: str = "auto") -> Source:
    """A video file, a folder of images, or a data set (see `open_recording` for the format).

    Raises InputError when there is no such file, it is no video, it holds no image, or images differ in size.
    """
    require_source(path)
    recording = open_recording(path, format)
    if recording is not None:
        return RecordingSource(recording)
    return FolderSource(path) if path.is_dir() else VideoSource(path)


_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")
"""Begins an address; a path has lost one of its slashes."""
_ARCHIVE_HEADS = (
    b"PK\3\4",
    b"\x1f\x8b",
    b"BZh",
    b"7z\xbc\xaf\x27\x1c",
    b"Rar!\x1a\x07",
    b"\xfd7zXZ\0",
    b"\x28\xb5\x2f\xfd",
)
_TAR_MARK_AT = 257


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
    with opened(path) as file:
        head = file.read(_TAR_MARK_AT + 5)
    if head.startswith(_ARCHIVE_HEADS) or head[_TAR_MARK_AT:] == b"ustar":
        raise InputError(f"{path} is an archive: unpack it first, then give the video or the folder that was in it")


def source_digest(source: Path, format: str) -> str:
    """Identity of a source: a video's bytes; names and bytes of the images of a folder or data set, and their times.

    Other files in the folder do not count. A file that stays the same is read once in a process. Raises InputError
    where there is nothing to read.
    """
    require_source(source)
    recording = open_recording(source, format)
    if recording is not None and recording.image_paths:
        head = f"{recording.format} {recording.camera}".encode()
        head += b"" if recording.timestamps is None else recording.timestamps.tobytes()
        return files_sha256(zip(recording.names, recording.image_paths, strict=True), head, known_sha256)
    if source.is_file():
        files = video_files(source)
        if files == (source,):
            return known_sha256(source)
        return files_sha256(((str(i), f) for i, f in enumerate(files)), of_file=known_sha256)
    images, times = list_images(source), times_file(source)
    return files_sha256(sorted((p.name, p) for p in [*images, *([times] if times else [])]), of_file=known_sha256)


def require_different(videos: Iterable[Path]) -> None:
    """Raise InputError for a video that is named twice: each of its frames would have a twin that does not move."""
    counts = Counter(video.resolve() for video in videos)
    if twice := next((video for video, times in counts.items() if times > 1), None):
        raise InputError(f"{twice} is given {counts[twice]} times: give each video once")


def is_of_source(path: Path, run: RunFolder) -> bool:
    """Return whether something that exists is a video that a run was made from, its folder of images, or in that."""
    if (manifest := run.manifest()) is None or not path.exists():
        return False
    source = Path(manifest.source.path)
    files = video_files(source) if source.is_file() else (source,)
    return any(path.resolve().is_relative_to(file.resolve()) for file in files)


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


def _warn_of_the_file(path: Path, reader: VideoReader, warn: Warn) -> None:
    decoded = len(reader.timestamps)
    if reader.tone_mapped:
        warn(f"{path.name} is HDR ({reader.hdr}): tone-mapped to the range of ordinary images")
    elif reader.hdr:
        fix = install_extra("hdr")
        warn(f"{path.name} is HDR ({reader.hdr}), its colours will look flat. To read it in full: {fix}")
    _warn_of_the_rest(path, reader, warn)
    if reader.is_truncated:
        warn(
            f"{path.name} is truncated: its header declares {reader.info.frame_count_claimed} frames, {decoded} "
            "decode; going on with those"
        )
    _warn_of_shape(path, reader, warn)
    if reader.blank_frames:
        warn(f"{path.name}: {reader.blank_frames} frames of one flat colour (a fade, or damage) were left out")
    if reader.unreadable_frames:
        warn(f"{path.name}: {reader.unreadable_frames} damaged frames were left out")
    _warn_of_the_clock(path, reader, warn)


def _warn_of_the_clock(path: Path, reader: VideoReader, warn: Warn) -> None:
    decoded = len(reader.timestamps)
    if reader.repaired_timestamps == decoded - 1 > 1:
        warn(f"{path.name} has no timestamps (a raw stream?): {reader.info.fps:g} frames a second are assumed")
    elif reader.repaired_timestamps:
        warn(f"{path.name}: {reader.repaired_timestamps} of {decoded} timestamps were missing or went back; repaired")
    if reader.restarts:
        warn(
            f"{path.name}: the clock jumps or starts anew {reader.restarts} times (recordings joined to one file?); "
            "going on with the usual time between two frames"
        )


def _warn_of_the_rest(path: Path, reader: VideoReader, warn: Warn) -> None:
    """Report what the file holds beside the frames that are used: other video tracks, an alpha channel."""
    file, main = shlex.quote(path.name), main_track(reader.tracks)
    named = [f"track {i} ({track.width}x{track.height})" for i, track in enumerate(reader.tracks, 1)]
    if others := [i for i in range(len(named)) if i != reader.track]:
        wanted = main if main in others else others[0]
        more = "" if wanted != main else f"; `{install_extra('hdr')}` makes it the one that is read"
        warn(
            f"{path.name} holds {len(named)} video tracks: {named[reader.track]} is used, not "
            f"{', '.join(named[i] for i in others)}. To use {named[wanted]}, copy it with "
            f"`ffmpeg -i {file} -map 0:v:{wanted} -c copy OUT{path.suffix}`{more}"
        )
    if reader.has_alpha:
        warn(
            f"{path.name} has an alpha channel, which is not read: its background counts as part of the scene. To "
            f"leave it out, make masks with `ffmpeg -i {file} -vf alphaextract -start_number 0 MASKS/%06d.png`, and "
            "pass --masks MASKS"
        )


def _warn_of_shape(path: Path, reader: VideoReader, warn: Warn) -> None:
    if reader.interlaced:
        warn(f"{path.name} is interlaced: deinterlaced, at the cost of some detail; film progressive where you can")
    if reader.display.aspect != 1:
        warn(
            f"{path.name} has pixels that are not square ({reader.display.aspect:.3f} times as wide as high): frames "
            f"are stretched to {reader.info.width}x{reader.info.height}, the size in which all pixels given count"
        )
