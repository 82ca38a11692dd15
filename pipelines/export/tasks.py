"""The mesh as tasks: what the map shows in the keyframes, and the surface region by region."""

from __future__ import annotations

from pathlib import Path

from ..engine.stages import StageContext
from ..engine.tasks import Chunk
from ..outcome import load_outcome
from ..system.progress import Progress
from .mesh import draw, drawn_views, fuse_regions, straighten


def draw_keyframes(task: Chunk, progress: Progress) -> None:
    """Render the map in the keyframes of a chunk."""
    context = task.context(progress)
    outcome = load_outcome(task.run, context.device).moved(task.known["move"])
    draw(outcome, task.config.export, scratch_of(context), progress, task.numbers)


def straighten_views(task: Chunk, progress: Progress) -> None:
    """Move the unsure depths of a chunk's views onto the planes of all."""
    straighten(scratch_of(task.context(progress)), task.known["planes"], progress, task.numbers)


def fuse_views(task: Chunk, progress: Progress) -> None:
    """The surface in some regions of the grid."""
    scratch, known = scratch_of(task.context(progress)), task.known
    views = drawn_views(scratch, known["views"])
    fuse_regions(views, known["grid"], known["class_ids"], scratch, progress, task.numbers)


def scratch_of(context: StageContext) -> Path:
    """Return the folder of rendered views and finished regions."""
    return context.snapshot / "mesh"
