"""Data set readers: on the real recordings depth, poses and intrinsics must agree with one another."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from msgs_slam.formats.datasets import VOID_LABEL, Camera, Dataset, open_sequence
from msgs_slam.formats.datasets.folder import poses_at
from msgs_slam.formats.datasets.nerfstudio import write_transforms
from msgs_slam.formats.datasets.sequence import shift_viewpoint, warp_nearest
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png, write_rgb
from msgs_slam.formats.trajectory import write_tum
from tests.matrices import random_poses, write_matrices


def _depth_disagreement(sequence: Dataset, i: int, j: int) -> float:
    """Median relative difference between depth of frame j and that of frame i moved there by the poses."""
    depth1, depth2 = sequence.depth(i), sequence.depth(j)
    assert depth1 is not None
    assert depth2 is not None
    assert sequence.camera is not None
    assert sequence.world_from_cam is not None
    k = sequence.camera.resized(depth1.shape[1], depth1.shape[0])
    v, u = np.nonzero(depth1)
    z = depth1[v, u].astype(np.float64)
    points = np.stack([(u + 0.5 - k.cx) / k.fx * z, (v + 0.5 - k.cy) / k.fy * z, z, np.ones_like(z)])
    x, y, z = (np.linalg.inv(sequence.world_from_cam[j]) @ sequence.world_from_cam[i] @ points)[:3]
    front = z > 0.1
    column = np.floor(k.fx * x[front] / z[front] + k.cx).astype(int)
    row = np.floor(k.fy * y[front] / z[front] + k.cy).astype(int)
    inside = (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
    seen = depth2[row[inside], column[inside]]
    known = seen > 0
    return float(np.median(np.abs(seen[known] - z[front][inside][known]) / seen[known]))


@pytest.mark.parametrize(
    ("name", "format", "frames", "limit"),
    [("replica_office0", "replica", 81, 0.002), ("whiteroom", "folder", 150, 0.002), ("kitchen", "7scenes", 150, 0.02)],
)
def test_depth_poses_and_intrinsics_agree(shared_data: Path, name: str, format: str, frames: int, limit: float) -> None:
    sequence = open_sequence(shared_data / name)
    assert (sequence.format, len(sequence), int(sequence.has_pose.sum())) == (format, frames, frames)
    error = _depth_disagreement(sequence, 10, 13)
    assert 0 < error < limit
    assert sequence.world_from_cam is not None
    inverted = replace(sequence, world_from_cam=np.linalg.inv(sequence.world_from_cam))
    assert _depth_disagreement(inverted, 10, 13) > 4 * error
    rotations = sequence.world_from_cam[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12)


def test_replica_camera_labels_and_times(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "replica_office0")
    assert sequence.camera == Camera(600, 340, 300.0, 300.0, 300.0, 170.0)
    assert sequence.rgb(5).shape == (340, 600, 3)
    assert sequence.timestamps is None
    assert len(sequence.classes) == 101
    names = {c.id: c.name for c in sequence.classes}
    table = [line.split() for line in (shared_data / "replica_office0/classes_used.txt").read_text().splitlines()[1:]]
    assert all(names[int(i)] == name for i, name, _ in table if i != "0")
    counts = np.zeros(256)
    for i in range(len(sequence)):
        labels = sequence.labels(i)
        assert labels is not None
        counts += np.bincount(labels.ravel(), minlength=256)
    fractions = dict(zip(sequence.class_names, counts / counts.sum(), strict=False))
    for _, name, fraction in table[:1] + table[2:]:
        assert fractions[name] == pytest.approx(float(fraction), abs=1e-3)
    assert counts[VOID_LABEL] / counts.sum() == pytest.approx(0.23002, abs=1e-3)


def test_the_images_folder_of_a_data_set_opens_that_data_set(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "replica_office0" / "rgb")
    assert (sequence.format, len(sequence.classes)) == ("replica", 101)
    assert open_sequence(shared_data / "whiteroom" / "rgb").has_pose.all()


def test_whiteroom_rows_belong_to_frame_numbers(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "whiteroom")
    assert sequence.camera == Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
    assert sequence.world_from_cam is not None
    truth = np.loadtxt(shared_data / "whiteroom" / "traj.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(sequence.world_from_cam, truth[::3], atol=2e-8)
    np.testing.assert_allclose(sequence.timestamps, np.arange(0, 450, 3) / 30, atol=1e-5)
    assert len(sequence.classes) == 18
    assert "none" not in sequence.class_names


def test_kitchen_depth_is_moved_to_the_colour_camera(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "kitchen")
    assert sequence.camera == Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
    assert sequence.depth_camera == Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    assert sequence.timestamps[1] == pytest.approx(2 / 30)
    unregistered = replace(sequence, depth_camera=None)
    assert _depth_disagreement(sequence, 0, 40) < 0.8 * _depth_disagreement(unregistered, 0, 40)
    for i in (0, 75, 149):
        depth = sequence.depth(i)
        assert depth is not None
        assert depth.max() < 20  # 65535 is no depth


def test_a_folder_of_photos_is_a_sequence_without_truth(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "phone_desk" / "images")
    assert (len(sequence), sequence.camera, sequence.has_depth, sequence.has_labels) == (70, None, False, False)
    assert sequence.depth(0) is None
    assert sequence.labels(0) is None
    assert sequence.names[0] == "frame_0001.jpg"


def _write_images(folder: Path, names: list[str], size: tuple[int, int] = (24, 18)) -> None:
    for i, name in enumerate(names):
        write_rgb(folder / name, np.full((size[1], size[0], 3), 10 * i, np.uint8))


def _write_depth(folder: Path, names: list[str], size: tuple[int, int] = (24, 18)) -> None:
    for i, name in enumerate(names):
        write_grey_png(folder / name, np.full((size[1], size[0]), 1000 * (i + 1), np.uint16))


def test_nice_slam_layout(tmp_path: Path) -> None:
    path = tmp_path / "room0"
    _write_images(path / "results", [f"frame{i:06d}.jpg" for i in range(12)])
    _write_depth(path / "results", [f"depth{i:06d}.png" for i in range(12)])
    write_matrices(path / "traj.txt", random_poses(12))
    camera = {"w": 24, "h": 18, "fx": 12.0, "fy": 12.0, "cx": 11.5, "cy": 8.5, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    sequence = open_sequence(path)
    assert (sequence.format, len(sequence)) == ("replica", 12)
    assert sequence.camera == Camera(24, 18, 12.0, 12.0, 12.0, 9.0)
    np.testing.assert_allclose(sequence.world_from_cam, random_poses(12), atol=1e-12)
    depth = sequence.depth(10)
    assert depth is not None
    assert depth[0, 0] == pytest.approx(11000 / 6553.5)
    write_grey_png(path / "results" / "depth000003.png", np.full((18, 24), 65535, np.uint16))
    far = sequence.depth(3)
    assert far is not None
    assert far[0, 0] == pytest.approx(10.0)


def test_semantic_nerf_layout(tmp_path: Path) -> None:
    path = tmp_path / "room_0" / "Sequence_1"
    for folder, stem in [("rgb", "rgb"), ("depth", "depth"), ("semantic_class", "semantic_class")]:
        names = [f"{stem}_{i}.png" for i in range(12)]
        if folder == "rgb":
            _write_images(path / folder, names, (32, 24))
        elif folder == "depth":
            _write_depth(path / folder, names, (32, 24))
        else:
            for i, name in enumerate(names):
                write_grey_png(path / folder / name, np.full((24, 32), [0, 93, 40][i % 3], np.uint8))
    write_matrices(path / "traj_w_c.txt", random_poses(12))
    sequence = open_sequence(tmp_path / "room_0")
    assert sequence.names[:3] == ("rgb_0.png", "rgb_1.png", "rgb_2.png")
    assert sequence.names[-1] == "rgb_11.png"
    assert sequence.camera == Camera(32, 24, 16.0, 16.0, 16.0, 12.0)
    assert sequence.class_names == ("class 40", "class 93")
    assert [int(sequence.labels(i)[0, 0]) for i in range(3)] == [VOID_LABEL, 1, 0]  # type: ignore[index]
    depth = sequence.depth(10)
    assert depth is not None
    assert depth[0, 0] == pytest.approx(11.0)


def test_seven_scenes_gaps_and_lost_poses(tmp_path: Path) -> None:
    poses = random_poses(4)
    for row, i in enumerate((0, 5, 6, 9)):
        _write_images(tmp_path, [f"frame-{i:06d}.color.png"], (640, 480))
        if i != 5:
            write_matrices(tmp_path / f"frame-{i:06d}.pose.txt", poses[row : row + 1])
    _write_depth(tmp_path, [f"frame-{i:06d}.depth.png" for i in (0, 6, 9)], (640, 480))
    sequence = open_sequence(tmp_path)
    assert sequence.timestamps == pytest.approx(np.array([0, 5, 6, 9]) / 30)
    assert sequence.has_pose.tolist() == [True, False, True, True]
    assert sequence.depth(1) is None
    depth = sequence.depth(2)
    assert depth is not None
    assert depth[240, 320] == 2.0


def test_generic_folder_with_tum_trajectory(tmp_path: Path) -> None:
    _write_images(tmp_path / "images", ["a1.png", "a2.png", "a10.png"])
    (tmp_path / "timestamps.txt").write_text("1.0\n1.5\n2.0\n")
    write_tum(tmp_path / "groundtruth.txt", np.array([2.001, 0.999, 1.7]), random_poses(3))
    sequence = open_sequence(tmp_path)
    assert sequence.world_from_cam is not None
    assert sequence.has_pose.tolist() == [True, False, True]
    np.testing.assert_allclose(sequence.world_from_cam[[0, 2]], random_poses(3)[[1, 0]], atol=1e-8)
    # Numbers in names are no times: poses of other instants would be assigned by them.
    (tmp_path / "timestamps.txt").unlink()
    sequence = open_sequence(tmp_path)
    assert sequence.timestamps is None
    np.testing.assert_allclose(sequence.world_from_cam, random_poses(3), atol=1e-8)
    write_tum(tmp_path / "groundtruth.txt", np.arange(4) / 30, random_poses(4))
    sequence = open_sequence(tmp_path)
    assert sequence.world_from_cam is None
    assert "the 4 poses of groundtruth.txt belong to times, and the 3 images state none" in sequence.notes[0]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("traj.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2, "2 poses for 3 images"),
        ("traj.txt", "1 2 3\n", "no 4x4 matrices"),
        ("timestamps.txt", "0\n1\n1\n", "increase"),
        ("intrinsics.json", '{"w": 24, "h": 18, "fx": 20}', "lacks 'fy'"),
        ("intrinsics.json", '{"w": 24, "h": 18, "fx": "20"}', "expected a number"),
        ("intrinsics.json", '{"w": 24', "no valid JSON"),
        ("intrinsics.json", '{"w": 24, "h": 18, "fx": 9, "fy": 9, "cx": 500, "cy": 9}', "far outside"),
        ("intrinsics.json", '{"w":9,"h":9,"fx":9,"fy":9,"cx":5,"cy":5,"distortion":[1,2,3,4,5,6,7]}', "up to 5: k1"),
        ("intrinsics.json", '{"w":9,"h":9,"fx":9,"fy":9,"cx":5,"cy":5,"model":"FISHEYE","distortion":"no"}', "k3, k4"),
        ("intrinsics.json", '{"w":9,"h":9,"fx":9,"fy":9,"cx":5,"cy":5,"pixel_centre":"?"}', "pixel_centre"),
    ],
)
def test_parts_that_contradict_are_explained(tmp_path: Path, name: str, text: str, message: str) -> None:
    _write_images(tmp_path / "rgb", ["a.png", "b.png", "c.png"])
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        open_sequence(tmp_path)


def test_classes_of_a_generic_folder(tmp_path: Path) -> None:
    _write_images(tmp_path / "rgb", ["0.png"])
    labels = np.zeros((18, 24), np.uint16)
    labels[:, 5:] = 1191
    labels[:, 10:] = 7
    write_grey_png(tmp_path / "labels" / "0.png", labels)
    sequence = open_sequence(tmp_path)
    assert sequence.class_names == ("class 7", "class 1191")
    table = [{"id": 7, "name": "sofa", "color": [1, 2, 3]}, {"id": 0, "name": "none"}, {"id": 3, "name": "lamp"}]
    (tmp_path / "classes.json").write_text(json.dumps({"classes": table}))
    sequence = open_sequence(tmp_path)
    assert sequence.class_names == ("lamp", "sofa")
    assert sequence.classes[1].color == (1, 2, 3)
    found = sequence.labels(0)
    assert found is not None
    assert [int(found[0, x]) for x in (0, 6, 12)] == [VOID_LABEL, VOID_LABEL, 1]
    for bad in ([{"id": 7, "name": "a"}, {"id": 7, "name": "b"}], [{"id": -1, "name": "a"}], [{"name": "a"}], [], "x"):
        (tmp_path / "classes.json").write_text(json.dumps({"classes": bad}))
        with pytest.raises(InputError):
            open_sequence(tmp_path)


def test_images_named_by_their_times_have_each_its_own_depth(tmp_path: Path) -> None:
    """What stands before the first dot is the same for all images of a second."""
    names = ["17.25", "17.50", "17.75", "18.00"]
    _write_images(tmp_path / "rgb", [f"{n}.jpg" for n in names])
    _write_depth(tmp_path / "depth", [f"{n}.png" for n in names])
    assert [p.stem for p in open_sequence(tmp_path, "folder").depth_paths if p] == names
    (tmp_path / "depth" / "17.50.png").unlink()
    found = open_sequence(tmp_path, "folder").depth_paths
    assert [p and p.stem for p in found] == ["17.25", None, "17.75", "18.00"]


def test_depth_that_belongs_to_no_image_is_refused(tmp_path: Path) -> None:
    _write_images(tmp_path / "rgb", ["a.png", "b.png"])
    _write_depth(tmp_path / "depth", ["c.png", "d.png"])
    with pytest.raises(InputError, match="none of the 2 files"):
        open_sequence(tmp_path)


def test_unknown_formats_and_places(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'replica'"):
        open_sequence(tmp_path, "repilca")
    with pytest.raises(InputError, match="no such file or folder"):
        open_sequence(tmp_path / "none")
    with pytest.raises(InputError, match="layout of no known data set"):
        open_sequence(tmp_path)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    assert open_sequence(tmp_path).format == "folder"


def test_poses_at_takes_the_nearest_within_tolerance() -> None:
    poses = random_poses(3)
    found = poses_at(np.array([0.0, 0.9, 5.0]), np.array([1.0, 0.0, 2.0]), poses, 0.2)
    np.testing.assert_allclose(found[:2], poses[[1, 0]])
    assert np.isnan(found[2]).all()
    assert np.isfinite(poses_at(np.array([0.0]), np.array([0.0]), poses[:1])).all()


def test_warp_nearest_moves_a_ramp() -> None:
    source, target = Camera(40, 30, 50.0, 50.0, 20.0, 15.0), Camera(20, 20, 25.0, 25.0, 10.0, 10.0)
    ramp = np.tile(np.arange(40, dtype=np.float32) + 1, (30, 1))
    warped = warp_nearest(ramp, source, target)
    assert warped.shape == (20, 20)
    np.testing.assert_allclose(warped[10], 2 * np.arange(20) + 2, atol=1)
    # target rows 0..2 and 17..19 look above and below the source image
    assert (warped[[0, 1, 18, 19]] == 0).all()
    assert (warp_nearest(ramp, source, source) == ramp).all()


def test_transforms_come_back_through_the_data_set_reader(tmp_path: Path) -> None:
    poses = random_poses(3)
    names = [f"frames/{i}.png" for i in range(3)]
    for name in names:
        write_rgb(tmp_path / name, np.zeros((6, 8, 3), np.uint8))
    write_transforms(tmp_path / "transforms.json", Camera(8, 6, 7.0, 7.5, 4.25, 3.0), names, poses, "map.ply")
    sequence = open_sequence(tmp_path)
    assert sequence.format == "nerfstudio"
    assert sequence.camera == Camera(8, 6, 7.0, 7.5, 4.25, 3.0)
    np.testing.assert_allclose(sequence.world_from_cam, poses, atol=1e-12)
    with pytest.raises(ValueError, match="got 2 images"):
        write_transforms(tmp_path / "transforms.json", Camera(8, 6, 7.0, 7.5, 4.25, 3.0), names[:2], poses)


def test_depth_of_a_camera_beside_is_moved_as_far_as_it_is_near() -> None:
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    depth = np.full((48, 64), 2.0, np.float32)
    depth[10:20, 30:40] = 1.0
    seen = shift_viewpoint(depth, camera, (-0.1, 0.0, 0.0))
    assert (seen[10:20, 24:34] == 1.0).all()
    assert (seen[:9, :61] == 2.0).all()
    assert (seen[:, 61:] == 0).all()
    assert (seen[12, 34:37] == 0).all(), "what the near thing hid is unknown"
    assert (seen[12, 37:61] == 2.0).all()
    assert shift_viewpoint(depth, camera, (0.0, 0.0, 0.0)) is depth
