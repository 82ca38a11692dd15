"""Labels from a folder of images: the truth in tests, or the user's own model."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets.sequence import MAX_ID, LabelClass, find_class_table, read_class_table
from ...formats.errors import InputError
from ...formats.images import read_label_png
from ..depth.files import as_read, find_folder, match_files, require_aspect
from ..geometry.camera import resample_nearest
from ..geometry.sequence import Sequence
from ..providers import DepthEstimate, LabelEstimate, SemanticsProvider, class_colors
from ..system.progress import Progress
from ..types import VOID, ClassTable, Frame

_SUFFIXES = (".png", ".tif", ".tiff")
_NAMES = ("labels", "label", "semantic_class", "semantic", "semantics", "segmentation")


class FilesLabels(SemanticsProvider):
    """One 8 or 16 bit image of class ids a frame; only the classes that occur in the video are kept.

    Ids named void, none, unknown … are void. Without a table of classes beside the images, every id is a class
    named by its number, except 255 (65535 in 16 bit), which is void.
    """

    shared_state = ("_label_of",)

    def __init__(
        self,
        folder: str,
        source: Path,
        sequence: Sequence,
        progress: Progress,
        turns: Mapping[int, int] = MappingProxyType({}),
    ) -> None:
        """Raises InputError unless the folder is there, frames find their files, and the first file fits the frames;
        `turns` are the quarter turns of frames that are not read upright."""
        path = find_folder(folder, source, _NAMES, _SUFFIXES)
        self.name = f"files:{path}"
        self._sequence, self._progress, self._turns = sequence, progress, turns
        self._files = match_files(path, _SUFFIXES, _NAMES, sequence.frames, source.is_file())
        self._table_file = find_class_table(path)
        self._table = read_class_table(self._table_file) if self._table_file else None
        self._label_of = np.full(MAX_ID + 1, VOID, np.uint8)
        self._classes = ClassTable((), ())
        self._outside: dict[int, int] = {}
        self._read(next(iter(self._files)))

    def fit(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Count the ids of all frames and give labels to those that are classes. InputError for more than 254."""
        counts = np.zeros(MAX_ID + 1, np.int64)
        ids = [f.id for f in frames if f.id in self._files]
        for frame_id in self._progress.track(ids, "labels", len(ids)):
            counts += np.bincount(self._read(frame_id).ravel(), minlength=MAX_ID + 1)
        occurring = np.flatnonzero(counts).tolist()
        table = self._table_of(occurring)
        kept = [i for i in occurring if i in table and not table[i].is_void]
        if not kept:
            raise self._no_class()
        if len(kept) >= VOID:
            raise InputError(f"{self.name}: {len(kept)} classes occur, at most {VOID - 1} fit. Are these instance ids?")
        # 0 is the usual id of "nothing" in tables that do not name it.
        self._outside = {i: int(counts[i]) for i in occurring if i not in table and i not in (0, VOID, MAX_ID)}
        self._label_of[kept] = np.arange(len(kept), dtype=np.uint8)
        colors = class_colors(table[i].name for i in kept)
        self._classes = ClassTable(
            tuple(table[i].name for i in kept), tuple(table[i].color or colors[k] for k, i in enumerate(kept))
        )

    def require_content(self) -> None:
        """Raise InputError where no image holds a class; images are read up to the first that does."""
        found = (np.unique(self._read(i)).tolist() for i in self._files)
        if not any(i in (table := self._table_of(ids)) and not table[i].is_void for ids in found for i in ids):
            raise self._no_class()

    def _table_of(self, ids: list[int]) -> dict[int, LabelClass]:
        return self._table or {i: LabelClass(i, f"class {i}") for i in ids if i not in (VOID, MAX_ID)}

    def _no_class(self) -> InputError:
        what = f"the ids that {self._table_file} names" if self._table_file else "ids below 255"
        return InputError(f"{self.name}: the label images hold no class at all, only void. Classes are {what}")

    def warnings(self) -> list[str]:
        """Return a warning of ids that are missing in the table of classes."""
        if not self._outside:
            return []
        ids = ", ".join(map(str, sorted(self._outside)[:8]))
        total = sum(self._outside.values())
        return [f"{total} pixels have label ids that are not in the table of classes ({ids}); they count as void"]

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without a file."""
        return [f for f in frames if f.id not in self._files]

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """Void with no confidence where the file says nothing."""
        camera = self._sequence.intrinsics
        if frame.id not in self._files:
            labels = np.full((camera.height, camera.width), VOID, np.uint8)
        else:
            labels = resample_nearest(self._label_of[self._read(frame.id)], camera.height, camera.width)
        return LabelEstimate(labels, (labels != VOID).astype(np.float32))

    def classes(self) -> ClassTable:
        """The classes that occur, in the order of their ids."""
        return self._classes

    def files(self) -> list[Path]:
        """Every file that it may read."""
        return [*self._files.values(), *([self._table_file] if self._table_file else [])]

    def turned(self) -> set[Path]:
        """Return the files of photos that are not read upright."""
        return {self._files[i] for i in self._turns if i in self._files}

    def figures(self) -> dict[str, Any]:
        """Pixels whose id is not in the table, by id."""
        return {"label_ids_outside_table": {str(k): v for k, v in self._outside.items()}}

    def _read(self, frame_id: int) -> NDArray[np.uint16]:
        path, camera = self._files[frame_id], self._sequence.calibration.intrinsics
        ids = as_read(read_label_png(path), self._turns.get(frame_id, 0), camera)
        require_aspect(path, ids, self._sequence)
        return ids
