"""The scale by a network that was trained with one camera: a stand-in that sees what it says, and the real one."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs_slam.formats.images import read_rgb
from msgs_slam.pipelines.networks.card import Card
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.scene.metres import SMALL_SD, network_scale, retake
from msgs_slam.pipelines.scene.room import SeenFrame
from msgs_slam.pipelines.types import Intrinsics, ProxyMaps
from tests.networks import save_network

SIDE, NEAREST, SPAN = 64, 1.0, 3.0
CAMERA = Intrinsics(200, 150, 160.0, 160.0, 104.0, 72.0)


def stand_in(path: Path) -> Card:
    """Metres = 1 + 3 · red, for pictures of its own 64 x 64 camera."""
    save_network(
        path,
        f"float[1, 3, {SIDE}, {SIDE}] image",
        f"float[1, 1, {SIDE}, {SIDE}] depth",
        "one = Gather <axis = 1> (image, red)",
        "scaled = Mul (one, span)",
        "depth = Add (scaled, near)",
        red=[0], span=float(SPAN), near=float(NEAREST),
    )  # fmt: skip
    return Card("depth", path, "image", "depth", white=1.0, size=(SIDE, SIDE), focal=(60.0, 80.0), relative="scale")


def painted(unit: float, confidence: float = 1.0) -> SeenFrame:
    """A picture whose red tells its depth, in units of `unit` metres: steep, so that pixels must meet their own."""
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    red = (np.clip(0.5 + 0.3 * np.sin(x / 9) + 0.2 * np.cos(y / 7), 0, 1) * 255).astype(np.uint8)
    depth = ((NEAREST + SPAN * red / 255.0) / unit).astype(np.float32)
    maps = ProxyMaps(depth, np.full_like(depth, confidence), np.zeros_like(red), np.zeros_like(depth))
    return SeenFrame(np.stack([red, 0 * red, 0 * red], -1), maps, np.eye(4))


@pytest.mark.parametrize("unit", [0.2, 1.0, 7.0])
def test_a_network_is_asked_as_its_training_camera_would_have_seen(tmp_path: Path, unit: float) -> None:
    found = network_scale(stand_in(tmp_path / "n.onnx"), [painted(unit)] * 3, CAMERA, 1, "cpu")
    assert found.log_scale == pytest.approx(np.log(unit), abs=0.02)
    assert SMALL_SD <= found.sd < SMALL_SD + 0.01


def test_a_network_that_errs_by_a_known_line_is_put_right(tmp_path: Path) -> None:
    """The truth is half of the square of what it says."""
    card = replace(stand_in(tmp_path / "n.onnx"), metres_line=(0.5, 2.0))
    frame = painted(1.0)
    squared = replace(frame, maps=replace(frame.maps, depth=0.5 * frame.maps.depth**2))
    assert network_scale(card, [squared] * 3, CAMERA, 1, "cpu").log_scale == pytest.approx(0, abs=0.02)


def test_a_narrow_lens_is_enlarged_and_its_depth_counts_more(tmp_path: Path) -> None:
    narrow = replace(CAMERA, fx=400.0, fy=400.0)
    card = stand_in(tmp_path / "n.onnx")
    wide, tele = (network_scale(card, [painted(1.0)], camera, 1, "cpu") for camera in (CAMERA, narrow))
    # 64 pixels at 60 see 56 degrees; at 400 pixels of focal length the picture's 200 see 28: 1.875 times less.
    assert tele.log_scale - wide.log_scale == pytest.approx(np.log(400 / 200 * 64 / 60), abs=0.03)


def test_without_reliable_depth_it_says_nothing(tmp_path: Path) -> None:
    assert network_scale(stand_in(tmp_path / "n.onnx"), [painted(1.0, 0.1)], CAMERA, 1, "cpu") is None


def test_a_picture_taken_again_shows_the_same_directions() -> None:
    picture = np.zeros((150, 200, 3), np.uint8)
    cv2.circle(picture, (134, 51), 3, (255, 255, 255), -1)  # pixel centres at integers: (134.5, 51.5) here
    other = Intrinsics(64, 64, 60.0, 80.0, 32.0, 32.0)
    seen = retake(picture, CAMERA, other)[..., 0].astype(np.float64)
    y, x = (np.average(np.arange(64) + 0.5, weights=seen.sum(axis)) for axis in (1, 0))
    assert x == pytest.approx((134.5 - 104) / 160 * 60 + 32, abs=0.1)
    assert y == pytest.approx((51.5 - 72) / 160 * 80 + 32, abs=0.1)


def test_the_real_network_tells_the_metres_of_a_real_kitchen(shared_data: Path, tmp_path: Path) -> None:
    """FastDepth against the Kinect's own depth, in a unit of 0.3 m; another camera than that of its training."""
    store = ModelStore.open(tmp_path)
    if not store.take(shared_data / "models", [store.get("fast-depth")]):
        pytest.skip("fast_depth_224.tflite is not in the shared models")
    pytest.importorskip("ai_edge_litert")
    camera, frames = Intrinsics(640, 480, 525.0, 525.0, 320.0, 240.0), []
    for i in (0, 100, 200, 298):
        image = read_rgb(shared_data / "kitchen" / f"frame-{i:06d}.color.jpg")
        depth = cv2.imread(str(shared_data / "kitchen" / f"frame-{i:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        metres = np.where(depth == 65535, 0, depth).astype(np.float32) / 1000
        maps = ProxyMaps(metres / 0.3, np.ones_like(metres), np.zeros(metres.shape, np.uint8), np.ones_like(metres))
        frames.append(SeenFrame(image, maps, np.eye(4)))
    card = store.card(store.get("fast-depth"))
    found = network_scale(card, frames, camera, 1, "cpu")
    assert 0 < abs(found.log_scale - np.log(0.3)) < 2 * found.sd
    assert SMALL_SD <= found.sd < 0.4
    assert found.source == "the network fast-depth"
