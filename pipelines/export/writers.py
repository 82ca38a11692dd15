"""The files for other programs, each written from what the run ended with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import copy_file, write_text
from ...formats.colmap import ColmapModel, write_colmap_model
from ...formats.datasets.nerfstudio import write_transforms
from ...formats.gaussians import GaussianCloud
from ...formats.ply import write_gaussian_ply, write_point_ply
from ...formats.sog import write_sog
from ...formats.splats import write_gaussian_glb
from ...formats.spz import write_spz
from ...formats.trajectory import write_tum
from ..config import ExportConfig
from ..geometry.camera import rig_of
from ..geometry.sparse_model import SparseModel
from ..outcome import Outcome, map_cloud
from ..run.files import CLASSES, LEFT_OUT, METRES
from ..scene.world import WORLD, World
from ..system.parallel import LruSequence
from ..system.wording import stretches
from .readme import lengths, licences, readme

IMAGES, SPARSE = "images", "sparse/0"
"""Folders of a COLMAP data set by the names that trainers expect."""
START = f"{SPARSE}/points3D.ply"
_PART = 1 << 17
"""Gaussians of a part that is written at a time."""


def write_colmap(outcome: Outcome, folder: Path) -> list[Path]:
    """A data set as COLMAP, nerfstudio and the trainers of Gaussian splatting open it: `images/` with the frames whose
    place is known, `sparse/0` (binary and text, and the points as a PLY to start from), transforms.json, and `masks/`
    where frames have any."""
    trajectory, k = outcome.trajectory, outcome.calibration.intrinsics
    posed = np.flatnonzero(trajectory.is_placed)
    frame_of = {f.id: f for f in outcome.frames}
    frames = [frame_of[int(i)] for i in trajectory.frame_ids[posed]]
    names = tuple(f.name for f in frames)
    camera = (k.width, k.height, k.fx, k.fy, k.cx, k.cy)
    for frame in frames:
        copy_file(outcome.run.image_file(frame), folder / IMAGES / frame.name)
        if (left_out := outcome.run.left_out(frame)) is not None:
            LEFT_OUT.save(folder, left_out, frame.name)
        else:  # of an earlier export, before the frame was made without one
            LEFT_OUT.path(folder, frame.name).unlink(missing_ok=True)
    points = seen_points(outcome.load_sparse(), trajectory.frame_ids[posed])
    pinhole = ("PINHOLE", k.width, k.height, (k.fx, k.fy, k.cx, k.cy))
    model = ColmapModel(names, trajectory.cam_from_world[posed], (pinhole,), *points)
    write_colmap_model(folder / SPARSE, model)
    start = write_start(folder, points[0], points[1])
    paths = [f"{IMAGES}/{name}" for name in names]
    write_transforms(folder / "transforms.json", *camera, paths, trajectory.world_from_cam[posed], start)
    return [folder / SPARSE, folder / IMAGES, folder / "transforms.json"]


def write_start(folder: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> str | None:
    """The points (P, 3) that a splat begins with, as a PLY; its name in `folder`, None where there are none.

    It is where the original trainer looks for it and else writes it; others find it in transforms.json.
    """
    if len(points) == 0:
        return None
    write_point_ply(folder / START, points, colors)
    return START


def seen_points(
    model: SparseModel | None, image_ids: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """points, colors, and obs_image, obs_point, obs_xy of the points that at least two of the images see."""
    if model is None:
        none = np.zeros(0, np.int64)
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none, np.zeros((0, 2))
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


def write_ply(outcome: Outcome, sh_rest: bool, folder: Path) -> list[Path]:
    """The map as splat PLYs, in its own colours and in those of the classes; part by part, for a cloud takes more
    memory than the map it is of. The probabilities are in the first only."""
    starts, names = range(0, max(len(outcome.require_map()), 1), _PART), outcome.classes.names
    clouds = LruSequence(len(starts), lambda n: map_cloud(outcome, slice(starts[n], starts[n] + _PART)), len, 0)
    paths = [folder / n for n in ("point_cloud.ply", "point_cloud_semantic.ply")]
    write_gaussian_ply(paths[0], clouds, names, sh_degree=3 * sh_rest)
    by_class = clouds.changed(lambda _, cloud: _by_class(cloud, outcome))
    write_gaussian_ply(paths[1], by_class, names, sh_degree=3 * sh_rest)
    return paths


def write_splats(kind: str, outcome: Outcome, world: World, settings: ExportConfig, folder: Path) -> list[Path]:
    """Write the map's colours as point_cloud.spz, .sog or .glb, upright in viewers: SPZ defines the gravity direction,
    the others are turned as splat PLYs are.

    SPZ takes a tenth of the space of the PLY, SOG a fifteenth, and neither has room for classes; the last is glTF with
    KHR_gaussian_splatting. Without Gaussians there is an empty SPZ, and nothing of the others.
    """
    cloud, path = map_cloud(outcome), folder / f"point_cloud.{kind}"
    if kind == "spz":
        write_spz(path, _turned(cloud, world), settings.spz_version)
    elif len(cloud) == 0:
        return []
    elif kind == "sog":
        write_sog(path, _turned(cloud, world))
    else:
        write_gaussian_glb(path, _turned(cloud, world), outcome.classes.names)
    return [path]


def _turned(cloud: GaussianCloud, world: World) -> GaussianCloud:
    """The balls in the axes that splat formats take for theirs: x right, y down, z forward."""
    return replace(cloud, means=(cloud.means @ world.image_axes_from_exported.T).astype(np.float32))


def _by_class(cloud: GaussianCloud, outcome: Outcome) -> GaussianCloud:
    if cloud.class_ids is None:
        return cloud
    table = (np.array(outcome.classes.colors) / 255).astype(np.float32)
    return replace(cloud, colors=table[cloud.class_ids].astype(np.float32), class_probs=None)


def write_trajectory(outcome: Outcome, folder: Path) -> list[Path]:
    """The poses of all posed images of the source, where only frames have one of these, and of panoramas those of their
    middle; a comment names those that only turned."""
    t, note = outcome.every or outcome.trajectory, lengths(outcome.metres, outcome.metric)
    if t.by_rotation.any():
        note += f"\nTurned only, so put at their neighbours' positions: frames {stretches(t.frame_ids[t.by_rotation])}."
    posed = np.flatnonzero(t.is_posed)
    if outcome.every is None:
        posed = posed[t.frame_ids[posed] < rig_of(outcome.calibration.directions, len(outcome.frames)).stations]
    write_tum(folder / "trajectory.txt", t.timestamps[posed], t.world_from_cam[posed], note)
    return [folder / "trajectory.txt"]


def write_world(outcome: Outcome, world: World, folder: Path) -> Path:
    """world.json: what the coordinates of the other files mean."""
    return WORLD.save(folder, replace(world, unit="metre" if outcome.metric or world.earth else "free"))


def write_notes(outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """The class table, the world, how long its unit is, and what each file is for."""
    CLASSES.save(folder, outcome.classes)
    world_file, scale_file = write_world(outcome, world, folder), METRES.save(folder, outcome.metres)
    return [folder / "classes.json", world_file, scale_file, write_readme(outcome, world, folder)]


def write_readme(outcome: Outcome, world: World, folder: Path, only: str | None = None) -> Path:
    """README.txt: what each file is for, of all of them or of one of the `EXPORTS`."""
    text = readme(world, outcome.metres, outcome.metric, only)
    write_text(folder / "README.txt", text + licences([r.figures for r in outcome.records.values()], outcome.metres))
    return folder / "README.txt"
