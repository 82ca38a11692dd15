"""Data sets that are not at hand: written here in their layouts from one known sequence, and read back."""

import json
import re
import struct
import unicodedata
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.formats.colmap import read_colmap_model, write_colmap_model
from msgs_slam.formats.datasets import VOID_LABEL, Camera, open_sequence, recognise_source
from msgs_slam.formats.datasets.calibration import camera_from_colmap
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_grey_png, write_rgb
from msgs_slam.formats.poses import read_poses
from msgs_slam.pipelines.source.recording import DatasetRecording
from tests.colmap_models import posed_images
from tests.matrices import random_poses, write_matrices

WIDTH, HEIGHT, N = 64, 48, 5


@dataclass(frozen=True)
class Known:
    """N frames: colours, depth in metres, poses, times."""

    rgb: list[np.ndarray]
    depth: list[np.ndarray]
    poses: np.ndarray
    times: np.ndarray


@pytest.fixture(scope="module")
def known() -> Known:
    return Known(
        [np.full((HEIGHT, WIDTH, 3), (40 * i, 20, 200 - 40 * i), np.uint8) for i in range(N)],
        [np.full((HEIGHT, WIDTH), 1 + 0.5 * i) for i in range(N)],
        random_poses(N, 7),
        1305031102.1 + np.arange(N) * 0.0333,
    )


def _tum_folder(path: Path, known: Known) -> None:
    rgb, depth, truth = [], [], []
    for i, time in enumerate(known.times):
        write_rgb(path / "rgb" / f"{time:.6f}.png", known.rgb[i])
        rgb.append(f"{time:.6f} rgb/{time:.6f}.png")
        if i != 3:
            write_grey_png(path / "depth" / f"{time + 0.009:.6f}.png", (known.depth[i] * 5000).astype(np.uint16))
            depth.append(f"{time + 0.009:.6f} depth/{time + 0.009:.6f}.png")
        if i != 1:
            q = Rotation.from_matrix(known.poses[i, :3, :3]).as_quat()
            truth.append(f"{time - 0.004:.4f} " + " ".join(f"{v:.12f}" for v in (*known.poses[i, :3, 3], *q)))
    rgb[0], rgb[2] = rgb[2], rgb[0]  # the real lists are not always in order
    for name, lines in (("rgb", rgb), ("depth", depth), ("groundtruth", truth)):
        (path / f"{name}.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")


def test_tum_rgbd(tmp_path: Path, known: Known) -> None:
    path = tmp_path / "rgbd_dataset_freiburg3_office"
    _tum_folder(path, known)
    sequence = open_sequence(path)
    assert sequence.format == "tum"
    np.testing.assert_allclose(sequence.timestamps, known.times, atol=1e-6)
    assert sequence.has_pose.tolist() == [True, False, True, True, True]
    assert sequence.world_from_cam is not None
    np.testing.assert_allclose(sequence.world_from_cam[2:], known.poses[2:], atol=1e-9)
    scale = WIDTH / 640
    assert sequence.camera is not None
    assert sequence.camera.fx == pytest.approx(535.4 * scale)
    assert sequence.camera.cx == pytest.approx(320.6 * scale)
    assert [sequence.depth(i) is None for i in range(N)] == [False, False, False, True, False]
    for i in (0, 4):
        depth = sequence.depth(i)
        assert depth is not None
        np.testing.assert_allclose(depth, known.depth[i], atol=1e-4)
        assert (sequence.rgb(i) == known.rgb[i]).all()


@pytest.mark.parametrize(("number", "fx", "k1"), [("1", 517.306408, 0.262383), ("2", 520.90862, 0.231222)])
def test_tum_cameras_are_distorted(tmp_path: Path, known: Known, number: str, fx: float, k1: float) -> None:
    path = tmp_path / f"fr{number}_desk"
    _tum_folder(path, known)
    camera = open_sequence(path).camera
    assert camera is not None
    assert camera.is_distorted
    assert not camera.is_nominal
    assert (camera.fx / WIDTH * 640, camera.distortion[0]) == pytest.approx((fx, k1))


def test_tum_folder_of_another_name_says_that_it_guesses(tmp_path: Path, known: Known) -> None:
    _tum_folder(tmp_path / "mine", known)
    sequence = open_sequence(tmp_path / "mine")
    assert "expected" in sequence.notes[0]
    assert sequence.camera is not None
    assert sequence.camera.is_nominal
    assert sequence.camera.cx == pytest.approx(WIDTH / 2)


def test_lists_that_lead_out_of_the_folder_are_refused(tmp_path: Path, known: Known) -> None:
    path = tmp_path / "set"
    _tum_folder(path, known)
    write_rgb(tmp_path / "secret.png", known.rgb[0])
    for name in ("../secret.png", "/etc/hostname"):
        (path / "rgb.txt").write_text(f"1.0 {name}\n")
        with pytest.raises(InputError, match="outside"):
            open_sequence(path)


def test_euroc(tmp_path: Path, known: Known) -> None:
    cam = tmp_path / "mav0" / "cam0"
    nanoseconds = (1403636579763555584 + np.arange(N) * 50_000_000).tolist()
    body_from_cam = np.eye(4)
    body_from_cam[:3, :3] = Rotation.from_euler("xyz", [0.2, -0.4, 1.5]).as_matrix()
    body_from_cam[:3, 3] = [-0.02, -0.06, 0.01]
    for i, time in enumerate(nanoseconds):
        write_grey_png(cam / "data" / f"{time}.png", known.rgb[i][:, :, 0])
    rows = "".join(f"{t},{t}.png\r\n" for t in nanoseconds)
    (cam / "data.csv").write_text("#timestamp [ns],filename\r\n" + rows)
    values = [f"{v:.12f}" for v in body_from_cam.ravel()]
    grid = ",\n         ".join(", ".join(values[i : i + 4]) for i in range(0, 16, 4))
    (cam / "sensor.yaml").write_text(
        "# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        f"  data: [{grid}]\nrate_hz: 20\nresolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\n"
        "intrinsics: [45.8, 45.7, 31.5, 23.5] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.283, 0.0739, 0.00019, 1.76e-05]\n"
    )
    truth = ["#timestamp, p_RS_R_x [m], ..."]
    for time, pose in zip(nanoseconds[1:], known.poses[1:], strict=True):
        body = pose @ np.linalg.inv(body_from_cam)
        qx, qy, qz, qw = Rotation.from_matrix(body[:3, :3]).as_quat()
        truth.append(",".join(f"{v:.12f}" for v in (*body[:3, 3], qw, qx, qy, qz, 0, 0, 0)))
        truth[-1] = f"{time + 2_000_000},{truth[-1]}"
    folder = tmp_path / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir()
    (folder / "data.csv").write_text("\n".join(truth))
    for place in (tmp_path, tmp_path / "mav0"):
        sequence = open_sequence(place)
        assert sequence.format == "euroc"
        assert sequence.camera == Camera(WIDTH, HEIGHT, 45.8, 45.7, 32.0, 24.0, (-0.283, 0.0739, 0.00019, 1.76e-05))
        assert sequence.has_pose.tolist() == [False, True, True, True, True]
        assert sequence.world_from_cam is not None
        np.testing.assert_allclose(sequence.world_from_cam[1:], known.poses[1:], atol=1e-9)
        np.testing.assert_allclose(np.diff(sequence.timestamps), 0.05, atol=1e-6)
        assert (sequence.rgb(2)[:, :, 1] == 80).all()
    assert sequence.notes == ()
    (tmp_path / "mav0" / "cam1").mkdir()
    assert "cam1/, is not read" in open_sequence(tmp_path).notes[0]
    (cam / "sensor.yaml").write_text("intrinsics: [1, 2]\n")
    with pytest.raises(InputError, match="list of 4 numbers"):
        open_sequence(tmp_path)


def _scannet_folder(path: Path, known: Known) -> None:
    for i in range(N):
        write_rgb(path / "color" / f"{i * 20}.jpg", known.rgb[i])
        write_grey_png(path / "depth" / f"{i * 20}.png", (known.depth[i][::2, ::2] * 1000).astype(np.uint16))
        pose = known.poses[i] if i != 2 else np.full((4, 4), -np.inf)
        np.savetxt(path / "pose" / f"{i * 20}.txt", pose) if (path / "pose").is_dir() else None
        labels = np.zeros((HEIGHT, WIDTH), np.uint16)
        labels[:, 20:40] = 1191
        labels[:, 40:] = 2
        write_grey_png(path / "label-filt" / f"{i * 20}.png", labels)


def test_scannet_folder(tmp_path: Path, known: Known) -> None:
    path = tmp_path / "scans" / "scene0000_00"
    (path / "pose").mkdir(parents=True)
    (path / "intrinsic").mkdir()
    _scannet_folder(path, known)
    k = np.eye(4)
    k[:2, :3] = [[50, 0, 31.5], [0, 50, 23.5]]
    np.savetxt(path / "intrinsic" / "intrinsic_color.txt", k)
    k[:2, :3] = [[25, 0, 15.5], [0, 25, 11.5]]
    np.savetxt(path / "intrinsic" / "intrinsic_depth.txt", k)
    sequence = open_sequence(path)
    assert sequence.format == "scannet"
    assert sequence.names == ("0.jpg", "20.jpg", "40.jpg", "60.jpg", "80.jpg")
    assert sequence.timestamps == pytest.approx(np.arange(N) * 20 / 30)
    assert sequence.camera == Camera(WIDTH, HEIGHT, 50, 50, 32, 24)
    assert sequence.depth_camera == Camera(WIDTH // 2, HEIGHT // 2, 25, 25, 16, 12)
    assert sequence.has_pose.tolist() == [True, True, False, True, True]
    assert sequence.world_from_cam is not None
    np.testing.assert_allclose(sequence.world_from_cam[[0, 4]], known.poses[[0, 4]], atol=1e-12)
    depth = sequence.depth(3)
    assert depth is not None
    assert depth.shape == (HEIGHT, WIDTH)
    assert (depth > 0).all()
    np.testing.assert_allclose(depth, 2.5)
    assert sequence.class_names == ("class 2", "class 1191")
    header = "id\traw_category\tnyu40id\tnyu40class\n"
    rows = "1\twall\t1\twall\n2\tchair\t5\tchair\n1191\toffice chair\t5\tchair\n22\tghost\t0\tunannotated\n"
    (tmp_path / "scannetv2-labels.combined.tsv").write_text(header + rows)
    sequence = open_sequence(path)
    assert sequence.class_names == ("wall", "chair")
    labels = sequence.labels(0)
    assert labels is not None
    assert [int(labels[0, x]) for x in (0, 30, 50)] == [VOID_LABEL, 1, 1]


def test_scannet_calibration_of_the_recorded_size(tmp_path: Path, known: Known) -> None:
    (tmp_path / "pose").mkdir()
    (tmp_path / "intrinsic").mkdir()
    _scannet_folder(tmp_path, known)
    np.savetxt(tmp_path / "intrinsic" / "intrinsic_color.txt", [[1170, 0, 647.5], [0, 1170, 483.5], [0, 0, 1]])
    camera = open_sequence(tmp_path).camera
    assert camera is not None
    assert (camera.fx, camera.cx, camera.cy) == pytest.approx((1170 * WIDTH / 1296, WIDTH / 2, HEIGHT / 2))


def _sens_bytes(known: Known, zero_times: bool = False) -> bytes:
    color, depth = np.eye(4, dtype="<f4"), np.eye(4, dtype="<f4")
    color[:2, :3] = [[50, 0, 31.5], [0, 50, 23.5]]
    depth[:2, :3] = [[25, 0, 15.5], [0, 25, 11.5]]
    eye = np.eye(4, dtype="<f4")
    out = struct.pack("<IQ", 4, 9) + b"StructSen" + color.tobytes() + eye.tobytes() + depth.tobytes() + eye.tobytes()
    out += struct.pack("<2i4IfQ", 2, 1, WIDTH, HEIGHT, WIDTH // 2, HEIGHT // 2, 1000.0, N)
    for i in range(N):
        jpeg = cv2.imencode(".jpg", known.rgb[i][:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
        packed = zlib.compress((known.depth[i][::2, ::2] * 1000).astype("<u2").tobytes())
        pose = known.poses[i] if i != 2 else np.full((4, 4), -np.inf)
        out += pose.astype("<f4").tobytes()
        out += struct.pack("<4Q", 0 if zero_times else 1000 + 40_000 * i, 0, len(jpeg), len(packed)) + jpeg + packed
    return out + struct.pack("<Q", 0)  # no IMU frames


def test_sens_file(tmp_path: Path, known: Known) -> None:
    path = tmp_path / "scene.sens"
    path.write_bytes(_sens_bytes(known))
    sequence = open_sequence(path)
    assert (sequence.format, len(sequence), sequence.has_depth, sequence.has_labels) == ("sens", N, True, False)
    assert sequence.camera == Camera(WIDTH, HEIGHT, 50, 50, 32, 24)
    assert sequence.has_pose.tolist() == [True, True, False, True, True]
    assert sequence.world_from_cam is not None
    np.testing.assert_allclose(sequence.world_from_cam[[0, 4]], known.poses[[0, 4]], atol=1e-6)
    np.testing.assert_allclose(sequence.timestamps, np.arange(N) * 0.04)
    depth = sequence.depth(4)
    assert depth is not None
    np.testing.assert_allclose(depth, known.depth[4])
    assert np.abs(sequence.rgb(4).astype(int) - known.rgb[4]).max() <= 3
    path.write_bytes(_sens_bytes(known, zero_times=True))
    assert open_sequence(path).timestamps is None


def test_damaged_sens_files_are_explained(tmp_path: Path, known: Known) -> None:
    data, path = _sens_bytes(known), tmp_path / "scene.sens"
    path.write_bytes(b"")
    with pytest.raises(InputError, match="is empty"):
        open_sequence(path)
    for keep in (10, 200, len(data) // 2):
        path.write_bytes(data[:keep])
        with pytest.raises(InputError, match="not copied completely"):
            open_sequence(path)
    path.write_bytes(struct.pack("<I", 3) + data[4:])
    with pytest.raises(InputError, match="version 4"):
        open_sequence(path)
    count_at = 12 + 9 + 256 + 8 + 16 + 4
    path.write_bytes(data[:count_at] + struct.pack("<Q", 1 << 60) + data[count_at + 8 :])
    with pytest.raises(InputError, match="declares"):
        open_sequence(path)


def test_a_depth_frame_unpacks_to_no_more_than_its_size(tmp_path: Path, known: Known) -> None:
    deep = Known(known.rgb, [np.tile(d, (40, 40)) for d in known.depth], known.poses, known.times)
    (tmp_path / "scene.sens").write_bytes(_sens_bytes(deep))
    depth = open_sequence(tmp_path / "scene.sens").depth(0)
    assert depth is not None
    assert depth.shape == (HEIGHT, WIDTH)


def _colmap_folder(path: Path, known: Known, names: list[str]) -> None:
    for name, rgb in zip(names, known.rgb, strict=True):
        write_rgb(path / "images" / name, rgb)
    camera = (WIDTH, HEIGHT, 50.0, 51.0, 32.5, 24.0)
    write_colmap_model(path / "sparse" / "0", posed_images(names, np.linalg.inv(known.poses), *camera))


@pytest.mark.parametrize("place", [".", "sparse/0"])
def test_colmap_project(tmp_path: Path, known: Known, place: str) -> None:
    names = ["a/9.png", "a/10.png", "a/11.png", "b/1.png", "b/2.png"]
    _colmap_folder(tmp_path, known, names)
    sequence = open_sequence(tmp_path / place)
    assert (sequence.format, sequence.metric) == ("colmap", False)
    assert sequence.names == tuple(name.replace("/", "_") for name in names)
    assert sequence.camera == Camera(WIDTH, HEIGHT, 50, 51, 32.5, 24)
    assert sequence.world_from_cam is not None
    np.testing.assert_allclose(sequence.world_from_cam, known.poses, atol=1e-12)
    assert (sequence.rgb(3) == known.rgb[3]).all()
    (tmp_path / "images" / "b" / "2.png").unlink()
    fewer = open_sequence(tmp_path / place)
    assert len(fewer) == 4
    assert "1 of the model's 5 images are missing" in fewer.notes[0]


def test_colmap_models_at_hand(shared_data: Path) -> None:
    phone = open_sequence(shared_data / "phone_desk")
    assert (phone.format, len(phone), phone.names[0]) == ("colmap", 70, "frame_0001.jpg")
    rows = np.loadtxt(shared_data / "phone_desk" / "poses_c2w.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(phone.world_from_cam, rows, atol=1e-8)
    photos = open_sequence(shared_data / "format_cases" / "colmap_table10")
    assert len(photos) == 10
    assert photos.camera is None
    assert "10 different cameras" in photos.notes[0]


def test_colmap_uses_its_largest_model_and_all_images(tmp_path: Path, known: Known) -> None:
    names = [f"{i}.png" for i in range(N)]
    _colmap_folder(tmp_path, known, names)
    camera = (WIDTH, HEIGHT, 50.0, 51.0, 32.5, 24.0)
    largest = posed_images(names[:4], np.linalg.inv(known.poses[:4]), *camera)
    write_colmap_model(tmp_path / "sparse" / "1", largest)
    write_colmap_model(tmp_path / "sparse" / "0", posed_images(names[2:4], np.linalg.inv(known.poses[2:4]), *camera))
    for suffix in (".bin", ".txt"):
        sequence = open_sequence(tmp_path)
        assert sequence.has_pose.tolist() == [True] * 4 + [False]
        np.testing.assert_allclose(sequence.world_from_cam[:4], known.poses[:4], atol=1e-12)
        assert [(sequence.rgb(i) == known.rgb[i]).all() for i in range(N)] == [True] * N
        assert "1 of the 5 images in images/ have no pose in the model 1/" in sequence.notes[0]
        assert "of 2 models the largest, 1/, is used, not 0/" in sequence.notes[1]
        assert read_poses(tmp_path).names == tuple(names[:4])
        for path in tmp_path.glob(f"sparse/*/*{suffix}"):
            path.unlink()
        if suffix == ".bin":
            assert list(tmp_path.glob("sparse/*/*.txt"))


def test_colmap_leaves_out_what_is_no_photograph_of_its_kind(tmp_path: Path, known: Known) -> None:
    names = [f"{i}.png" for i in range(N)]
    _colmap_folder(tmp_path, known, names)
    write_rgb(tmp_path / "images" / "0_mask.png", known.rgb[0])
    write_rgb(tmp_path / "images" / "cam_b" / "0.png", known.rgb[0])
    write_rgb(tmp_path / "images" / "large.png", np.tile(known.rgb[0], (2, 2, 1)))
    for name in ("7.CR3", "8.jxl", "0.cr2", "clip.mp4"):
        (tmp_path / "images" / name).touch()
    for i in (1, 2):
        write_grey_png(tmp_path / "masks" / f"{i}.png{'.png' if i == 1 else ''}", np.zeros((HEIGHT, WIDTH), np.uint8))
    sequence = open_sequence(tmp_path)
    assert sequence.names == tuple(names)
    assert [None if p is None else p.name for p in sequence.mask_paths] == [None, "1.png.png", "2.png", None, None]
    assert "left out (1 in images/cam_b/)" in sequence.notes[0]
    assert sequence.notes[1] == "2 images beside the 5 that are read are not named by the data set: left out"
    assert "(1 .cr3, 1 .jxl, 1 .mp4)" in sequence.notes[2]


def test_colmap_images_that_were_reduced(tmp_path: Path, known: Known) -> None:
    _colmap_folder(tmp_path, known, [f"{i}.png" for i in range(N)])
    for i, path in enumerate(sorted((tmp_path / "images").iterdir())):
        write_rgb(tmp_path / "images_4" / path.name, known.rgb[i][::4, ::4])
        path.unlink()
    source = DatasetRecording(open_sequence(tmp_path))
    assert source.camera() == Camera(WIDTH // 4, HEIGHT // 4, 12.5, 12.75, 8.125, 6)


def test_colmap_text_with_blanks_in_names_and_without_points(tmp_path: Path, known: Known) -> None:
    names = [f"cam {'ab'[i % 2]}/IMG {i}.png" for i in range(N)]
    _colmap_folder(tmp_path, known, names)
    for path in (tmp_path / "sparse" / "0").glob("*.bin"):
        path.unlink()
    for points in ("# a heading\n", ""):
        (tmp_path / "sparse" / "0" / "points3D.txt").write_text(points)
        assert read_colmap_model(tmp_path / "sparse" / "0").names == tuple(sorted(names))
        assert open_sequence(tmp_path).has_pose.all()


def test_colmap_images_that_lead_out_are_refused(tmp_path: Path, known: Known) -> None:
    _colmap_folder(tmp_path, known, [f"{i}.png" for i in range(N)])
    for kind in ("bin", "txt"):
        path = tmp_path / "sparse" / "0" / f"images.{kind}"
        path.write_bytes(path.read_bytes().replace(b"0.png", b"/etc/") if kind == "bin" else b"")
    with pytest.raises(InputError, match="outside"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("name", "parameters", "expected"),
    [
        ("SIMPLE_PINHOLE", (50, 32, 24), Camera(64, 48, 50, 50, 32, 24)),
        ("PINHOLE", (50, 51, 32, 24), Camera(64, 48, 50, 51, 32, 24)),
        ("SIMPLE_RADIAL", (50, 32, 24, 0.1), Camera(64, 48, 50, 50, 32, 24, (0.1, 0, 0, 0))),
        ("RADIAL", (50, 32, 24, 0.1, 0.2), Camera(64, 48, 50, 50, 32, 24, (0.1, 0.2, 0, 0))),
        ("OPENCV", (50, 51, 32, 24, 1, 2, 3, 4), Camera(64, 48, 50, 51, 32, 24, (1, 2, 3, 4))),
        ("OPENCV_FISHEYE", (50, 51, 32, 24, 1, 2, 3, 4), Camera(64, 48, 50, 51, 32, 24, (1, 2, 3, 4), True)),
        ("RADIAL_FISHEYE", (50, 32, 24, 1, 2), Camera(64, 48, 50, 50, 32, 24, (1, 2, 0, 0), True)),
        ("FULL_OPENCV", (50, 51, 32, 24, 1, 2, 3, 4, 5, 0, 0, 0), Camera(64, 48, 50, 51, 32, 24, (1, 2, 3, 4, 5))),
        (
            "FULL_OPENCV",
            (50, 51, 32, 24, 1, 2, 3, 4, 5, 1, 0, 0),
            Camera(64, 48, 50, 51, 32, 24, (1, 2, 3, 4, 5, 1, 0, 0)),
        ),
        ("FOV", (50, 51, 32, 24, 0.9), None),
    ],
)
def test_colmap_camera_models(name: str, parameters: tuple, expected: Camera | None) -> None:
    camera, notes = camera_from_colmap(name, 64, 48, parameters)
    assert camera == expected
    assert bool(notes) == (expected is None)


def _transforms(path: Path, known: Known, **changes: object) -> dict:
    frames = []
    for i in range(N):
        write_rgb(path / "images" / f"frame_{i}.png", known.rgb[i])
        write_grey_png(path / "depths" / f"frame_{i}.png", (known.depth[i] * 1000).astype(np.uint16))
        opengl = known.poses[i] @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"images/frame_{i}.png", "transform_matrix": opengl.tolist()})
        frames[-1]["depth_file_path"] = f"depths/frame_{i}.png"
    table = {"w": WIDTH, "h": HEIGHT, "fl_x": 50.0, "fl_y": 51.0, "cx": 32.5, "cy": 24.0, "k1": 0.1, "p2": 0.01}
    table |= {"camera_model": "OPENCV", "frames": frames[::-1]} | changes
    (path / "transforms.json").write_text(json.dumps({k: v for k, v in table.items() if v is not None}))
    return table


def test_nerfstudio(tmp_path: Path, known: Known) -> None:
    _transforms(tmp_path, known)
    for place in (tmp_path, tmp_path / "transforms.json"):
        sequence = open_sequence(place)
        assert (sequence.format, sequence.metric) == ("nerfstudio", True)
        assert sequence.names == tuple(f"frame_{i}.png" for i in range(N))
        assert sequence.camera == Camera(WIDTH, HEIGHT, 50, 51, 32.5, 24, (0.1, 0, 0, 0.01))
        assert sequence.world_from_cam is not None
        np.testing.assert_allclose(sequence.world_from_cam, known.poses, atol=1e-12)
        depth = sequence.depth(2)
        assert depth is not None
        np.testing.assert_allclose(depth, known.depth[2])


def test_nerfstudio_uses_all_images_and_the_masks_it_names(tmp_path: Path, known: Known) -> None:
    table = _transforms(tmp_path, known)
    for i, frame in enumerate(table["frames"]):
        frame["mask_path"], frame["normal_file_path"] = f"masks/{frame['file_path'][7:]}", f"normals/{i}.png"
        write_grey_png(tmp_path / frame["mask_path"], np.zeros((HEIGHT, WIDTH), np.uint8))
    (tmp_path / "transforms.json").write_text(json.dumps(table | {"frames": table["frames"][:3]}))
    sequence = open_sequence(tmp_path)
    assert sequence.has_pose.tolist() == [False, False, True, True, True]
    assert [p and p.name for p in sequence.mask_paths] == [None, None, *(f"frame_{i}.png" for i in (2, 3, 4))]
    assert "2 of 5 images have no frame in transforms.json" in sequence.notes[0]
    assert "under normal_file_path are not read" in sequence.notes[1]


@pytest.mark.parametrize("change", ["form", "case"])
def test_names_in_another_unicode_form_or_case(change: str, tmp_path: Path, known: Known) -> None:
    table = _transforms(tmp_path, known)
    for i, frame in enumerate(table["frames"]):
        path = tmp_path / frame["file_path"]
        frame["file_path"] = "images/" + unicodedata.normalize("NFC", f"Küche_{i}.png")
        new = unicodedata.normalize("NFD", f"Küche_{i}.png") if change == "form" else f"KÜCHE_{i}.PNG"
        path.rename(path.with_name(new))
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    assert open_sequence(tmp_path).has_pose.all()
    (tmp_path / "images").rename(tmp_path / "other")
    for i in range(N):
        write_rgb(tmp_path / "images" / f"Bad_{i}.png", known.rgb[i])
    with pytest.raises(InputError, match="images/ holds 5 images of other names, such as 'Bad_0"):
        open_sequence(tmp_path)


def test_blender_style_transforms(tmp_path: Path, known: Known) -> None:
    table = _transforms(tmp_path, known)
    for frame in table["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
        frame.pop("depth_file_path")
    table["frames"].append({"file_path": "./images/frame_99", "transform_matrix": np.eye(4).tolist()})
    blender = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / 40), "frames": table["frames"]}
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "transforms_train.json").write_text(json.dumps(blender))
    sequence = open_sequence(tmp_path)
    assert sequence.metric is False
    assert len(sequence) == N
    assert sequence.camera is not None
    assert (sequence.camera.fx, sequence.camera.cx) == pytest.approx((40, WIDTH / 2))
    assert "1 of 6 frames have no image" in sequence.notes[0]
    (tmp_path / "transforms_test.json").write_text("{}")
    assert "transforms_test.json beside transforms_train.json is not read" in open_sequence(tmp_path).notes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": []}, "none of its 0 frames"),
        ({"frames": [{"transform_matrix": []}]}, "no file_path"),
        ({"frames": [{"file_path": "../../etc/hostname", "transform_matrix": []}]}, "outside"),
        ({"frames": [{"file_path": "images/frame_0.png"}]}, "no 4x4 matrix"),
        ({"fl_x": "50"}, "expected a number"),
    ],
)
def test_bad_transforms_are_explained(tmp_path: Path, known: Known, changes: dict, message: str) -> None:
    _transforms(tmp_path, known, **changes)
    with pytest.raises(InputError, match=message):
        open_sequence(tmp_path)


def test_images_that_are_links_are_read(tmp_path: Path, known: Known) -> None:
    """As in the caches of Hugging Face, DVC and git-annex, and on shared disks."""
    names = [f"{i}.png" for i in range(N)]
    for make, path in ((_colmap_folder, tmp_path / "colmap"), (_transforms, tmp_path / "nerfstudio")):
        make(path, known, names) if make is _colmap_folder else make(path, known)
        for number, image in enumerate(sorted((path / "images").iterdir())):
            blob = tmp_path / "blobs" / path.name / f"{number}f0e1d2c"
            blob.parent.mkdir(parents=True, exist_ok=True)
            image.rename(blob)
            image.symlink_to(blob)
        assert (open_sequence(path).rgb(3) == known.rgb[3]).all()
        (path / "images").rename(tmp_path / f"store_{path.name}")
        (path / "images").symlink_to(tmp_path / f"store_{path.name}")
        assert (open_sequence(path).rgb(3) == known.rgb[3]).all()


def test_a_name_does_not_lead_out_behind_a_link(tmp_path: Path, known: Known) -> None:
    _tum_folder(tmp_path / "set", known)
    write_rgb(tmp_path / "store" / "0.png", known.rgb[0])
    write_rgb(tmp_path / "secret.png", known.rgb[0])
    (tmp_path / "set" / "link").symlink_to(tmp_path / "store")
    (tmp_path / "set" / "rgb.txt").write_text("1.0 rgb/../link/0.png\n")
    assert (open_sequence(tmp_path / "set").rgb(0) == known.rgb[0]).all()
    (tmp_path / "set" / "rgb.txt").write_text("1.0 link/../secret.png\n")
    with pytest.raises(InputError, match="no such file"):
        open_sequence(tmp_path / "set")


@pytest.mark.parametrize(
    "named",
    ["images\\frame_{}.png", "../images/frame_{}.png", "/home/other/scan/images/frame_{}.png",
     "C:\\Users\\Me\\scan\\images\\frame_{}", ".\\frame_{}.png"],
)  # fmt: skip
def test_names_of_another_machine_are_found(tmp_path: Path, known: Known, named: str) -> None:
    table = _transforms(tmp_path, known)
    for i, frame in enumerate(table["frames"][::-1]):
        frame["file_path"] = named.format(i)
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    sequence = open_sequence(tmp_path)
    assert [(sequence.rgb(i) == known.rgb[i]).all() for i in range(N)] == [True] * N
    np.testing.assert_allclose(sequence.world_from_cam, known.poses, atol=1e-12)
    if named.startswith(".."):  # as instant-ngp's scripts write it: the table in a folder beside the images
        (tmp_path / "ngp").mkdir()
        (tmp_path / "transforms.json").rename(tmp_path / "ngp" / "transforms.json")
        assert (open_sequence(tmp_path / "ngp").rgb(3) == known.rgb[3]).all()


def test_a_name_that_is_nowhere_is_told_with_the_places(tmp_path: Path, known: Known) -> None:
    frame = {"file_path": "D:\\scan\\0.png", "transform_matrix": np.eye(4).tolist()}
    _transforms(tmp_path, known, frames=[frame])
    with pytest.raises(InputError, match=r"none of its 1 frames.*'D:\\\\scan\\\\0.png'.*Put the images into"):
        open_sequence(tmp_path)
    write_rgb(tmp_path / "images" / "0.png", known.rgb[0])
    _transforms(tmp_path, known, frames=[frame, frame | {"file_path": "E:\\scan\\0.png"}])
    with pytest.raises(InputError, match="2 frames are the image"):
        open_sequence(tmp_path)


@pytest.mark.parametrize(
    ("changes", "distortion", "is_nominal", "note"),
    [
        ({"k2": 0.02, "k3": -0.3}, (0.1, 0.02, 0, 0.01, -0.3), False, ""),
        ({"k4": 0.2}, (0.1, 0, 0, 0.01), True, "k4 of transforms.json are not supported here: the lens is found"),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.2, "p2": 0}, (0.1, 0, 0, 0.2), False, ""),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.2}, (0.1, 0, 0, 0.2), False, "p2 of transforms.json"),
        ({"camera_model": "PINHOLE", "k1": 0, "p2": 0}, (0, 0, 0, 0), False, ""),
        ({"camera_model": "EQUIRECTANGULAR"}, None, False, "EQUIRECTANGULAR is not supported.*--camera equirect"),
        ({"camera_model": "FISHEYE624"}, None, False, "FISHEYE624 is not supported"),
        ({"fl_x": None, "fl_y": None}, None, False, "states no focal length"),
    ],
)
def test_what_transforms_state_of_the_lens_is_used_or_told(
    tmp_path: Path, known: Known, changes: dict, distortion: tuple | None, is_nominal: bool, note: str
) -> None:
    _transforms(tmp_path, known, **changes)
    sequence = open_sequence(tmp_path)
    assert bool(sequence.notes) == bool(note)
    assert re.search(note, " ".join(sequence.notes))
    camera = sequence.camera
    assert (camera is None) == (distortion is None)
    if camera is not None:
        assert (camera.distortion, camera.is_nominal) == (distortion, is_nominal)
        assert (camera.fx, camera.fisheye) == (50, "FISHEYE" in changes.get("camera_model", ""))


@pytest.mark.parametrize(("spread", "mean"), [(0.004, 50.1), (0.3, None)])
def test_intrinsics_of_each_image_are_averaged_where_they_hardly_differ(
    tmp_path: Path, known: Known, spread: float, mean: float | None
) -> None:
    table = _transforms(tmp_path, known)
    keys = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    own = {key: table.pop(key) for key in keys}
    for i, frame in enumerate(table["frames"]):
        frame |= own | {"fl_x": 50.0 * (1 + spread * (i % 2)) + (0.02 if mean else 0)}
    (tmp_path / "transforms.json").write_text(json.dumps(table))
    sequence = open_sequence(tmp_path)
    assert ("their mean is used" if mean else "different cameras") in sequence.notes[0]
    assert (sequence.camera.fx if sequence.camera else None) == (mean and pytest.approx(mean, abs=1e-9))


def test_each_set_is_told_from_the_others(tmp_path: Path, known: Known, shared_data: Path) -> None:
    _tum_folder(tmp_path / "tum", known)
    _colmap_folder(tmp_path / "colmap", known, [f"{i}.png" for i in range(N)])
    _transforms(tmp_path / "nerfstudio", known)
    write_rgb(tmp_path / "folder" / "rgb" / "a.png", known.rgb[0])
    write_matrices(tmp_path / "folder" / "traj.txt", known.poses[:1])
    for name in ("tum", "colmap", "nerfstudio", "folder"):
        assert recognise_source(tmp_path / name) == name
    expected = {"kitchen": "7scenes", "replica_office0": "replica", "whiteroom": "folder", "phone_desk": "colmap"}
    assert {name: recognise_source(shared_data / name) for name in expected} == expected
