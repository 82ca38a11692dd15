"""A run folder of the synthetic room as the stages before mapping would leave it, with exact poses and proxies."""

import json
from pathlib import Path

import cv2
import numpy as np
from finished import note_finished
from numpy.typing import NDArray

from msgs_slam.formats.images import read_rgb
from msgs_slam.formats.textfile import write_json
from msgs_slam.pipelines.depth.fields import DepthFields
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import (
    CALIBRATION,
    CLASSES,
    DEPTH_FIELDS,
    PROXY_MAPS,
    SPARSE,
    TRAJECTORY,
    save_frames,
)
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import VOID, Calibration, ClassTable, Frame, Intrinsics, ProxyMaps, Trajectory

SIZE = (80, 60)


def make_run(root: Path, sequence: Path, every: int = 2, most: int = 1000) -> RunFolder:
    """Every second frame at 80 x 60, at most so many, all of them keyframes; labels and metric depth are the truth."""
    run = RunFolder(root)
    camera = json.loads((sequence / "intrinsics.json").read_text())
    full = read_rgb(sequence / "rgb" / "000000.png").shape[1::-1]
    k = Intrinsics(*full, camera["fx"], camera["fy"], camera["cx"] + 0.5, camera["cy"] + 0.5).resized(*SIZE)
    rows = json.loads((sequence / "classes.json").read_text())["classes"]
    world_from_cam = np.loadtxt(sequence / "traj.txt").reshape(-1, 4, 4)[::every][:most]
    times = np.loadtxt(sequence / "timestamps.txt").reshape(-1)[::every][:most]
    names = sorted(p.name for p in (sequence / "rgb").iterdir())[::every][:most]
    frames = [Frame(i, n, float(t), i * every, 1.0) for i, (n, t) in enumerate(zip(names, times, strict=True))]
    depths = []
    for frame in frames:
        image = cv2.resize(read_rgb(sequence / "rgb" / frame.name), SIZE, interpolation=cv2.INTER_AREA)
        (root / "frames").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / "frames" / frame.name), image[:, :, ::-1])
        depth = grey(sequence / "depth" / frame.name).astype(np.float32) / 1000
        labels = grey(sequence / "labels" / frame.name)
        labels = np.where(labels == 0, VOID, labels).astype(np.uint8)
        maps = ProxyMaps(depth, (depth > 0).astype(np.float32), labels, np.ones_like(depth))
        PROXY_MAPS.save(root / "proxy", maps, frame.id)
        depths.append(depth)
    save_frames(root / "frames", frames)
    CALIBRATION.save(root / "frames", Calibration(k, "given", 0.0, (0, 0, 0, 0)))
    CLASSES.save(root / "proxy", ClassTable(tuple(r["name"] for r in rows), tuple(tuple(r["color"]) for r in rows)))
    write_json(root / "proxy" / "proxy.json", {"depth": "files", "semantics": "files", "metric": True})
    cam_from_world = np.linalg.inv(world_from_cam)
    n = len(frames)
    trajectory = Trajectory(np.arange(n), times, cam_from_world, np.ones(n, bool), ("",) * n)
    TRAJECTORY.save(root / "tracking", trajectory)
    DEPTH_FIELDS.save(root / "tracking", DepthFields({}))
    SPARSE.save(root / "tracking", points_seen_twice(k, cam_from_world, depths))
    note_finished(run, ("frames", "proxy", "tracking"), source=str(root))
    return run


def grey(path: Path) -> NDArray:
    """Every third pixel of a PNG of 240 x 180: a sample of the picture at a third of the size."""
    return np.ascontiguousarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[1::3, 1::3])


def points_seen_twice(
    k: Intrinsics, cam_from_world: NDArray[np.float64], depths: list[NDArray[np.float32]]
) -> SparseModel:
    """Points of a coarse grid of each frame, with their exact places in it and in the next."""
    points, obs = [], []
    for i in range(len(depths) - 1):
        rows, columns = np.nonzero(depths[i][5::10, 5::10])
        xy = np.stack([columns, rows], 1) * 10 + 5.5
        z = depths[i][5::10, 5::10][rows, columns].astype(np.float64)
        in_cam = np.stack([(xy[:, 0] - k.cx) / k.fx * z, (xy[:, 1] - k.cy) / k.fy * z, z], 1)
        world_from_cam = np.linalg.inv(cam_from_world[i])
        for point in in_cam @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]:
            for view in (i, i + 1):
                x, y, w = cam_from_world[view][:3, :3] @ point + cam_from_world[view][:3, 3]
                if w > 0:
                    obs.append((view, len(points), k.fx * x / w + k.cx, k.fy * y / w + k.cy))
            points.append(point)
    table = np.array(obs)
    return SparseModel(
        np.arange(len(depths)),
        cam_from_world,
        np.array(points),
        np.full((len(points), 3), 128, np.uint8),
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        table[:, 2:],
    )
