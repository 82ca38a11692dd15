"""Stage 6: files for other programs."""

import hashlib
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ...formats.errors import InputError
from ...formats.mesh import mesh_blocks
from ..config import ExportConfig
from ..networks.registry import metric_card
from ..outcome import Outcome, load_outcome
from ..run.files import METRES, SUBMAPS
from ..run.folder import RunFolder
from ..run.lock import locked_export
from ..run.stages import StageContext
from ..run.target import Target, read_list
from ..scene.gps import world_on_earth
from ..scene.metres import find_metres
from ..scene.upright import find_upright
from ..scene.world import FIRST, WORLD, World, upright_world, world_figures
from ..source.recording import is_of_source
from ..system.machine import release_free_memory
from ..system.progress import Progress, SilentProgress, log
from ..types import Metres
from .extra.floor_plan import write_floor_plan
from .extra.meshes import write_collision, write_usd
from .extra.tiles import write_tiles
from .extra.web_page import write_web_page
from .images import IMAGES
from .mesh import mesh_figures, write_meshes
from .pieces import write_pieces
from .readme import names_of
from .writers import (
    files_in,
    write_colmap,
    write_notes,
    write_ply,
    write_readme,
    write_splats,
    write_trajectory,
    write_world,
)


def run(context: StageContext) -> dict[str, Any]:
    """Write all files of a run whose map is done; a mesh that an interrupted attempt has finished is kept."""
    found, settings, folder = load_outcome(context.run, context.device), context.config.export, context.folder
    found.require_map()

    # Which way is up, where on the Earth, and how many metres a unit is
    world, reasons = find_world(found, settings)
    for reason in reasons:
        context.warn(reason)
    metres = gps_metres(world) or guess_metres(context, found, settings)
    outcome = on_earth(replace(found, metres=metres).moved(world.exported_from_run), world)
    del found  # one map is enough
    release_free_memory()

    # Poses and splats; of each disconnected component all that is known of it
    write_pieces(context)
    write_all_but_mesh(outcome, world, settings, folder, context.warn)
    if world.earth is not None:
        METRES.save(folder, metres)
    gaussians = len(outcome.require_map())

    # The mesh, by tasks that load the map themselves
    outcome = replace(outcome, gaussian_map=None)
    release_free_memory()
    write_meshes(context, folder, outcome, world)
    write_readme(outcome, world, folder, files_in(folder))
    mesh = mesh_blocks(folder / "mesh.ply")
    if mesh.face_count == 0:
        context.warn("the mesh is empty: no surface is seen by enough keyframes")

    counts = {"images": int(outcome.trajectory.is_placed.sum()), "gaussians": gaussians}
    return {**counts, **mesh_figures(mesh), **world_figures(world), **metres_figures(metres)}


def guess_metres(context: StageContext, outcome: Outcome, settings: ExportConfig) -> Metres | None:
    """Estimate how long the unit of the run's world is, and warn of what speaks against it."""
    guess = settings.scale == "auto"
    card = metric_card() if guess else None
    metres, warning = find_metres(context.run, outcome.trajectory, guess, card, context.threads, context.device)
    if warning:
        context.warn(warning)
    return metres


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


def gps_metres(world: World) -> Metres | None:
    """Derive from GPS how long the unit of the run's own world is."""
    if world.earth is None:
        return None
    return Metres(world.exported_from_run.scale, max(world.earth.scale_sd, 1e-3), False, ("GPS",))


def on_earth(outcome: Outcome, world: World) -> Outcome:
    """Files that lie on the Earth are in metres: there is nothing to multiply."""
    return outcome if world.earth is None else replace(outcome, metric=True, metres=None)


def find_world(outcome: Outcome, settings: ExportConfig) -> tuple[World, list[str]]:
    """The world for the files of a run whose map is done, and what could not be found that was asked for."""
    world = upright_world(outcome, find_upright(outcome)) if settings.axes == "up" else FIRST
    reasons = []
    if settings.axes == "up" and world.axes != "up":
        reasons.append(
            "neither a floor nor vertical lines were found, so up is unknown: the files keep the axes of the run, "
            "roughly those of the first posed camera"
        )
    world, reason = world_on_earth(outcome, world, settings.gps)
    return world, [*reasons, reason] if reason else reasons


def kinds_of_run(outcome: Outcome) -> list[str]:
    """The `EXPORTS` that a finished run has: tiles of a map in parts."""
    return ["html", "colmap", "ply", *["tiles"] * bool(outcome.run.load(SUBMAPS)), "tum", "mesh"]


def write_all_but_mesh(
    outcome: Outcome, world: World, settings: ExportConfig, folder: Path, warn: Callable[[str], None]
) -> list[Path]:
    """Write the `kinds_of_run` into a folder, but for the mesh and README.txt. `outcome` stands in `world`."""
    writers = _writers(outcome, world, settings, folder, warn)
    paths = [path for kind in kinds_of_run(outcome) if kind != "mesh" for path in writers[kind]()]
    return paths + write_notes(outcome, world, folder)


def _writers(
    outcome: Outcome, world: World, settings: ExportConfig, folder: Path, warn: Callable[[str], None] = log.warning
) -> dict[str, Callable[[], list[Path]]]:
    """What writes each of the `EXPORTS` but those of the mesh's own making, all from the same moved `outcome`."""
    return {
        "colmap": lambda: write_colmap(outcome, world, settings.image_side, folder, warn),
        "ply": lambda: write_ply(outcome, world, folder),
        **{k: partial(write_splats, k, outcome, world, folder) for k in ("spz", "sog", "glb")},
        "tiles": lambda: write_tiles(outcome, world, folder),
        "html": lambda: write_web_page(outcome, world, folder),
        "collision": lambda: write_collision(outcome, world, folder),
        "usd": lambda: write_usd(outcome, world, folder),
        "floorplan": lambda: write_floor_plan(outcome, world, folder),
        "tum": lambda: write_trajectory(outcome, folder),
    }


def export_run(
    run: RunFolder,
    folder: Path,
    only: str | None = None,
    progress: Progress | None = None,
    settings: ExportConfig | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write one of the `EXPORTS`, or with None all, of a run into a folder; returns what was written.

    Settings are the run's own where none are given. What is written takes the place of an earlier export; of other
    files only where they may be overwritten (see `Target`). Nothing changes before all of it is made. Raises InputError
    for a run without a map, and for a folder that holds such files of somebody else, or the run's source; RunBusyError
    where the folder is the run's own and another process works on the run.
    """
    is_own = folder.resolve() == run.stage("export").resolve()
    if IMAGES in names_of([only] if only else None) and is_of_source(folder / IMAGES, run):
        raise InputError(f"{folder / IMAGES} is the source of {run.root}: name another folder with --to")
    with locked_export(run, folder):
        outcome, world, settings = _exported(run, settings)
        kinds = [only] if only else kinds_of_run(outcome)
        names = names_of(kinds, with_notes=not only)
        manifest = run.manifest()
        fixed = manifest.records["export"].files if is_own and manifest and "export" in manifest.records else {}
        target = Target(folder, overwrite, "" if is_own else _origin(outcome, world), fixed)
        with target.replacing(names.__contains__) as staged:
            paths = _write_kinds(outcome, world, settings, staged, kinds, progress or SilentProgress())
            paths += [write_world(outcome, world, staged)] if only else write_notes(outcome, world, staged)
            if not (is_own and only):  # the README of the run's own folder is the stage's
                stay = fixed if is_own else [n for n in read_list(folder) if n.partition("/")[0] not in names]
                files = {name: folder / name for name in stay} | files_in(staged)
                paths.append(write_readme(outcome, world, staged, files))
    return [folder / path.relative_to(staged) for path in paths]


def _exported(run: RunFolder, settings: ExportConfig | None) -> tuple[Outcome, World, ExportConfig]:
    """The outcome of a run in the world of its exported files, that world, and the settings: the run's by default."""
    found = load_outcome(run)
    found.require_map()
    settings = settings or found.config.export
    if (world := _kept_world(found, settings)) is None:
        world, reasons = find_world(found, settings)
        for reason in reasons:
            log.warning(reason)
    outcome = on_earth(found.moved(world.exported_from_run), world)
    if outcome.metres is not None and outcome.metres.is_guess and settings.scale == "free":
        outcome = replace(outcome, metres=None)
    return outcome, world, settings


def _write_kinds(
    outcome: Outcome, world: World, settings: ExportConfig, folder: Path, kinds: list[str], progress: Progress
) -> list[Path]:
    """Write some of the `EXPORTS`, those of the mesh by a scratch folder that is removed again."""
    writers, paths = _writers(outcome, world, settings, folder), list[Path]()
    for kind in kinds:
        if kind in writers:
            paths += writers[kind]()
            continue
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            config = replace(outcome.config, export=settings)
            context = StageContext(outcome.run, Path(), config, Path(scratch), progress)
            paths += write_meshes(context, folder, outcome, world)
    return paths


def _origin(outcome: Outcome, world: World) -> str:
    """Identity of the map and of the world that the files show."""
    records, move = outcome.records, world.exported_from_run
    of_run = [records[stage].content for stage in (outcome.pose_stage, outcome.map_stage)]
    numbers = [move.scale, *move.rotation.ravel().tolist(), *move.translation.tolist()]
    return hashlib.sha256(" ".join([*of_run, *map(repr, numbers)]).encode()).hexdigest()


def _kept_world(outcome: Outcome, settings: ExportConfig) -> World | None:
    """That of the run's own export, so that what is written later or elsewhere fits; None for other axes."""
    own = outcome.config.export
    return outcome.run.find(WORLD) if (settings.axes, settings.gps) == (own.axes, own.gps) else None
