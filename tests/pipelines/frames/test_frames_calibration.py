"""Intrinsics as users write them, and the lens made from them."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from msgs_slam.formats.datasets.sequence import Camera
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.poses import read_poses
from msgs_slam.formats.reading import noting_files
from msgs_slam.pipelines.frames.stage import run
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm.lens import distortion_of, make_lens, set_lens, to_pycolmap, unknown_camera
from msgs_slam.pipelines.source.given import read_intrinsics
from msgs_slam.pipelines.source.recording import FolderRecording
from tests.pipelines.frames.conftest import Walk


def test_numbers_on_the_command_line() -> None:
    assert read_intrinsics("525,526,320,240", 640, 480) == Camera(640, 480, 525, 526, 320, 240)
    assert read_intrinsics("525, 526, 320, 240, 0.1, -0.2, 0.01, 0.02", 640, 480).distortion == (0.1, -0.2, 0.01, 0.02)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.txt", "525 526 320 240\n"),
        ("b.txt", "# K\n525 0 320\n0 526 240\n0 0 1\n"),
        ("cameras.txt", "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE 640 480 525 526 320 240\n"),
        ("twice.txt", "1 PINHOLE 1280 960 1050 1052 640 480\n"),
        ("c.json", '{"width": 640, "height": 480, "fx": 525, "fy": 526, "cx": 320, "cy": 240}'),
        ("d.json", '{"w": 640, "h": 480, "fx": 525, "fy": 526, "cx": 319.5, "cy": 239.5, "pixel_centre": "integer"}'),
    ],
)
def test_files_that_say_the_same(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert read_intrinsics(str(tmp_path / name), 640, 480) == Camera(640, 480, 525, 526, 320, 240)


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_cameras_txt_projects_as_pycolmap_does(model: str, tmp_path: Path) -> None:
    theirs = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
    rng = np.random.default_rng(3)
    theirs.params = [p + (0 if p else float(rng.normal(0, 0.02))) for p in theirs.params]
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(theirs)
    reconstruction.write_text(tmp_path)
    ours = to_pycolmap(read_intrinsics(str(tmp_path / "cameras.txt"), 640, 480))
    points = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    np.testing.assert_allclose(ours.img_from_cam(points), theirs.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("525,526,320", "3 numbers"),
        ("525,526,3200,240", "principal point"),
        ("no_such_file.json", "neither numbers nor an existing file"),
        ("-525,526,320,240", "no camera"),
    ],
)
def test_wrong_text_is_refused(text: str, what: str) -> None:
    with pytest.raises(InputError, match=what):
        read_intrinsics(text, 640, 480)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("1 PINHOLE 480 640 525 526 240 320\n", "another shape"),
        ("1 RAD_TAN_THIN_PRISM_FISHEYE 640 480 525 526 320 240 0 0 0 0 0 0 0 0 0 0 0 0\n", "not supported"),
        ("1 PINHOLE 640 480 525 526 320\n", "4 parameters"),
        ("hello world\n", "holds no camera"),
        ("1 2 3 4 5 6 7 8 9\n", "no calibration matrix"),
    ],
)
def test_wrong_files_are_refused(content: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "camera.txt").write_text(content)
    with pytest.raises(InputError, match=what):
        read_intrinsics(str(tmp_path / "camera.txt"), 640, 480)


KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0001, 1.7e-05]
  distortion_model: radtan
  intrinsics: [525, 526, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, 0.1]
  - [0.0, 1.0, 0.0, 0.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.003, 0.0004]
  distortion_model: equidistant
  intrinsics: [460, 461, 330, 250]
  resolution: [640, 480]
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 525., 0., 319.5, 0., 526., 239.5, 0., 0., 1. ]
distortion_model: rational_polynomial
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 8
   dt: d
   data: [ 0.1, 0.2, 0., 0., 0.3, 0.4, 0.5, 0.6 ]
"""


@pytest.mark.parametrize(
    ("name", "text", "distortion"),
    [
        ("opencv.yaml", OPENCV, (0.1, 0.2, 0, 0, 0.3, 0.4, 0.5, 0.6)),
        ("windows.yaml", OPENCV.replace("\n", "\r\n"), (0.1, 0.2, 0, 0, 0.3, 0.4, 0.5, 0.6)),
        ("chain.yaml#cam0", KALIBR, (-0.28, 0.07, 0.0001, 1.7e-05)),
    ],
)  # fmt: skip
def test_files_of_other_programs_count_pixels_from_zero(
    name: str, text: str, distortion: tuple[float, ...], tmp_path: Path
) -> None:
    (tmp_path / name.partition("#")[0]).write_bytes(text.encode())
    found = read_intrinsics(str(tmp_path / name), 640, 480)
    padded = (*distortion, *[0.0] * 8)[:8]
    assert Camera(640, 480, found.fx, found.fy, found.cx, found.cy) == Camera(640, 480, 525, 526, 320, 240)
    assert (*found.distortion, *[0.0] * 8)[:8] == padded
    assert not found.fisheye


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_what_opencv_writes_is_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"calibration{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("camera_matrix", np.array([[525.0, 0, 319.5], [0, 526, 239.5], [0, 0, 1]]))
    file.write("distortion_coefficients", np.array([[0.1, -0.2, 1e-5, 0, 0.05]]))
    file.release()
    assert read_intrinsics(str(path), 640, 480) == Camera(640, 480, 525, 526, 320, 240, (0.1, -0.2, 1e-5, 0, 0.05))


def test_the_files_that_poses_are_read_from_are_an_input_and_no_others(tmp_path: Path) -> None:
    """A COLMAP project has gigabytes beside its model, and apps keep poses in files of any suffix."""
    line = "{}, {:06d}, {}, 0, 0, 0, 0, 0, 1\n"
    head = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    quaternion = [0, 0, 0, 1]
    for name, good in (
        ("odometry.csv", head + line.format(0, 0, 1)),
        ("metadata", json.dumps({"poses": [[*quaternion, 0, 0, 1]]})),
    ):
        (folder := tmp_path / name.partition(".")[0]).mkdir()
        (folder / name).write_text(good)
        (folder / "dense").mkdir()
        for unread in ("dense/depth.bin", "dense/notes.txt", "other.json"):
            (folder / unread).write_text("{}")
        with noting_files() as files:
            read_poses(folder)
        assert files == [folder / name]


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_one_of_several_cameras_must_be_named(suffix: str, tmp_path: Path) -> None:
    made = pycolmap.Reconstruction()
    for number, focal in ((1, 500.0), (7, 900.0)):
        camera = pycolmap.Camera.create_from_model_name(number, "RADIAL_FISHEYE", focal, 640, 480)
        camera.params = [*camera.params[:3], 0.02, -0.01]
        made.add_camera_with_trivial_rig(camera)
    (made.write_text if suffix == ".txt" else made.write_binary)(str(tmp_path))
    path = tmp_path / f"cameras{suffix}"
    with pytest.raises(InputError, match=r"2 cameras that differ: 1 \(640x480, fx 500\), 7 \(.*name the one .*#1"):
        read_intrinsics(str(path), 640, 480)
    found = read_intrinsics(f"{path}#7", 640, 480)
    assert (found.fx, found.fisheye, found.distortion) == (900, True, (0.02, -0.01, 0, 0))
    with pytest.raises(InputError, match="no camera '2' but 1"):
        read_intrinsics(f"{path}#2", 640, 480)


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("a.yaml", KALIBR, r"cam0 \(640x480, fx 525\), cam1"),
        ("fov.yaml", OPENCV.replace("rational_polynomial", "fov"), "lens model fov is not supported"),
        ("ds.yaml", "cam0: {camera_model: ds, intrinsics: [1, 1, 1, 1], resolution: [640, 480]}", "model ds is not"),
        ("odd.yaml", OPENCV.replace("distortion_coefficients", "lens_dist"), "'lens_dist' is not understood"),
        ("tilt.yaml", OPENCV.replace("0.6 ]", "0.6, 0.1, 0, 0, 0]"), "distortion is"),
        ("skew.yaml", OPENCV.replace("525., 0.,", "525., 1.,"), "without skew"),
        ("bomb.yaml", "a: &a [1, 2]\nb: [*a, *a]\n", "aliases"),
        ("empty.yaml", "{}\n", "files that work: JSON .*OpenCV"),
        ("other.xml", "<?xml version='1.0'?><a><f>3</f></a>", "files that work: JSON .*OpenCV"),
        ("short.bin", "nonsense", "damaged or no calibration file"),
    ],
)  # fmt: skip
def test_what_would_be_lost_is_refused(name: str, text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=what):
        read_intrinsics(str(tmp_path / name), 640, 480)


def test_a_fifth_coefficient_is_kept(tmp_path: Path) -> None:
    camera = {"w": 640, "h": 480, "fx": 525, "fy": 526, "cx": 320, "cy": 240, "distortion": [0.1, 0, 0, 0, 0.3]}
    (tmp_path / "k3.json").write_text(json.dumps(camera))
    found = read_intrinsics(str(tmp_path / "k3.json"), 640, 480)
    assert distortion_of(to_pycolmap(found)) == (0.1, 0, 0, 0, 0.3)


LENSES = [(-0.15, 0.02, 0.001, -0.002), (0.08, -0.03, 0.0, 0.0), (-0.3, 0.1, 0.0, 0.003), (0.0, 0.0, 0.0, 0.0)]


@pytest.mark.parametrize("distortion", LENSES)
def test_points_are_undistorted_as_opencv_does(distortion: tuple[float, float, float, float]) -> None:
    camera = Camera(640, 480, 500.0, 505.0, 315.0, 243.0, distortion)
    lens = make_lens(to_pycolmap(camera))
    xy = np.random.default_rng(0).uniform([80, 60], [560, 420], (200, 2))
    matrix = np.array([[500.0, 0, 315.0], [0, 505.0, 243.0], [0, 0, 1]])
    new = lens.pinhole.matrix
    # The (0.5, 0.5) convention drops out when all of K, K' and the points follow it.
    exactly = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    expected = cv2.undistortPoints(xy[:, None], matrix, np.array(distortion), P=new, criteria=exactly)[:, 0]
    np.testing.assert_allclose(lens.undistort_points(xy), expected, atol=1e-5)


@pytest.mark.parametrize("distortion", LENSES)
def test_images_and_points_are_undistorted_alike_and_no_border_is_blank(
    distortion: tuple[float, float, float, float],
) -> None:
    camera = Camera(320, 240, 250.0, 252.0, 158.0, 121.0, distortion)
    lens = make_lens(to_pycolmap(camera))
    x, y = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    ramps = np.stack([x / 320 * 255, y / 240 * 255, np.full_like(x, 255)], axis=-1).round().astype(np.uint8)
    straight = lens.undistort_image(ramps)
    assert straight.shape == ramps.shape
    # Each undistorted pixel must show the ramp's value at the place that `undistort_points` sends there.
    source = np.random.default_rng(1).uniform([40, 30], [280, 210], (300, 2))
    at = lens.undistort_points(source)
    seen = straight[np.clip(at[:, 1].astype(int), 0, 239), np.clip(at[:, 0].astype(int), 0, 319)].astype(float)
    inside = (at > 1).all(1) & (at < [319, 239]).all(1)
    assert inside.mean() > 0.8
    assert np.abs(seen[inside, 0] / 255 * 320 - source[inside, 0]).max() < 2.5
    assert np.abs(seen[inside, 1] / 255 * 240 - source[inside, 1]).max() < 2.5
    assert (straight[..., 2] == 255).all()
    assert (lens.shift_px > 0.3) == any(distortion)


def test_a_camera_without_distortion_keeps_its_intrinsics() -> None:
    lens = make_lens(to_pycolmap(Camera(640, 480, 525.0, 525.0, 320.0, 240.0)))
    assert lens.shift_px < 1e-9
    assert (lens.pinhole.fx, lens.pinhole.cx) == (525.0, 320.0)


def test_pincushion_distortion_zooms_in_just_enough() -> None:
    camera = unknown_camera(640, 480, 600.0, is_prior=False)
    camera.params = [600.0, 320.0, 240.0, 0.1]
    lens = make_lens(camera)
    assert lens.pinhole.fx > 600
    corners = np.array([[0.0, 0.0], [640.0, 480.0], [0.0, 480.0]])
    rays = np.column_stack([(corners - np.array([320, 240])) / lens.pinhole.fx, np.ones(3)])
    source = camera.img_from_cam(rays)
    assert (source > -0.02).all()
    assert np.abs(source[0]).min() < 1  # the corner shows the source's edge, not less


@pytest.mark.parametrize(("focal", "k1", "share"), [(0.5, -0.3, 0.02), (0.45, -0.25, 0.027), (0.5, -0.15, 0.0)])
def test_what_a_strong_lens_would_show_twice_is_left_out(focal: float, k1: float, share: float) -> None:
    camera = unknown_camera(640, 360, focal * 640, is_prior=False)
    camera.params = [focal * 640, 320.0, 180.0, k1]
    lens = make_lens(camera)
    if share == 0:
        assert lens.folded is None
        return
    assert lens.folded is not None
    assert lens.folded.mean() == pytest.approx(share, abs=0.003)
    # A pixel that is seen once comes back to itself.
    row, column = np.indices((360, 640))
    source = np.stack(lens.maps, -1).astype(np.float64) + 0.5
    straight = np.stack([column, row], -1) + 0.5
    back = lens.undistort_points(source.reshape(-1, 2)).reshape(straight.shape)
    radius = np.linalg.norm((straight - [320, 180]) / lens.pinhole.fx, axis=2)
    turn = np.sqrt(1 / (3 * -k1))
    assert np.abs(back - straight)[radius < 0.97 * turn].max() < 0.5
    assert lens.folded[radius > 1.005 * turn].all()
    assert not lens.folded[radius < 0.99 * turn].any()


def test_a_second_coefficient_changes_nothing_by_itself() -> None:
    camera = unknown_camera(640, 480, 600.0, is_prior=False)
    camera.params = [600.0, 320.0, 240.0, -0.07]
    points = np.random.default_rng(0).uniform([-0.4, -0.4, 0.6], [0.4, 0.4, 1.4], (20, 3))
    before = camera.img_from_cam(points)
    set_lens(camera, 2)
    assert camera.model == pycolmap.CameraModelId.RADIAL
    np.testing.assert_array_equal(camera.img_from_cam(points), before)


def test_a_prior_focal_length_that_leaves_no_structure_is_dropped_before_the_images_are_blamed(
    bent_walk: Walk, make_context: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FolderRecording, "exif_focal", lambda _: 9.2)
    context = make_context(bent_walk.folder)
    figures = run(context)
    assert figures["calibration"] == "self-calibrated"
    assert figures["focal_px"] == pytest.approx(bent_walk.focal, rel=0.03)
    assert figures["keyframes_placed"] == figures["keyframes"]
    assert any("the metadata state (9 px) leaves no structure" in w for w in context.warnings)
    with pytest.raises(InputError, match=r"--intrinsics \(focal length 9 px\) leaves no structure.*correct or omit it"):
        run(make_context(bent_walk.folder, "frames.intrinsics=9.2,9.2,160,120", name="held"))


def test_a_plausible_prior_focal_length_that_contradicts_the_images_is_dropped_and_said(
    bent_walk: Walk, make_context: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FolderRecording, "exif_focal", lambda _: 0.3 * bent_walk.focal)
    context = make_context(bent_walk.folder)
    figures = run(context)
    assert figures["calibration"] == "self-calibrated"
    assert figures["focal_px"] == pytest.approx(bent_walk.focal, rel=0.03)
    assert any(
        "the focal length that the metadata state" in w and "contradicts the images" in w for w in context.warnings
    )


def test_a_prior_focal_length_that_the_images_agree_with_is_kept(
    bent_walk: Walk, make_context: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FolderRecording, "exif_focal", lambda _: 1.03 * bent_walk.focal)
    context = make_context(bent_walk.folder)
    assert run(context)["calibration"] == "exif"
    assert not [w for w in context.warnings if "contradicts the images" in w]
