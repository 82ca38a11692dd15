"""What workers do of an export: drawing the keyframes, and the mesh region by region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.export.depth_views import DrawnView
from pipelines.export.mesh import Region, draw, keyframe_rows, make_region, streamed_views
from pipelines.export.volume import Grid
from pipelines.geometry.alignment import Similarity
from pipelines.outcome import Outcome, load_outcome
from pipelines.portions import Portion, in_portions
from pipelines.progress import Progress
from pipelines.stages import StageContext
from pipelines.travel import load_value, save_value


def draw_views(task: Portion, progress: Progress) -> None:
    """What the map shows in some of the keyframes."""
    outcome = _outcome(task, progress)
    for number in progress.track(task.numbers, "drawing", len(task.numbers)):
        if not (file := _view(task.context(progress), number)).exists():
            save_value(file, draw(outcome, task.config.export, number))


def fuse_regions(task: Portion, progress: Progress) -> None:
    """Some regions of the grid."""
    context, outcome, grid = task.context(progress), _outcome(task, progress), task.known["grid"]
    views, regions = _views(context, outcome), list(grid.regions())
    for number in task.numbers:
        if not (file := _region(context, number)).exists():
            of = f", {number + 1} of {len(regions)}"
            save_value(file, make_region(outcome, views, grid, regions[number], progress, of))


@dataclass(frozen=True)
class MeshWorkers:
    """Those of a stage; the mesh stands in a world where the run is moved to."""

    context: StageContext
    move: Similarity

    def views(self, outcome: Outcome) -> Sequence[DrawnView]:
        """As `drawn_views`."""
        in_portions(self.context, draw_views, len(keyframe_rows(outcome)), move=self.move)
        return _views(self.context, outcome)

    def regions(self, grid: Grid) -> list[Region]:
        """All of the grid's."""
        count = len(list(grid.regions()))
        in_portions(self.context, fuse_regions, count, move=self.move, grid=grid)
        return [load_value(_region(self.context, n)) for n in range(count)]


def _outcome(task: Portion, progress: Progress) -> Outcome:
    return load_outcome(task.run, task.context(progress).device).moved(task.known["move"])


def _views(context: StageContext, outcome: Outcome) -> Sequence[DrawnView]:
    return streamed_views(len(keyframe_rows(outcome)), lambda number: load_value(_view(context, number)))


def _view(context: StageContext, number: int) -> Path:
    return context.snapshot / "mesh" / f"view_{number:06d}.npz"


def _region(context: StageContext, number: int) -> Path:
    return context.snapshot / "mesh" / f"region_{number:06d}.npz"
