"""Outcome of a run in the world of its exported files, its metres decided."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...formats.errors import InputError
from ...formats.glb import ClassMesh, read_mesh_glb
from ...formats.ply import MeshArrays, read_mesh_ply
from ...formats.splats import GaussianCloud
from ..config import ExportConfig
from ..geometry.camera import resample_nearest
from ..networks.registry import metric_card
from ..run.files import MESH
from ..run.folder import RunFolder
from ..run.outcome import Outcome, map_cloud
from ..run.stages import StageContext
from ..run.target import Target
from ..scene.gps import world_on_earth
from ..scene.metres import find_metres
from ..scene.world import FIRST, WORLD, World, find_upright, in_world, upright_world
from ..system.raster import draw_faces
from ..types import Metres
from .holes import cut_light, cut_map, cut_mesh, holes_in
from .inventory import NO_THINGS, THINGS, FoundThings, Selection, Thing, in_metres, load_things
from .things import of_faces

MESH_GLB = "mesh.glb"
_DRAWN, _AROUND = 320, 12
"""Pixels of the longer side at which a thing is looked for, and around it in its pictures."""
_FREE = "The unit of lengths is free: one camera cannot measure metres. Metric depth or --scale-ref makes them metres."


@dataclass(frozen=True)
class ExportScene:
    """outcome: poses, map and points in the `world` of the exported files, and how long its unit is; context: settings,
    threads, tasks and warnings of whoever exports; things: those of the mesh, as soon as there is one; selection: which
    of them are wanted, by which the outcome's map is cut already."""

    outcome: Outcome
    world: World
    context: StageContext
    things: FoundThings = NO_THINGS
    selection: Selection | None = None

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
        if self.things.table:
            cloud = replace(cloud, things=self.gaussian_things[slice(None) if rows is None else rows])
        return replace(cloud, means=(cloud.means @ self.world.image_axes_from_exported.T).astype(np.float32))

    @cached_property
    def gaussian_things(self) -> NDArray[np.uint16]:
        """(M,) the number of the thing that each Gaussian is of, 0 for none."""
        return self.things.of(self.outcome.require_map().means.cpu().numpy())

    def things_before(self) -> tuple[Thing, ...]:
        """Read the things of an earlier export of the run; none where there was none, or its list is damaged."""
        try:
            return THINGS.find(self.outcome.run.path("export")) or ()
        except InputError:
            return ()

    def mesh(self) -> MeshArrays:
        """Read the mesh that the run's own export has made, as `mesh_of_run`: the things of it that are wanted."""
        return self.mesh_of_things()[0]

    def mesh_of_things(self) -> tuple[MeshArrays, NDArray[np.uint16]]:
        """Return the same mesh with the numbers (V,) of its vertices' things."""
        mesh, numbers = mesh_of_run(self.outcome.run, self.world), self.things.numbers
        if not len(numbers):
            numbers = np.zeros(len(mesh.vertices), np.uint16)
        return (mesh, numbers) if self.selection is None else cut_mesh(mesh, numbers, self.selection, self.world)

    def light_mesh(self) -> ClassMesh | None:
        """Read the lighter mesh that the run's own export has made, z up, the things of it that are wanted; None where
        it has none."""
        run, own = self.outcome.run, self.outcome.run.find(WORLD)
        if own is None or not run.has("export", MESH_GLB):
            return None
        mesh = read_mesh_glb(run.file("export", MESH_GLB))
        turned = mesh.vertices.astype(np.float64) @ own.gltf_from_exported
        move = self.world.exported_from_run @ own.exported_from_run.inverse()
        mesh = replace(mesh, vertices=move.apply(turned).astype(np.float32))
        if self.selection is None:
            return mesh
        whole = mesh_of_run(self.outcome.run, self.world)
        return cut_light(mesh, self.selection, holes_in(whole, self.things.numbers, self.selection, self.world))

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


def with_things(scene: ExportScene, selection: Selection | None) -> ExportScene:
    """Return the scene with the things that the run's own export has found, or those of a selection alone; with a
    warning without any where its mesh is damaged. Raises InputError where that leaves nothing to select from."""
    try:
        things = things_of_run(scene.outcome.run, scene.world) or NO_THINGS
    except InputError as error:
        if selection is not None:
            raise
        scene.warn(f"without its things: {error}")
        return scene
    scene = replace(scene, things=things)
    return scene if selection is None else chosen_scene(scene, selection)


def things_of_run(run: RunFolder, world: World) -> FoundThings | None:
    """Load the things that a run's own export has found, and move them into `world`; None where it has none."""
    if not (run.holds(THINGS, "export") and run.has("export", MESH)):
        return None
    found, own = load_things(run.file("export", THINGS.name), run.file("export", MESH)), run.find(WORLD)
    if own is None:
        return found
    return found.moved(world.exported_from_run @ own.exported_from_run.inverse())


def draw_things(outcome: Outcome, mesh: MeshArrays, numbers: NDArray[np.uint16]) -> dict[int, NDArray[np.uint16]]:
    """(h, w) numbers of the things, 0 for none, that each keyframe shows, by its row; of the vertices' numbers (V,) of
    a mesh in the outcome's world."""
    camera, t = outcome.calibration.intrinsics.at_most(_DRAWN), outcome.trajectory
    of_face = np.append(of_faces(numbers.astype(np.int64), mesh.faces), 0).clip(min=0).astype(np.uint16)
    rows = np.flatnonzero(t.is_keyframe & t.is_posed).tolist()
    # Where no face is drawn it is number -1, the last.
    return {row: of_face[draw_faces(mesh.vertices, mesh.faces, t.cam_from_world[row], camera).face] for row in rows}


def pictures_of(
    outcome: Outcome, seen: dict[int, NDArray[np.uint16]], number: int, most: int
) -> list[tuple[str, NDArray[np.uint8], NDArray[np.bool_]]]:
    """Name, crop (h, w, 3) and mask (h, w) of the keyframes that show most of a thing, as `draw_things` saw them."""
    pixels = {row: int((image == number).sum()) for row, image in seen.items()}
    found = []
    for row in sorted((row for row in seen if pixels[row]), key=lambda row: -pixels[row])[:most]:
        frame = outcome.frames[row]
        image = outcome.run.image(frame)
        mask = resample_nearest(seen[row], *image.shape[:2]) == number
        lines, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        window = tuple(slice(max(at[0] - _AROUND, 0), at[-1] + _AROUND + 1) for at in (lines, columns))
        found.append((frame.name, image[window], mask[window]))
    return found


def chosen_scene(scene: ExportScene, selection: Selection) -> ExportScene:
    """Return the scene with those things alone that are wanted, and floor and walls where others stood."""
    outcome = scene.outcome
    whole = mesh_of_run(outcome.run, scene.world)
    cut = cut_map(
        outcome, scene.gaussian_things, selection, holes_in(whole, scene.things.numbers, selection, scene.world)
    )
    table = tuple(t for t in scene.things.table if (t.number in selection.numbers) == selection.only)
    things = replace(scene.things, table=table)
    return replace(scene, outcome=replace(outcome, gaussian_map=cut), selection=selection, things=things)


def write_things(scene: ExportScene, target: Target, things: FoundThings) -> None:
    """Write things.json, with metres where the scene knows them."""
    metres, outcome = outcome_metres(scene), scene.outcome
    per_unit, spread = (1.0, 0.0) if outcome.metric and metres is None else metres or (None, 0.0)
    THINGS.save(target.path(THINGS.name).parent, in_metres(things.table, per_unit, spread))


def written_things(target: Target, world: World) -> FoundThings:
    """Load what `write_mesh` has written into a folder."""
    found = load_things(target.folder / THINGS.name, target.folder / MESH)
    return found or NO_THINGS


def outcome_metres(scene: ExportScene) -> tuple[float, float] | None:
    """Return metres per unit of the files and their relative deviation; None where they are unknown."""
    metres = scene.outcome.metres
    return None if metres is None else (scene.metres_per_unit, metres.relative_sd)


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
