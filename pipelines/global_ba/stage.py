"""Stage 5: what tracking and mapping have left, as the result of the whole, and a pose for the images between.

Loops are closed in tracking, before there is a map that would have to follow (`tracking.links`)."""

from typing import Any

from ...formats.atomic import copy_file
from ..run.files import DEPTH_FIELDS, EXPOSURE, FIGURES, LOOPS, MAP, SPARSE, TRAJECTORY
from ..run.schema import RunFile
from ..run.stages import StageContext
from .between import pose_every_frame

_RESULTS: dict[str, tuple[RunFile[Any], ...]] = {
    "tracking": (SPARSE, DEPTH_FIELDS, LOOPS),
    "mapping": (TRAJECTORY, MAP, EXPOSURE),
}


def run(context: StageContext) -> dict[str, Any]:
    """Take over the results and pose the images of the source between the picked frames."""
    run = context.run
    for stage, files in _RESULTS.items():
        for file in files:
            copy_file(run.file(stage, file.name), file.path(context.folder))
    figures = pose_every_frame(context, run.load(SPARSE, "tracking"), run.load(TRAJECTORY, "mapping"))
    context.save(FIGURES["global_ba"], figures)
    return figures
