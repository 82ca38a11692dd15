"""A data set as COLMAP, nerfstudio and the trainers of Gaussian splatting open it, and the poses as a TUM file.

Structure from motion works on smaller images than trainers want: `images/` is read again from the source.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ...formats.colmap import ColmapModel, write_colmap_model
from ...formats.datasets.nerfstudio import write_transforms
from ...formats.datasets.sequence import Camera
from ...formats.errors import InputError
from ...formats.images import write_rgb
from ...formats.ply import write_point_ply
from ...formats.trajectory import write_tum
from ...formats.video import VideoFrame
from ..geometry.camera import rig_of
from ..geometry.se3 import Similarity
from ..geometry.sparse_model import FrameObservations, SparseModel
from ..render.gaussian_map import GaussianMap
from ..run.files import LEFT_OUT
from ..run.outcome import Outcome
from ..run.target import Target
from ..sfm.lens import Lens, distorted_camera, make_lens, to_pycolmap
from ..source.picking import reduce_image, reduced_size
from ..source.recording import Recording, open_recording
from ..system.parallel import parallel_map
from ..system.threads import get_threads
from ..types import Frame, Intrinsics
from .kinds import IMAGES
from .scene import ExportScene, lengths

SPARSE = "sparse/0"
"""The folder of a COLMAP model by the name that trainers expect."""
START = f"{SPARSE}/points3D.ply"
"""The points that a splat begins with, where the original trainer looks for them; others find it in transforms.json."""
_START_POINTS = 50_000
"""Points to start a splat from: what COLMAP gives for a few hundred images."""
_MAX_ERROR_PX = 4.0
"""Reprojection error above which COLMAP drops an observation by default."""
_MOST_DIFFERENT = 8.0
"""Mean difference in grey levels between a frame and the image of the source that it was made from."""

Points = tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]
"""points (P, 3), colors (P, 3); and of their observations obs_image, obs_point (O,), obs_xy (O, 2)."""


def posed_frames(outcome: Outcome) -> list[Frame]:
    """Return the posed frames, in the order of the trajectory."""
    frame_of, trajectory = {f.id: f for f in outcome.frames}, outcome.trajectory
    return [frame_of[int(i)] for i in trajectory.frame_ids[trajectory.is_posed]]


def write_colmap(scene: ExportScene, target: Target) -> None:
    """Write `images/` with the posed frames, `sparse/0` (binary and text, and the points as a PLY to
    start from), transforms.json, and `masks/` where frames have any."""
    write_data_set(scene, target)


def write_data_set(scene: ExportScene, target: Target, depths: Sequence[str] = ()) -> None:
    """Write what `write_colmap` does, with the names of the frames' `depths` in transforms.json.

    It has the axes of splat files, as the PLYs of the map: what is trained from it stands as the map does.
    """
    outcome, turn = scene.outcome, Similarity(1.0, scene.world.image_axes_from_exported, np.zeros(3))
    trajectory, small = outcome.trajectory.moved(turn.apply_to_poses), outcome.calibration.intrinsics
    posed = np.flatnonzero(trajectory.is_posed)
    frames = posed_frames(outcome)
    names = tuple(f.name for f in frames)
    model_folder = target.path(SPARSE)
    k = _write_images(scene, frames, target.path(IMAGES))
    masks = _write_masks(outcome, frames, k, target)
    camera = (k.width, k.height, k.fx, k.fy, k.cx, k.cy)
    points, colors, obs_image, obs_point, obs_xy = start_points(outcome, posed)
    points, obs_xy = turn.apply(points), obs_xy * [k.width / small.width, k.height / small.height]
    pinhole = ("PINHOLE", k.width, k.height, camera[2:])
    model = ColmapModel(
        names, trajectory.cam_from_world[posed], (pinhole,), points, colors, obs_image, obs_point, obs_xy
    )
    write_colmap_model(model_folder, model)
    start = START if len(points) else None
    if start:
        write_point_ply(target.folder / start, points, colors)
    paths, transforms = [f"{IMAGES}/{name}" for name in names], target.path("transforms.json")
    write_transforms(transforms, Camera(*camera), paths, trajectory.world_from_cam[posed], start, masks, depths)


def write_trajectory(scene: ExportScene, target: Target) -> None:
    """Write the poses of all posed images of the source, where only frames have one of these, and of panoramas those of
    their middle."""
    outcome = scene.outcome
    t, note = outcome.every or outcome.trajectory, lengths(outcome.metres, outcome.metric)
    posed = np.flatnonzero(t.is_posed)
    if outcome.every is None:
        posed = posed[t.frame_ids[posed] < rig_of(outcome.calibration.directions, len(outcome.frames)).stations]
    write_tum(target.path("trajectory.txt"), t.timestamps[posed], t.world_from_cam[posed], note)


def start_points(outcome: Outcome, rows: NDArray[np.int64]) -> Points:
    """Return what a splat of the frames in these rows of the trajectory begins with: the triangulated points that at
    least two of them see, with all observations, then a sample of the map, without any."""
    t, sparse = outcome.trajectory, outcome.load_sparse()
    others = None if sparse is None else outcome.load_observations(sparse)
    camera = outcome.calibration.intrinsics
    points, colors, image, point, xy = seen_points(sparse, t.frame_ids[rows], camera, t.cam_from_world[rows], others)
    if outcome.gaussian_map is not None:
        means, shades = _map_sample(outcome.gaussian_map, _START_POINTS - len(points))
        points, colors = np.concatenate([points, means]), np.concatenate([colors, shades])
    return points, colors, image, point, xy


def seen_points(
    model: SparseModel | None,
    image_ids: NDArray[np.int64],
    camera: Intrinsics,
    cam_from_world: NDArray[np.float64],
    others: FrameObservations | None = None,
) -> Points:
    """Return the points that at least two of the images (N,), posed by cam_from_world (N, 4, 4), see.

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


def _map_sample(gaussian_map: GaussianMap, count: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Centres (P, 3) and colours (P, 3) of at most `count` Gaussians that are more opaque than not, evenly spread."""
    opaque = np.flatnonzero(gaussian_map.opacity_logits.cpu().numpy() > 0)
    spread = np.linspace(0, len(opaque) - 1, max(min(count, len(opaque)), 0)).round().astype(np.int64)
    sample = gaussian_map.only(torch.from_numpy(opaque[spread]))
    colors = np.round(255 * sample.colors.cpu().numpy().clip(0, 1)).astype(np.uint8)
    return sample.means.cpu().numpy().astype(np.float64), colors


def _write_images(scene: ExportScene, frames: list[Frame], folder: Path) -> Intrinsics:
    """Write the undistorted frames, and return their camera.

    They are read again from the source where that is larger than the frames; where it cannot be read, or is no longer
    what the frames were made from, they are the frames of the run, which is warned of.
    """
    outcome, side = scene.outcome, scene.settings.image_side
    camera = outcome.calibration.intrinsics
    try:
        if (larger := _larger(outcome, side)) is not None:
            source, lens = larger
            _write_larger(outcome, frames, source, lens, side, folder)
            return lens.pinhole
    except InputError as error:
        scene.warn(f"images/ has the frames of the run, {camera.width}x{camera.height}, and none larger: {error}")
    for frame in frames:
        copy_file(outcome.run.image_file(frame), folder / frame.name)
    return camera


def _write_masks(outcome: Outcome, frames: list[Frame], camera: Intrinsics, target: Target) -> list[str]:
    """Write the masks of the frames, as large as their images, and return their names: of all frames where one has any,
    as nerfstudio reads them."""
    if all(outcome.run.left_out(frame) is None for frame in frames):
        return []
    size = (camera.width, camera.height)
    for frame in frames:
        left_out = outcome.run.left_out(frame)
        mask = np.zeros(size[::-1], np.uint8) if left_out is None else left_out.astype(np.uint8)
        LEFT_OUT.save(target.folder, cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0, frame.name)
    return [LEFT_OUT.name.format(frame.name) for frame in frames]


def _larger(outcome: Outcome, side: int) -> tuple[Recording, Lens] | None:
    """The source, and the lens of its images reduced to `side`; None where these are no larger than the frames, or the
    frames are no whole images of the source."""
    calibration, most = outcome.calibration, outcome.config.frames.max_side
    k = calibration.intrinsics
    if calibration.directions > 1 or calibration.fisheye or max(k.width, k.height) < most:
        return None
    source = open_recording(Path(outcome.run.source.path), outcome.config.run.format)
    width, height = reduced_size(source.width, source.height, side)
    if reduced_size(source.width, source.height, most) != (k.width, k.height) or width <= k.width:
        return None
    x, y = width / k.width, height / k.height
    pinhole = Intrinsics(width, height, k.fx * x, k.fy * y, k.cx * x, k.cy * y)
    distorted = to_pycolmap(distorted_camera(calibration))
    straight = make_lens(distorted).is_straight
    distorted.rescale(width, height)
    return source, Lens(distorted, pinhole, 0.0 if straight else np.inf)


def _write_larger(
    outcome: Outcome, frames: list[Frame], source: Recording, lens: Lens, side: int, folder: Path
) -> None:
    by_index = {frame.source_index: frame for frame in frames}

    def write(picture: VideoFrame) -> None:
        frame = by_index[picture.source_index]
        reduced = reduce_image(picture.rgb, side)
        image = reduced if lens.is_straight else lens.undistort_image(reduced)
        kept = outcome.run.image(frame)
        small = cv2.resize(image, (kept.shape[1], kept.shape[0]), interpolation=cv2.INTER_AREA)
        if np.abs(small.astype(np.int16) - kept).mean() > _MOST_DIFFERENT:
            what = f"its image {frame.source_index} is not that of frame {frame.id}"
            raise InputError(f"{source.path} has changed: {what}")
        write_rgb(folder / frame.name, image)

    count = sum(1 for _ in parallel_map(write, source.read(by_index), get_threads()))
    if count < len(frames):
        raise InputError(f"only {count} of {len(frames)} frames could be read again from {source.path}")
