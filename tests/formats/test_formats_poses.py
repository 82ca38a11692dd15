"""Poses by other programs, in the layouts that these write."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.colmap import write_colmap_model
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.poses import read_poses
from msgs_slam.formats.trajectory import write_tum
from tests.colmap_models import posed_images
from tests.matrices import write_matrices

GL = np.diag([1.0, -1.0, -1.0, 1.0])
Poses = NDArray[np.float64]


def made() -> Poses:
    """(5, 4, 4) world_from_cam."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(5, 3))).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(5, 3))
    return poses


def colmap(folder: Path, poses: Poses) -> Path:
    names = [f"images/frame_{i:03d}.jpg" for i in range(5)]
    model = posed_images(names, np.linalg.inv(poses), 640, 480, 500.0, 500.0, 320.0, 240.0)
    write_colmap_model(folder / "sparse" / "0", model)
    return folder


def transforms(folder: Path, poses: Poses) -> Path:
    frames = [
        {"file_path": f"./images/frame_{i:03d}", "transform_matrix": (p @ GL).tolist()} for i, p in enumerate(poses)
    ]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 500, "frames": frames}))
    return folder


def arkit_rows(folder: Path, poses: Poses) -> Path:
    frames = [
        {"image": f"frame_{i:03d}.jpg", "cameraPoseARFrame": (p @ GL).ravel().tolist()} for i, p in enumerate(poses)
    ]
    (folder / "arkit.json").write_text(json.dumps({"frames": frames}))
    return folder / "arkit.json"


def arkit_columns(folder: Path, poses: Poses) -> Path:
    frames = [{"timestamp": 10 + i / 30, "transform": (p @ GL).T.tolist()} for i, p in enumerate(poses)]
    (folder / "poses.json").write_text(json.dumps(frames))
    return folder / "poses.json"


def tum(folder: Path, poses: Poses) -> Path:
    write_tum(folder / "trajectory.txt", 10 + np.arange(5) / 30, poses)
    return folder / "trajectory.txt"


def matrices(folder: Path, poses: Poses) -> Path:
    write_matrices(folder / "traj.txt", poses)
    return folder / "traj.txt"


def polycam(folder: Path, poses: Poses) -> Path:
    for i, pose in enumerate(poses):
        rows = {f"t_{a}{b}": float(v) for (a, b), v in np.ndenumerate((pose @ GL)[:3])}
        path = folder / "keyframes" / "cameras" / f"frame_{i:03d}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**rows, "fx": 500, "timestamp": i}))
    return folder


def scanner_app(folder: Path, poses: Poses) -> Path:
    for i, pose in enumerate(poses):
        frame = {"cameraPoseARFrame": (pose @ GL).ravel().tolist(), "intrinsics": [1.0] * 9, "time": float(i)}
        (folder / f"frame_{i:03d}.json").write_text(json.dumps(frame))
    return folder


def record3d(folder: Path, poses: Poses) -> Path:
    turns = Rotation.from_matrix((poses @ GL)[:, :3, :3]).as_quat()
    rows = np.column_stack([turns, poses[:, :3, 3]]).tolist()
    (folder / "metadata.json").write_text(json.dumps({"w": 720, "h": 960, "fps": 60, "poses": rows}))
    return folder


def stray(folder: Path, poses: Poses) -> Path:
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, pose in enumerate(poses):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        lines.append(f"{i / 60}, {i:06d}, " + ", ".join(f"{v:.9f}" for v in numbers))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    return folder / "odometry.csv"


@pytest.mark.parametrize(
    ("write", "pattern"),
    [(polycam, "frame_{:03d}"), (scanner_app, "frame_{:03d}"), (record3d, "{}"), (stray, "{:06d}")],
)
def test_what_apps_on_phones_write_is_in_metres(
    write: Callable[[Path, Poses], Path], pattern: str, tmp_path: Path
) -> None:
    found = read_poses(write(tmp_path, made()))
    np.testing.assert_allclose(found.world_from_cam, made(), atol=1e-6)
    assert found.names == tuple(pattern.format(i) for i in range(5))
    assert found.is_metric


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("keyframes/cameras/1.json", '{"t_00": 1}', "t_01"),
        ("frame_00000.json", '{"cameraPoseARFrame": [1, 2]}', "sixteen numbers"),
        ("metadata.json", '{"poses": [[0, 0, 0, 1]]}', "seven numbers"),
        ("odometry.csv", "timestamp, frame, x\n0, 0, 1\n", "no column y"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n0, 0, a, 0, 0, 0, 0, 0, 1\n", "than numbers"),
    ],
)
def test_damaged_files_of_apps_are_refused(name: str, text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=what):
        read_poses(tmp_path)


@pytest.mark.parametrize(
    ("write", "is_named", "is_timed", "is_metric"),
    [
        (colmap, True, False, False),
        (transforms, True, False, False),
        (arkit_rows, True, False, True),
        (arkit_columns, False, True, True),
        (tum, False, True, False),
        (matrices, False, False, False),
    ],
)
def test_all_layouts_say_the_same(
    write: Callable[[Path, Poses], Path], is_named: bool, is_timed: bool, is_metric: bool, tmp_path: Path
) -> None:
    found = read_poses(write(tmp_path, made()))
    np.testing.assert_allclose(found.world_from_cam, made(), atol=1e-6)
    assert found.names == (tuple(f"frame_{i:03d}" for i in range(5)) if is_named else ())
    assert (found.times is not None, found.is_metric) == (is_timed, is_metric)
    if found.times is not None:
        np.testing.assert_allclose(found.times, 10 + np.arange(5) / 30)


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.json", "[]", "lists no frames"),
        ("a.json", '[{"transform": [1, 2, 3], "name": "a"}]', "no 4x4 matrix"),
        ("a.json", '[{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]', "lists no frames"),
        ("a.json", '[{"timestamp": "now", "transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]', "is not a time"),
        ("a.json", '[{"name": "a", "transform": [[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]}]', "no rigid transform"),
        ("a.txt", "1 2 3\n", "no 4x4 matrices"),
        ("a.txt", "nan " * 16 + "\n", "holds no pose"),
    ],
)
def test_what_is_none_is_refused(name: str, text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=what):
        read_poses(tmp_path / name)


def _spoil(path: Path, format: str) -> None:
    """Make the second of the five poses one that was lost, as the program that writes the format does."""
    if format in ("tum", "matrices"):
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        time, *rest = lines[1].split()
        lines[1] = " ".join([time if format == "tum" else "nan", *["nan"] * len(rest)])
        path.write_text("\n".join(lines))
        return
    if format == "polycam":
        path = path / "keyframes" / "cameras" / "frame_001.json"
        path.write_text(re.sub(r"(\"t_03\": )[^,}]*", r"\1NaN", path.read_text()))
        (path.parent / "._frame_001.json").write_bytes(b"\0\5\x16\7")  # macOS leaves such beside each file
        return
    path = next((p for p in (path / "transforms.json", path / "metadata.json") if p.exists()), path)
    table = json.loads(path.read_text())
    rows = table if isinstance(table, list) else table.get("poses") or table["frames"]
    key = next((k for k in ("transform_matrix", "cameraPoseARFrame", "transform") if k in rows[1]), None)
    lost = (np.array(rows[1][key] if key else rows[1]) * np.nan).tolist()
    rows[1] = rows[1] | {key: lost} if key else [0.0] * 7
    path.write_text(json.dumps(table))


@pytest.mark.parametrize("write", [transforms, arkit_rows, arkit_columns, tum, matrices, polycam, record3d])
def test_a_lost_pose_does_not_cost_the_others(write: Callable[[Path, Poses], Path], tmp_path: Path) -> None:
    path = write(tmp_path, made())
    _spoil(path, write.__name__)
    found = read_poses(path)
    known = np.isfinite(found.world_from_cam).all(axis=(1, 2))
    np.testing.assert_allclose(found.world_from_cam[known], made()[[0, 2, 3, 4]], atol=1e-6)
    assert found.lost == 1


def test_poses_that_are_mostly_lost_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + ("nan " * 12 + "\n") * 4)
    with pytest.raises(InputError, match="4 of its 5 poses are not finite"):
        read_poses(tmp_path / "a.txt")


def test_a_folder_without_poses_and_a_name_twice_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="neither a COLMAP model nor"):
        read_poses(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_poses(tmp_path / "nowhere")
    frame = {"transform_matrix": np.eye(4).tolist()}
    frames = [frame | {"file_path": f"{folder}/0.jpg"} for folder in ("left", "right")]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match="two poses are of images called '0'"):
        read_poses(tmp_path / "transforms.json")
