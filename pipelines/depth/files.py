"""Maps that the user or a data set gives, which of them is which frame's, and depth by them."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets import Dataset
from ...formats.errors import InputError
from ...formats.image_folder import natural_key
from ...formats.images import MAX_IMAGE_PIXELS, image_size, read_depth_png, read_grey_png, read_label_png
from ...formats.reading import home_expanded, note_read, parsing, reaching, require_file
from ...formats.tensors import HEADERS
from ..geometry.camera import resample_nearest, resize_depth
from ..geometry.sequence import Sequence
from ..providers import DepthEstimate, DepthProvider
from ..types import Frame

if TYPE_CHECKING:
    from ..sfm.lens import FramePixels

_WORDS = r"(colou?r|rgb|image|img|depth|disp|labels?|semantic|segmentation|class|conf|confidence)"
_OF_KIND = re.compile(rf"^{_WORDS}[._-]|[._-]{_WORDS}$", re.IGNORECASE)
_INVALID_U16 = 65535
NO_DEPTH = (
    "the depth files hold no depth at all, every value is 0, 65535, negative, infinite or NaN. Look at what wrote "
    "them, or omit --depth files"
)


@dataclass(frozen=True)
class MapKind:
    """A kind of maps: names of its folders and files, suffixes, how a file is read, (h, w), and how that is resized to
    a height and width."""

    names: tuple[str, ...]
    suffixes: tuple[str, ...]
    load: Callable[[Path], NDArray]
    resize: Callable[[NDArray, int, int], NDArray] = resample_nearest

    def find_folder(self, given: str, source: Path) -> Path:
        """Find `given` or a folder of the kind's name inside it; without `given`, such a folder beside the source.

        Raises InputError when there is none that holds files of the kind.
        """
        roots = [home_expanded(given)] if given else [source.parent, source]
        candidates = [*(root / name for root in roots for name in self.names), roots[-1]]
        for folder in candidates:
            if self.files_in(folder):
                return folder
        raise InputError(
            f"no folder with {self.names[0]} files ({', '.join(self.suffixes)}) found; looked in "
            f"{', '.join(map(str, candidates))}. Give the folder as files:FOLDER"
        )

    def files_in(self, folder: Path) -> list[Path]:
        """List those of a folder in natural order; where several kinds are mixed, those that carry one of the names."""
        with reaching(folder):
            inside = folder.iterdir() if folder.is_dir() else ()
            files = [p for p in inside if p.suffix.lower() in self.suffixes and p.is_file() and p.name[0] != "."]
        files.sort(key=lambda p: natural_key(p.name))
        marked = re.compile(rf"(^|[._-])({'|'.join(self.names)})s?([._-]|$)")
        return [p for p in files if marked.search(p.stem.lower())] or files

    def match(self, folder: Path, frames: list[Frame], is_video: bool) -> dict[int, Path]:
        """Frame id → file. An image folder matches by name, then by the last number in it where no other image or file
        has that; a video by source index.

        Raises InputError when no frame finds a file.
        """
        note_read(folder)
        files = self.files_in(folder)
        by_key = {} if is_video else {frame_key(p.name): p for p in files}
        by_number = {_last_number(p.stem): p for p in reversed(files)}  # the first of several
        if not is_video:  # two of a kitchen and a hall may be number 3: that of the one is none of the other's
            for stems in ({p.stem for p in files}, [Path(f.name).stem for f in frames]):
                for number in (n for n, k in Counter(map(_last_number, stems)).items() if k > 1):
                    by_number.pop(number, None)
        by_number.pop(None, None)
        found = {}
        for frame in frames:
            number = frame.source_index if is_video else _last_number(Path(frame.name).stem)
            if path := by_key.get(frame_key(frame.name)) or by_number.get(number):
                found[frame.id] = path
        if not found:
            rule = "the frame's number in the video" if is_video else "the image's name"
            raise InputError(
                f"{folder}: none of its {len(files)} files ({files[0].name} …) belongs to a frame "
                f"({frames[0].name} …). Name each file by {rule}"
            )
        return found


def depth_kind(unit: float) -> MapKind:
    """uint16 images in units of `unit` metres (0 and 65535 unknown), or .npy of float metres."""
    return MapKind(("depth",), (".png", ".npy", ".tif", ".tiff"), lambda path: read_depth(path, unit), resize_depth)


_IMAGES = (".png", ".tif", ".tiff")
CONFIDENCE = MapKind(("confidence", "conf"), _IMAGES, read_grey_png)
LABELS = MapKind(
    ("labels", "label", "semantic_class", "semantic", "semantics", "segmentation"), _IMAGES, read_label_png
)


class FrameMaps(ABC):
    """The maps of one kind of a sequence's frames; they show what the source's images show, with the lens distortion of
    these. `files` are those of frames that have one, by id."""

    name: str
    files: dict[int, Path]

    def __init__(self, kind: MapKind, sequence: Sequence) -> None:
        self._kind, self.sequence = kind, sequence

    @abstractmethod
    def read(self, frame_id: int) -> NDArray:
        """(h, w) of a frame that has a file. Raises InputError for one that cannot be read or has another shape."""

    def fitted(self, array: NDArray) -> NDArray:
        """(H, W) at the size of the proxy maps, the distortion taken away."""
        if any(self.sequence.calibration.distortion):
            return self._pixels.sample(array)
        return self._kind.resize(array, self.sequence.intrinsics.height, self.sequence.intrinsics.width)

    @cached_property
    def _pixels(self) -> FramePixels:
        from ..sfm.lens import FramePixels  # imports pycolmap

        return FramePixels(replace(self.sequence.calibration, intrinsics=self.sequence.intrinsics))


class FolderMaps(FrameMaps):
    """The files of a folder."""

    def __init__(
        self,
        kind: MapKind,
        folder: Path,
        sequence: Sequence,
        is_video: bool = False,
        turns: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        """Raises InputError unless frames find their files, and the first file fits the frames; `turns` are the quarter
        turns of frames that are not read upright, by id."""
        super().__init__(kind, sequence)
        self.name, self.folder, self._is_video, self._turns = f"files:{folder}", folder, is_video, turns
        self.files = kind.match(folder, sequence.frames, is_video)
        self.read(next(iter(self.files)))

    def companion(self, kind: MapKind) -> FolderMaps | None:
        """Return maps of another kind beside these, first of all those of a folder that is named like this one."""
        own = self._kind.names[0]
        alike = [self.folder.name.replace(own, name) for name in kind.names if own in self.folder.name]
        for name in (*alike, *kind.names):
            note_read(self.folder.parent / name)
            if kind.files_in(self.folder.parent / name):
                return FolderMaps(kind, self.folder.parent / name, self.sequence, self._is_video, self._turns)
        return None

    def read(self, frame_id: int) -> NDArray:
        return self._lying(frame_id, self._kind.load(self.files[frame_id]))

    def require_shapes(self) -> None:
        """Raise InputError for a file of another shape than the frames, by the headers alone."""
        for frame_id, path in self.files.items():
            shape = _open_npy(path).shape if path.suffix.lower() == ".npy" else image_size(path)[::-1]
            self._lying(frame_id, np.broadcast_to(np.uint8(0), shape))

    def _lying(self, frame_id: int, array: NDArray) -> NDArray:
        """A map of an upright photo, turned as the photo is; one that lies already as the frames do stays."""
        turn, frame = self._turns.get(frame_id, 0), self.sequence.calibration.intrinsics
        if turn % 2 == 0 or (array.shape[1] > array.shape[0]) != (frame.width > frame.height):
            array = np.rot90(array, turn)
        height, width = array.shape
        # Cross-multiplied aspect ratios, with one pixel of slack on the smaller image.
        if abs(width * frame.height - height * frame.width) > max(frame.width, frame.height, width, height):
            raise InputError(
                f"{self.files[frame_id]} is {width}x{height}, which is not the shape of the frames "
                f"({frame.width}x{frame.height}). The maps must show exactly what the frames show"
            )
        return array


class DatasetMaps(FrameMaps):
    """Maps that a data set has of its images, its sensor's or its annotators': metres, or numbers of its classes."""

    def __init__(self, kind: MapKind, dataset: Dataset, sequence: Sequence) -> None:
        """`kind` is of depth or labels. Raises InputError for a data set without such maps."""
        super().__init__(kind, sequence)
        what = kind.names[0]
        self._load: Callable[[int], NDArray | None] = dataset.depth if what == "depth" else dataset.labels
        paths = dataset.depth_paths if what == "depth" else dataset.label_paths
        if what == "depth" and dataset.store is not None:
            paths = (dataset.root,) * len(dataset)
        if not any(paths):
            option = "depth" if what == "depth" else "semantics"
            raise InputError(f"{dataset.root}: this {dataset.format} recording has no {what}: --{option} files:FOLDER")
        self.name, self.dataset = f"files of the data set ({dataset.format})", dataset
        self._index = {f.id: f.source_index for f in sequence.frames}
        self.files = {i: path for i, k in self._index.items() if (path := paths[k]) is not None}

    def read(self, frame_id: int) -> NDArray:
        found = self._load(self._index[frame_id])
        assert found is not None, "it has a file"
        return found


class FilesDepth(DepthProvider):
    """Metric depth by files. Confidence is 1 where it is known, or what images of 8 or 16 bits in a folder `confidence`
    (or `conf`) say, of several that which is named like the depth's: `proxy_conf` beside `proxy_depth`."""

    metric = True

    def __init__(self, maps: FrameMaps) -> None:
        self._maps, self.name = maps, maps.name
        self._confidences = maps.companion(CONFIDENCE) if isinstance(maps, FolderMaps) else None

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without a file."""
        return [f for f in frames if f.id not in self._maps.files]

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Raises InputError for a file of another shape than the frame; without a file all depth is unknown."""
        if frame.id not in self._maps.files:
            camera = self._maps.sequence.intrinsics
            empty = np.zeros((camera.height, camera.width), np.float32)
            return DepthEstimate(empty, empty)
        depth, invalid = clean_depth(self._maps.read(frame.id))
        depth = self._maps.fitted(depth)
        confidence = (depth > 0).astype(np.float32)
        if self._confidences is not None and frame.id in self._confidences.files:
            confidence *= self._confidences.fitted(self._confidences.read(frame.id))
        return DepthEstimate(depth, confidence, invalid)

    def check(self) -> None:
        """Raise InputError for a file of another shape than the frames, and where none holds any depth: they are read
        up to the first that does."""
        for maps in (self._maps, self._confidences):
            if isinstance(maps, FolderMaps):
                maps.require_shapes()
        if not any((clean_depth(self._maps.read(i))[0] > 0).any() for i in self._maps.files):
            raise InputError(f"{self.name}: {NO_DEPTH}")

    def figures(self) -> dict[str, Any]:
        """Whether the folder had confidences too."""
        return {"confidence_files": len(self._confidences.files) if self._confidences else 0}


def clean_depth(depth: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """Depth with NaN, infinite and negative values made unknown (0), and how many of them there were."""
    bad = ~np.isfinite(depth) | (depth < 0)
    count = int(bad.sum())
    return (np.where(bad, 0, depth).astype(np.float32) if count else depth), count


def read_depth(path: Path, unit: float) -> NDArray[np.float32]:
    """(h, w) metres of a uint16 image in units of `unit` metres, or of an .npy. Raises InputError for anything else."""
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


def frame_key(file_name: str) -> str:
    """Return the key shared by files of one instant: the stem without words like `.color` or `depth_`."""
    return _OF_KIND.sub("", Path(file_name).stem).lower()


def _last_number(stem: str) -> int | None:
    digits = re.findall(r"\d+", stem)
    return int(digits[-1]) if digits else None
