"""The labelled mesh: rendered median depth of the keyframes, fused, extracted, painted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.mesh import write_mesh_glb, write_mesh_ply
from pipelines.config import ExportConfig
from pipelines.depth.posed import PosedDepth
from pipelines.export.depth_views import DrawnView, drawn_view
from pipelines.export.paint import paint
from pipelines.export.surface import extract_surface, without_floaters
from pipelines.export.volume import fuse
from pipelines.gaussians.render import get_threads
from pipelines.outcome import Outcome, evenly
from pipelines.progress import Progress
from pipelines.types import VOID, SemanticMesh

TRUNCATION = 4.0
"""Voxels on either side of a surface that a depth speaks for."""
LEAST_WEIGHT = 1.5
"""A voxel seen with less weight, in views at the median depth, has no surface."""
_LEAST_PIECE = 0.01
"""Connected pieces smaller than this share of the largest one are floaters."""


def keyframe_rows(outcome: Outcome, settings: ExportConfig) -> list[int]:
    """The rows of the trajectory whose views the mesh is made from."""
    return evenly(np.flatnonzero(outcome.trajectory.is_keyframe).tolist(), settings.max_views)


def drawn_views(outcome: Outcome, settings: ExportConfig, progress: Progress) -> list[DrawnView]:
    """What the map shows in each of the `keyframe_rows`."""
    rows, gaussian_map = keyframe_rows(outcome, settings), outcome.require_map()
    camera = outcome.calibration.intrinsics.at_most(settings.mesh_side)
    poses = outcome.trajectory.cam_from_world
    return [drawn_view(gaussian_map, poses[r], camera) for r in progress.track(rows, "drawing", len(rows))]


def make_mesh(outcome: Outcome, views: Sequence[DrawnView], settings: ExportConfig, progress: Progress) -> SemanticMesh:
    """The surface of the map as the keyframes see it; without a vertex where nothing is seen twice."""
    shown = [view.shown for view in views]
    voxel = settings.voxel * _median_depth(shown)
    volume = fuse(shown, voxel, TRUNCATION, settings.max_blocks, get_threads())
    least = LEAST_WEIGHT if len(views) >= 4 else 0.5
    vertices, faces = without_floaters(*extract_surface(volume, least), _LEAST_PIECE)
    painting = progress.track(views, "painting", len(views))
    colors, labels = paint(vertices, painting, tuple(outcome.label_of_channel.tolist()), 2 * volume.truncation)
    return SemanticMesh(vertices, faces, colors, labels)


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
    seen = np.concatenate([v.depth[v.trust > 0][::16] for v in views])
    return float(np.median(seen)) if len(seen) else 1.0


def mesh_figures(mesh: SemanticMesh) -> dict[str, int | float]:
    """Counts for the report."""
    labelled = float((mesh.labels != VOID).mean()) if len(mesh.labels) else 0.0
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "labelled_share": round(labelled, 4)}
