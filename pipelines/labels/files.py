"""Labels by files: the truth, or the user's own model."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ...formats.datasets.sequence import MAX_ID, LabelClass, find_class_table, read_class_table
from ...formats.errors import InputError
from ..depth.files import DatasetMaps, FolderMaps
from ..providers import DepthEstimate, LabelEstimate, SemanticsProvider, class_colors
from ..system.progress import Progress
from ..types import VOID, ClassTable, Frame


class FilesLabels(SemanticsProvider):
    """Classes by their ids; only those that occur in the video are kept.

    Ids named void, none, unknown … are void. Without a table of classes beside the images of a folder, every id is a
    class named by its number, except 255 (65535 in 16 bit), which is void.
    """

    shared_state = ("_label_of",)

    def __init__(self, maps: FolderMaps | DatasetMaps, progress: Progress) -> None:
        """Raises InputError for a damaged table of classes."""
        self._maps, self._progress, self.name = maps, progress, maps.name
        self._table: dict[int, LabelClass] = {}
        self._named_by = "ids below 255"
        if isinstance(maps, DatasetMaps):
            self._table, self._named_by = dict(enumerate(maps.dataset.classes)), "the ids that the data set names"
        elif path := find_class_table(maps.folder):
            self._table, self._named_by = read_class_table(path), f"the ids that {path} names"
        self._label_of = np.full(MAX_ID + 1, VOID, np.uint8)
        self._classes = ClassTable((), ())
        self._outside: dict[int, int] = {}

    def fit(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Count the ids of all frames and give labels to those that are classes. InputError for more than 254."""
        counts = np.zeros(MAX_ID + 1, np.int64)
        ids = [f.id for f in frames if f.id in self._maps.files]
        for frame_id in self._progress.track(ids, "labels", len(ids)):
            counts += np.bincount(self._maps.read(frame_id).ravel(), minlength=MAX_ID + 1)
        occurring = np.flatnonzero(counts).tolist()
        found = self._classes_among(occurring)
        if not found:
            raise self._no_class()
        if len(found) >= VOID:
            raise InputError(
                f"{self.name}: {len(found)} classes occur, at most {VOID - 1} fit. Are these instance ids?"
            )
        # 0 is the usual id of "nothing" in tables that do not name it.
        named = {*(self._table or found), 0, VOID, MAX_ID}
        self._outside = {i: int(counts[i]) for i in occurring if i not in named}
        self._label_of[[*found]] = np.arange(len(found), dtype=np.uint8)
        names = tuple(c.name for c in found.values())
        colors = zip(found.values(), class_colors(names), strict=True)
        self._classes = ClassTable(names, tuple(c.color or own for c, own in colors))

    def check(self) -> None:
        """Raise InputError for a file of another shape than the frames, and where none holds a class: they are read up
        to the first that does."""
        if isinstance(self._maps, FolderMaps):
            self._maps.require_shapes()
        if not any(self._classes_among(np.unique(self._maps.read(i)).tolist()) for i in self._maps.files):
            raise self._no_class()

    def _classes_among(self, ids: Iterable[int]) -> dict[int, LabelClass]:
        """Those of some ids that are classes."""
        table = self._table or {i: LabelClass(i, f"class {i}") for i in ids if i not in (VOID, MAX_ID)}
        return {i: table[i] for i in ids if i in table and not table[i].is_void}

    def _no_class(self) -> InputError:
        held = "the label images hold no class at all, only void"
        return InputError(f"{self.name}: {held}. Classes are {self._named_by}")

    def warnings(self) -> list[str]:
        """Return a warning of ids that are missing in the table of classes."""
        if not self._outside:
            return []
        ids = ", ".join(map(str, sorted(self._outside)[:8]))
        total = sum(self._outside.values())
        return [f"{total} pixels have label ids that are not in the table of classes ({ids}); they count as void"]

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without a file."""
        return [f for f in frames if f.id not in self._maps.files]

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """Void with no confidence where the file says nothing."""
        camera = self._maps.sequence.intrinsics
        labels = np.full((camera.height, camera.width), VOID, np.uint8)
        if frame.id in self._maps.files:
            labels = self._maps.fitted(self._label_of[self._maps.read(frame.id)])
        return LabelEstimate(labels, (labels != VOID).astype(np.float32))

    def classes(self) -> ClassTable:
        """The classes that occur, in the order of their ids."""
        return self._classes

    def figures(self) -> dict[str, Any]:
        """Pixels whose id is not in the table, by id."""
        return {"label_ids_outside_table": {str(k): v for k, v in self._outside.items()}}
