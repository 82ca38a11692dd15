"""Views, schedule, moving the trajectory."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import resize_depth
from msgs_slam.pipelines.mapping.growth import Seeding
from msgs_slam.pipelines.mapping.move_map import interpolate_rows, move_trajectory
from msgs_slam.pipelines.mapping.optimise import RATE_DECAY, Schedule, keyframe_weights
from msgs_slam.pipelines.mapping.views import MappingInput, channel_table, half_view, load_views, occurring_classes
from msgs_slam.pipelines.run.files import CALIBRATION, CLASSES, PROXY_MAPS, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import VOID, Intrinsics, Trajectory


def walk(count: int = 6) -> Trajectory:
    twists = np.linspace(0, 1, count)[:, None] * np.array([0.5, 0.1, 0.2, 0.0, 0.3, 0.1])
    lost = tuple("blurred" if i == 3 else "" for i in range(count))
    poses = se3.exp(twists)
    poses[3] = np.eye(4)
    keyframes = np.array([i in (0, 2, 5) for i in range(count)])
    return Trajectory(np.arange(count), np.arange(count) * 0.1, poses, keyframes, lost)


def test_views_without_room_are_the_same_views(small_run: RunFolder, room: MappingInput) -> None:
    """Read again at every use, those that others contradict left out as ever."""
    trajectory, settings = small_run.load(TRAJECTORY, "tracking"), MappingConfig(hold_out=8)
    given = load_views(small_run, trajectory, settings, memory=0)
    assert [len(given.views), len(given.held_out)] == [len(room.views), len(room.held_out)]
    assert given.class_ids == room.class_ids
    for ours, theirs in zip([*given.views, *given.held_out], [*room.views, *room.held_out], strict=True):
        assert ours.frame_id == theirs.frame_id
        for name in ("cam_from_world", "image", "depth", "reliability", "channels", "channel_confidence"):
            assert torch.equal(getattr(ours, name), getattr(theirs, name))
    first = given.views[0]
    assert given.views[1] is given.views[1]
    assert given.views[0] is not first


def test_views_hold_what_the_run_says(small_run: RunFolder, room: MappingInput) -> None:
    assert len(room.views) == 14
    assert [v.frame_id for v in room.held_out] == [4, 12]
    assert not {v.frame_id for v in room.views} & {4, 12}
    view, maps = room.views[3], small_run.load(PROXY_MAPS, of=room.views[3].frame_id)
    kept = view.depth.numpy() > 0
    assert kept.mean() > 0.97 * (maps.depth > 0).mean()
    assert np.array_equal(view.depth.numpy()[kept], maps.depth[kept])
    labels = np.array([*room.class_ids, *[VOID] * (256 - len(room.class_ids))])[view.channels.numpy()]
    assert (labels == maps.labels).mean() > 0.999
    assert VOID not in room.class_ids
    assert 0 < len(room.class_ids) < len(small_run.load(CLASSES))


def test_views_are_reduced_to_the_working_size(small_run: RunFolder) -> None:
    loaded = load_views(small_run, small_run.load(TRAJECTORY, "tracking"), MappingConfig(max_side=60))
    view = loaded.views[0]
    assert view.depth.shape == (45, 60)
    assert view.image.shape == (45, 60, 3)
    assert view.intrinsics.fx == pytest.approx(small_run.load(CALIBRATION).intrinsics.fx * 0.75)


def test_half_a_view_sees_the_same(room: MappingInput) -> None:
    view = room.views[0]
    half = half_view(view)
    assert half.depth.shape == (30, 40)
    assert torch.equal(half.channels, view.channels[1::2, 1::2])
    four = torch.stack([view.depth[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    assert ((half.depth >= four.amin(0) - 1e-5) & (half.depth <= four.amax(0) + 1e-5)).all()
    assert abs(half.colors.mean() - view.colors.mean()) < 0.01
    assert half.intrinsics.cx * 2 == view.intrinsics.cx


@pytest.mark.parametrize(("width", "height"), [(64, 48), (43, 32)])
def test_reduced_depth_lies_on_the_same_plane_and_between_no_surfaces(width: int, height: int) -> None:
    rows = np.arange(96) + 0.5
    floor = np.tile((750 / (rows + 30)).astype(np.float32)[:, None], (1, 128))
    floor[:, 64:], floor[:8] = 40.0, 0
    small = resize_depth(floor, height, width)
    rows = (np.arange(height) + 0.5) * 96 / height
    truth = 750 / (rows[height // 8 :, None] + 30)
    left, beside = small[height // 8 :, : width // 2 - 1], small[height // 8 :, width // 2 - 1 :]
    assert np.allclose(left, truth, rtol=1e-3)
    assert (np.isclose(beside, 40) | np.isclose(beside, truth, rtol=0.03)).all()
    assert (small[: height // 12] == 0).all()


def test_working_size_never_enlarges() -> None:
    k = Intrinsics(300, 200, 250, 250, 150, 100)
    assert k.at_most(640) == k == k.at_most(0)
    assert (k.at_most(150).width, k.at_most(150).height) == (150, 100)


def test_classes_that_hardly_occur_get_no_channel() -> None:
    labels = np.full((400, 500), 4, np.uint8)
    labels[:200] = 9
    labels[0, 0], labels[1] = 7, VOID
    assert occurring_classes([labels]) == (4, 9)
    assert channel_table((4, 9))[[4, 9, 7, VOID]].tolist() == [0, 1, VOID, VOID]


def test_hold_out_takes_keyframes_and_others_alike() -> None:
    trajectory = walk()
    assert trajectory.split(0) == ([0, 2, 5], [])
    # Every fourth from 2 on: frame 2, a keyframe; every second from 1 on: 1 and 5, for 3 is lost.
    assert trajectory.split(4) == ([0, 5], [2])
    assert trajectory.split(2) == ([0, 2], [1, 5])


def test_keyframe_weights_fade_with_age_and_unreliability() -> None:
    weights = keyframe_weights(2, np.array([1.0, 1.0, 1.0, 0.5]), 0.1, 1.0)
    assert np.allclose(weights, [np.exp(-0.2), np.exp(-0.1), 1.0, np.exp(-0.5)])


def test_schedule_visits_each_view_once_a_pass(room: MappingInput) -> None:
    settings = MappingConfig(passes=3.0, min_iterations=0)
    schedule = Schedule.plan(room.views, settings, seed=1, seeding=True, passes=None)
    n = len(room.views)
    steps = [schedule.step(i) for i in range(schedule.total)]
    assert len(steps) == 3 * n + 3 * n
    assert [s.view for s in steps if s.seed is Seeding.TRUSTED] == list(range(n))
    assert [s.view for s in steps if s.seed is Seeding.REST] == list(range(n))
    assert all(s.seed is Seeding.NOTHING for s in steps[3 * n :])
    for first in range(3 * n, 6 * n, n):
        assert Counter(s.view for s in steps[first : first + n]) == Counter(range(n))
    assert steps[3 * n].rate == 1.0
    assert RATE_DECAY < steps[-1].rate < 1.2 * RATE_DECAY
    assert not any(s.refine_pose for s in steps if s.view == 0)
    again = Schedule.plan(room.views, settings, seed=1, seeding=True, passes=None)
    assert [again.step(i) for i in (7, 40, 61)] == [steps[i] for i in (7, 40, 61)]


def test_what_is_left_out_is_made_up_for_by_visits(room: MappingInput) -> None:
    settings = MappingConfig(passes=6.0, min_iterations=0)
    views = list(room.views)
    scene = torch.ones(views[3].depth.shape, dtype=torch.bool)
    scene[:, : scene.shape[1] // 2] = False
    for i in (3, 5, 8, 9, 10, 11, 12):
        views[i] = replace(views[i], scene=scene, depth=torch.where(scene, views[i].depth, 0.0))
    assert views[3].shown == pytest.approx(0.5)
    plain = Schedule.plan(room.views, settings, seed=1, seeding=True, passes=None)
    masked = Schedule.plan(views, settings, seed=1, seeding=True, passes=None)
    assert plain.visits == 6 * len(views)
    assert masked.visits == pytest.approx(6 * len(views) / 0.75, abs=1)
    hardly = [replace(v, scene=torch.zeros_like(scene)) for v in views]
    assert Schedule.plan(hardly, settings, seed=1, seeding=False, passes=4.0).visits == 8 * len(views)


def test_the_map_grows_by_whole_passes(room: MappingInput) -> None:
    n = len(room.views)
    settings = MappingConfig(passes=10.0, min_iterations=0)
    schedule = Schedule.plan(room.views, settings, seed=0, seeding=True, passes=None)
    visits = [schedule.step(i) for i in range(schedule.seeding, schedule.total)]
    assert [i // n for i, s in enumerate(visits) if s.prune] == [2, 3, 4, 5]
    assert Counter(i // n for i, s in enumerate(visits) if s.grow) == {2: n, 4: n}
    assert Counter(i // n for i, s in enumerate(visits) if s.note) == {2: n, 3: n, 4: n, 5: n}
    assert sum(s.coarse for s in visits) == 2 * n
    refining = Schedule.plan(room.views, settings, seed=0, seeding=False, passes=4.0)
    assert not any(s.coarse for s in map(refining.step, range(refining.total)))


def test_frames_between_move_with_their_keyframes() -> None:
    trajectory = walk()
    shift = np.eye(4)
    shift[0, 3] = 0.2
    ids = np.array([0, 2, 5])
    moved = move_trajectory(
        trajectory,
        ids,
        np.stack([trajectory.cam_from_world[0], *(shift @ trajectory.cam_from_world[i] for i in (2, 5))]),
    )
    assert np.allclose(moved.cam_from_world[[2, 5]], shift @ trajectory.cam_from_world[[2, 5]])
    assert np.allclose(moved.cam_from_world[1, :3, 3] - trajectory.cam_from_world[1, :3, 3], [0.1, 0, 0])
    assert np.allclose(moved.cam_from_world[4, :3, 3] - trajectory.cam_from_world[4, :3, 3], [0.2, 0, 0])
    assert np.array_equal(moved.cam_from_world[3], np.eye(4))
    same = move_trajectory(trajectory, ids, trajectory.cam_from_world[ids])
    assert np.abs(same.cam_from_world - trajectory.cam_from_world).max() < 1e-12


def test_exposure_between_keyframes_is_interpolated() -> None:
    rows = interpolate_rows(np.array([0.5, 9.0]), np.array([1.0, 0.0]), np.array([[2.0], [0.0]], np.float32))
    assert rows.tolist() == [[1.0], [2.0]]


def test_a_view_without_proxy_counts_by_its_colours(small_run: RunFolder) -> None:
    run = SimpleNamespace(
        **{n: getattr(small_run, n) for n in dir(small_run) if n.startswith("load")},
        image=small_run.image, left_out=small_run.left_out,
    )  # fmt: skip
    run.find_proxy = lambda i: small_run.find_proxy(i) if i != 2 else None
    loaded = load_views(run, small_run.load(TRAJECTORY, "tracking"), MappingConfig())  # type: ignore[arg-type]
    assert loaded.views[2].depth.max() == 0
    assert loaded.views[2].trust.max() == 0
    assert (loaded.views[2].channels == VOID).all()
    assert loaded.views[1].depth.max() > 0
    assert replace(loaded.views[1]).frame_id == 1
