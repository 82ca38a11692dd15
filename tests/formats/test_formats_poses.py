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
from msgs_slam.formats.image_folder import stem
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
        ("keyframes/cameras/1.json", '{"t_00": 1}', "no 4x4 matrix"),
        ("frame_00000.json", '{"cameraPoseARFrame": [1, 2]}', "sixteen numbers"),
        ("metadata.json", '{"poses": [[0, 0, 0, 1]]}', "seven numbers"),
        ("odometry.csv", "timestamp, frame, x\n0, 0, 1\n", "no column y"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n0, 0, a, 0, 0, 0, 0, 0, 1\n", "must be a number"),
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
    assert tuple(map(stem, found.names)) == (tuple(f"frame_{i:03d}" for i in range(5)) if is_named else ())
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
    frames = [frame | {"file_path": f"{folder}/0.jpg"} for folder in ("left", "right", "left")]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match="two poses are of images called 'left/0"):
        read_poses(tmp_path / "transforms.json")
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames[:2]}))
    assert read_poses(tmp_path / "transforms.json").names == ("left/0.jpg", "right/0.jpg")


def _row(i: int, pose: NDArray[np.float64], order: str) -> list[str]:
    numbers = dict(zip("xyz", pose[:3, 3], strict=True)) | {"t": 10 + i / 30, "i": i + 1}
    numbers |= dict(zip(("qx", "qy", "qz", "qw"), Rotation.from_matrix(pose[:3, :3]).as_quat(), strict=True))
    return [f"{numbers[key]:.9f}" if key != "i" else str(i + 1) for key in order.split()]


@pytest.mark.parametrize(
    ("headings", "order", "divider"),
    [
        ("", "t x y z qx qy qz qw", ";"),
        ("", "t x y z qx qy qz qw", "\t"),
        ("timestamp;tx;ty;tz;qx;qy;qz;qw", "t x y z qx qy qz qw", ";"),
        ("timestamp tx ty tz qw qx qy qz", "t x y z qw qx qy qz", " "),
        ("# timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
         "t x y z qw qx qy qz", ","),
        ("#timestamp x y z qx qy qz qw id", "t x y z qx qy qz qw i", " "),
        ("", "t x y z qx qy qz qw i", " "),
    ],
)  # fmt: skip
def test_a_table_is_read_by_its_headings_whatever_divides_it(
    headings: str, order: str, divider: str, tmp_path: Path
) -> None:
    rows = [divider.join(_row(i, pose, order)) for i, pose in enumerate(made())]
    text = "\n".join([headings, *rows] if headings else rows)
    for name in ("poses.txt", "poses.csv"):
        (tmp_path / name).write_text(text.replace(".", ",") if divider == ";" else text)
        found = read_poses(tmp_path / name)
        np.testing.assert_allclose(found.world_from_cam, made(), atol=1e-6)
        np.testing.assert_allclose(found.times, 10 + np.arange(5) / 30, atol=1e-6)


def test_a_table_may_name_images(tmp_path: Path) -> None:
    rows = [[f"IMG {i}.jpg", *_row(i, pose, "x y z qx qy qz qw")] for i, pose in enumerate(made())]
    text = "\n".join(["Name,x,y,z,qx,qy,qz,qw", *(",".join(row) for row in rows)])
    (tmp_path / "poses.csv").write_text(text)
    found = read_poses(tmp_path / "poses.csv")
    np.testing.assert_allclose(found.world_from_cam, made(), atol=1e-6)
    assert (found.names, found.times) == (tuple(f"IMG {i}.jpg" for i in range(5)), None)


def test_rows_without_a_frame_are_lost(tmp_path: Path) -> None:
    path = stray(tmp_path, made())
    path.write_text(path.read_text().replace(" 000001,", " nan,").replace(" 000002,", " inf,"))
    found = read_poses(path)
    assert np.isfinite(found.world_from_cam).all(axis=(1, 2)).tolist() == [True, False, False, True, True]
    assert (found.names[3], found.lost) == ("000003", 2)


def opensfm(folder: Path, poses: Poses) -> Path:
    shots = {}
    for i, pose in enumerate(np.linalg.inv(poses)):
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[f"frame_{i:03d}.jpg"] = {"rotation": turn, "translation": pose[:3, 3].tolist(), "camera": "v2"}
    parts = [{"cameras": {}, "shots": {}}, {"cameras": {}, "shots": shots}]
    (folder / "reconstruction.json").write_text(json.dumps(parts))
    return folder / "reconstruction.json"


def metashape(folder: Path, poses: Poses) -> Path:
    cameras = [
        f"<camera id='{i}' label='frame_{i:03d}'><transform>{' '.join(map(str, pose.ravel()))}</transform></camera>"
        for i, pose in enumerate(poses)
    ]
    text = f"<document><chunk><cameras>{''.join(cameras)}<camera id='9' label='x'/></cameras></chunk></document>"
    (folder / "cameras.xml").write_text(text)
    return folder / "cameras.xml"


@pytest.mark.parametrize("write", [opensfm, metashape])
def test_poses_of_photogrammetry(write: Callable[[Path, Poses], Path], tmp_path: Path) -> None:
    found = read_poses(write(tmp_path, made()))
    np.testing.assert_allclose(found.world_from_cam, made(), atol=1e-6)
    assert tuple(map(stem, found.names)) == tuple(f"frame_{i:03d}" for i in range(5))
    assert not found.is_metric


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("rc.csv", "#name,x,y,alt,heading,pitch,roll,f\n0.jpg,1,2,3,4,5,6,7\n", "as RealityScan and Metashape"),
        ("cameras.sfm", "{}", "its node ExportColmap"),
        ("cameras.xml", "<document><chunk/></document>", "no <camera> with a label"),
    ],
)
def test_what_is_not_read_is_named_with_the_export_that_is(name: str, text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=what):
        read_poses(tmp_path / name)
