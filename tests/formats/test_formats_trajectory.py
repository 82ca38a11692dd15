"""Trajectories survive the round trip, foreign files are read, and what is no pose is refused."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets.folder import poses_at
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.trajectory import nearest_rotation, read_matrices, read_tum, write_tum
from tests.matrices import random_poses, write_matrices


def test_tum_round_trip(tmp_path: Path) -> None:
    poses, times = random_poses(50), np.cumsum(np.random.default_rng(1).uniform(0.01, 1, 50)) + 1.3e9
    write_tum(tmp_path / "t.txt", times, poses)
    times_back, poses_back = read_tum(tmp_path / "t.txt")
    np.testing.assert_allclose(times_back, times, rtol=0, atol=1e-6)
    np.testing.assert_allclose(poses_back, poses, atol=5e-9)


def test_tum_order_of_the_quaternion(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    pose[:3, 3] = [1, 2, 3]
    write_tum(tmp_path / "t.txt", np.array([0.5]), pose[None])
    half = np.sqrt(0.5)
    numbers = [float(v) for v in (tmp_path / "t.txt").read_text().splitlines()[1].split()]
    np.testing.assert_allclose(numbers, [0.5, 1, 2, 3, 0, 0, half, half], atol=1e-9)
    write_tum(tmp_path / "t.txt", np.zeros(0), np.zeros((0, 4, 4)))
    assert (tmp_path / "t.txt").read_text().startswith("# timestamp")


def test_foreign_tum_files(shared_data: Path) -> None:
    folder = shared_data / "format_cases" / "trajectories"
    times, poses = read_tum(folder / "freiburg1_xyz-groundtruth.txt")
    assert poses.shape == (len(times), 4, 4)
    np.testing.assert_allclose(poses[0, :3, 3], [1.3563, 0.6305, 1.6380])
    turn = Rotation.from_matrix(poses[0, :3, :3]).as_quat()
    np.testing.assert_allclose(turn / turn[3], np.array([0.6132, 0.5962, -0.3311, -0.3986]) / -0.3986, atol=2e-3)
    times, poses = read_tum(folder / "freiburg1_xyz-ORB_kf_mono.txt")
    assert (np.diff(times) > 0).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1 2 3 0 0 0\n", "7 numbers"),
        ("0 1 2 3 0 0 0 0\n", "length 0"),
        ("0 1 2 nan 0 0 0 1\n", "no rigid transform"),
        ("0 1 2 3 0 0 0 one\n", "must be a number"),
        ("# nothing\n", "no numbers"),
    ],
)
def test_bad_tum_files_are_explained(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        read_tum(tmp_path / "t.txt")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_of_other_systems_and_lost_rows_are_no_damage(tmp_path: Path, encoding: str) -> None:
    rows = ["timestamp,tx,ty,tz,qx,qy,qz,qw"] + [f"{i},{i},0,0,0,0,0,1" for i in range(6)]
    rows[2:2] = ["// a remark", "1,nan,nan,nan,nan,nan,nan,nan", "nan,1,2,3,0,0,0,1", "1,0,0,0,0,0,0,0  # lost", ""]
    (tmp_path / "a.txt").write_bytes("\r\n".join(rows).encode(encoding))
    times, poses = read_tum(tmp_path / "a.txt")
    assert times.tolist() == [0, 1, 2, 3, 4, 5]
    np.testing.assert_array_equal(poses[:, 0, 3], times)
    np.testing.assert_array_equal(poses_at(np.array([1.0]), times, poses)[0], poses[1])


def test_matrix_layouts_agree(tmp_path: Path) -> None:
    poses = random_poses(5)
    write_matrices(tmp_path / "16.txt", poses)
    np.savetxt(tmp_path / "12.txt", poses[:, :3].reshape(5, 12), fmt="%.17g")
    np.savetxt(tmp_path / "4.txt", poses.reshape(20, 4), fmt="%.17g", delimiter=",")
    for name in ("16.txt", "12.txt", "4.txt"):
        np.testing.assert_allclose(read_matrices(tmp_path / name), poses, atol=1e-14, err_msg=name)


def test_frames_without_a_pose_are_nan(tmp_path: Path) -> None:
    poses = random_poses(3)
    lost = poses.copy()
    lost[1] = -np.inf
    write_matrices(tmp_path / "m.txt", lost)
    back = read_matrices(tmp_path / "m.txt")
    assert np.isnan(back[1]).all()
    np.testing.assert_allclose(back[[0, 2]], poses[[0, 2]], atol=1e-14)


@pytest.mark.parametrize("spoil", ["scale", "mirror", "transpose", "zero"])
def test_what_is_no_pose_is_refused(tmp_path: Path, spoil: str) -> None:
    poses = random_poses(3)
    if spoil == "scale":
        poses[1, :3, :3] *= 1.2
    elif spoil == "mirror":
        poses[1, :3, 0] *= -1
    elif spoil == "transpose":
        poses[1] = poses[1].T
    else:
        poses[1] = 0
    write_matrices(tmp_path / "m.txt", poses)
    with pytest.raises(InputError, match="matrix 2 is no rigid transform"):
        read_matrices(tmp_path / "m.txt")


def test_rotations_that_drifted_are_projected(shared_data: Path) -> None:
    path = shared_data / "kitchen" / "frame-000298.pose.txt"
    raw, clean = np.loadtxt(path), read_matrices(path)[0]
    assert 1e-5 < abs(np.linalg.det(raw[:3, :3]) - 1) < 1e-2
    assert abs(np.linalg.det(clean[:3, :3]) - 1) < 1e-12
    np.testing.assert_allclose(clean[:3, :3] @ clean[:3, :3].T, np.eye(3), atol=1e-12)
    assert (clean[:3, 3] == raw[:3, 3]).all()


@given(st.integers(0, 10_000), st.floats(0, 0.5))
def test_nearest_rotation_is_a_rotation_and_the_nearest(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    matrix = Rotation.random(rng=rng).as_matrix() + noise * rng.uniform(-1, 1, (3, 3))
    if np.linalg.svd(matrix)[1][-1] < 1e-3:
        return
    best = nearest_rotation(matrix)
    np.testing.assert_allclose(best @ best.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(best) > 0
    distance = np.linalg.norm(best - matrix)
    for vector in rng.normal(0, 0.05, (10, 3)):
        other = best @ Rotation.from_rotvec(vector).as_matrix()
        assert np.linalg.norm(other - matrix) >= distance - 1e-9


def test_nearest_rotation_refuses_what_has_none() -> None:
    with pytest.raises(ValueError, match="singular"):
        nearest_rotation(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="not finite"):
        nearest_rotation(np.full((3, 3), np.nan))
