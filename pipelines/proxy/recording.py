"""Depth and labels that a data set has of its own frames: its sensor's or its annotators'."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets import Dataset
from ...formats.errors import InputError
from ..geometry.sequence import Sequence
from ..providers import DepthEstimate, DepthProvider, LabelEstimate, SemanticsProvider, class_colors
from ..sfm.lens import FramePixels
from ..system.progress import Progress
from ..types import VOID, ClassTable, Frame


class _RecordingMaps:
    """What depth and labels share: frames are images of the recording, its maps cover its images."""

    def __init__(self, recording: Dataset, sequence: Sequence) -> None:
        self._recording, self._sequence = recording, sequence
        self.name = f"files of the data set ({recording.format})"

    @cached_property
    def _pixels(self) -> FramePixels:
        """The map's pixels in the recording's images, which may be distorted."""
        return FramePixels(replace(self._sequence.calibration, intrinsics=self._sequence.intrinsics))

    def _nothing(self) -> NDArray[np.float32]:
        return np.zeros((self._sequence.intrinsics.height, self._sequence.intrinsics.width), np.float32)


class RecordingDepth(_RecordingMaps, DepthProvider):
    """Metric depth, its unit, unknown values and camera as the data set's reader settles them; confidence 1."""

    metric = True

    def __init__(self, recording: Dataset, sequence: Sequence) -> None:
        """Raises InputError for a data set without depth."""
        if not recording.has_depth:
            raise InputError(f"{recording.root}: this {recording.format} recording has no depth: --depth files:FOLDER")
        super().__init__(recording, sequence)

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without depth."""
        if self._recording.store is not None:
            return []
        return [f for f in frames if self._recording.depth_paths[f.source_index] is None]

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Raises InputError for an unreadable file; without one all depth is unknown."""
        depth = self._recording.depth(frame.source_index)
        if depth is None:
            return DepthEstimate(self._nothing(), self._nothing())
        depth = self._pixels.sample(depth).astype(np.float32, copy=False)
        return DepthEstimate(depth, (depth > 0).astype(np.float32))

    def files(self) -> list[Path]:
        """Every file that it may read."""
        return [self._recording.root] if self._recording.store else [p for p in self._recording.depth_paths if p]


class RecordingLabels(_RecordingMaps, SemanticsProvider):
    """The classes of the data set that occur in the frames, with its names and colours."""

    shared_state = ("_label_of",)

    def __init__(self, recording: Dataset, sequence: Sequence, progress: Progress) -> None:
        """Raises InputError for a data set without labels."""
        if not recording.has_labels:
            raise InputError(
                f"{recording.root}: this {recording.format} recording has no labels: --semantics files:FOLDER"
            )
        super().__init__(recording, sequence)
        self._progress = progress
        self._label_of = np.full(256, VOID, np.uint8)
        self._classes = ClassTable((), ())

    def fit(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Find the classes that occur. Raises InputError where there is none."""
        seen = np.zeros(256, bool)
        for frame in self._progress.track(frames, "labels", len(frames)):
            labels = self._recording.labels(frame.source_index)
            if labels is not None:
                seen[labels.ravel()] = True
        kept = [i for i in range(len(self._recording.classes)) if seen[i]]
        if not kept:
            raise InputError(f"{self._recording.root}: the label images hold no class at all, only void")
        self._label_of[kept] = np.arange(len(kept), dtype=np.uint8)
        chosen = [self._recording.classes[i] for i in kept]
        colors = class_colors(c.name for c in chosen)
        self._classes = ClassTable(
            tuple(c.name for c in chosen), tuple(c.color or colors[k] for k, c in enumerate(chosen))
        )

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without labels."""
        return [f for f in frames if self._recording.label_paths[f.source_index] is None]

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """Void with no confidence where the data set says nothing."""
        found = self._recording.labels(frame.source_index)
        labels = np.full(self._nothing().shape, VOID, np.uint8)
        if found is not None:
            labels = self._label_of[self._pixels.sample(found)]
        return LabelEstimate(labels, (labels != VOID).astype(np.float32))

    def classes(self) -> ClassTable:
        """Return the classes that occur; valid after `fit`."""
        return self._classes

    def files(self) -> list[Path]:
        """Every file that it may read."""
        return [p for p in self._recording.label_paths if p]
