"""What workers do of an export: drawing the keyframes, and the mesh region by region."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from msgs_slam.pipelines.engine.chunks import Chunk, in_chunks
from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.export.mesh import drawn_views, fused_regions, keyframe_rows
from msgs_slam.pipelines.export.volume import Grid
from msgs_slam.pipelines.geometry.alignment import Similarity
from msgs_slam.pipelines.outcome import Outcome, load_outcome
from msgs_slam.pipelines.system.progress import Progress


def draw_views(task: Chunk, progress: Progress) -> None:
    """What the map shows in some of the keyframes."""
    drawn_views(
        _outcome(task, progress), task.config.export, scratch_of(task.context(progress)), progress, task.numbers
    )


def fuse_regions(task: Chunk, progress: Progress) -> None:
    """Some regions of the grid."""
    outcome, scratch = _outcome(task, progress), scratch_of(task.context(progress))
    views = drawn_views(outcome, task.config.export, scratch, progress, range(0))
    fused_regions(outcome, views, task.known["grid"], scratch, progress, task.numbers)


def scratch_of(context: StageContext) -> Path:
    """Where views and regions lie."""
    return context.snapshot / "mesh"


@dataclass(frozen=True)
class MeshWorkers:
    """Those of a stage; the mesh stands in a world where the run is moved to."""

    context: StageContext
    move: Similarity

    def draw(self, outcome: Outcome) -> None:
        """All views."""
        in_chunks(self.context, draw_views, len(keyframe_rows(outcome)), move=self.move)

    def fuse(self, grid: Grid) -> None:
        """All of the grid's regions."""
        in_chunks(self.context, fuse_regions, len(list(grid.regions())), move=self.move, grid=grid)


def _outcome(task: Chunk, progress: Progress) -> Outcome:
    return load_outcome(task.run, task.context(progress).device).moved(task.known["move"])
