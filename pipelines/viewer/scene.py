"""The content of the viewer, as plain arrays: from a run, or from a splat file by any program."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...formats.errors import InputError
from ...formats.gaussians import GaussianCloud, isotropic_cloud
from ...formats.reading import reaching
from ...formats.splats import read_gaussians
from ..export.stage import on_earth
from ..geometry.sparse_model import SparseModel
from ..outcome import Outcome, labels_of_channels, load_outcome, map_cloud, spread_sample
from ..providers import class_colors
from ..reconstruct import require_run
from ..render.gaussian_map import decided_channels
from ..run.files import BACKBONE, CALIBRATION, CLASSES, FRAMES
from ..run.folder import RunFolder, load_records
from ..scene.upright import cameras_up
from ..scene.world import WORLD, up_in_run
from ..types import ClassTable, Frame, Intrinsics, Metres
from .camera_path import EXPORTED, RUN, SPLATS

Array = NDArray[np.float64]

MODES = ("colour", "classes", "depth")
MAX_CAMERAS = 60
GAUSSIANS, POINTS = "Gaussians", "points"
UP_OF_SPLATS = np.array([0.0, -1, 0])
"""Splat files have x right, y down, z forward."""
_POINT_RADIUS = 0.012
"""Of a scene as shown."""
_USUAL_SIZE = 5.0
"""The scene is shown this large: covariances travel in half precision, which has few digits for small numbers."""


@dataclass(frozen=True)
class ViewerCamera:
    """world_from_cam (4, 4), vertical field of view in radians, width over height; frame of the run."""

    frame: Frame
    world_from_cam: NDArray[np.float64]
    fov: float
    aspect: float

    @staticmethod
    def of(frame: Frame, world_from_cam: NDArray[np.float64], camera: Intrinsics) -> ViewerCamera:
        """Place a camera of these intrinsics at a frame's pose."""
        fov = 2 * float(np.arctan(camera.height / 2 / camera.fy))
        return ViewerCamera(frame, world_from_cam, fov, camera.width / camera.height)


@dataclass(frozen=True)
class ViewerScene:
    """cloud: the M Gaussians in the world of the exported files; labels (M,) uint8 indices into `class_names`, VOID
    for none, or None without classes; `scale` multiplies the world's lengths for show; up (3,); path (N, 3) camera
    centres as shown; mesh_file of the run, a GLB, if there is one, and what turns it into the world (3, 3); world:
    which one, as camera paths name it; whether the floor is at 0; is_metric, metres: what a unit of the world is;
    what: the cloud's elements, GAUSSIANS or, before there is a map, POINTS; is_empty: nothing is there yet, and the
    cloud holds an invisible one."""

    title: str
    cloud: GaussianCloud
    scale: float
    up: NDArray[np.float64]
    labels: NDArray[np.uint8] | None = None
    class_names: tuple[str, ...] = ()
    class_colors: tuple[tuple[int, int, int], ...] = ()
    cameras: list[ViewerCamera] = field(default_factory=list)
    path: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    mesh_file: Path | None = None
    world_from_mesh: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    run: RunFolder | None = None
    world: str = EXPORTED
    has_floor: bool = False
    is_metric: bool = False
    metres: Metres | None = None
    what: str = GAUSSIANS
    is_empty: bool = False

    @cached_property
    def centers(self) -> NDArray[np.float32]:
        """(M, 3) as shown."""
        return (self.cloud.means * self.scale).astype(np.float32)

    @cached_property
    def covariances(self) -> NDArray[np.float32]:
        """(M, 3, 3) as shown."""
        turn = Rotation.from_quat(self.cloud.quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()
        axes = turn * (np.exp(self.cloud.log_scales) * self.scale)[:, None, :]
        return (axes @ axes.transpose(0, 2, 1)).astype(np.float32)

    @cached_property
    def opacities(self) -> NDArray[np.float32]:
        """Opacities (M, 1) in 0..1, as the page wants them."""
        return (1 / (1 + np.exp(-self.cloud.opacity_logits)))[:, None].astype(np.float32)

    @cached_property
    def colors(self) -> dict[str, NDArray[np.uint8]]:
        """Mode → (M, 3), of all modes but depth, which is seen from somewhere."""
        colors = {"colour": np.round(np.clip(self.cloud.colors, 0, 1) * 255).astype(np.uint8)}
        if self.labels is not None and self.class_colors:
            table = np.full((256, 3), 128, np.uint8)
            table[: len(self.class_colors)] = np.array(self.class_colors, np.uint8)
            colors["classes"] = table[self.labels]
        return colors

    def depth_colors(self, position: NDArray[np.float64], forward: NDArray[np.float64]) -> NDArray[np.uint8]:
        """(M, 3) near red, far blue: the depth of each Gaussian along the unit vector `forward` from `position` (3,),
        both as shown. Behind the viewer it is as near as can be."""
        depth = (self.centers - position.astype(np.float32)) @ forward.astype(np.float32)
        seen = depth[depth > 0]
        near, far = np.quantile(seen, (0.02, 0.98)) if len(seen) else (0.0, 1.0)
        # Inverse depth, as in the pictures of the report: what is near has the finer steps.
        low, high = 1 / max(float(far), 1e-6), 1 / max(float(near), 1e-6)
        share = (1 / np.maximum(depth, max(float(near), 1e-6)) - low) / max(high - low, 1e-9)
        shades = np.clip(share * 255, 0, 255).astype(np.uint8)
        colors = np.asarray(cv2.applyColorMap(shades[:, None], cv2.COLORMAP_TURBO), np.uint8)
        return np.ascontiguousarray(colors.reshape(-1, 3)[:, ::-1])


def load_scenes(path: Path) -> list[ViewerScene]:
    """Load a run folder and its pieces, largest first, or a file of Gaussians; of a run without a map its cameras and
    points, as far as they are done. Raises InputError for anything else."""
    with reaching(path):
        is_file, is_folder = path.is_file(), path.is_dir()
    if is_file:
        return [_from_file(path)]
    if not is_folder:
        raise InputError(f"{path}: there is no such run folder or splat file")
    require_run(run := RunFolder(path))
    records = load_records(run)
    if "mapping" not in records:
        return [_from_tracking(load_outcome(run)) if "tracking" in records else _from_frames(run, "frames" in records)]
    outcome = load_outcome(run)
    return [_from_run(outcome), *(_from_run(piece) for piece in outcome.pieces() if piece.gaussian_map is not None)]


def _from_run(outcome: Outcome) -> ViewerScene:
    world, up, run = outcome.run.find(WORLD), up_in_run(outcome), outcome.run
    outcome = outcome if world is None else on_earth(outcome.moved(world.exported_from_run), world)
    m, cloud = outcome.require_map(), map_cloud(outcome)
    t, k = outcome.trajectory, outcome.calibration.intrinsics
    centers = t.centers[t.is_posed]
    scale = _scale(cloud.means, centers)
    rows = [outcome.frame_row(i) for i in spread_sample(t.frame_ids[t.is_keyframe].tolist(), MAX_CAMERAS)]
    world_from_cam = t.world_from_cam
    channels = decided_channels(m.class_logits).cpu().numpy()
    return ViewerScene(
        title=f"{run.place.parent.name}, {run.place.name.replace('_', ' ')}" if run.is_piece else run.place.name,
        cloud=cloud,
        scale=scale,
        up=up if world is None else world.exported_from_run.rotation @ up,
        labels=labels_of_channels(channels, outcome.label_of_channel) if m.class_logits.shape[1] else None,
        class_names=outcome.classes.names,
        class_colors=outcome.classes.colors,
        cameras=[ViewerCamera.of(outcome.frames[row], world_from_cam[row], k) for row in rows],
        path=centers * scale,
        mesh_file=run.file("export", "mesh.glb") if run.has("export", "mesh.glb") else None,
        world_from_mesh=np.eye(3) if world is None else world.gltf_from_exported.T,
        run=outcome.run,
        world=RUN if world is None else EXPORTED,
        has_floor=world is not None and world.has_floor,
        is_metric=outcome.metric,
        metres=outcome.metres,
    )


def _from_tracking(outcome: Outcome) -> ViewerScene:
    """Cameras and points, in the run's world."""
    t, run = outcome.trajectory, outcome.run
    posed = t.world_from_cam[t.is_posed]
    rows = np.flatnonzero(t.is_keyframe)
    cameras = list(zip(t.frame_ids[rows].tolist(), t.world_from_cam[rows], strict=True))
    scene = _of_points(run, outcome.load_sparse(), cameras, up_in_run(outcome))
    return replace(scene, path=posed[:, :3, 3] * scene.scale, is_metric=outcome.metric)


def _from_frames(run: RunFolder, is_done: bool) -> ViewerScene:
    """Keyframes and points of structure from motion, or nothing before they are found."""
    model = run.find(BACKBONE) if is_done else None
    if model is None or not len(model.frame_ids):
        return _of_points(run, None, [], np.array([0.0, -1, 0]))
    world_from_cam = np.asarray(np.linalg.inv(model.cam_from_world), np.float64)
    cameras = list(zip(model.frame_ids.tolist(), world_from_cam, strict=True))
    scene = _of_points(run, model, cameras, cameras_up(world_from_cam))
    return replace(scene, path=model.centers * scene.scale)


def _of_points(
    run: RunFolder, model: SparseModel | None, cameras: list[tuple[int, NDArray[np.float64]]], up: NDArray[np.float64]
) -> ViewerScene:
    """Small balls for points; cameras: (frame id, world_from_cam (4, 4)) of keyframes."""
    points, colors = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
    if is_empty := model is None or not len(model.points_in_world):
        opacity = -20.0
    else:
        points, colors, opacity = model.points_in_world, model.colors, 4.0
    centers = np.array([pose[:3, 3] for _, pose in cameras]).reshape(-1, 3)
    scale, ones = _scale(points, centers), np.ones(len(points), np.float32)
    cloud = isotropic_cloud(
        points.astype(np.float32), np.float32(np.log(_POINT_RADIUS / scale)) * ones, np.float32(opacity) * ones,
        (colors / 255).astype(np.float32),
    )  # fmt: skip
    shown = ViewerScene(run.place.name, cloud, scale, up, run=run, world=RUN, what=POINTS, is_empty=is_empty)
    if not cameras:
        return shown
    frames, k = run.load(FRAMES), run.load(CALIBRATION).intrinsics
    seen = [ViewerCamera.of(frames[i], pose, k) for i, pose in spread_sample(cameras, MAX_CAMERAS)]
    return replace(shown, cameras=seen)


def _from_file(path: Path) -> ViewerScene:
    cloud = read_gaussians(path)
    if len(cloud) == 0:
        raise InputError(f"{path}: holds no Gaussians")
    count = 0 if cloud.class_ids is None else int(cloud.class_ids.max()) + 1
    names = tuple(f"class {i}" for i in range(count))
    known = CLASSES.read(beside) if (beside := path.with_name(CLASSES.name)).is_file() else ClassTable((), ())
    table = known if len(known) >= count else ClassTable(names, class_colors(names))
    return ViewerScene(
        title=path.name,
        cloud=cloud,
        scale=_scale(cloud.means, np.zeros((0, 3))),
        up=UP_OF_SPLATS,
        world=SPLATS,
        labels=cloud.class_ids,
        class_names=table.names,
        class_colors=table.colors,
    )


def _scale(means: NDArray, centers: NDArray) -> float:
    """So that most of the scene spans `_USUAL_SIZE`."""
    points = np.concatenate([means.astype(np.float64), centers])
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    return _USUAL_SIZE / max(float((high - low).max()), 1e-9)


def client_view(client: Any) -> Array:
    """(4, 4) pose of a client's camera as shown, x right, y down, z forward: viser's convention is ours."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.asarray(client.camera.wxyz)[[1, 2, 3, 0]]).as_matrix()
    pose[:3, 3] = client.camera.position
    return pose


def shown_pose(world_from_cam: Array, scale: float) -> tuple[Array, Array]:
    """(wxyz, position) as shown of a pose (4, 4) in the scene's world."""
    quat_xyzw = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
    return quat_xyzw[[3, 0, 1, 2]], world_from_cam[:3, 3] * scale


def move_client(client: Any, world_from_cam: Array, scale: float, fov: float) -> None:
    """Let a client look from a pose (4, 4) in the scene's world; fov: vertical, in radians."""
    wxyz, position = shown_pose(world_from_cam, scale)
    with client.atomic():
        client.camera.wxyz, client.camera.position = wxyz, position
        client.camera.fov = fov
