"""Depth from a folder of files, ground truth or the user's own model's, and which file of a folder is which frame's."""

import re
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.image_folder import natural_key
from ...formats.images import MAX_IMAGE_PIXELS, image_size, read_depth_png, read_grey_png
from ...formats.reading import home_expanded, note_read, parsing, reaching, require_file
from ...formats.tensors import HEADERS
from ..geometry.camera import resample_nearest, resize_depth
from ..geometry.sequence import Sequence
from ..providers import DepthEstimate, DepthProvider
from ..types import Frame, Intrinsics

_KINDS = r"(colou?r|rgb|image|img|depth|disp|labels?|semantic|segmentation|class|conf|confidence)"
_PREFIX = re.compile(rf"^{_KINDS}[._-]", re.IGNORECASE)
_SUFFIX = re.compile(rf"[._-]{_KINDS}$", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(\d+)(?!.*\d)")
_SUFFIXES = (".png", ".npy", ".tif", ".tiff")
_NAMES = ("depth",)
_CONFIDENCE_NAMES = ("confidence", "conf")
_INVALID_U16 = 65535
NO_DEPTH = (
    "the depth files hold no depth at all, every value is 0, 65535, negative, infinite or NaN. Look at what wrote "
    "them, or omit --depth files"
)


class FilesDepth(DepthProvider):
    """One file a frame: uint16 images in units of `unit` metres (0 and 65535 unknown), or .npy of float metres.

    A folder `confidence` (or `conf`) beside it, of 8 or 16 bit images, gives the confidence, first of all the one that
    is named like the depth's: `proxy_conf` beside `proxy_depth`. Without one it is 1 where the depth is known.
    """

    metric = True

    def __init__(
        self,
        folder: str,
        source: Path,
        sequence: Sequence,
        unit: float,
        turns: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        """Raises InputError unless the folder is there, frames find their files, and the first file fits the frames;
        `turns` are the quarter turns of frames that are not read upright."""
        if not unit > 0:
            raise InputError(f"proxy.depth_scale must be positive (metres per unit of the depth files), got {unit}")
        self._sequence, self._unit, self._turns = sequence, unit, turns
        is_video = source.is_file()
        path = find_folder(folder, source, _NAMES, _SUFFIXES)
        self.name = f"files:{path}"
        self._files = match_files(path, _SUFFIXES, _NAMES, sequence.frames, is_video)
        self._confidences = _match_confidence(path, sequence, is_video)
        self.estimate(next(f for f in sequence.frames if f.id in self._files))

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without a file."""
        return [f for f in frames if f.id not in self._files]

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Raises InputError for a file of another shape than the frame; without a file all depth is unknown."""
        camera = self._sequence.intrinsics
        if frame.id not in self._files:
            empty = np.zeros((camera.height, camera.width), np.float32)
            return DepthEstimate(empty, empty)
        path = self._files[frame.id]
        turn, full = self._turns.get(frame.id, 0), self._sequence.calibration.intrinsics
        depth, invalid = clean_depth(as_read(_read(path, self._unit), turn, full))
        require_aspect(path, depth, self._sequence)
        depth = resize_depth(depth, camera.height, camera.width)
        confidence = (depth > 0).astype(np.float32)
        if frame.id in self._confidences:
            given = as_read(read_grey_png(self._confidences[frame.id]), turn, full)
            require_aspect(self._confidences[frame.id], given, self._sequence)
            confidence *= resample_nearest(given, camera.height, camera.width)
        return DepthEstimate(depth, confidence, invalid)

    def files(self) -> list[Path]:
        """Every file that it may read."""
        return [*self._files.values(), *self._confidences.values()]

    def turned(self) -> set[Path]:
        """Return the files of photos that are not read upright."""
        return {files[i] for files in (self._files, self._confidences) for i in self._turns if i in files}

    def require_content(self) -> None:
        """Raise InputError where no file holds any depth; files are read up to the first that does."""
        if not any((self.estimate(f).depth > 0).any() for f in self._sequence.frames if f.id in self._files):
            raise InputError(f"{self.name}: {NO_DEPTH}")

    def figures(self) -> dict[str, Any]:
        """Whether the folder had confidences too."""
        return {"confidence_files": len(self._confidences)}


def clean_depth(depth: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """Depth with NaN, infinite and negative values made unknown (0), and how many of them there were."""
    bad = ~np.isfinite(depth) | (depth < 0)
    count = int(bad.sum())
    return (np.where(bad, 0, depth).astype(np.float32) if count else depth), count


def require_aspect(path: Path, array: NDArray, sequence: Sequence) -> None:
    """Raise InputError unless a map has the frames' shape at some scale (a pixel of rounding is allowed)."""
    require_size(path, array.shape[1], array.shape[0], sequence)


def require_sizes(files: list[Path], turned: Collection[Path], sequence: Sequence) -> None:
    """`require_aspect` of many files by their headers alone, without reading what they hold; the `turned` are of photos
    that are not read upright."""
    full = sequence.calibration.intrinsics
    for path in files:
        if path.suffix.lower() == ".npy":
            height, width = _open_npy(path).shape
        elif path.suffix.lower() in (".png", ".tif", ".tiff"):
            width, height = image_size(path)
        else:
            continue
        is_turned = path in turned and (width > height) != (full.width > full.height)
        require_size(path, *((height, width) if is_turned else (width, height)), sequence)


def require_size(path: Path, width: int, height: int, sequence: Sequence) -> None:
    """Raise InputError unless width x height has the frames' shape at some scale (a pixel of rounding is allowed)."""
    frame = sequence.calibration.intrinsics
    # Cross-multiplied aspect ratios, with one pixel of slack on the smaller image.
    if abs(width * frame.height - height * frame.width) > max(frame.width, frame.height, width, height):
        raise InputError(
            f"{path} is {width}x{height}, which is not the shape of the frames ({frame.width}x{frame.height}). "
            "The maps must show exactly what the frames show"
        )


def _read(path: Path, unit: float) -> NDArray[np.float32]:
    if path.suffix.lower() == ".npy":
        with np.errstate(over="ignore"):  # infinite is as unknown as too far
            return np.array(_open_npy(path), dtype=np.float32)
    stored = read_depth_png(path)
    return np.where(stored == _INVALID_U16, 0, stored).astype(np.float32) * np.float32(unit)


def _open_npy(path: Path) -> NDArray[np.floating]:
    """Mapped, not read: (h, w) floats. Raises InputError for anything else."""
    require_file(path)
    with parsing(path, ".npy of an array", "save it again with numpy.save"):
        with HEADERS:
            stored = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(stored, np.ndarray):
            raise ValueError("an archive of several")
    shape = stored.shape
    if not np.issubdtype(stored.dtype, np.floating) or len(shape) != 2 or 0 in shape:
        raise InputError(f"{path}: holds {stored.dtype} {shape}; depth is a float array (height, width) in metres")
    if stored.size > MAX_IMAGE_PIXELS:
        raise InputError(f"{path}: holds {stored.size} values, more than {MAX_IMAGE_PIXELS}. Reduce it")
    return stored


def _match_confidence(depth_folder: Path, sequence: Sequence, is_video: bool) -> dict[int, Path]:
    suffixes = (".png", ".tif", ".tiff")
    alike = tuple(depth_folder.name.replace(_NAMES[0], n) for n in _CONFIDENCE_NAMES if _NAMES[0] in depth_folder.name)
    for name in alike + _CONFIDENCE_NAMES:
        folder = depth_folder.parent / name
        note_read(folder)
        with reaching(folder):
            found = folder.is_dir() and any(p.suffix.lower() in suffixes for p in folder.iterdir())
        if found:
            return match_files(folder, suffixes, _CONFIDENCE_NAMES, sequence.frames, is_video)
    return {}


def frame_key(file_name: str) -> str:
    """Return the key shared by files of one instant: the stem without words like `.color` or `depth_`."""
    return _SUFFIX.sub("", _PREFIX.sub("", Path(file_name).stem)).lower()


def find_folder(given: str, source: Path, names: tuple[str, ...], suffixes: tuple[str, ...]) -> Path:
    """The folder of maps: `given` or a folder named so inside it; without `given`, such a folder beside the source.

    Raises InputError when there is none that holds files with one of `suffixes`.
    """
    roots = [home_expanded(given)] if given else [source.parent, source]
    candidates = [root / name for root in roots for name in names]
    candidates += [home_expanded(given)] if given else [source]
    for folder in candidates:
        with reaching(folder):
            if folder.is_dir() and _list(folder, suffixes, names):
                return folder
    looked = ", ".join(str(c) for c in candidates)
    raise InputError(
        f"no folder with {names[0]} files ({', '.join(suffixes)}) found; looked in {looked}. "
        f"Give the folder as files:FOLDER"
    )


def as_read(array: NDArray, turn: int, frame: Intrinsics) -> NDArray:
    """A map (h, w) of an upright photo, turned as the photo is; one that lies already as the frames do stays."""
    is_turned = turn % 2 == 0 or (array.shape[1] > array.shape[0]) != (frame.width > frame.height)
    return np.rot90(array, turn) if turn and is_turned else array


def match_files(
    folder: Path, suffixes: tuple[str, ...], names: tuple[str, ...], frames: list[Frame], is_video: bool
) -> dict[int, Path]:
    """Frame id → file. An image folder matches by name, then by the last number in it where no other image or file has
    that; a video by source index.

    Raises InputError when no frame finds a file.
    """
    note_read(folder)
    files = _list(folder, suffixes, names)
    by_key = {frame_key(p.name): p for p in files}
    by_number = {n: p for p in reversed(files) if (n := _last_number(p.stem)) is not None}
    # Two of a kitchen and a hall may be number 3: that of the one is none of the other's.
    stems = {p.stem for p in files}, [Path(f.name).stem for f in frames]
    usable = set.intersection(*({n for n, k in Counter(map(_last_number, s)).items() if k == 1} for s in stems))
    found = {}
    for frame in frames:
        if is_video:
            path = by_number.get(frame.source_index)
        elif (path := by_key.get(frame_key(frame.name))) is None:
            number = _last_number(Path(frame.name).stem)
            path = by_number.get(number) if number is not None and number in usable else None
        if path is not None:
            found[frame.id] = path
    if not found:
        rule = "the frame's number in the video" if is_video else "the image's name"
        raise InputError(
            f"{folder}: none of its {len(files)} files ({files[0].name} …) belongs to a frame "
            f"({frames[0].name} …). Name each file by {rule}"
        )
    return found


def _last_number(stem: str) -> int | None:
    found = _LAST_NUMBER.search(stem)
    return int(found.group(1)) if found else None


def _list(folder: Path, suffixes: tuple[str, ...], names: tuple[str, ...]) -> list[Path]:
    """The map files of a folder; where several kinds are mixed, those that carry one of `names`."""
    files = sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and not p.name.startswith(".")),
        key=lambda p: natural_key(p.name),
    )
    marked = [p for p in files if any(re.search(rf"(^|[._-]){n}s?([._-]|$)", p.stem.lower()) for n in names)]
    return marked or files
