"""The files for other programs, each written from what the run ended with."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.atomic import write_text
from ...formats.colmap import ColmapModel, write_colmap_model
from ...formats.datasets.nerfstudio import write_transforms
from ...formats.gaussians import GaussianCloud
from ...formats.glb import write_gaussian_glb
from ...formats.mesh import has_texture
from ...formats.ply import write_gaussian_ply, write_point_ply
from ...formats.sog import write_sog
from ...formats.spz import write_spz
from ...formats.trajectory import write_tum
from ..geometry.camera import rig_of
from ..geometry.se3 import Similarity
from ..geometry.sparse_model import FrameObservations, SparseModel
from ..outcome import Outcome, map_cloud
from ..render.gaussian_map import GaussianMap
from ..run.files import CLASSES, METRES
from ..scene.world import WORLD, World
from ..system.parallel import LruSequence
from ..system.progress import log
from ..system.wording import stretches
from ..types import Intrinsics
from .images import IMAGES, write_images, write_masks
from .readme import Facts, lengths, licences, readme

SPARSE = "sparse/0"
"""The folder of a COLMAP model by the name that trainers expect."""
START = f"{SPARSE}/points3D.ply"
_START_POINTS = 50_000
"""Points to start a splat from: what COLMAP gives for a few hundred images."""
_MAX_ERROR_PX = 4.0
"""Reprojection error above which COLMAP drops an observation by default."""
_PART = 1 << 17
"""Gaussians of a part that is written at a time."""


def write_colmap(
    outcome: Outcome, world: World, image_side: int, folder: Path, warn: Callable[[str], None] = log.warning
) -> list[Path]:
    """A data set as COLMAP, nerfstudio and the trainers of Gaussian splatting open it: `images/` with the frames whose
    place is known (see `write_images`), `sparse/0` (binary and text, and the points as a PLY to start from),
    transforms.json, and `masks/` where frames have any. It has the axes of splat files, as the PLYs of the map: what is
    trained from it stands as the map does."""
    turn = Similarity(1.0, world.image_axes_from_exported, np.zeros(3))
    trajectory, small = outcome.trajectory.moved(turn.apply_to_poses), outcome.calibration.intrinsics
    posed = np.flatnonzero(trajectory.is_placed)
    frame_of = {f.id: f for f in outcome.frames}
    frames = [frame_of[int(i)] for i in trajectory.frame_ids[posed]]
    names = tuple(f.name for f in frames)
    k = write_images(outcome, frames, image_side, folder, warn)
    masks = write_masks(outcome, frames, k, folder)
    camera = (k.width, k.height, k.fx, k.fy, k.cx, k.cy)
    points, colors, obs_image, obs_point, obs_xy = start_points(outcome, posed)
    points, obs_xy = turn.apply(points), obs_xy * [k.width / small.width, k.height / small.height]
    pinhole = ("PINHOLE", k.width, k.height, camera[2:])
    model = ColmapModel(
        names, trajectory.cam_from_world[posed], (pinhole,), points, colors, obs_image, obs_point, obs_xy
    )
    write_colmap_model(folder / SPARSE, model)
    start = write_start(folder, points, colors)
    paths = [f"{IMAGES}/{name}" for name in names]
    write_transforms(folder / "transforms.json", *camera, paths, trajectory.world_from_cam[posed], start, masks)
    return [folder / SPARSE, folder / IMAGES, folder / "transforms.json"]


def write_start(folder: Path, points: NDArray[np.float64], colors: NDArray[np.uint8]) -> str | None:
    """The points (P, 3) that a splat begins with, as a PLY; its name in `folder`, None where there are none.

    It is where the original trainer looks for it and else writes it; others find it in transforms.json.
    """
    if len(points) == 0:
        return None
    write_point_ply(folder / START, points, colors)
    return START


def start_points(
    outcome: Outcome, rows: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return, as `seen_points`, what a splat of the frames in these rows of the trajectory begins with: the
    triangulated points that at least two of them see, with all observations, then a sample of the map, without any."""
    t, sparse = outcome.trajectory, outcome.load_sparse()
    others = None if sparse is None else outcome.load_observations(sparse)
    camera = outcome.calibration.intrinsics
    points, colors, image, point, xy = seen_points(sparse, t.frame_ids[rows], camera, t.cam_from_world[rows], others)
    if outcome.gaussian_map is not None:
        means, shades = map_sample(outcome.gaussian_map, _START_POINTS - len(points))
        points, colors = np.concatenate([points, means]), np.concatenate([colors, shades])
    return points, colors, image, point, xy


def seen_points(
    model: SparseModel | None,
    image_ids: NDArray[np.int64],
    camera: Intrinsics,
    cam_from_world: NDArray[np.float64],
    others: FrameObservations | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return points (P, 3), colors (P, 3), and obs_image, obs_point (O,), obs_xy (O, 2) of the points that at least two
    of the images (N,), posed by cam_from_world (N, 4, 4), see.

    Of `others`, the observations of images that are no keyframes, those stay that agree with the poses.
    """
    if model is None:
        none = np.zeros(0, np.int64)
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), none, none, np.zeros((0, 2))
    row = {int(i): n for n, i in enumerate(image_ids)}
    image = np.array([row.get(int(i), -1) for i in model.frame_ids], dtype=np.int64)[model.obs_frame]
    point, xy = model.obs_point, model.obs_xy
    if others is not None:
        more = others.agreeing(model.points_in_world, row, camera, cam_from_world, _MAX_ERROR_PX)
        image, point, xy = (np.concatenate(both) for both in zip((image, point, xy), more, strict=True))
    kept = image >= 0
    used = np.bincount(point[kept], minlength=len(model.points_in_world)) >= 2
    place = np.cumsum(used) - 1
    kept &= used[point]
    return model.points_in_world[used], model.colors[used], image[kept], place[point[kept]], xy[kept]


def map_sample(gaussian_map: GaussianMap, count: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return centres (P, 3) and colours (P, 3) of at most `count` of the Gaussians that are more opaque than not,
    evenly spread over the map in its order."""
    opaque = np.flatnonzero(gaussian_map.opacity_logits.cpu().numpy() > 0)
    spread = np.linspace(0, len(opaque) - 1, max(min(count, len(opaque)), 0)).round().astype(np.int64)
    picked = gaussian_map.only(torch.from_numpy(opaque[spread]))
    colors = np.round(255 * picked.colors.cpu().numpy().clip(0, 1)).astype(np.uint8)
    return picked.means.cpu().numpy().astype(np.float64), colors


def write_ply(outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """The map as splat PLYs, upright in viewers of these, in its own colours and in those of the classes; part by part,
    for a cloud takes more memory than the map it is of. The probabilities are in the first only."""
    starts, names = range(0, max(len(outcome.require_map()), 1), _PART), outcome.classes.names

    def part(number: int) -> GaussianCloud:
        return _turned(map_cloud(outcome, slice(starts[number], starts[number] + _PART)), world)

    clouds = LruSequence(len(starts), part, len, 0)
    paths = [folder / n for n in ("point_cloud.ply", "point_cloud_semantic.ply")]
    write_gaussian_ply(paths[0], clouds, names)
    by_class = clouds.changed(lambda _, cloud: _by_class(cloud, outcome))
    write_gaussian_ply(paths[1], by_class, names)
    return paths


def write_splats(kind: str, outcome: Outcome, world: World, folder: Path) -> list[Path]:
    """Write the map's colours as point_cloud.spz, .sog or .glb, upright in viewers: SPZ defines the gravity direction,
    the others are turned as splat PLYs are.

    SPZ takes a tenth of the space of the PLY, SOG a fifteenth, and neither has room for classes; the last is glTF with
    KHR_gaussian_splatting. Without Gaussians there is an empty SPZ, and nothing of the others.
    """
    cloud, path = map_cloud(outcome), folder / f"point_cloud.{kind}"
    if kind == "spz":
        write_spz(path, _turned(cloud, world))
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
    """The class table, the world, and how long its unit is."""
    CLASSES.save(folder, outcome.classes)
    return [folder / "classes.json", write_world(outcome, world, folder), METRES.save(folder, outcome.metres)]


def files_in(folder: Path) -> dict[str, Path]:
    """Relative path, with slashes → path of the files below a folder."""
    return {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}


def write_readme(outcome: Outcome, world: World, folder: Path, files: Mapping[str, Path]) -> Path:
    """README.txt: what each of the files is for, by their names in the folder of the export."""
    facts = Facts(
        textured="mesh.glb" in files and has_texture(files["mesh.glb"]), every_image=outcome.every is not None
    )
    text = readme(world, outcome.metres, outcome.metric, files, facts)
    write_text(folder / "README.txt", text + licences([r.figures for r in outcome.records.values()], outcome.metres))
    return folder / "README.txt"
