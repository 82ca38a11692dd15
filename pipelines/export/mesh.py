"""The labelled mesh: rendered median depth of the keyframes, fused, extracted, painted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.mesh import write_mesh_glb, write_mesh_ply
from pipelines.config import ExportConfig
from pipelines.depth.posed import PosedDepth
from pipelines.export.depth_views import DrawnView, Shown, ViewsOnDisk, drawn_view
from pipelines.export.paint import paint
from pipelines.export.surface import EMPTY, Surface, extract_surface, join_faces, without_floaters
from pipelines.export.volume import Grid, fuse, make_grid
from pipelines.gaussians.render import get_threads
from pipelines.outcome import Outcome
from pipelines.progress import Progress
from pipelines.streamed import Streamed
from pipelines.types import VOID, SemanticMesh

TRUNCATION = 4.0
"""Voxels on either side of a surface that a depth speaks for."""
LEAST_WEIGHT = 1.5
"""A voxel seen with less weight, in views at the median depth, has no surface."""
LONG = 200
"""Keyframes of a recording for which `export.max_blocks` is meant; a longer one may have more by its length."""
_KEPT_BYTES = 200e6
_LEAST_PIECE = 0.01
"""Connected pieces smaller than this share of the largest one are floaters."""


def keyframe_rows(outcome: Outcome) -> list[int]:
    """The rows of the trajectory whose views the mesh is made from."""
    return np.flatnonzero(outcome.trajectory.is_keyframe).tolist()


def draw(outcome: Outcome, settings: ExportConfig, number: int) -> DrawnView:
    """What the map shows in one of the `keyframe_rows`."""
    pose = outcome.trajectory.cam_from_world[keyframe_rows(outcome)[number]]
    return drawn_view(outcome.require_map(), pose, outcome.calibration.intrinsics.at_most(settings.mesh_side))


def drawn_views(outcome: Outcome, settings: ExportConfig, progress: Progress, folder: Path) -> Sequence[DrawnView]:
    """What the map shows in each of the `keyframe_rows`, on disk in `folder` but for those used last."""
    drawn, count = ViewsOnDisk(folder), len(keyframe_rows(outcome))
    for number in progress.track(range(count), "drawing", count):
        drawn.append(draw(outcome, settings, number))
    return streamed_views(count, drawn.load)


def streamed_views(count: int, load: Callable[[int], DrawnView]) -> Sequence[DrawnView]:
    """Those used last are kept."""
    return Streamed(count, load, lambda view: view.size, _KEPT_BYTES)


@dataclass(frozen=True)
class Region:
    """A part of the mesh, with colors (V, 3) uint8 and labels (V,) uint8 of its vertices."""

    surface: Surface
    colors: NDArray[np.uint8]
    labels: NDArray[np.uint8]


_NO_REGION = Region(EMPTY, np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8))


def make_mesh(
    outcome: Outcome,
    views: Sequence[DrawnView],
    settings: ExportConfig,
    progress: Progress,
    regions_of: Callable[[Grid], list[Region]] | None = None,
) -> SemanticMesh:
    """The surface of the map as the keyframes see it, a region of the grid after the other (or as `regions_of` makes
    them); without a vertex where nothing is seen twice."""
    shown = Shown(views)
    most = int(settings.max_blocks * max(len(views) / LONG, 1))
    grid = make_grid(shown, settings.voxel * _median_depth(shown), TRUNCATION, most)
    parts = list(grid.regions())
    regions = [_NO_REGION]
    if regions_of is not None:
        regions += regions_of(grid)
    else:
        for number, chunks in enumerate(parts, 1):
            of = f", {number} of {len(parts)}" if len(parts) > 1 else ""
            regions.append(make_region(outcome, views, grid, chunks, progress, of))
    surfaces = [region.surface for region in regions]
    vertices = np.concatenate([surface.vertices for surface in surfaces])
    joined = join_faces(surfaces)
    colors, labels = (np.concatenate([getattr(r, name) for r in regions]) for name in ("colors", "labels"))
    del surfaces, regions  # of a building, a gigabyte
    rows, faces = without_floaters(joined, len(vertices), _LEAST_PIECE)
    return SemanticMesh(vertices[rows], faces, colors[rows], labels[rows])


def make_region(
    outcome: Outcome,
    views: Sequence[DrawnView],
    grid: Grid,
    chunks: NDArray[np.int32],
    progress: Progress,
    of: str = "",
) -> Region:
    """One of the regions of the grid, from the views that see it; `of` tells progress which."""
    near = grid.views_of(chunks)
    least, class_ids = LEAST_WEIGHT if len(views) >= 4 else 0.5, tuple(outcome.label_of_channel.tolist())
    fusing = (views[n].shown for n in progress.track(near, "fusing" + of, len(near)))
    surface = extract_surface(fuse(grid, chunks, fusing, get_threads()), chunks, least)
    painting = (views[n] for n in progress.track(near, "painting" + of, len(near)))
    return Region(surface, *paint(surface.vertices, painting, class_ids, 2 * grid.truncation))


def write_mesh(
    mesh: SemanticMesh, class_names: tuple[str, ...], folder: Path, gltf_from_world: NDArray[np.float64]
) -> list[Path]:
    """mesh.ply and, where there is a triangle at all, mesh.glb in axes that gltf_from_world (3, 3) turns to."""
    arrays = (mesh.faces, mesh.colors, mesh.labels, class_names)
    write_mesh_ply(folder / "mesh.ply", mesh.vertices, *arrays)
    if len(mesh.faces) == 0:
        return [folder / "mesh.ply"]
    write_mesh_glb(folder / "mesh.glb", (mesh.vertices @ gltf_from_world.T).astype(np.float32), *arrays)
    return [folder / "mesh.ply", folder / "mesh.glb"]


def _median_depth(views: Sequence[PosedDepth]) -> float:
    step = 16 * -(-len(views) // LONG)
    seen = np.concatenate([v.depth[v.trust > 0][::step] for v in views])
    return float(np.median(seen)) if len(seen) else 1.0


def mesh_figures(mesh: SemanticMesh) -> dict[str, int | float]:
    """Counts for the report."""
    labelled = float((mesh.labels != VOID).mean()) if len(mesh.labels) else 0.0
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "labelled_share": round(labelled, 4)}
