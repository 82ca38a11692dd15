"""The synthetic world: its truth agrees with itself, and its pictures are worth reconstructing."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.video import VideoReader
from msgs_slam.formats.video_writer import write_video
from msgs_slam.pipelines.types import Intrinsics
from tests.world import (
    ClipOptions,
    World,
    WorldFrame,
    make_world,
    render_frame,
    walk,
    write_sequence,
)
from tests.world.shapes import TOP, Material, Solid, box, cylinder, sphere

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


def test_walk_is_smooth_closed_and_never_turns_on_the_spot(world: World) -> None:
    poses = walk(world, np.arange(401) / 400)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (401, 1, 1)), atol=1e-12
    )
    assert (np.linalg.det(poses[:, :3, :3]) > 0.999).all()
    assert np.linalg.norm(poses[0, :3, 3] - poses[-1, :3, 3]) < 0.1
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.min() / np.median(steps) > 0.4
    assert steps.max() / np.median(steps) < 2
    turns = np.array(
        [np.arccos(np.clip((np.trace(b[:3, :3] @ a[:3, :3].T) - 1) / 2, -1, 1)) for a, b in pairwise(poses)]
    )
    # Radians of turn for each metre walked: pure rotation would be infinite.
    assert (turns / steps).max() < 2.5


def test_camera_keeps_its_distance_and_sees_many_classes(world: World) -> None:
    frames = [render_frame(world, OPTIONS, i) for i in range(0, OPTIONS.frames, 4)]
    assert min(f.depth.min() for f in frames) > 0.3
    assert max(f.depth.max() for f in frames) < 14
    seen = {int(i) for f in frames for i in np.unique(f.labels)}
    assert len(seen) >= 12
    assert 0 not in seen


def test_pictures_have_corners_all_over_and_blank_walls_fewer(world: World) -> None:
    options = ClipOptions(frames=12, laps=1.0)
    blank = make_world(texel=0.02, blank_walls=True)

    def corners(chosen: World) -> list[int]:
        frames = [render_frame(chosen, options, i) for i in range(0, 12, 3)]
        return [len(cv2.SIFT_create().detect(cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY))) for f in frames]

    textured = corners(world)
    assert min(textured) > 250
    assert sum(corners(blank)) < 0.75 * sum(textured)


def test_exposure_is_neither_dark_nor_burnt(world: World) -> None:
    for i in (0, 13, 26):
        rgb = render_frame(world, OPTIONS, i).rgb
        assert 70 < rgb.mean() < 190
        assert (rgb.min(axis=2) > 253).mean() < 0.05


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


def test_solids_are_where_they_are_said_to_be() -> None:
    """Rays against each kind of solid, judged by dense signed distances along the ray."""
    from tests.world.cast import pack_solids, trace

    paint = Material("plain", (0.5, 0.5, 0.5))
    distances: list[tuple[Solid, Callable[[NDArray], NDArray]]] = [
        (sphere("s", (0.2, 0.1, 0.0), 1.0, paint), lambda p: np.linalg.norm(p - (0.2, 0.1, 0), axis=1) - 0.5),
        (
            cylinder("c", (0.1, 0.0, -0.4), 0.8, 0.9, paint),
            lambda p: np.maximum(np.hypot(p[:, 0] - 0.1, p[:, 1]) - 0.4, np.abs(p[:, 2] - 0.05) - 0.45),
        ),
        (
            box("b", (0, 0.1, 0), (1.0, 0.6, 0.4), paint),
            lambda p: (np.abs(p - (0, 0.1, 0)) - (0.5, 0.3, 0.2)).max(axis=1),
        ),
    ]
    rng = np.random.default_rng(1)
    along = np.linspace(0, 4, 40001)
    for solid, distance in distances:
        a = pack_solids([solid])
        hits = 0
        for _ in range(40):
            origin = rng.normal(size=3)
            origin *= 1.8 / np.linalg.norm(origin)
            direction = rng.normal(scale=0.3, size=3) - origin
            direction /= np.linalg.norm(direction)
            inside = distance(origin + along[:, None] * direction) < 0
            t, s, _ = trace(*origin, *direction, np.zeros(1, np.int32), 1, *a.arguments)
            if inside.any():
                hits += 1
                assert t == pytest.approx(along[inside.argmax()], abs=2e-4)
            else:
                assert s == -1
        assert hits > 10


def test_texture_coordinates_invert() -> None:
    from tests.world.cast import pack_solids, point_on_face, surface

    paint = Material("plain", (0.5, 0.5, 0.5))
    solids = [box("b", (1, 2, 3), (1.0, 0.6, 0.4), paint, 0.7), sphere("s", (0, 1, 0), 0.8, paint)]
    solids += [cylinder("c", (0, 0, 1), 0.5, 1.0, paint), Solid(0, "r", (0, 0, 1), (5, 4, 3), paint)]
    a = pack_solids(solids)
    scene = (a.shape, a.center, a.half, a.turn)
    for s, faces in enumerate((6, 1, 3, 6)):
        for face in range(faces):
            for u, v in ((0.2, 0.3), (0.7, 0.9)):
                point = point_on_face(u, v, s, face, *scene)
                got = surface(*point, s, face, *scene)
                if s == 2 and face > 0:  # a cap's corners are not on the disc, but invert all the same
                    assert got[4] == (1.0 if face == TOP - 3 else -1.0)
                np.testing.assert_allclose(got[:2], (u, v), atol=1e-9)
                np.testing.assert_allclose(np.linalg.norm(got[2:]), 1, atol=1e-9)


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
