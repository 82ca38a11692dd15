"""Panoramas and fisheye pictures become pictures of a pinhole camera."""

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from msgs_slam.formats.datasets.sequence import Camera
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.video_head import PART, WHOLE, image_sphere, video_sphere
from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.frames.inputs import check_frames
from msgs_slam.pipelines.geometry.camera import CUBE, ONE_CAMERA, Rig, rig_of
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.source.faces import find_faces, fisheye_face, has_panorama_shape, panorama_faces
from msgs_slam.pipelines.source.recording import open_recording

WIDTH = 320
XML = "<GSpherical:ProjectionType>{}</GSpherical:ProjectionType><GSpherical:StereoMode>{}</GSpherical:StereoMode>"


def _colors(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) of a world that is painted by direction."""
    waves = np.array([[3.0, 1, 2], [-2, 4, 1], [1, -2, 5]])
    return 127 + 100 * np.sin(directions / np.linalg.norm(directions, axis=-1, keepdims=True) @ waves.T)


def test_each_side_of_a_panorama_is_what_a_pinhole_camera_sees_there() -> None:
    rows, columns = np.indices((WIDTH // 2, WIDTH)) + 0.5
    longitude, latitude = (columns / WIDTH - 0.5) * 2 * np.pi, (0.5 - 2 * rows / WIDTH) * np.pi
    level = np.cos(latitude)
    directions = np.stack([np.sin(longitude) * level, -np.sin(latitude), np.cos(longitude) * level], axis=-1)
    faces = panorama_faces(WIDTH, WIDTH // 2, 960)
    sides = faces.cut(_colors(directions).astype(np.uint8))
    k = faces.pinhole
    rows, columns = np.indices((k.height, k.width)) + 0.5
    rays = np.stack([(columns - k.cx) / k.fx, (rows - k.cy) / k.fy, np.ones(rows.shape)], axis=-1)
    for side_from_rig, side in zip(CUBE, sides, strict=True):
        error = np.abs(side - _colors(rays @ side_from_rig))
        assert 0 < error.mean() < 1
        assert error.max() < 6


def test_sides_have_the_panoramas_resolution_and_at_most_so_many_pixels() -> None:
    assert panorama_faces(960, 480, 960).pinhole.width == 306
    big = panorama_faces(1440, 720, 240)
    assert (big.pinhole.width, big.size) == (240, (754, 377))
    assert big.names("000001.jpg") == [f"f{c}_000001.jpg" for c in range(6)]
    with pytest.raises(InputError, match="twice as wide as high, these images are 640x480"):
        panorama_faces(640, 480, 960)


def test_a_mask_is_cut_as_its_picture_is() -> None:
    faces = panorama_faces(WIDTH, WIDTH // 2, 960)
    below = np.zeros((WIDTH // 2, WIDTH), bool)
    below[WIDTH * 3 // 8 :] = True  # lower than 45 degrees
    shares = [faces.cut_mask(below, camera).mean() for camera in range(6)]
    # Of a level side what lies below y = hypot(x, z): the corners, beyond a hyperbola.
    assert shares[4] == 0
    assert all(0 < share < 0.01 or share == 0 for share in shares[:4])
    assert shares[5] == pytest.approx(np.pi / 4, abs=0.02)


def test_frames_of_a_rig_are_counted_camera_by_camera() -> None:
    rig = rig_of(6, 30)
    assert rig.stations == 5
    assert rig.frames_of([1, 4]) == [1, 4, 6, 9, 11, 14, 16, 19, 21, 24, 26, 29]
    assert rig_of(1, 30) is ONE_CAMERA
    np.testing.assert_allclose(np.linalg.det(CUBE), 1)
    with pytest.raises(ValueError, match="cam_from_rig"):
        Rig(1, np.eye(3))


def _fisheye_picture(camera: Camera, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """By OpenCV's fisheye module, from a pinhole picture of the same focal length about its middle."""
    matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    xy = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(np.float64)
    rays = cv2.fisheye.undistortPoints(xy.reshape(-1, 1, 2), matrix, np.array(camera.distortion)).reshape(xy.shape)
    height, width = picture.shape[:2]
    at = rays * [camera.fx, camera.fy] + [width / 2 - 0.5, height / 2 - 0.5]
    return cv2.remap(picture, *np.moveaxis(at.astype(np.float32), -1, 0), cv2.INTER_CUBIC).astype(np.uint8)


LENS = Camera(320, 240, 180.0, 180.0, 160.0, 120.0, (0.03, -0.01, 0.002, 0.0), fisheye=True)


def test_a_known_fisheye_is_made_straight() -> None:
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 255, (720, 960, 3), np.uint8), (0, 0), 4)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    faces = fisheye_face(LENS, 960)
    (straight,) = faces.cut(_fisheye_picture(LENS, scene))
    assert (faces.pinhole.fx, faces.names("a.jpg")) == (pytest.approx(180.0, abs=1e-6), ["a.jpg"])
    true = scene[360 - 120 : 360 + 120, 480 - 160 : 480 + 160]
    assert (
        np.abs(straight.astype(float) - true).mean() < 3 < np.abs(straight[:, 4:].astype(float) - true[:, :-4]).mean()
    )


def _folder(tmp_path: Path, width: int, height: int) -> Path:
    for i in range(2):
        write_rgb(tmp_path / "pictures" / f"{i}.jpg", np.full((height, width, 3), 90 + i, np.uint8))
    return tmp_path / "pictures"


@pytest.mark.parametrize(
    "text",
    ["180,180,160,120,0.03,-0.01,0.002,0", "cameras.txt", "lens.json"],
)
def test_a_fisheye_is_given_by_numbers_or_files(tmp_path: Path, text: str) -> None:
    (tmp_path / "cameras.txt").write_text("1 OPENCV_FISHEYE 320 240 180 180 160 120 0.03 -0.01 0.002 0\n")
    (tmp_path / "lens.json").write_text(
        '{"model": "OPENCV_FISHEYE", "width": 320, "height": 240, "fx": 180, "fy": 180, "cx": 160, "cy": 120,'
        ' "k1": 0.03, "k2": -0.01, "k3": 0.002, "k4": 0}'
    )
    source = open_recording(_folder(tmp_path, 320, 240))
    numbers = text[0].isdigit()
    config = FramesConfig(intrinsics=text if numbers else str(tmp_path / text), camera="fisheye" if numbers else "auto")
    faces = find_faces(source, config)
    assert faces is not None
    assert faces.fisheye == LENS


def test_what_cannot_be_is_refused_before_the_work(tmp_path: Path) -> None:
    source = open_recording(_folder(tmp_path, 320, 160))
    assert find_faces(source, FramesConfig()) is None
    assert has_panorama_shape(source, FramesConfig())
    assert not has_panorama_shape(source, FramesConfig(camera="perspective"))
    with pytest.raises(InputError, match="--camera fisheye needs the lens"):
        find_faces(source, FramesConfig(camera="fisheye"))
    for text in ("proxy.depth=files", "proxy.scale_ref=1.jpg:1,1,2,2=1"):
        with pytest.raises(InputError, match="cannot be used with panoramas"):
            check_frames(source.path, load_config(None, ["frames.camera=equirectangular", text]))
    check_frames(source.path, load_config(None, ["frames.camera=equirectangular", "proxy.scale_ref=height=1.5"]))


@pytest.mark.parametrize(("said", "kind"), [("equirectangular", WHOLE), ("cubemap", PART), ("", "")])
def test_photo_spheres_are_known_by_their_xmp(tmp_path: Path, said: str, kind: str) -> None:
    xmp = f'<rdf:Description GPano:ProjectionType="{said}"/>'.encode() if said else b""
    Image.new("RGB", (320, 160)).save(tmp_path / "a.jpg", xmp=xmp)
    assert image_sphere(tmp_path / "a.jpg") == kind
    source = open_recording(tmp_path)
    if kind == PART:
        with pytest.raises(InputError, match="partial or stereo panorama"):
            find_faces(source, FramesConfig())
    else:
        assert (find_faces(source, FramesConfig()) is not None) == (kind == WHOLE)


def _box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def _sphere_box(mode: int, bounds: tuple[int, int, int, int], projection: bytes = b"equi") -> bytes:
    inner = _box(b"prhd", bytes(16)) + _box(projection, bytes(4) + struct.pack(">4I", *bounds))
    return _box(b"st3d", bytes(4) + bytes([mode])) + _box(b"sv3d", _box(b"svhd", bytes(5)) + _box(b"proj", inner))


@pytest.mark.parametrize(
    ("box", "kind"),
    [
        (_box(b"uuid", XML.format("equirectangular", "mono").encode()), WHOLE),
        (_box(b"uuid", XML.format("equirectangular", "top-bottom").encode()), PART),
        (_sphere_box(0, (0, 0, 0, 0)), WHOLE),
        (_sphere_box(1, (0, 0, 0, 0)), PART),
        (_sphere_box(0, (0, 0, 0x40000000, 0x40000000)), PART),
        (_sphere_box(0, (0, 0, 0, 0), b"cbmp"), PART),
        (b"", ""),
    ],
)
def test_videos_are_known_by_their_boxes(tmp_path: Path, box: bytes, kind: str) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(_box(b"ftyp", b"isom") + _box(b"moov", _box(b"mvhd", bytes(100)) + box) + _box(b"mdat", b""))
    assert video_sphere(path) == kind


def test_a_lens_is_no_matter_of_the_size_given(tmp_path: Path) -> None:
    small = fisheye_face(replace(LENS, width=640, height=480, fx=360, fy=360, cx=320, cy=240), 320)
    assert small.size == (320, 240)
    assert small.pinhole.fx == pytest.approx(180, abs=0.01)
