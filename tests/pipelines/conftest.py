"""A finished run made from the truth of the synthetic room, without running any stage."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from finished import note_finished
from numpy.typing import NDArray

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import MeshBlocks, write_mesh_ply
from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.config import Config, MappingConfig
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.run.files import CALIBRATION, CLASSES, MAP, PROXY_MAPS, TRAJECTORY, save_frames
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import VOID, Calibration, ClassTable, Frame, Intrinsics, ProxyMaps, Trajectory

KEYFRAME_EVERY = 4
OracleRun = Callable[..., RunFolder]


@pytest.fixture(scope="session")
def truth(world_sequence: Path) -> Dataset:
    return open_sequence(world_sequence)


@pytest.fixture(scope="session")
def oracle_run(truth: Dataset, tmp_path_factory: pytest.TempPathFactory) -> OracleRun:
    """Makes a run whose poses, depth and labels are the truth's, its world moved by a similarity.

    metric, rename (classes lose their names), wrong_poses (N, 3) metres added to the camera centres, video (the run
    comes from a video and not from the folder), pixel_stride (more makes fewer, larger Gaussians).
    """

    def make(
        world_from_truth: Similarity | None = None,
        metric: bool = True,
        rename: bool = False,
        wrong_centers: NDArray | None = None,
        video: bool = False,
        hold_out: int = 0,
        mesh: bool = False,
        pixel_stride: int = 3,
    ) -> RunFolder:
        run = RunFolder(tmp_path_factory.mktemp("oracle") / "walk.msgs")
        move = world_from_truth or Similarity(1.0, np.eye(3), np.zeros(3))
        frames = _write_frames(run, truth, video)
        _write_proxy(run, truth, frames, metric, rename)
        trajectory = _trajectory(truth, frames, move, wrong_centers)
        TRAJECTORY.save(run.stage("tracking"), trajectory)
        gaussian_map, class_ids = _seeded_map(truth, move, pixel_stride)
        MAP.save(run.stage("mapping"), gaussian_map)
        TRAJECTORY.save(run.stage("mapping"), trajectory)
        write_json(run.stage("mapping") / "mapping.json", {"class_ids": class_ids})
        if mesh:
            _write_mesh(run.stage("export") / "mesh.ply", gaussian_map, class_ids)
        config = Config(mapping=MappingConfig(hold_out=hold_out))
        source = "walk.mp4" if video else str(truth.root / "rgb")
        note_finished(run, ("frames", "proxy", "tracking", "mapping", "export"), config, source, seconds=2.0)
        return run

    return make


def _write_frames(run: RunFolder, truth: Dataset, video: bool) -> list[Frame]:
    folder = run.stage("frames")
    frames = []
    for i, name in enumerate(truth.names):
        frames.append(Frame(i, f"{i:06d}.png" if video else name, float(truth.timestamps[i]), i, 1.0))
        write_rgb(folder / frames[-1].name, truth.rgb(i))
    save_frames(folder, frames)
    c = truth.camera
    assert c is not None
    intrinsics = Intrinsics(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
    CALIBRATION.save(folder, Calibration(intrinsics, "given", 0.0, (0.0, 0.0, 0.0, 0.0)))
    return frames


def _write_proxy(run: RunFolder, truth: Dataset, frames: list[Frame], metric: bool, rename: bool) -> ClassTable:
    folder = run.stage("proxy")
    names = tuple(f"segment {i}" for i in range(len(truth.classes))) if rename else truth.class_names
    classes = ClassTable(names, tuple(c.color or (9, 9, 9) for c in truth.classes))
    CLASSES.save(folder, classes)
    write_json(
        folder / "proxy.json", {"depth": "files:x", "semantics": "segments" if rename else "files:x", "metric": metric}
    )
    for frame in frames[::KEYFRAME_EVERY]:
        depth, labels = truth.depth(frame.id), truth.labels(frame.id)
        assert depth is not None
        assert labels is not None
        maps = ProxyMaps(depth, np.ones_like(depth), labels, np.ones_like(depth))
        PROXY_MAPS.save(folder, maps, frame.id)
    return classes


def _trajectory(truth: Dataset, frames: list[Frame], move: Similarity, wrong_centers: NDArray | None) -> Trajectory:
    assert truth.world_from_cam is not None
    world_from_cam = truth.world_from_cam.copy()
    if wrong_centers is not None:
        world_from_cam[:, :3, 3] += wrong_centers
    n = len(frames)
    return Trajectory(
        np.arange(n),
        truth.timestamps,
        move.apply_to_poses(np.linalg.inv(world_from_cam)),
        np.arange(n) % KEYFRAME_EVERY == 0,
        ("",) * n,
    )


def _seeded_map(truth: Dataset, move: Similarity, stride: int) -> tuple[GaussianMap, list[int]]:
    """A Gaussian at every `stride`-th pixel of every keyframe, as large as its pixels."""
    means, radii, colors, labels, anchors = [], [], [], [], []
    assert truth.camera is not None
    assert truth.world_from_cam is not None
    for i in range(0, len(truth), KEYFRAME_EVERY):
        depth, label = truth.depth(i), truth.labels(i)
        assert depth is not None
        assert label is not None
        v, u = np.mgrid[0 : depth.shape[0] : stride, 0 : depth.shape[1] : stride]
        z = depth[v, u].astype(np.float64)
        c = truth.camera
        cam = np.stack([(u + 0.5 - c.cx) / c.fx * z, (v + 0.5 - c.cy) / c.fy * z, z], axis=-1)[z > 0]
        pose = truth.world_from_cam[i]
        means.append(move.apply(cam @ pose[:3, :3].T + pose[:3, 3]))
        radii.append(move.scale * cam[:, 2] / c.fx * 1.3 * stride / 3)
        colors.append(truth.rgb(i)[v, u][z > 0] / 255.0)
        labels.append(label[v, u][z > 0])
        anchors.append(np.full(len(cam), i))
    label_all = np.concatenate(labels)
    class_ids = [int(k) for k in np.unique(label_all) if k != VOID]
    # Channels in another order than the labels: what mixes the two up shows.
    class_ids = class_ids[::-1]
    logits = np.zeros((len(label_all), len(class_ids)), np.float32)
    for channel, k in enumerate(class_ids):
        logits[label_all == k, channel] = 8
    return GaussianMap(
        torch.tensor(np.concatenate(means), dtype=torch.float32),
        torch.tensor(np.log(np.concatenate(radii)), dtype=torch.float32),
        torch.full((len(label_all),), 3.0),
        torch.tensor(np.concatenate(colors), dtype=torch.float32),
        torch.tensor(logits),
        torch.tensor(np.concatenate(anchors), dtype=torch.int64),
    ), class_ids


def _write_mesh(path: Path, gaussian_map: GaussianMap, class_ids: list[int]) -> None:
    """A small triangle at every fifth Gaussian, in its colour and of its class."""
    means = gaussian_map.means.numpy()[::5].astype(np.float64)
    size = 1e-3
    corners = means[:, None] + size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    points, faces = corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(means), dtype=np.int32).reshape(-1, 3)
    colors = np.rint(255 * gaussian_map.colors.numpy()[::5]).clip(0, 255).astype(np.uint8)
    labels = np.array(class_ids, np.uint8)[gaussian_map.class_logits.numpy()[::5].argmax(1)]
    vertices = (points, np.repeat(colors, 3, axis=0), np.repeat(labels, 3))
    path.parent.mkdir(parents=True)
    write_mesh_ply(path, MeshBlocks(len(points), len(faces), lambda: [vertices], lambda: [faces]))
