"""The Python interface for notebooks: reconstruct a video, open a finished run, take what it found, draw its map.

    import msgs_slam

    run = msgs_slam.reconstruct("video.mp4", quality="draft", progress=True)  # or open_run("video.msgs")
    seconds, world_from_cam = run.trajectory          # a pose for every image of the video
    view = run.draw(run.world_from_cam[0], size=(640, 480))
    view.color, view.depth, view.labels

Everything else of the program is importable under this name: `msgs_slam.formats`, `msgs_slam.pipelines`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .formats.ply import MeshArrays
    from .formats.splats import GaussianCloud
    from .pipelines.evaluation.views import MapView
    from .pipelines.export.inventory import FoundThings, Thing
    from .pipelines.run.outcome import Outcome
    from .pipelines.system.progress import Progress
    from .pipelines.types import Frame, Intrinsics

__all__ = ["Found", "InputError", "Measured", "Poses", "Run", "__version__", "open_run", "reconstruct"]


def __dir__() -> list[str]:
    """The interface, without what this module imports."""
    return [*__all__, "formats"]


def __getattr__(name: str) -> str:
    """`__version__`, by what pip knows of the program: asking takes longer than the rest of this module."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("msgs-slam")


class Poses(NamedTuple):
    """Poses (N, 4, 4) of a camera in the world, axes x right, y down, z forward, at timestamps (N,) in seconds."""

    timestamps: NDArray[np.float64]
    world_from_cam: NDArray[np.float64]


class Measured(NamedTuple):
    """A value and its standard deviation."""

    value: float
    sd: float


class Found:
    """A thing that was found in a run: `about` it says all that things.json does, such as name, size and center."""

    def __init__(self, run: Run, about: Thing, among: FoundThings) -> None:
        self._run, self.about, self._among = run, about, among

    def __repr__(self) -> str:
        return f"Found({self.about.name!r}, {self.about.size_text})"

    @property
    def name(self) -> str:
        """Its name with its number, such as "chair 2"."""
        return self.about.name

    def mesh(self) -> MeshArrays:
        """The faces of the exported surface that are of it."""
        mesh = self._run.mesh()
        return mesh.of_vertices(self._among.numbers == self.about.number)

    def gaussians(self) -> GaussianCloud:
        """The part of the map that is of it."""
        cloud = self._run.gaussians
        return cloud.only(self._among.of(cloud.means) == self.about.number)

    def pictures(self, most: int = 8) -> list[tuple[str, NDArray[np.uint8], NDArray[np.bool_]]]:
        """The keyframes that show most of it, cut out around it, largest first: file name of the frame, image
        (h, w, 3), and mask (h, w) of its pixels. The first call for a run draws its mesh in all keyframes."""
        from .pipelines.export.scene import pictures_of

        return pictures_of(self._run._outcome, self._run._things_seen, self.about.number, most)


class Run:
    """A run whose map is done, in the world of its exported files (z up and metres where `world.json` says so)."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @cached_property
    def _outcome(self) -> Outcome:
        """All that the run has found; raises InputError where the folder is no run or its map is not done."""
        from .pipelines.run.folder import RunFolder
        from .pipelines.run.outcome import load_outcome
        from .pipelines.scene.world import WORLD

        found = load_outcome(RunFolder(self.path).required())
        found.require_map()
        world = found.run.find(WORLD)
        return found if world is None else found.moved(world.exported_from_run)

    @property
    def _frames(self) -> list[Frame]:
        posed = self._outcome.trajectory.is_posed
        return [frame for frame, has_pose in zip(self._outcome.frames, posed, strict=True) if has_pose]

    @property
    def names(self) -> list[str]:
        """File names of the N posed frames, in the order of `world_from_cam`."""
        return [frame.name for frame in self._frames]

    @property
    def timestamps(self) -> NDArray[np.float64]:
        """(N,) times of the posed frames: seconds, or the number of the image where the source has no times."""
        trajectory = self._outcome.trajectory
        return trajectory.timestamps[trajectory.is_posed]

    @property
    def image_paths(self) -> list[Path]:
        """Undistorted images of the posed frames. Raises InputError where one is missing or damaged."""
        return [self._outcome.run.image_file(frame) for frame in self._frames]

    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """(N, 4, 4) poses of the posed frames; camera axes x right, y down, z forward."""
        trajectory = self._outcome.trajectory
        return trajectory.world_from_cam[trajectory.is_posed]

    @property
    def trajectory(self) -> Poses:
        """Poses of all images of the source that have one, those between the frames too."""
        trajectory = self._outcome.every or self._outcome.trajectory
        posed = trajectory.is_posed
        return Poses(trajectory.timestamps[posed], trajectory.world_from_cam[posed])

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera of the undistorted frames, in pixels; the first pixel's centre is (0.5, 0.5)."""
        return self._outcome.calibration.intrinsics

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the labels: label i is `classes[i]`, 255 is none."""
        return self._outcome.classes.names

    @property
    def metres_per_unit(self) -> Measured | None:
        """Metres per unit of the world and their standard deviation; None where nothing tells them."""
        metres = self._outcome.metres
        return None if metres is None else Measured(metres.per_unit, metres.per_unit * metres.relative_sd)

    @property
    def gaussians(self) -> GaussianCloud:
        """The map: means, log_scales (M, 3), colors (M, 3), class_ids (M,), class_probs (M, classes) and more."""
        from .pipelines.run.outcome import map_cloud

        return map_cloud(self._outcome)

    def mesh(self, classes: Sequence[str] = ()) -> MeshArrays:
        """The exported surface, or its faces between vertices of these classes: vertices (V, 3), faces (F, 3), colors
        (V, 3), labels (V,). Raises InputError for an unknown class, and where the export is not done."""
        from .formats.ply import read_mesh_ply

        labels = [self._label(name) for name in classes]
        mesh = read_mesh_ply(self._outcome.run.file("export", "mesh.ply"))
        return mesh.of_labels(labels) if labels else mesh

    @property
    def things(self) -> list[Found]:
        """The things of the exported mesh, as in things.json, with what of mesh and map they are. Raises InputError
        where the export is not done."""
        from .pipelines.export.scene import things_of_run
        from .pipelines.scene.world import FIRST, WORLD

        run = self._outcome.run
        if (found := things_of_run(run, run.find(WORLD) or FIRST)) is None:
            raise InputError(f"{self.path} has no list of its things: make its export anew")
        return [Found(self, thing, found) for thing in found.table]

    @cached_property
    def _things_seen(self) -> dict[int, NDArray[np.uint16]]:
        """(h, w) numbers of things in each keyframe, by its row."""
        from .pipelines.export.scene import draw_things

        return draw_things(self._outcome, self.mesh(), self.things[0]._among.numbers)

    def _label(self, name: str) -> int:
        if name not in self.classes:
            raise InputError(f"there is no class {name!r} in {self.path}; there are {', '.join(self.classes)}")
        return self.classes.index(name)

    def draw(
        self,
        world_from_cam: NDArray[np.float64],
        size: tuple[int, int] | None = None,
        intrinsics: Intrinsics | None = None,
    ) -> MapView:
        """The map as a camera at that pose (4, 4) sees it: that of the run, or one of other `intrinsics`; at another
        `size` (width, height) it sees as much from top to bottom, and more or less at the sides.

        color (H, W, 3) float32 0..1, depth (H, W) in the unit of the world, labels (H, W) uint8 (255 = none), coverage
        (H, W). Raises ValueError for a pose of another shape.
        """
        import numpy as np

        from .pipelines.evaluation.views import view_map

        pose, found = np.asarray(world_from_cam, np.float64), self._outcome
        if pose.shape != (4, 4):
            raise ValueError(f"draw: got a pose of shape {pose.shape}, expected (4, 4)")
        camera = intrinsics or self.intrinsics
        camera = camera if size is None else camera.of_size(*size)
        return view_map(
            found.require_map(), found.label_of_channel, camera, np.asarray(np.linalg.inv(pose), np.float64)
        )

    def depth(self, i: int) -> NDArray[np.float32]:
        """(H, W) depth of the map in posed frame i, along the optical axis, in the unit of the world; 0 where the map
        has nothing."""
        return self.draw(self.world_from_cam[i]).depth


def open_run(path: Path | str) -> Run:
    """A finished run folder. Raises InputError where it is none, or its map is not done."""
    run = Run(path)
    _ = run._outcome
    return run


def reconstruct(
    source: Path | str | Sequence[Path | str],
    out: Path | str | None = None,
    settings: Mapping[str, Any] | Iterable[str] = (),
    progress: Progress | bool = False,
    quality: str | None = None,
) -> Run:
    """Reconstruct a video, several videos of one place by one camera, a folder of images or a data set, or resume an
    interrupted run.

    out: the run folder, by default the (first) source's name with .msgs in the working folder; settings: a dict like
    {"mapping.passes": 6} or {"mapping": {"passes": 6}}, or texts as after `--set` on the command line; quality: draft,
    normal or best; progress: True for bars on a terminal and a line a stage elsewhere, or an object with `track` and
    `stage` (`msgs_slam.pipelines.system.progress.Progress`). Raises InputError for a source or setting that cannot be
    used.
    """
    from .pipelines.reconstruct import default_run_folder, existing_config, one_source
    from .pipelines.reconstruct import reconstruct as run_reconstruct
    from .pipelines.run.folder import RunFolder
    from .pipelines.run.settings import load_config, merge_with_quality

    sources = [Path(s) for s in ([source] if isinstance(source, Path | str) else source)]
    run = RunFolder(Path(out)) if out is not None else default_run_folder(sources[0])
    texts = () if isinstance(settings, Mapping) else settings
    config = load_config(None, texts, existing_config(run), quality)
    if isinstance(settings, Mapping):
        config = merge_with_quality(config, _nested(settings), "settings")
    run_reconstruct(one_source(sources, run), run, config, _progress(progress))
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
