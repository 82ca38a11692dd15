"""The labelled mesh: rendered median depth of the keyframes, fused, extracted, painted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.mesh import MeshBlocks, read_mesh_ply
from ..compute.threads import get_threads, host_threads
from ..config import ExportConfig
from ..geometry.posed_depth import PosedDepth
from ..geometry.resampling import resample_nearest
from ..mapping.measure import DrawnView, Shown, drawn_view
from ..outcome import Outcome, maps_around
from ..run.files import MESH
from ..scene.world import WORLD, World
from ..system.lru_sequence import LruSequence
from ..system.parallel import abreast
from ..system.progress import Progress
from ..system.values import load_value, save_value
from ..types import VOID, Intrinsics, ProxyMaps, SemanticMesh
from .joined import Region
from .paint import paint
from .planes import Planes
from .straighten import planes_of, straightened
from .surface import chunk_surfaces, weld
from .volume import Grid, fuse, make_grid

TRUNCATION = 3.0
"""Voxels on either side of a surface that a depth speaks for."""
LEAST_WEIGHT = 0.5
"""A voxel seen with less weight, in views at the median depth, has no surface."""
LONG = 200
"""Keyframes of a recording for which `export.max_blocks` is meant; a longer one may have more by its length."""
SURE = 0.5
"""Confidence of a proxy's depth from which the depth drawn there stays where it is."""
_KEPT_BYTES = 100e6


def mesh_of_run(outcome: Outcome, world: World) -> SemanticMesh:
    """The mesh that a run's own export has made, in `world`; `outcome` is in the run's own.

    Raises InputError where there is none, or an empty one.
    """
    run = outcome.run
    if not run.has("export", MESH):
        raise InputError(
            f"{run.root} has no mesh yet, and this file is made from it: finish the run with msgs-slam resume"
        )
    mesh = SemanticMesh(**vars(read_mesh_ply(run.file("export", MESH))))
    if len(mesh.faces) == 0:
        raise InputError(f"{run.root}: the mesh is empty, so there is nothing to write: film the scene again")
    if (own := run.find(WORLD)) is None:
        return mesh
    move = world.exported_from_run @ own.exported_from_run.inverse()
    return replace(mesh, vertices=move.apply(mesh.vertices.astype(np.float64)).astype(np.float32))


def keyframe_rows(outcome: Outcome) -> list[int]:
    """The rows of the trajectory whose views the mesh is made from."""
    return np.flatnonzero(outcome.trajectory.is_keyframe).tolist()


def draw(outcome: Outcome, settings: ExportConfig, scratch: Path, progress: Progress, numbers: range) -> None:
    """Render the map in the `keyframe_rows` with these numbers into `scratch`; existing files are kept."""
    rows, t, near = keyframe_rows(outcome), outcome.trajectory, maps_around(outcome)
    camera = outcome.calibration.intrinsics.at_most(settings.mesh_side)

    def draw_one(number: int) -> None:
        if not (file := _view_file(scratch, number)).exists():
            row = rows[number]
            frame_id = int(t.frame_ids[row])
            view = drawn_view(near(frame_id), t.cam_from_world[row], camera)
            maps = outcome.run.find_proxy(frame_id) if settings.planes else None
            save_value(file, view if maps is None else replace(view, unsure=_unsure(maps, camera)))

    done = abreast(draw_one, numbers, host_threads(outcome.require_map().means))
    for _ in progress.track(done, "drawing", len(numbers)):
        pass


def _unsure(maps: ProxyMaps, camera: Intrinsics) -> NDArray[np.bool_]:
    return resample_nearest(maps.confidence, camera.height, camera.width) < SURE


def straighten(scratch: Path, planes: Planes, progress: Progress, numbers: range) -> None:
    """Move unsure depths of the views of `draw` onto the planes; a view that is done stays."""

    def straighten_one(number: int) -> None:
        view: DrawnView = load_value(file := _view_file(scratch, number))
        if view.unsure is not None:
            save_value(file, straightened(view, planes))

    done = abreast(straighten_one, numbers, get_threads())
    for _ in progress.track(done, "straightening", len(numbers)):
        pass


def planes_in(scratch: Path, count: int) -> Planes:
    """The planes of what `draw` has left, found once: views that are straight would give others."""
    if not (file := scratch / "planes.npz").exists():
        save_value(file, planes_of(drawn_views(scratch, count)))
    planes: Planes = load_value(file)
    return planes


def drawn_views(scratch: Path, count: int) -> Sequence[DrawnView]:
    """Load the renderings of `draw` on demand; the last ones used stay in memory."""
    return LruSequence(count, lambda n: load_value(_view_file(scratch, n)), lambda view: view.size, _KEPT_BYTES)


def _view_file(scratch: Path, number: int) -> Path:
    return scratch / f"view_{number:06d}.npz"


def make_grid_of(views: Sequence[DrawnView], settings: ExportConfig) -> Grid:
    """Choose the voxel grid of the mesh, around what the views show."""
    shown = Shown(views)
    most = int(settings.max_blocks * max(len(views) / LONG, 1))
    return make_grid(shown, settings.voxel * _median_depth(shown), TRUNCATION, most)


def fuse_regions(
    views: Sequence[DrawnView],
    grid: Grid,
    class_ids: tuple[int, ...],
    scratch: Path,
    progress: Progress,
    numbers: range,
) -> None:
    """The surface of the map as the keyframes see it, in the grid's regions with these numbers, into `scratch`; what is
    there stays. `class_ids`: the label of each class channel."""
    parts = list(grid.regions())
    for number in numbers:
        if not (file := _region_file(scratch, number)).exists():
            of = f", {number + 1} of {len(parts)}" if len(parts) > 1 else ""
            save_value(file, make_region(views, grid, class_ids, parts[number], progress, of))


def fused_regions(scratch: Path, count: int) -> Callable[[], Iterable[Region]]:
    """Return a function that loads the regions of `fuse_regions`, one in memory at a time."""
    return lambda: (load_value(_region_file(scratch, number)) for number in range(count))


def _region_file(scratch: Path, number: int) -> Path:
    return scratch / f"region_{number:06d}.npz"


def make_region(
    views: Sequence[DrawnView],
    grid: Grid,
    class_ids: tuple[int, ...],
    chunks: NDArray[np.int32],
    progress: Progress,
    of: str = "",
) -> Region:
    """One of the regions of the grid, from the views that see it; `of` names it for the progress."""
    near = grid.views_of(chunks)
    fusing = (views[n].shown for n in progress.track(near, "fusing" + of, len(near)))
    triangles = chunk_surfaces(fuse(grid, chunks, fusing), chunks, LEAST_WEIGHT)
    surface = weld(triangles, chunks, grid.voxel)
    painting = (views[n] for n in progress.track(near, "painting" + of, len(near)))
    return Region(surface, *paint(surface.vertices, painting, class_ids, 2 * grid.truncation))


def _median_depth(views: Sequence[PosedDepth]) -> float:
    step = 16 * -(-len(views) // LONG)
    seen = np.concatenate([v.depth[v.trust > 0][::step] for v in views])
    return float(np.median(seen)) if len(seen) else 1.0


def mesh_figures(mesh: MeshBlocks) -> dict[str, int | float]:
    """Counts for the report."""
    labelled = sum(int((labels != VOID).sum()) for _, _, labels in mesh.vertices())
    share = round(labelled / max(mesh.vertex_count, 1), 4)
    return {"vertices": mesh.vertex_count, "faces": mesh.face_count, "labelled_share": share}
