"""Outcome of a run in the world of its exported files, its metres decided."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from ...formats.errors import InputError
from ...formats.glb import ClassMesh, read_mesh_glb
from ...formats.ply import MeshArrays, read_mesh_ply
from ...formats.splats import GaussianCloud
from ..config import ExportConfig
from ..networks.registry import metric_card
from ..run.files import MESH
from ..run.folder import RunFolder
from ..run.outcome import Outcome, map_cloud
from ..run.stages import StageContext
from ..scene.gps import world_on_earth
from ..scene.metres import find_metres
from ..scene.world import FIRST, WORLD, World, find_upright, in_world, upright_world
from ..types import Metres

MESH_GLB = "mesh.glb"
_FREE = "The unit of lengths is free: one camera cannot measure metres. Metric depth or --scale-ref makes them metres."


@dataclass(frozen=True)
class ExportScene:
    """outcome: poses, map and points in the `world` of the exported files, and how long its unit is; context: settings,
    threads, tasks and warnings of whoever exports."""

    outcome: Outcome
    world: World
    context: StageContext

    @property
    def settings(self) -> ExportConfig:
        return self.context.config.export

    @property
    def warn(self) -> Callable[[str], None]:
        return self.context.warn

    @property
    def metres_per_unit(self) -> float:
        """Metres per unit of the files, 1 where that is unknown."""
        return 1.0 if self.outcome.metric or self.outcome.metres is None else self.outcome.metres.per_unit

    def cloud(self, rows: Tensor | slice | None = None) -> GaussianCloud:
        """Return the map, or `rows` of it, in the axes of splat formats: x right, y down, z forward."""
        cloud = map_cloud(self.outcome, rows)
        return replace(cloud, means=(cloud.means @ self.world.image_axes_from_exported.T).astype(np.float32))

    def mesh(self) -> MeshArrays:
        """Read the mesh that the run's own export has made, as `mesh_of_run`."""
        return mesh_of_run(self.outcome.run, self.world)

    def light_mesh(self) -> ClassMesh | None:
        """Read the lighter mesh that the run's own export has made, z up; None where it has none."""
        run, own = self.outcome.run, self.outcome.run.find(WORLD)
        if own is None or not run.has("export", MESH_GLB):
            return None
        mesh = read_mesh_glb(run.file("export", MESH_GLB))
        turned = mesh.vertices.astype(np.float64) @ own.gltf_from_exported
        move = self.world.exported_from_run @ own.exported_from_run.inverse()
        return replace(mesh, vertices=move.apply(turned).astype(np.float32))

    def without_map(self) -> "ExportScene":
        """Return the scene for writers that load the map themselves."""
        return replace(self, outcome=replace(self.outcome, gaussian_map=None))


def mesh_of_run(run: RunFolder, world: World) -> MeshArrays:
    """Read the mesh that a run's own export has made, and move it into `world`. Raises InputError for an empty one."""
    mesh = read_mesh_ply(run.file("export", MESH))
    if len(mesh.faces) == 0:
        raise InputError(f"{run.root}: the mesh is empty, so there is nothing to write: film the scene again")
    if (own := run.find(WORLD)) is None:
        return mesh
    move = world.exported_from_run @ own.exported_from_run.inverse()
    return replace(mesh, vertices=move.apply(mesh.vertices.astype(np.float64)).astype(np.float32))


def find_world(outcome: Outcome, settings: ExportConfig) -> tuple[World, list[str]]:
    """Find the world for the files of a run whose map is done; returns it, and what was asked for and not found."""
    world = upright_world(outcome, find_upright(outcome)) if settings.axes == "up" else FIRST
    reasons = []
    if settings.axes == "up" and world.axes != "up":
        reasons.append(
            "neither a floor nor vertical lines were found, so up is unknown: the files keep the axes of the run, "
            "roughly those of the first posed camera"
        )
    world, reason = world_on_earth(outcome, world, settings.gps)
    return world, [*reasons, reason] if reason else reasons


def estimate_metres(context: StageContext, outcome: Outcome, world: World) -> Metres | None:
    """Find how long the unit of the run's own world is: by GPS, else by `find_metres`, whose doubts are warned of."""
    if world.earth is not None:
        return Metres(world.exported_from_run.scale, max(world.earth.scale_sd, 1e-3), False, ("GPS",))
    guess = context.config.export.scale == "auto"
    card = metric_card() if guess else None
    metres, warning = find_metres(context.run, outcome.trajectory, guess, card, context.threads, context.device)
    if warning:
        context.warn(warning)
    return metres


def finished_scene(outcome: Outcome, context: StageContext) -> ExportScene:
    """Return the scene of a run in the world of its own export, so that what is written later fits, but for settings of
    `context` that differ."""
    settings, own = context.config.export, outcome.config.export
    outcome.require_map()
    is_same = (settings.axes, settings.gps) == (own.axes, own.gps)
    if (world := outcome.run.find(WORLD) if is_same else None) is None:
        world, reasons = find_world(outcome, settings)
        for reason in reasons:
            context.warn(reason)
    outcome = in_world(outcome, world)
    if outcome.metres is not None and outcome.metres.is_guess and settings.scale == "free":
        outcome = replace(outcome, metres=None)
    return ExportScene(outcome, world, context)


def lengths(metres: Metres | None, metric: bool) -> str:
    """Describe the unit of length in a line or two of plain text."""
    if metres is None:
        return "Lengths are metres." if metric else _FREE
    if metric:
        return f"Lengths are metres: {metres.text}."
    return (
        f"{metres.text[0].upper()}{metres.text[1:]}.\n"
        f"Coordinates are not rescaled: multiply lengths by {metres.per_unit:.3g} to have them in metres."
    )
