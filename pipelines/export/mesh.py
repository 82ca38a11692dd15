"""The labelled mesh: rendered median depth of the keyframes, fused, extracted, painted.

Each step is a task over chunks of keyframes or of regions, and leaves files in the stage's snapshot. Before the depths
are fused, uncertain ones move onto the planes of sure ones beside them, which go on behind furniture (`planes.py`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...formats.glb import ClassMesh, write_mesh_glb
from ...formats.ply import MeshArrays, MeshBlocks, mesh_blocks, read_mesh_ply, write_mesh_ply
from ..config import ExportConfig
from ..geometry.camera import resample_nearest
from ..geometry.posed_depth import PosedDepth
from ..mapping.measure import DepthViews, MeshView, mesh_view
from ..run.outcome import Outcome, load_outcome, maps_around
from ..run.stages import Chunk, StageContext, in_chunks
from ..run.target import Target
from ..system.parallel import LruSequence, map_lookahead
from ..system.progress import Progress
from ..system.threads import get_threads, host_threads
from ..system.values import load_value, save_value
from ..types import VOID
from .inventory import FoundThings, things_in
from .light import SHARE, clustered, labels_near, lightened, middles, smoothed_rims
from .patches import patched
from .planes import Planes, planes_of, put_planes, snap_to_planes
from .scene import ExportScene, write_things
from .surface import Region, chunk_surfaces, closed, filled, joined, weld
from .texture import textured
from .volume import BEHIND, Grid, fuse, make_grid

TRUNCATION = 3.0
"""Voxels on either side of a surface that a depth speaks for."""
MIN_WEIGHT = 0.5
"""A voxel seen with less weight, in views at the median depth, has no surface."""
MAX_BLOCKS, LONG = 80_000, 200
"""Blocks of 8 x 8 x 8 voxels for so many keyframes, more for more; voxels grow where that is too few."""
SURE = 0.5
"""Confidence of a proxy's depth from which the depth drawn there stays where it is."""
_BEFORE = 0.05
"""A face is hidden behind what is nearer by this part."""
_PATCHES = 0.2
"""Part of the triangles of the lighter mesh that is kept for patches."""
_KEPT_BYTES = 100e6


def write_mesh(scene: ExportScene, target: Target) -> None:
    """Draw the map in the keyframes, snap uncertain depths to planes, fuse all region by region, join the regions, find
    the things, and write mesh.ply with all its vertices, and mesh.glb, lighter and with a texture where the settings
    want one; with things.json. Of a scene of some things only, write what is left of the run's own meshes.

    Files that are there stay. The tasks load the map themselves; what does not fit into memory is in the snapshot of
    the scene's context.
    """
    if scene.selection is not None:
        write_chosen(scene, target)
        return
    context, outcome, settings = scene.context, scene.outcome, scene.settings
    names, axes = outcome.classes.names, scene.world.gltf_from_exported
    ply, glb = target.path("mesh.ply"), target.path("mesh.glb")
    scratch, count = _scratch(context), len(keyframe_rows(outcome))
    if ply.exists() and glb.exists():
        return
    in_chunks(context, draw_keyframes, count, move=outcome.move)
    planes = None if settings.planes == "off" else planes_in(scratch, count)
    if planes is not None:
        in_chunks(context, snap_views, count, planes=planes)
    planes = planes if settings.planes == "complete" else None
    views = mesh_views(scratch, count)
    whole = scratch / "mesh.ply"
    if not whole.exists():
        grid = _grid_around(views, settings, planes)
        regions, class_ids = len(list(grid.regions())), tuple(outcome.label_of_channel.tolist())
        in_chunks(context, fuse_views, regions, grid=grid, views=count, class_ids=class_ids, planes=planes)
        # Regions are loaded one at a time, whenever `joined` goes over them.
        write_mesh_ply(whole, joined(lambda: (load_value(_region_file(scratch, n)) for n in range(regions))), names)
    mesh, shown = read_mesh_ply(whole), DepthViews(views)
    things = things_in(mesh, names, scene.world, shown, scene.things_before()).on(mesh.vertices)
    write_things(scene, target, things)
    write_mesh_ply(ply, mesh_blocks(whole), names, things.numbers)
    if not mesh.faces.size:
        context.warn("the mesh is empty: no surface is seen by enough keyframes")
        return
    most = min(settings.triangles, round(SHARE * len(mesh.faces))) if settings.texture else settings.triangles
    kinds, label_of, thing_of = _kinds(mesh, things)
    of_kinds = replace(mesh, labels=kinds)  # type: ignore[arg-type] # any integers do
    light, of_faces = lightened(filled(smoothed_rims(clustered(of_kinds)), shown), round((1 - _PATCHES) * most))
    covered = patched(light, shown, settings.triangles)
    light, of_faces = covered, labels_near(light, of_faces, covered)
    labels = label_of[of_faces]
    if settings.texture:
        made = textured(outcome, light, labels, shown, context.progress)
    else:
        uv, nothing = np.zeros((len(light.vertices), 2), np.float32), np.zeros((0, 0, 3), np.uint8)
        made = ClassMesh(light.vertices, light.colors, labels, np.arange(len(uv)), uv, light.faces, nothing)
    made = replace(made, hidden=_is_hidden(light, shown), things=thing_of[of_faces])
    write_mesh_glb(glb, replace(made, vertices=(made.vertices @ axes.T).astype(np.float32)), names, things.names)


def write_chosen(scene: ExportScene, target: Target) -> None:
    """Write those things of the run's meshes that are wanted, and floor and walls where others stood."""
    names, axes, (mesh, numbers) = scene.outcome.classes.names, scene.world.gltf_from_exported, scene.mesh_of_things()
    vertices = [(mesh.vertices, mesh.colors, mesh.labels)]
    blocks = MeshBlocks(len(mesh.vertices), len(mesh.faces), lambda: vertices, lambda: [mesh.faces])
    write_mesh_ply(target.path("mesh.ply"), blocks, names, numbers)
    write_things(scene, target, scene.things)
    if (light := scene.light_mesh()) is not None:
        turned = replace(light, vertices=(light.vertices @ axes.T).astype(np.float32))
        write_mesh_glb(target.path("mesh.glb"), turned, names, scene.things.names)


def _kinds(mesh: MeshArrays, things: FoundThings) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint16]]:
    """(V,) what no face of the lighter mesh reaches over the border of: things, and classes elsewhere; and of each
    kind its label and thing."""
    table = np.full(1 + int(things.numbers.max(initial=0)), VOID, np.uint8)
    table[[t.number for t in things.table]] = [t.label for t in things.table]
    labels = np.where(things.numbers > 0, table[things.numbers], mesh.labels).astype(np.int64)
    pairs, kinds = np.unique(256 * things.numbers.astype(np.int64) + labels, return_inverse=True)
    return kinds.reshape(-1), (pairs % 256).astype(np.uint8), (pairs // 256).astype(np.uint16)


def _is_hidden(mesh: MeshArrays, views: Iterable[PosedDepth]) -> NDArray[np.bool_]:
    """(F,) whether no view sees a face's middle."""
    places, hidden = middles(mesh), np.ones(len(mesh.faces), bool)
    for view in views:
        xy, z, inside = view.seen(places)
        rows = np.flatnonzero(inside & hidden)
        column, row = xy[rows].astype(int).T
        hidden[rows[view.depth[row, column] > (1 - _BEFORE) * z[rows]]] = False
    return hidden


def _scratch(context: StageContext) -> Path:
    return context.snapshot / "mesh"


def keyframe_rows(outcome: Outcome) -> list[int]:
    """The rows of the trajectory whose views the mesh is made from."""
    return np.flatnonzero(outcome.trajectory.is_keyframe).tolist()


def draw_keyframes(task: Chunk, progress: Progress) -> None:
    """Render the map in the keyframes of a chunk into the scratch folder; existing files are kept."""
    context, settings = task.context(progress), task.config.export
    outcome, scratch = load_outcome(task.run, context.device).moved(task.known["move"]), _scratch(context)
    rows, t, near = keyframe_rows(outcome), outcome.trajectory, maps_around(outcome)
    camera = outcome.calibration.intrinsics.at_most(outcome.config.mapping.max_side)

    def draw_one(number: int) -> None:
        if not (file := _view_file(scratch, number)).exists():
            row = rows[number]
            frame_id = int(t.frame_ids[row])
            view = mesh_view(near(frame_id), t.cam_from_world[row], camera)
            if settings.planes != "off" and (maps := outcome.run.find_proxy(frame_id)) is not None:
                view = replace(view, unsure=resample_nearest(maps.confidence, camera.height, camera.width) < SURE)
            save_value(file, view)

    done = map_lookahead(draw_one, task.numbers, host_threads(outcome.require_map().means))
    for _ in progress.track(done, "drawing", len(task.numbers)):
        pass


def snap_views(task: Chunk, progress: Progress) -> None:
    """Move uncertain depths of a chunk's views onto the planes of all; a view that is done stays."""
    scratch = _scratch(task.context(progress))

    def snap_one(number: int) -> None:
        view: MeshView = load_value(file := _view_file(scratch, number))
        if view.unsure is not None:
            save_value(file, snap_to_planes(view, task.known["planes"]))

    done = map_lookahead(snap_one, task.numbers, get_threads())
    for _ in progress.track(done, "straightening", len(task.numbers)):
        pass


def planes_in(scratch: Path, count: int) -> Planes:
    """The planes of what `draw` has left, found once: views that are straight would give others."""
    if not (file := scratch / "planes.npz").exists():
        save_value(file, planes_of(mesh_views(scratch, count)))
    planes: Planes = load_value(file)
    return planes


def mesh_views(scratch: Path, count: int) -> Sequence[MeshView]:
    """Load the renderings of `draw` on demand; the last ones used stay in memory."""
    return LruSequence(count, lambda n: load_value(_view_file(scratch, n)), lambda view: view.size, _KEPT_BYTES)


def _view_file(scratch: Path, number: int) -> Path:
    return scratch / f"view_{number:06d}.npz"


def _grid_around(views: Sequence[MeshView], settings: ExportConfig, planes: Planes | None) -> Grid:
    """The voxel grid around what the views show, by their median depth, and where planes go on."""
    shown = DepthViews(views)
    step = 16 * -(-len(shown) // LONG)
    seen = np.concatenate([v.depth[v.trust > 0][::step] for v in shown])
    median = float(np.median(seen)) if len(seen) else 1.0
    most = int(MAX_BLOCKS * max(len(views) / LONG, 1))
    return make_grid(shown, settings.voxel * median, TRUNCATION, most, *[planes.points] if planes else [])


def fuse_views(task: Chunk, progress: Progress) -> None:
    """The surface of the map as the keyframes see it, in some regions of the grid; what is there stays."""
    scratch, known = _scratch(task.context(progress)), task.known
    grid, views = known["grid"], mesh_views(scratch, known["views"])
    parts = list(grid.regions())
    for number in task.numbers:
        if not (file := _region_file(scratch, number)).exists():
            of = f", {number + 1} of {len(parts)}" if len(parts) > 1 else ""
            save_value(file, _region(views, grid, known["class_ids"], parts[number], progress, of, known["planes"]))


def _region_file(scratch: Path, number: int) -> Path:
    return scratch / f"region_{number:06d}.npz"


def _region(
    views: Sequence[MeshView],
    grid: Grid,
    class_ids: tuple[int, ...],
    chunks: NDArray[np.int32],
    progress: Progress,
    of: str,
    planes: Planes | None,
) -> Region:
    """One of the regions of the grid, from the views that see it and planes that go on; `of` names it for the
    progress."""
    near = grid.views_of(chunks)
    fusing = (views[n].shown for n in progress.track(near, "fusing" + of, len(near)))
    volume = fuse(grid, chunks, fusing)
    if planes is not None:
        put_planes(volume, planes, grid.truncation, MIN_WEIGHT)
    triangles = chunk_surfaces(volume, chunks, MIN_WEIGHT)
    surface = closed(weld(triangles, chunks, grid.voxel), (views[n].shown for n in near), BEHIND * grid.truncation)
    painting = (views[n] for n in progress.track(near, "painting" + of, len(near)))
    return Region(surface, *paint(surface.vertices, painting, class_ids, 2 * grid.truncation))


def mesh_figures(path: Path) -> dict[str, Any]:
    """Count for the report what a mesh.ply holds."""
    mesh = mesh_blocks(path)
    labelled = sum(int((labels != VOID).sum()) for _, _, labels in mesh.vertices())
    share = round(labelled / max(mesh.vertex_count, 1), 4)
    return {"vertices": mesh.vertex_count, "faces": mesh.face_count, "labelled_share": share}


def paint(
    vertices: NDArray[np.float32], views: Iterable[MeshView], class_ids: tuple[int, ...], tolerance: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """colors (V, 3) uint8 and labels (V,) uint8: weighted mean and vote of the views that see a vertex.

    A view sees a vertex where its depth there agrees within `tolerance`. Unseen ones, as on the rims behind steps, are
    as the nearest seen one; grey and VOID where none is.
    """
    total = np.zeros((len(vertices), 3), np.float32)
    weight = np.zeros(len(vertices), np.float32)
    votes = np.zeros((len(vertices), max(len(class_ids), 1)), np.float32)
    for view in views:
        rows, place = _seen(vertices, view.shown, tolerance)
        share = view.shown.trust[place]
        total[rows] += view.colors[place] * share[:, None]
        weight[rows] += share
        if view.channels is not None and class_ids:
            channel = view.channels[place]
            votes[rows[channel >= 0], channel[channel >= 0]] += share[channel >= 0]
    seen, unseen = np.flatnonzero(weight > 0), np.flatnonzero(weight == 0)
    if len(seen) and len(unseen):
        nearest = seen[cKDTree(vertices[seen]).query(vertices[unseen])[1]]
        total[unseen], weight[unseen], votes[unseen] = total[nearest], weight[nearest], votes[nearest]
    colors = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-9)[:, None], 127.5)
    table = np.array([*class_ids, VOID] if class_ids else [VOID, VOID], np.uint8)
    labels = np.where(votes.max(1) > 0, votes.argmax(1), len(table) - 1)
    return np.round(colors).astype(np.uint8), table[labels]


def _seen(
    vertices: NDArray[np.float32], view: PosedDepth, tolerance: float
) -> tuple[NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Which vertices the view sees, and the (row, column) of each."""
    xy, z, is_inside = view.seen(vertices.astype(np.float64))
    inside = np.flatnonzero(is_inside)
    place = xy[inside].astype(int)
    close = np.abs(view.depth[place[:, 1], place[:, 0]] - z[inside]) < tolerance
    close &= view.trust[place[:, 1], place[:, 0]] > 0
    return inside[close], (place[close, 1], place[close, 0])
