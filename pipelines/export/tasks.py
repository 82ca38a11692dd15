"""What workers do of an export: drawing the keyframes, and the mesh region by region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pipelines.config import ExportConfig
from pipelines.export.depth_views import DrawnView
from pipelines.export.mesh import Region, draw, keyframe_rows, make_region, streamed_views
from pipelines.export.volume import Grid
from pipelines.geometry.alignment import Similarity
from pipelines.outcome import Outcome, load_outcome
from pipelines.progress import Progress
from pipelines.run_folder import RunFolder
from pipelines.stages import StageContext
from pipelines.travel import load_value, save_value

_PORTION = 20
"""Keyframes that a task draws: each loads the map first."""


@dataclass(frozen=True)
class MeshTask:
    """One part of the work (keyframes to draw, or a region) on the mesh of a run that is moved; results in `folder`."""

    run: RunFolder
    device: str
    move: Similarity
    settings: ExportConfig
    folder: Path
    number: int = 0

    @property
    def outcome(self) -> Outcome:
        """Of the run, in the world of the mesh."""
        return load_outcome(self.run, self.device).moved(self.move)

    @property
    def grid(self) -> Path:
        """The file of what the regions are of."""
        return self.folder / "grid.npz"

    def file(self, kind: str, number: int) -> Path:
        """A result."""
        return self.folder / f"{kind}_{number:06d}.npz"

    def views(self, count: int) -> Sequence[DrawnView]:
        """What has been drawn."""
        return streamed_views(count, lambda number: load_value(self.file("view", number)))


def draw_views(task: MeshTask, progress: Progress) -> None:
    """What the map shows in some of the keyframes."""
    outcome = task.outcome
    numbers = range(len(keyframe_rows(outcome)))[task.number * _PORTION :][:_PORTION]
    for number in progress.track(numbers, "drawing", len(numbers)):
        if not (file := task.file("view", number)).exists():
            save_value(file, draw(outcome, task.settings, number))


def fuse_region(task: MeshTask, progress: Progress) -> None:
    """One region of the grid."""
    if not (file := task.file("region", task.number)).exists():
        outcome = task.outcome
        views = task.views(len(keyframe_rows(outcome)))
        grid: Grid = load_value(task.grid)
        save_value(file, make_region(outcome, views, grid, list(grid.regions())[task.number], progress))


@dataclass(frozen=True)
class MeshWorkers:
    """Those of a stage, and what is to be done."""

    context: StageContext
    task: MeshTask

    def views(self, outcome: Outcome) -> Sequence[DrawnView]:
        """As `drawn_views`."""
        count = len(keyframe_rows(outcome))
        self.context.each(draw_views, [replace(self.task, number=n) for n in range(-(-count // _PORTION))])
        return self.task.views(count)

    def regions(self, grid: Grid) -> list[Region]:
        """All of the grid's."""
        save_value(self.task.grid, grid)
        numbers = range(len(list(grid.regions())))
        self.context.each(fuse_region, [replace(self.task, number=n) for n in numbers])
        return [load_value(self.task.file("region", n)) for n in numbers]
