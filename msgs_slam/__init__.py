"""The Python interface for notebooks: reconstruct a video, open a finished run, render it from anywhere.

    import msgs_slam

    run = msgs_slam.reconstruct("video.mp4", settings={"mapping.passes": 6}, progress=True)
    run.world_from_cam            # (N, 4, 4) poses of the posed frames, in the world of the exported files
    view = run.draw(run.world_from_cam[0])
    view.color, view.depth, view.labels

Everything else of the program is importable under this name: `msgs_slam.formats`, `msgs_slam.pipelines`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .pipelines.evaluation.views import MapView
    from .pipelines.run.outcome import Outcome
    from .pipelines.system.progress import Progress
    from .pipelines.types import Intrinsics

__all__ = ["InputError", "Run", "__version__", "main", "open_run", "reconstruct"]


def __getattr__(name: str) -> str:
    """`__version__`, by what pip knows of the program: asking takes longer than the rest of this module."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("msgs-slam")


@dataclass(frozen=True)
class Run:
    """A run whose map is done, in the world of its exported files (z up and metres where `world.json` says so)."""

    path: Path

    @cached_property
    def outcome(self) -> Outcome:
        """All that the run has found; raises InputError where the folder is no run or its map is not done."""
        from .pipelines.run.folder import RunFolder
        from .pipelines.run.outcome import load_outcome
        from .pipelines.scene.world import WORLD

        found = load_outcome(RunFolder(self.path))
        found.require_map()
        world = found.run.find(WORLD)
        return found if world is None else found.moved(world.exported_from_run)

    @property
    def names(self) -> list[str]:
        """File names of the posed frames, in the order of `world_from_cam`."""
        posed = self.outcome.trajectory.is_posed
        return [frame.name for frame, has_pose in zip(self.outcome.frames, posed, strict=True) if has_pose]

    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """(N, 4, 4) poses of the posed frames; camera axes x right, y down, z forward."""
        trajectory = self.outcome.trajectory
        return trajectory.world_from_cam[trajectory.is_posed]

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera of the undistorted frames, in pixels; the first pixel's centre is (0.5, 0.5)."""
        return self.outcome.calibration.intrinsics

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the labels."""
        return self.outcome.classes.names

    def draw(self, world_from_cam: NDArray[np.float64]) -> MapView:
        """The map as a camera at that pose (4, 4) sees it.

        color (H, W, 3) float32 0..1, depth (H, W) in the unit of the world, labels (H, W) uint8 (255 = none), coverage
        (H, W). Raises ValueError for another shape.
        """
        import numpy as np

        from .pipelines.evaluation.views import render_outcome

        pose = np.asarray(world_from_cam, np.float64)
        if pose.shape != (4, 4):
            raise ValueError(f"draw: got a pose of shape {pose.shape}, expected (4, 4)")
        return render_outcome(self.outcome, np.asarray(np.linalg.inv(pose), np.float64))


def open_run(path: Path | str) -> Run:
    """A finished run folder. Raises InputError where it is none, or its map is not done."""
    from .pipelines.run.folder import RunFolder

    run = Run(Path(path))
    RunFolder(run.path).required()
    _ = run.outcome
    return run


def reconstruct(
    source: Path | str,
    out: Path | str | None = None,
    settings: Mapping[str, Any] | Iterable[str] = (),
    progress: Progress | bool = False,
) -> Run:
    """Reconstruct a video, a folder of images or a data set, or go on where an interrupted run was.

    out: the run folder, by default the source's name with .msgs in the working folder; settings: a dict like
    {"mapping.passes": 6} or {"mapping": {"passes": 6}}, or texts as after `--set` on the command line; progress: True
    for bars on a terminal and a line a stage elsewhere, or an object with `track` and `stage`
    (`msgs_slam.pipelines.system.progress.Progress`). Raises InputError for a source or setting that cannot be used.
    """
    from .pipelines.reconstruct import default_run_folder, existing_config
    from .pipelines.reconstruct import reconstruct as run_reconstruct
    from .pipelines.run.folder import RunFolder
    from .pipelines.run.settings import load_config, merge_with_quality

    source = Path(source)
    run = RunFolder(Path(out)) if out is not None else default_run_folder(source)
    if isinstance(settings, Mapping):
        config = merge_with_quality(existing_config(run) or load_config(), _nested(settings), "settings")
    else:
        config = load_config(None, settings, base=existing_config(run))
    run_reconstruct(source, run, config, _progress(progress))
    return Run(run.root)


def _nested(changes: Mapping[str, Any]) -> dict[str, Any]:
    """{"mapping.passes": 6} → {"mapping": {"passes": 6}}; what is nested already stays so."""
    sections: dict[str, Any] = {}
    for key, value in changes.items():
        section, dot, name = key.partition(".")
        if not dot and not isinstance(value, Mapping):
            raise InputError(f"settings: {key!r}: expected section.key, for example frames.rate")
        sections.setdefault(section, {}).update({name: value} if dot else value)
    return sections


def _progress(wanted: Progress | bool) -> Progress:
    from .msgs_cli.output import Output

    return Output(quiet=not wanted).progress() if isinstance(wanted, bool) else wanted


def main() -> None:
    """Run the command `msgs-slam`."""
    from .msgs_cli.main import main as command

    command()
