"""The synthetic world: its truth agrees with itself, and its pictures are worth reconstructing."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.types import Intrinsics
from tests.world import (
    ClipOptions,
    World,
    WorldFrame,
    make_world,
    render_frame,
    write_sequence,
)

OPTIONS = ClipOptions(frames=40, width=160, height=120, laps=1.0)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(texel=0.02)


def unproject(depth: NDArray, k: Intrinsics, world_from_cam: NDArray) -> NDArray:
    v, u = np.indices(depth.shape) + 0.5
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(depth)], axis=-1)
    return (rays * depth[..., None]) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]


def test_same_arguments_same_bytes_and_another_seed_another_picture() -> None:
    first, second, other = (make_world(seed=s, texel=0.03) for s in (3, 3, 4))
    options = replace(OPTIONS, noise=2.0)
    a, b, c = (render_frame(w, options, 5) for w in (first, second, other))
    assert a.rgb.tobytes() == b.rgb.tobytes()
    assert a.depth.tobytes() == b.depth.tobytes()
    assert np.abs(a.rgb.astype(int) - c.rgb).mean() > 2
    assert (a.depth == c.depth).all()


def test_depth_of_one_frame_predicts_depth_and_colour_of_the_next(world: World) -> None:
    options = replace(OPTIONS, frames=120)
    k = options.intrinsics
    first, second = (render_frame(world, options, i) for i in (50, 51))
    points = unproject(first.depth.astype(np.float64), k, first.world_from_cam)
    cam = np.linalg.inv(second.world_from_cam)
    seen = points @ cam[:3, :3].T + cam[:3, 3]
    x, y = k.fx * seen[..., 0] / seen[..., 2] + k.cx, k.fy * seen[..., 1] / seen[..., 2] + k.cy
    inside = (x > 1) & (y > 1) & (x < k.width - 1) & (y < k.height - 1)
    map_x, map_y = (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)
    depth = cv2.remap(second.depth, map_x, map_y, cv2.INTER_LINEAR)
    error = np.abs(depth - seen[..., 2])[inside]
    assert 0 < np.median(error) < 2e-3
    assert (error < 0.02).mean() > 0.85
    color = cv2.remap(second.rgb, map_x, map_y, cv2.INTER_LINEAR).astype(float)
    unmoved = np.abs(second.rgb.astype(float) - first.rgb)[inside].mean()
    moved = np.abs(color - first.rgb)[inside].mean()
    assert 0 < moved < 0.5 * unmoved


def test_distortion_moves_points_as_the_lens_says(world: World) -> None:
    """The depth seen through a lens is the pinhole depth at the undistorted place."""
    k1 = -0.12
    plain, bent = (render_frame(world, replace(OPTIONS, k1=k), 7).depth for k in (0.0, k1))
    k = OPTIONS.intrinsics
    v, u = np.indices(plain.shape)
    straight = np.stack([(u + 0.5 - k.cx) / k.fx, (v + 0.5 - k.cy) / k.fy], axis=-1).reshape(-1, 1, 2)
    on_plane = np.concatenate([straight.reshape(-1, 2), np.ones((straight.shape[0], 1))], axis=1)
    distorted, _ = cv2.projectPoints(on_plane, np.zeros(3), np.zeros(3), np.eye(3), np.array([k1, 0, 0, 0]))
    moved = distorted.reshape(*plain.shape, 2) * (k.fx, k.fy) + (k.cx - 0.5, k.cy - 0.5)
    expected = cv2.remap(bent, moved[..., 0].astype(np.float32), moved[..., 1].astype(np.float32), cv2.INTER_LINEAR)
    right, wrong = np.abs(plain - expected), np.abs(plain - bent)
    assert 0 < np.median(right) < 1e-3
    assert np.quantile(right, 0.85) < 0.01 < np.quantile(wrong, 0.7)


def test_noise_exposure_and_blur_do_what_they_say(world: World) -> None:
    clean = render_frame(world, OPTIONS, 3)
    noisy = render_frame(world, replace(OPTIONS, noise=4.0), 3)
    assert np.std(noisy.rgb.astype(float) - clean.rgb) == pytest.approx(4.0, rel=0.08)
    swung = [render_frame(world, replace(OPTIONS, exposure_swing=0.3), i).rgb.mean() for i in (3, 10)]
    still = [render_frame(world, OPTIONS, i).rgb.mean() for i in (3, 10)]
    assert swung[0] / still[0] > 1.05
    assert swung[1] / still[1] < 0.97
    blurred = render_frame(world, replace(OPTIONS, shutter=0.8), 3)

    def sharpness(frame: WorldFrame) -> float:
        return float(cv2.Laplacian(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())

    assert sharpness(blurred) < 0.5 * sharpness(clean)
    assert (blurred.depth == clean.depth).all()


def test_sequence_reads_back_as_it_was_rendered(world: World, tmp_path: Path) -> None:
    options = replace(OPTIONS, frames=3, laps=0.1, k1=0.05)
    folder = write_sequence(tmp_path / "clip", world, options)
    sequence = open_sequence(folder)
    assert len(sequence) == 3
    assert sequence.world_from_cam is not None
    for i in range(3):
        frame = render_frame(world, options, i)
        assert (sequence.rgb(i) == frame.rgb).all()
        np.testing.assert_allclose(sequence.depth(i), frame.depth, atol=5.1e-4)
        labels = sequence.labels(i)
        assert labels is not None
        names = np.array(sequence.class_names)
        assert (names[labels] == np.array(world.class_names)[frame.labels]).all()
        np.testing.assert_allclose(sequence.world_from_cam[i], frame.world_from_cam, atol=1e-8)
    np.testing.assert_allclose(sequence.timestamps, np.arange(3) / options.fps)
    camera = json.loads((folder / "intrinsics.json").read_text())
    assert camera["cx"] + 0.5 == camera["cx_colmap"] == options.intrinsics.cx
    assert sequence.camera is not None


@pytest.mark.parametrize(("name", "least_psnr"), [("clip.mp4", 26.0), ("clip.avi", 90.0)])
def test_video_decodes_to_its_frames(world: World, tmp_path: Path, name: str, least_psnr: float) -> None:
    options = replace(OPTIONS, frames=5, laps=0.05)
    frames = [render_frame(world, options, i).rgb for i in range(5)]
    path = write_video(tmp_path / name, frames, options.fps)
    decoded = list(VideoReader(path))
    assert len(decoded) == 5
    for got, frame in zip(decoded, frames, strict=True):
        error = np.mean((got.rgb.astype(float) - frame) ** 2)
        assert 10 * np.log10(255**2 / max(error, 1e-9)) > least_psnr


def test_video_of_an_unknown_kind_or_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot tell the video format"):
        write_video(tmp_path / "clip.gif", [], 10)
    with pytest.raises(InputError, match="no frame"):
        write_video(tmp_path / "clip.mp4", [], 10)
    with pytest.raises(ValueError, match="layout"):
        make_world("castle")
