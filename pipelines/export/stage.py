"""Stage 6: files for other programs."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ...formats.errors import InputError
from ...formats.mesh import mesh_blocks
from ..config import ExportConfig
from ..engine.stages import StageContext
from ..networks.registry import metric_card
from ..outcome import Outcome, load_outcome
from ..run.ending import empty
from ..run.files import METRES, SUBMAPS
from ..run.folder import RunFolder
from ..scene.gps import world_on_earth
from ..scene.metres import find_metres
from ..scene.upright import find_upright
from ..scene.world import FIRST, WORLD, World, upright_world, world_figures
from ..source.opening import is_of_source
from ..system.memory import release_free_memory
from ..system.progress import Progress, SilentProgress, log
from ..types import Metres
from .extra.floor_plan import write_floor_plan
from .extra.meshes import write_collision, write_usd
from .extra.tiles import TILES, TILESET, write_tiles
from .extra.web_page import write_web_page
from .mesh import MeshJob, mesh_figures, write_meshes
from .pieces import write_pieces
from .readme import names_of
from .writers import (
    IMAGES,
    write_colmap,
    write_notes,
    write_ply,
    write_readme,
    write_splats,
    write_trajectory,
    write_world,
)

_SEVERAL = ("colmap", "ply", "mesh", "obj")
"""The `EXPORTS` of more than one file."""


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
    write_all_but_mesh(outcome, world, settings, folder)
    if world.earth is not None:
        METRES.save(folder, metres)
    gaussians = len(outcome.require_map())

    # The mesh, by tasks that load the map themselves
    outcome = replace(outcome, gaussian_map=None)
    release_free_memory()
    write_meshes(MeshJob(context, ("mesh",), folder, keep=True), outcome, world)
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


def write_all_but_mesh(outcome: Outcome, world: World, settings: ExportConfig, folder: Path) -> list[Path]:
    """Web page, COLMAP model, PLYs, trajectory, notes; SPZ and GLB where the settings want them, tiles of a map that
    was made in parts. `outcome` stands in `world`."""
    paths = write_web_page(outcome, world, folder) + write_colmap(outcome, folder)
    paths += write_ply(outcome, settings.sh_rest, folder)
    paths += write_splats("spz", outcome, world, settings, folder) if settings.spz else []
    paths += write_splats("glb", outcome, world, settings, folder) if settings.splat_glb else []
    paths += write_tiles(outcome, world, folder) if outcome.run.load(SUBMAPS) else []
    return paths + write_trajectory(outcome, folder) + write_notes(outcome, world, folder)


def export_run(
    run: RunFolder,
    folder: Path,
    only: str | None = None,
    progress: Progress | None = None,
    settings: ExportConfig | None = None,
) -> list[Path]:
    """Write one of the `EXPORTS`, or with None all, of a run into a folder; returns what was written.

    Settings are the run's own where none are given. Raises InputError for a run without a map, and for a folder that
    holds such files of somebody else, or the run's source.
    """
    _require_own(run, folder, only)
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

    def mesh(*kinds: str) -> list[Path]:
        empty(scratch := folder / ".mesh")  # what a killed export has left
        try:
            config = replace(found.config, export=settings)
            context = StageContext(run, Path(), config, scratch, progress or SilentProgress())
            return write_meshes(MeshJob(context, kinds, folder), outcome, world)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)

    writers: dict[str, Callable[[], list[Path]]] = {
        "colmap": lambda: write_colmap(outcome, folder),
        "ply": lambda: write_ply(outcome, settings.sh_rest, folder),
        **{k: partial(write_splats, k, outcome, world, settings, folder) for k in ("spz", "sog", "glb")},
        "tiles": lambda: write_tiles(outcome, world, folder),
        "html": lambda: write_web_page(outcome, world, folder),
        "mesh": lambda: mesh("mesh"),
        "obj": lambda: mesh("obj"),
        "collision": lambda: write_collision(found, world, folder),
        "usd": lambda: write_usd(found, world, folder),
        "floorplan": lambda: write_floor_plan(found, folder),
        "tum": lambda: write_trajectory(outcome, folder),
    }
    if only in (None, *_SEVERAL):  # by it the folder is known for an export's, should this be stopped
        write_world(outcome, world, folder)
    if only:
        paths = [*writers[only](), write_world(outcome, world, folder)]
        # The run's own folder has a README that tells of every kind.
        own = folder.resolve() == run.stage("export").resolve()
        return paths if own else [*paths, write_readme(outcome, world, folder, only)]
    return write_all_but_mesh(outcome, world, settings, folder) + mesh("mesh")


def _require_own(run: RunFolder, folder: Path, only: str | None) -> None:
    """Nothing that the user has is overwritten: photographs, another program's data set, a README of his own."""
    if folder.resolve() == run.stage("export").resolve():
        return
    names = names_of(only)
    if IMAGES in names and is_of_source(folder / IMAGES, run):
        raise InputError(f"{folder / IMAGES} is the source of {run.root}: name another folder with --to")
    # Tiles that were stopped have no tileset yet.
    entries = {name: folder / name for name in names} | {TILES: folder / TILES / TILESET}
    taken = [name for name in names if entries[name].exists()]
    if taken and not (folder / WORLD.name).is_file():
        raise InputError(
            f"{folder} holds {', '.join(taken)} already, which is of no export (without {WORLD.name}): name another "
            "folder with --to"
        )


def _kept_world(outcome: Outcome, settings: ExportConfig) -> World | None:
    """That of the run's own export, so that what is written later or elsewhere fits; None for other axes."""
    own = outcome.config.export
    return outcome.run.find(WORLD) if (settings.axes, settings.gps) == (own.axes, own.gps) else None
