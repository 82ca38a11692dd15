"""Stage 6: write what the run found as files that other programs open."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from formats.colmap import write_colmap_model
from formats.compact_gaussians import write_compact
from formats.errors import InputError
from formats.gaussian_ply import write_gaussian_ply
from formats.gaussians import GaussianCloud, isotropic_cloud
from formats.mesh import write_mesh_glb, write_mesh_ply
from formats.nerfstudio import write_transforms
from formats.trajectory import write_tum
from pipelines.evaluation.outcome import Outcome, load_outcome
from pipelines.evaluation.views import view_map
from pipelines.export.mesh import SurfaceView, fuse_mesh
from pipelines.export.readme import README
from pipelines.gaussians.map import GaussianMap
from pipelines.mapping.views import working_size
from pipelines.progress import Progress, SilentProgress
from pipelines.run_folder import RunFolder, save_classes, write_json
from pipelines.run_folder_names import EXPORTS
from pipelines.stages import Stage, StageContext
from pipelines.types import SemanticMesh


def run(context: StageContext) -> dict[str, Any]:
    """Poses, map and mesh, each in the formats of the programs people use."""
    outcome = load_outcome(context.run)
    export_colmap(outcome, context.folder)
    export_tum(outcome, context.folder)
    megabytes = export_ply(outcome, context.folder)
    mesh = export_mesh(outcome, context.folder, context.progress)
    if not len(mesh.faces):
        context.warn("the mesh is empty: no view of the map shows a closed surface")
    save_classes(context.folder, outcome.classes)
    (context.folder / "README.txt").write_text(README, encoding="utf-8")
    return {
        "images": int(outcome.trajectory.is_posed.sum()),
        "point_cloud_mb": megabytes,
        "mesh_vertices": len(mesh.vertices),
        "mesh_faces": len(mesh.faces),
        "unit": "metre" if outcome.metric else "free",
    }


def export_run(run_folder: RunFolder, folder: Path, only: str | None, progress: Progress | None = None) -> list[Path]:
    """Write one kind of export ("colmap", "ply", "mesh", "tum"), or all, into `folder`; returns what was written.

    Raises InputError when the run has not come far enough.
    """
    if only is not None and only not in EXPORTS:
        raise InputError(f"--only {only}: expected one of {', '.join(EXPORTS)}")
    outcome = load_outcome(run_folder)
    if outcome.gaussian_map is None and only in (None, "ply", "mesh"):
        raise InputError(
            f"{run_folder.root}: there is no map yet. Type `msgs-slam resume {run_folder.root}`, or export only the "
            "poses: --only colmap"
        )
    folder.mkdir(parents=True, exist_ok=True)
    makers: dict[str, Callable[[], object]] = {
        "colmap": lambda: export_colmap(outcome, folder),
        "tum": lambda: export_tum(outcome, folder),
        "ply": lambda: export_ply(outcome, folder),
        "mesh": lambda: export_mesh(outcome, folder, progress or SilentProgress()),
    }
    for kind in makers if only is None else (only,):
        makers[kind]()
    save_classes(folder, outcome.classes)
    return sorted(p for p in folder.iterdir())


def export_colmap(outcome: Outcome, folder: Path) -> None:
    """sparse/0 (binary and text) and transforms.json, with the posed frames beside them in frames/."""
    trajectory, k = outcome.trajectory, outcome.calibration.intrinsics
    model = outcome.run.load_sparse("global_ba" if outcome.pose_stage == "global_ba" else "tracking")
    posed = np.flatnonzero(trajectory.is_posed)
    name_of = {f.id: f.name for f in outcome.frames}
    names = [name_of[int(i)] for i in trajectory.frame_ids[posed]]
    row_of = {int(trajectory.frame_ids[row]): n for n, row in enumerate(posed)}
    rows = np.array([row_of.get(int(i), -1) for i in model.frame_ids], dtype=np.int64)[model.obs_frame]
    poses = trajectory.cam_from_world[posed]
    keep = rows >= 0
    points, colors, rows, point, xy = _seen_points(model, rows[keep], keep)
    target = folder / "sparse" / "0"
    write_colmap_model(
        target, k.width, k.height, k.fx, k.fy, k.cx, k.cy, names, poses, points, colors, rows, point, xy
    )  # fmt: skip
    for name in names:
        _link(outcome.run.stage("frames") / name, folder / "frames" / name)
    paths = [f"frames/{name}" for name in names]
    write_transforms(
        folder / "transforms.json", k.width, k.height, k.fx, k.fy, k.cx, k.cy, paths, trajectory.world_from_cam[posed]
    )


def _seen_points(model: Any, rows: NDArray[np.int64], keep: NDArray[np.bool_]) -> tuple[NDArray, ...]:
    """Points that at least two kept images see, renumbered, with their observations."""
    point, xy = model.obs_point[keep], model.obs_xy[keep]
    counts = np.bincount(point, minlength=len(model.points_in_world))
    used = np.flatnonzero(counts >= 2)
    place = np.full(len(counts), -1, dtype=np.int64)
    place[used] = np.arange(len(used))
    good = place[point] >= 0
    return model.points_in_world[used], model.colors[used], rows[good], place[point[good]], xy[good]


def _link(source: Path, target: Path) -> None:
    """A hard link where the file system has them (the frames are the bulk of a run), else a copy."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def export_tum(outcome: Outcome, folder: Path) -> None:
    """trajectory.txt: one line a posed frame, at its time in the source."""
    posed = outcome.trajectory.is_posed
    write_tum(folder / "trajectory.txt", outcome.trajectory.timestamps[posed], outcome.trajectory.world_from_cam[posed])


def export_ply(outcome: Outcome, folder: Path) -> float:
    """point_cloud.ply, the same coloured by class, and the compact file; returns the compact file's size in MB."""
    gaussian_map = _require_map(outcome)
    cloud = gaussian_cloud(gaussian_map, outcome.label_of_channel, len(outcome.classes))
    names = outcome.classes.names
    write_gaussian_ply(folder / "point_cloud.ply", cloud, names)
    palette = (np.array([*outcome.classes.colors, (128, 128, 128)]) / 255).astype(np.float32)
    ids = cloud.class_ids if cloud.class_ids is not None else np.full(len(cloud), len(names))
    by_class = GaussianCloud(
        cloud.means, cloud.log_scales, cloud.quat_wxyz, cloud.opacity_logits,
        palette[np.minimum(ids, len(names))], cloud.class_ids, cloud.class_probs,
    )  # fmt: skip
    write_gaussian_ply(folder / "point_cloud_semantic.ply", by_class, names)
    compact = folder / "point_cloud_compact.safetensors"
    write_compact(compact, cloud, names)
    return round(compact.stat().st_size / 1e6, 2)


def gaussian_cloud(gaussian_map: GaussianMap, label_of_channel: NDArray[np.uint8], class_count: int) -> GaussianCloud:
    """The map as plain arrays, its channels spread over the run's class table."""
    probabilities = np.zeros((len(gaussian_map), class_count), np.float32)
    if gaussian_map.class_logits.shape[1]:
        probabilities[:, label_of_channel] = torch.softmax(gaussian_map.class_logits, dim=1).cpu().numpy()
    m = {name: getattr(gaussian_map, name).cpu().numpy() for name in ("means", "log_radii", "opacity_logits", "colors")}
    return isotropic_cloud(**m, class_probs=probabilities if class_count else None)


def export_mesh(outcome: Outcome, folder: Path, progress: Progress) -> SemanticMesh:
    """mesh.ply and mesh.glb."""
    gaussian_map = _require_map(outcome)
    intrinsics = working_size(outcome.calibration.intrinsics, outcome.config.mapping.max_side)
    poses = outcome.trajectory.cam_from_world[outcome.trajectory.is_keyframe]

    def draw(number: int) -> SurfaceView:
        view = view_map(gaussian_map, outcome.label_of_channel, intrinsics, poses[number])
        return SurfaceView(poses[number], view.depth, view.exposed(None, 0.0), view.labels, view.coverage)

    mesh = fuse_mesh(draw, len(poses), intrinsics, len(outcome.classes), outcome.config.export, progress)
    for write, name in ((write_mesh_ply, "mesh.ply"), (write_mesh_glb, "mesh.glb")):
        write(folder / name, mesh.vertices, mesh.faces, mesh.colors, mesh.labels, outcome.classes.names)
    write_json(folder / "mesh.json", {"vertices": len(mesh.vertices), "faces": len(mesh.faces)})
    return mesh


def _require_map(outcome: Outcome) -> GaussianMap:
    if outcome.gaussian_map is None:
        raise InputError(f"{outcome.run.root}: there is no map yet. Type `msgs-slam resume {outcome.run.root}`")
    return outcome.gaussian_map


STAGE = Stage("export", 1, run, "files for other programs")
