"""The labelled mesh: rendered median depth of the keyframes, fused, extracted, painted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from formats.mesh import write_mesh_glb, write_mesh_ply
from pipelines.config import ExportConfig
from pipelines.depth.posed import PosedDepth
from pipelines.export.depth_views import depth_view
from pipelines.export.paint import PaintedView, paint
from pipelines.export.surface import extract_surface, without_floaters
from pipelines.export.volume import fuse
from pipelines.gaussian_map import GaussianMap, decided_channels
from pipelines.gaussians.render import get_threads, render
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


def depth_views(outcome: Outcome, settings: ExportConfig, progress: Progress) -> list[PosedDepth]:
    """What the map shows as depth in each of the `keyframe_rows`."""
    rows, gaussian_map = keyframe_rows(outcome, settings), outcome.require_map()
    camera = outcome.calibration.intrinsics.at_most(settings.mesh_side)
    poses = outcome.trajectory.cam_from_world
    return [depth_view(gaussian_map, poses[r], camera) for r in progress.track(rows, "depth views", len(rows))]


def make_mesh(outcome: Outcome, views: list[PosedDepth], settings: ExportConfig, progress: Progress) -> SemanticMesh:
    """The surface of the map as the keyframes see it; without a vertex where nothing is seen twice."""
    gaussian_map = outcome.require_map()
    voxel = settings.voxel * _median_depth(views)
    volume = fuse(views, voxel, TRUNCATION, settings.max_blocks, get_threads())
    least = LEAST_WEIGHT if len(views) >= 4 else 0.5
    vertices, faces = without_floaters(*extract_surface(volume, least), _LEAST_PIECE)
    painted = progress.track(_painted(gaussian_map, views), "painting", len(views))
    colors, labels = paint(vertices, painted, tuple(outcome.label_of_channel.tolist()), 2 * volume.truncation)
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


@torch.no_grad()
def _painted(gaussian_map: GaussianMap, views: Sequence[PosedDepth]) -> Iterator[PaintedView]:
    m = gaussian_map
    features = torch.cat([m.colors, m.class_logits], dim=1)
    for view in views:
        pose = torch.as_tensor(view.cam_from_world, device=m.means.device)
        shown = render(m.means, m.radii, m.opacities, features, pose, view.intrinsics).features
        channels = decided_channels(shown[..., 3:]).cpu().numpy() if shown.shape[-1] > 3 else None
        yield PaintedView(view, shown[..., :3].cpu().numpy(), channels)


def mesh_figures(mesh: SemanticMesh) -> dict[str, int | float]:
    """Counts for the report."""
    labelled = float((mesh.labels != VOID).mean()) if len(mesh.labels) else 0.0
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "labelled_share": round(labelled, 4)}
