"""The files for other programs, each written from a `Result`."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.atomic import atomic_path, write_text
from formats.colmap import write_colmap_model
from formats.compact_gaussians import write_compact
from formats.gaussian_ply import write_gaussian_ply
from formats.gaussians import GaussianCloud, isotropic_cloud
from formats.nerfstudio import write_transforms
from formats.trajectory import write_tum
from pipelines.export.readme import README
from pipelines.export.result import Result
from pipelines.run_folder import RunFolder, save_classes
from pipelines.types import SparseModel


def write_colmap(run: RunFolder, result: Result, folder: Path) -> list[Path]:
    """`sparse/0` (binary and text) and transforms.json, with the posed frames beside them in `frames/`."""
    trajectory, k = result.trajectory, result.calibration.intrinsics
    posed = np.flatnonzero(trajectory.is_posed)
    names = tuple(result.frames[int(trajectory.frame_ids[r])].name for r in posed)
    camera = (k.width, k.height, k.fx, k.fy, k.cx, k.cy)
    for name in names:
        place_image(run.stage("frames") / name, folder / "frames" / name)
    points = seen_points(result.sparse, trajectory.frame_ids[posed])
    write_colmap_model(folder / "sparse" / "0", *camera, names, trajectory.cam_from_world[posed], *points)
    paths = [f"frames/{name}" for name in names]
    write_transforms(folder / "transforms.json", *camera, paths, trajectory.world_from_cam[posed])
    return [folder / "sparse" / "0", folder / "frames", folder / "transforms.json"]


def seen_points(
    model: SparseModel, image_ids: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """points, colors, and obs_image, obs_point, obs_xy of the points that at least two of the images see."""
    row = {int(i): n for n, i in enumerate(image_ids)}
    image = np.array([row.get(int(i), -1) for i in model.frame_ids], dtype=np.int64)[model.obs_frame]
    kept = image >= 0
    views = np.bincount(model.obs_point[kept], minlength=len(model.points_in_world))
    used = views >= 2
    place = np.cumsum(used) - 1
    kept &= used[model.obs_point]
    return (
        model.points_in_world[used], model.colors[used], image[kept], place[model.obs_point[kept]], model.obs_xy[kept],
    )  # fmt: skip


def place_image(source: Path, target: Path) -> None:
    """A hard link where the disk allows it, else a copy."""
    if target.exists() and target.samefile(source):
        return
    with atomic_path(target) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def write_ply(result: Result, folder: Path) -> list[Path]:
    """The map as splat PLYs, in its own colours and in those of the classes, and as a compact file."""
    m, names = result.gaussian_map, result.classes.names
    cloud = isotropic_cloud(
        m.means.numpy(), m.log_radii.numpy(), m.opacity_logits.numpy(), m.colors.numpy(),
        result.class_probabilities if result.class_ids else None,
    )  # fmt: skip
    paths = [folder / n for n in ("point_cloud.ply", "point_cloud_semantic.ply", "point_cloud_compact.safetensors")]
    write_gaussian_ply(paths[0], cloud, names)
    write_gaussian_ply(paths[1], _by_class(cloud, result), names)
    write_compact(paths[2], cloud, names)
    return paths


def _by_class(cloud: GaussianCloud, result: Result) -> GaussianCloud:
    if cloud.class_ids is None:
        return cloud
    table = (np.array(result.classes.colors) / 255).astype(np.float32)
    return replace(cloud, colors=table[cloud.class_ids].astype(np.float32))


def write_trajectory(result: Result, folder: Path) -> list[Path]:
    """The poses of all posed frames."""
    posed = result.trajectory.is_posed
    write_tum(folder / "trajectory.txt", result.trajectory.timestamps[posed], result.trajectory.world_from_cam[posed])
    return [folder / "trajectory.txt"]


def write_notes(result: Result, folder: Path) -> list[Path]:
    """The class table and what each file is for."""
    save_classes(folder, result.classes)
    write_text(folder / "README.txt", README)
    return [folder / "classes.json", folder / "README.txt"]
