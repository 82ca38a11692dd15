"""The files for other programs, each written from a `Result`."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.atomic import atomic_path, write_text
from formats.colmap import write_colmap_model
from formats.compact_gaussians import write_compact
from formats.gaussian_ply import write_gaussian_ply
from formats.gaussians import GaussianCloud, isotropic_cloud
from formats.trajectory import write_tum
from pipelines.export.result import Result
from pipelines.run_folder import RunFolder, save_classes

README = """Made by msgs-slam. World axes are those of the first camera: x right, y down, z forward; {unit}.

sparse/0, frames/         COLMAP model (binary and text, one PINHOLE camera) and its images: splatting trainers and
                          other COLMAP programs take this folder as it is
point_cloud.ply           the Gaussian map in the layout of the original 3D Gaussian splatting, with class_id and
                          class_prob_* after it: any splat viewer
point_cloud_semantic.ply  the same, coloured by class
map_compact.safetensors   the same in a few megabytes: quantised, the most probable classes only
mesh.ply, mesh.glb        triangles with a colour and a class label a vertex: MeshLab, Blender, any glTF viewer
trajectory.txt            camera poses, `timestamp tx ty tz qx qy qz qw` (TUM), seconds in the source: evo
classes.json              number, name and colour of every class; 255 = none
"""


def write_colmap(run: RunFolder, result: Result, folder: Path) -> list[Path]:
    """`sparse/0` and `frames/` beside it."""
    trajectory, sparse, k = result.trajectory, result.sparse, result.calibration.intrinsics
    posed = np.flatnonzero(trajectory.is_posed)
    row = {int(trajectory.frame_ids[r]): n for n, r in enumerate(posed)}
    names = tuple(result.frames[int(trajectory.frame_ids[r])].name for r in posed)
    image_of = np.array([row.get(int(i), -1) for i in sparse.frame_ids], dtype=np.int64)
    seen = image_of[sparse.obs_frame] >= 0
    write_colmap_model(
        folder / "sparse" / "0", k.width, k.height, k.fx, k.fy, k.cx, k.cy, names, trajectory.cam_from_world[posed],
        sparse.points_in_world, sparse.colors, image_of[sparse.obs_frame][seen], sparse.obs_point[seen],
        sparse.obs_xy[seen],
    )  # fmt: skip
    for name in names:
        place_image(run.stage("frames") / name, folder / "frames" / name)
    return [folder / "sparse" / "0", folder / "frames"]


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
    paths = [folder / n for n in ("point_cloud.ply", "point_cloud_semantic.ply", "map_compact.safetensors")]
    write_gaussian_ply(paths[0], cloud, names)
    write_gaussian_ply(paths[1], _by_class(cloud, result), names)
    write_compact(paths[2], cloud, names)
    return paths


def _by_class(cloud: GaussianCloud, result: Result) -> GaussianCloud:
    if cloud.class_ids is None:
        return cloud
    table = np.array(result.classes.colors, np.float32) / 255
    return replace(cloud, colors=table[cloud.class_ids])


def write_trajectory(result: Result, folder: Path) -> list[Path]:
    """The poses of all posed frames."""
    posed = result.trajectory.is_posed
    write_tum(folder / "trajectory.txt", result.trajectory.timestamps[posed], result.trajectory.world_from_cam[posed])
    return [folder / "trajectory.txt"]


def write_notes(result: Result, metric: bool, folder: Path) -> list[Path]:
    """The class table and what each file is for."""
    save_classes(folder, result.classes)
    unit = "lengths in metres" if metric else "the unit of length is arbitrary (monocular, no metric depth)"
    write_text(folder / "README.txt", README.format(unit=unit))
    return [folder / "classes.json", folder / "README.txt"]
