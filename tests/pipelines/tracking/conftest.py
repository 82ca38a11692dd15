"""A small room with exact truth, as a run whose frames and proxies are done; and a bundle of random points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.images import to_grey, write_rgb
from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.geometry.camera import project, unproject
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, CLASSES, PROXY_MAPS, save_frames
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm.bundle import Bundle
from msgs_slam.pipelines.sfm.flow import find_corners
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, ClassTable, Frame, Intrinsics, ProxyMaps
from tests.pipelines.kept import keep_correspondences
from tests.world.clip import ClipOptions, WorldFrame, make_world, render_frame

Array = NDArray[np.float64]


def small_motion(rng: np.random.Generator, angle: float, distance: float) -> Array:
    """(4, 4) random motion of about that size."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * angle).as_matrix()
    motion[:3, 3] = rng.normal(size=3) * distance
    return motion


@dataclass(frozen=True)
class KnownBundle:
    """A bundle with noisy pixels, and the truth."""

    bundle: Bundle
    cam_from_world: Array
    points: Array
    intrinsics: Intrinsics


@pytest.fixture
def known_bundle() -> KnownBundle:
    """Twelve cameras on an arc that all see 150 points, half a pixel of noise."""
    rng = np.random.default_rng(0)
    intrinsics = Intrinsics(640, 480, 500, 500, 320, 240)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 7], (150, 3))
    poses = []
    for step in np.linspace(-1, 1, 12):
        pose = small_motion(rng, 0.02, 0.02)
        pose[:3, 3] += [step, 0.2 * step**2, 0]
        poses.append(pose)
    cam = np.repeat(np.arange(12), 150)
    point = np.tile(np.arange(150), 12)
    truth = np.array(poses)
    in_cam = np.einsum("oij,oj->oi", truth[cam, :3, :3], points[point]) + truth[cam, :3, 3]
    xy, z = project(in_cam, intrinsics)
    xy = xy + rng.normal(size=xy.shape) * 0.5
    n = len(cam)
    noisy = np.array([small_motion(rng, 0.01, 0.03) @ p for p in truth])
    moved = points + rng.normal(size=points.shape) * 0.05
    bundle = Bundle(noisy, moved, cam, point, xy, np.full(n, 0.5), z, np.full(n, 0.02), np.full(n, -1))
    return KnownBundle(bundle, truth, points, intrinsics)


@dataclass(frozen=True)
class MadeRun:
    """A run with frames and proxies, and the true poses of its frames."""

    run: RunFolder
    cam_from_world: Array


@pytest.fixture(scope="session")
def room_frames() -> tuple[Intrinsics, list[WorldFrame]]:
    """24 frames of a walk through the room, 320 x 240."""
    options = ClipOptions(width=320, height=240, frames=24, laps=0.16)
    world = make_world("room", seed=3, texel=0.01)
    return options.intrinsics, [render_frame(world, options, i) for i in range(options.frames)]


@pytest.fixture(scope="session")
def make_run(room_frames: tuple[Intrinsics, list[WorldFrame]]) -> Callable[..., MadeRun]:
    """make_run(folder, keyframes=..., depth_factor=..., metric=..., blank=..., all_proxies=..., more=...)."""

    def make(
        folder: Path,
        keyframes: tuple[int, ...] = (0, 3, 6, 9, 12, 15, 18, 21, 23),
        backbone_scale: float = 0.4,
        depth_factor: float = 1.0,
        metric: bool = True,
        blank: tuple[int, ...] = (),
        all_proxies: bool = False,
        more: Sequence[WorldFrame] = (),
    ) -> MadeRun:
        intrinsics, frames = room_frames[0], [*room_frames[1], *more]
        truth = np.linalg.inv(np.array([f.world_from_cam for f in frames]))
        for sub in ("frames/backbone", "proxy/maps"):
            (folder / sub).mkdir(parents=True)
        rows = [Frame(i, f"{i:06d}.png", i / 10, i, 1.0) for i in range(len(frames))]
        for row, frame in zip(rows, frames, strict=True):
            picture = np.full_like(frame.rgb, 128) if row.id in blank else frame.rgb
            write_rgb(folder / "frames" / row.name, picture)
            if all_proxies or row.id in keyframes:
                PROXY_MAPS.save(folder / "proxy", _maps(frame, depth_factor), row.id)
        save_frames(folder / "frames", rows)
        CALIBRATION.save(folder / "frames", Calibration(intrinsics, "given", 0.0, (0, 0, 0, 0)))
        CLASSES.save(folder / "proxy", ClassTable(tuple(f"c{i}" for i in range(32)), ((0, 0, 0),) * 32))
        write_json(folder / "proxy" / "proxy.json", {"depth": "files", "semantics": "files", "metric": metric})
        keep_correspondences(folder / "frames", {i: frames[i].rgb for i in keyframes or (0, 12)})
        if keyframes:
            model = _backbone(frames, truth, intrinsics, keyframes, backbone_scale)
            BACKBONE.save(folder / "frames", model)
        return MadeRun(RunFolder(folder), truth)

    return make


def _maps(frame: WorldFrame, factor: float) -> ProxyMaps:
    ones = np.ones_like(frame.depth)
    return ProxyMaps(frame.depth * np.float32(factor), ones * (frame.depth > 0), frame.labels, ones)


def _backbone(
    frames: list[WorldFrame], truth: Array, intrinsics: Intrinsics, keyframes: tuple[int, ...], scale: float
) -> SparseModel:
    """Corners of every second keyframe at their true place, seen with noise where nothing hides them."""
    rng = np.random.default_rng(1)
    points, colors = [], []
    for k in keyframes[::2]:
        xy = find_corners(to_grey(frames[k].rgb), np.zeros((0, 2)), 150)
        row, column = xy[:, 1].astype(int), xy[:, 0].astype(int)
        in_cam = unproject(xy, frames[k].depth[row, column].astype(float), intrinsics)
        world_from_cam = np.linalg.inv(truth[k])
        points.append(in_cam @ world_from_cam[:3, :3].T + world_from_cam[:3, 3])
        colors.append(frames[k].rgb[row, column])
    world = np.concatenate(points)
    seen = []
    for c, k in enumerate(keyframes):
        in_cam = world @ truth[k][:3, :3].T + truth[k][:3, 3]
        xy, z = project(in_cam, intrinsics)
        inside = (z > 0.1) & (xy > 1).all(1) & (xy < [intrinsics.width - 1, intrinsics.height - 1]).all(1)
        index = np.flatnonzero(inside)
        there = frames[k].depth[xy[index, 1].astype(int), xy[index, 0].astype(int)]
        index = index[np.abs(there - z[index]) < 0.02 * z[index]]
        seen.append((np.full(len(index), c), index, xy[index] + rng.normal(size=(len(index), 2)) * 0.3))
    poses = np.array([small_motion(rng, 0.002, 0.004) @ truth[k] for k in keyframes])
    poses[:, :3, 3] *= scale
    return SparseModel(
        np.array(keyframes), poses, world * scale, np.concatenate(colors),
        *(np.concatenate([s[i] for s in seen]) for i in range(3)),
    )  # fmt: skip


@pytest.fixture
def open_stage() -> Callable[..., StageContext]:
    """open_stage(run, stage, config): the context of an unfinished stage."""

    def open_it(run: RunFolder, stage: str, config: Config | None = None) -> StageContext:
        run.partial(stage).mkdir(exist_ok=True)
        return StageContext(run, run.root, config or Config(), run.partial(stage), SilentProgress())

    return open_it
