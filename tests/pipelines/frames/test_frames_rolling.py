"""Rolling shutter: found where there is one and only there, and poses that are right with it."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.sfm.bundle import Bundle, adjust_bundle
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.rolling import (
    MIN_GAIN,
    RollingModel,
    Shutter,
    adjust_rolling,
    estimate,
    frame_interval,
    read_readout,
    velocities,
    weigh_readout,
)
from msgs_slam.pipelines.tracking.adjust import adjust_state
from msgs_slam.pipelines.tracking.state import Sightings, TrackState
from msgs_slam.pipelines.types import Intrinsics
from tests.pipelines.frames.made_views import model_of_bundle
from tests.world.clip import ROWS, ClipOptions, make_world, render_frame, render_view, walk
from tests.world.paths import look_at

Array = NDArray[np.float64]
CAMERA = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
COUNT, READOUT = 30, 0.03
TIMES = np.arange(COUNT) / 10


def path(times: Array) -> Array:
    """(N, 4, 4) cam_from_world of a walk past a wall by someone who looks left and right."""
    center = np.stack([0.5 * times, 0.1 * np.sin(3 * times), 0.1 * np.sin(2 * times)], axis=1)
    ahead = np.stack([0.4 * np.sin(3 * times), np.ones_like(times), 0.1 * np.sin(4 * times + 1)], axis=1)
    return np.linalg.inv(look_at(center, center + ahead, roll=0.05 * np.sin(2 * times)))


def seen_by(readout: float) -> tuple[Bundle, Array]:
    """Truth but for half a pixel of noise in what is seen, by cameras whose lowest row is so much later than the top
    one; and the points."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.5, 1.5, -1.5], [3.0, 4.5, 1.5], (400, 3))
    cam, point = (a.ravel() for a in np.meshgrid(np.arange(COUNT), np.arange(len(points)), indexing="ij"))
    late = np.zeros(len(cam))
    for _ in range(5):
        moving = path(TIMES[cam] + late)
        in_cam = np.einsum("oij,oj->oi", moving[:, :3, :3], points[point]) + moving[:, :3, 3]
        xy, depth = project(in_cam, CAMERA)
        late = readout * (np.clip(np.nan_to_num(xy[:, 1]), 0, CAMERA.height) / CAMERA.height - 0.5)
    inside = (depth > 0) & (xy >= 0).all(1) & (xy < [CAMERA.width, CAMERA.height]).all(1)
    xy = (xy + rng.normal(0, 0.5, xy.shape))[inside]
    zeros = np.zeros(len(xy))
    return Bundle(
        path(TIMES), points, cam[inside], point[inside], xy, zeros + 0.5, zeros, zeros + 1, cam[inside] * 0 - 1
    ), points


def as_model(bundle: Bundle) -> tuple[pycolmap.Reconstruction, list[Array]]:
    """`model_of_bundle` with a camera whose focal length is a little off."""
    return model_of_bundle(bundle, unknown_camera(CAMERA.width, CAMERA.height, 505.0, is_prior=True))


def off_by(cam_from_world: Array) -> float:
    """RMSE of the camera centres, after Sim(3)."""
    found, wanted = (se3.inverse(poses)[:, :3, 3] for poses in (cam_from_world, path(TIMES)))
    return float(np.sqrt(((align_points(found, wanted).apply(found) - wanted) ** 2).sum(1).mean()))


def poses_of(model: pycolmap.Reconstruction) -> Array:
    return np.array([np.vstack([model.images[k + 1].cam_from_world().matrix(), [0, 0, 0, 1]]) for k in range(COUNT)])


def test_velocity_is_the_derivative_of_the_poses_of_one_world() -> None:
    twist = np.array([0.1, 0.2, 0.3, 0.4, -0.2, 0.1])
    poses, worlds = se3.exp(np.sin(6 * TIMES)[:, None] * twist), np.arange(COUNT) // 15
    found, wanted = velocities(poses, TIMES, worlds), 6 * np.cos(6 * TIMES)[:, None] * twist
    inner = [i for i in range(COUNT) if 2 <= i % 15 < 13]
    assert 0 < np.abs(found - wanted)[inner].max() < 0.01 * np.abs(wanted).max()
    assert np.abs(found - wanted).max() < 0.15 * np.abs(wanted).max()
    assert not velocities(poses, 2 * np.arange(COUNT)).any()
    # A frame whose time is (nearly) that of its predecessor adds nothing, and above all no step of almost no length.
    for gap in (0.0, 1e-6):
        twice = np.insert(np.arange(COUNT), 12, 11)
        times = TIMES[twice] + gap * (np.arange(COUNT + 1) == 12)
        jitter = se3.exp(np.full(6, 1e-3) * (np.arange(COUNT + 1) == 12)[:, None])
        doubled, plain = velocities(jitter @ poses[twice], times), velocities(poses, TIMES)
        assert np.isfinite(doubled).all()
        assert 0 < np.abs(doubled[13:18] - plain[12:17]).max() < 0.2 * np.abs(plain).max()
    assert np.array_equal(velocities(poses, TIMES % 1.5), velocities(poses, TIMES % 1.5, worlds))


def test_readout_is_found_in_closed_form_and_only_where_there_is_one() -> None:
    at_once, _ = seen_by(0.0)
    settled = adjust_bundle(at_once, CAMERA).bundle
    for axis in ((1.0, 0.0), (0.0, 1.0)):
        seconds, share = estimate(settled, settled.obs_xy, CAMERA, TIMES, axis)
        assert abs(seconds) < 0.001
        assert seconds**2 * share < MIN_GAIN / 10
    rolling = adjust_bundle(seen_by(READOUT)[0], CAMERA).bundle
    seconds, share = estimate(rolling, rolling.obs_xy, CAMERA, TIMES, (0.0, 1.0))
    assert 0.6 * READOUT < seconds < 1.1 * READOUT
    assert seconds**2 * share > 0.3


def test_model_is_adjusted_with_the_readout_and_keeps_its_pixels() -> None:
    model, pixels = as_model(adjust_bundle(seen_by(READOUT)[0], CAMERA).bundle)
    settled = adjust_rolling(model, pixels, TIMES, None, refine_camera=True)
    assert settled is not None
    found, readout, focal_sd = settled
    assert readout[0] == 0
    assert readout[1] == pytest.approx(READOUT, rel=0.03)
    assert found.cameras[1].focal_length == pytest.approx(CAMERA.fx, abs=3 * focal_sd)
    before, after = (off_by(poses_of(m)) for m in (model, found))
    assert 0 < after < 0.25 * before
    kept = [k for k, p in enumerate(found.images[3].points2D) if p.has_point3D()]
    assert np.array_equal([found.images[3].points2D[k].xy for k in kept], pixels[2][kept])


def test_model_taken_at_once_stays_as_it_is() -> None:
    model, pixels = as_model(adjust_bundle(seen_by(0.0)[0], CAMERA).bundle)
    assert adjust_rolling(model, pixels, TIMES, None, refine_camera=True) is None


def test_readout_is_found_only_within_the_time_of_a_frame_and_where_it_bends_nothing() -> None:
    model, pixels = as_model(adjust_bundle(seen_by(READOUT)[0], CAMERA).bundle)
    assert adjust_rolling(model, pixels, TIMES, None, refine_camera=True, longest=0.9 * READOUT) is None
    assert adjust_rolling(model, pixels, TIMES, None, refine_camera=True, longest=1.2 * READOUT) is not None
    rolling = RollingModel(model, pixels, TIMES)
    right, wrong = (weigh_readout(rolling, (0.0, seconds)) for seconds in (READOUT, -READOUT))
    assert right.is_convincing
    assert right.held_out_gain > 0.3
    assert 1 < right.scale_change < 1.2
    assert not wrong.is_convincing
    assert wrong.held_out_gain < 0
    assert not replace(right, scale_change=7.0).is_convincing


def test_interval_between_images_is_that_of_the_source() -> None:
    assert frame_interval(np.array([0.0, 0.1, 0.2, 0.3]), np.array([0, 3, 6, 9])) == pytest.approx(1 / 30)
    assert frame_interval(np.array([0.0, 0.1, 5.0, 5.1]), np.array([0, 1, 2, 3])) == pytest.approx(0.1)
    assert frame_interval(np.array([1.0]), np.array([0])) == 0


@pytest.mark.parametrize("together", [True, False])
def test_tracked_frames_are_adjusted_with_the_readout(together: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not together:
        monkeypatch.setattr("msgs_slam.pipelines.tracking.adjust.MAX_FRAMES", 10)
    bundle, points = seen_by(READOUT)
    errors = []
    for shutter in (Shutter(), Shutter((0.0, READOUT), TIMES)):
        state = TrackState(points.copy(), np.zeros((len(points), 3), np.uint8), shutter=shutter)
        for k, pose in enumerate(bundle.cam_from_world):
            mine = bundle.obs_cam == k
            seen = Sightings.of(bundle.obs_point[mine], bundle.obs_xy[mine], 0.5)
            state.add_frame(k, pose, seen, is_keyframe=k % 2 == 0, segment=0)
        adjust_state(state, CAMERA, lambda _: None, False, True)
        errors.append(off_by(np.array([state.poses[i] for i in range(COUNT)])))
    assert 0 < errors[1] < 0.3 * errors[0]


def test_setting_is_a_time_or_a_word() -> None:
    assert read_readout("auto") is None
    assert read_readout("off") == (0, 0)
    assert read_readout("-0.02") == (0, -0.02)
    for text in ("on", "nan", "30"):
        with pytest.raises(InputError, match="first row to its last"):
            read_readout(text)


def test_rows_of_a_rendered_clip_are_taken_one_after_the_other() -> None:
    world = make_world("room", texel=0.05)
    options = ClipOptions(frames=20, width=64, height=48, readout=0.8)
    frame, step = render_frame(world, options, 7), options.laps / 19
    for first in (0, 24, 44):
        late = 0.8 * ((first + ROWS / 2) / 48 - 0.5)
        plain = render_view(world, replace(options, readout=0.0), walk(world, np.array([(7 + late) * step]))[0])
        assert np.array_equal(frame.depth[first : first + ROWS], plain[1][first : first + ROWS])
    assert not np.array_equal(frame.depth, render_frame(world, replace(options, readout=0.0), 7).depth)
