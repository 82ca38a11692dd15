"""Stage 6, the files for other programs: of a run (`ExportStage`), and of a finished one on request (`export_run`)."""

import hashlib
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...formats.errors import InputError
from ..config import STAGES, ExportConfig
from ..outcome import load_outcome
from ..run.files import CLASSES, MESH, METRES, SUBMAPS
from ..run.folder import RunFolder
from ..run.stages import StageContext
from ..run.target import Target, read_list
from ..scene.world import WORLD, in_world, world_figures
from ..source.recording import is_of_source
from ..system.machine import release_free_memory
from ..system.progress import Progress, SilentProgress
from ..types import Metres
from .kinds import EXPORTS, IMAGES, NOTES, WORLD_NOTE, Export, export_of, names_of
from .mesh import mesh_figures
from .pieces import write_pieces
from .readme import write_readme
from .scene import ExportScene, estimate_metres, find_world, finished_scene

EXPORTS_FOLDER = "exports"
"""The folder in a run for what is exported on request, a folder a kind; no stage touches it."""


def run(context: StageContext) -> dict[str, Any]:
    """Write all files of a run whose map is done; a mesh that an interrupted attempt has finished is kept."""
    return ExportStage(context).run()


class ExportStage:
    """The stage: `run` is the order of its work. Its files lie in the folder of its context."""

    scene: ExportScene
    metres: Metres | None

    def __init__(self, context: StageContext) -> None:
        self.context, self.target = context, Target(context.folder)

    def run(self) -> dict[str, Any]:
        """Write all, and return the figures of the report."""
        self.open_scene()
        write_pieces(self.context)
        kinds = stage_exports(self.context.run)
        self.write(export for export in kinds if export.kind != "mesh")
        write_notes(self.scene, self.target, self.metres)
        gaussians = len(self.scene.outcome.require_map())
        self.scene = self.scene.without_map()
        release_free_memory()
        self.write(export for export in kinds if export.kind == "mesh")
        write_readme(self.scene, self.target, files_in(self.target.folder))
        return {"images": int(self.scene.outcome.trajectory.is_placed.sum()), "gaussians": gaussians, **self.figures()}

    def open_scene(self) -> None:
        """Find which way is up, where on the Earth the scene is, and how many metres a unit is."""
        found = load_outcome(self.context.run, self.context.device)
        found.require_map()
        world, reasons = find_world(found, self.context.config.export)
        for reason in reasons:
            self.context.warn(reason)
        self.metres = estimate_metres(self.context, found, world)
        self.scene = ExportScene(in_world(replace(found, metres=self.metres), world), world, self.context)
        del found  # one map is enough
        release_free_memory()

    def write(self, exports: Iterable[Export]) -> None:
        """Write the kinds of files that the stage makes."""
        for export in exports:
            export.writer()(self.scene, self.target)

    def figures(self) -> dict[str, Any]:
        """Return what the report and `status` say of the mesh, the world and its unit."""
        mesh = mesh_figures(self.target.folder / "mesh.ply")
        return {**mesh, **world_figures(self.scene.world), **metres_figures(self.metres)}


def stage_exports(run: RunFolder) -> list[Export]:
    """Return the kinds that the stage writes."""
    has_submaps = bool(run.load(SUBMAPS))
    return [export for export in EXPORTS if export.when == "always" or (has_submaps and export.when == "in submaps")]


def metres_figures(metres: Metres | None) -> dict[str, Any]:
    """Report how long the unit is, and where that comes from."""
    if metres is None:
        return {"metres_per_unit": None}
    return {
        "metres_per_unit": round(metres.per_unit, 4),
        "metres_relative_sd": round(metres.relative_sd, 4),
        "metres_are": "estimated" if metres.is_guess else "given",
        "metres_from": ", ".join([*metres.sources, *["if the scene is a room"] * metres.only_in_room]),
        "metres_disagreement": round(metres.disagreement, 2),
    }


def write_notes(scene: ExportScene, target: Target, metres: Metres | None) -> None:
    """Write the class table, the world, and how many metres a unit of the run's own world is."""
    CLASSES.save(target.path("classes.json").parent, scene.outcome.classes)
    METRES.save(target.path("scale.json").parent, metres)
    write_world(scene, target)


def write_world(scene: ExportScene, target: Target) -> None:
    """Write world.json: what the coordinates of the other files mean."""
    unit = "metre" if scene.outcome.metric or scene.world.earth else "free"
    WORLD.save(target.path("world.json").parent, replace(scene.world, unit=unit))


def files_in(folder: Path) -> list[str]:
    """Return the relative paths, with slashes, of the files below a folder."""
    return [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]


def export_folder(run: RunFolder, kind: str | None) -> Path:
    """Return the folder of the run for what is exported on request."""
    return run.path(EXPORTS_FOLDER, export_of(kind).kind if kind else "all")


def export_run(
    run: RunFolder,
    folder: Path | None = None,
    only: str | None = None,
    progress: Progress | None = None,
    settings: ExportConfig | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write one of the `EXPORTS`, or with None all that the stage writes, of a run into a folder; returns what was
    written.

    folder: None for `export_folder`; settings: None for the run's own. What is written takes the place of an earlier
    export; of other files only where they may be overwritten (see `Target`). Nothing changes before all of it is made.
    Raises InputError for a run without a map, or without a mesh for what is made from it, and for a folder that holds
    such files of somebody else, or belongs to the run.
    """
    folder = export_folder(run, only) if folder is None else folder
    exports = [export_of(only)] if only else stage_exports(run)
    names = names_of(exports, [WORLD_NOTE] if only else NOTES)
    _require_free(run, folder, names)
    if any(export.needs == "mesh" for export in exports) and not run.has(STAGES[-1], MESH):
        raise InputError(
            f"{run.root} has no mesh yet, and {only} is made from it: finish the run with msgs-slam resume"
        )
    outcome = load_outcome(run)
    config = replace(outcome.config, export=settings or outcome.config.export)
    scene = finished_scene(outcome, StageContext(run, Path(), config, Path(), progress or SilentProgress()))
    with Target(folder, overwrite, _origin(scene)).replacing(names.__contains__) as staged:
        with tempfile.TemporaryDirectory(dir=staged.folder) as scratch:
            scene = replace(scene, context=replace(scene.context, folder=Path(scratch)))
            for export in exports:
                export.writer()(scene, staged)
        if only:
            write_world(scene, staged)
        else:
            write_notes(scene, staged, scene.outcome.metres)
        stay = [name for name in read_list(folder) if name.partition("/")[0] not in names]
        write_readme(scene, staged, [*stay, *files_in(staged.folder)])
    return [folder / name for name in staged.written if (folder / name).exists()]


def _require_free(run: RunFolder, folder: Path, names: set[str]) -> None:
    """Raise InputError for a folder of the run's own, or of its source."""
    if IMAGES in names and is_of_source(folder / IMAGES, run):
        raise InputError(f"{folder / IMAGES} is the source of {run.root}: name another folder with --to")
    around = run.place.parent if run.is_piece else run.place
    inside = folder.resolve()
    if inside.is_relative_to(around.resolve()) and EXPORTS_FOLDER not in inside.relative_to(around.resolve()).parts:
        raise InputError(
            f"{folder} belongs to the run, whose stages write there: leave --to out, for "
            f"{run.path(EXPORTS_FOLDER)}, or name a folder outside of the run"
        )


def _origin(scene: ExportScene) -> str:
    """Identity of the map and of the world that the files show."""
    outcome, move = scene.outcome, scene.world.exported_from_run
    of_run = [outcome.records[stage].content for stage in (outcome.pose_stage, outcome.map_stage)]
    numbers = [move.scale, *move.rotation.ravel().tolist(), *move.translation.tolist()]
    return hashlib.sha256(" ".join([*of_run, *map(repr, numbers)]).encode()).hexdigest()
