"""Views, covisibility, schedule, depth fields, moving the trajectory."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipelines.config import MappingConfig
from pipelines.geometry import se3
from pipelines.mapping.consistency import without_contradicted_depth
from pipelines.mapping.covisibility import keyframe_weights, overlaps
from pipelines.mapping.depth_fields import Anchors, agree_on_depth
from pipelines.mapping.load import DepthScales, MappingInput, load_views, scale_field, split_frames
from pipelines.mapping.poses import interpolate_rows, move_trajectory
from pipelines.mapping.schedule import RATE_DECAY, Schedule, Seeding
from pipelines.mapping.views import channel_table, halved, occurring_classes, working_size
from pipelines.run_folder import RunFolder
from pipelines.types import VOID, Intrinsics, Trajectory


def walk(count: int = 6) -> Trajectory:
    twists = np.linspace(0, 1, count)[:, None] * np.array([0.5, 0.1, 0.2, 0.0, 0.3, 0.1])
    lost = tuple("blurred" if i == 3 else "" for i in range(count))
    poses = se3.exp(twists)
    poses[3] = np.eye(4)
    keyframes = np.array([i in (0, 2, 5) for i in range(count)])
    return Trajectory(np.arange(count), np.arange(count) * 0.1, poses, keyframes, lost)


def test_views_hold_what_the_run_says(small_run: RunFolder, room: MappingInput) -> None:
    assert len(room.views) == 14
    assert [v.frame_id for v in room.held_out] == [4, 12]
    assert not {v.frame_id for v in room.views} & {4, 12}
    view, maps = room.views[3], small_run.load_proxy(room.views[3].frame_id)
    assert np.array_equal(view.depth.numpy(), maps.depth)
    labels = np.array([*room.class_ids, *[VOID] * (256 - len(room.class_ids))])[view.channels.numpy()]
    assert (labels == maps.labels).mean() > 0.999
    assert VOID not in room.class_ids
    assert 0 < len(room.class_ids) < len(small_run.load_classes())


def test_views_are_reduced_to_the_working_size(small_run: RunFolder) -> None:
    loaded = load_views(small_run, small_run.load_trajectory("tracking"), MappingConfig(max_side=60))
    view = loaded.views[0]
    assert view.depth.shape == (45, 60)
    assert view.image.shape == (45, 60, 3)
    assert view.intrinsics.fx == pytest.approx(small_run.load_calibration().intrinsics.fx * 0.75)


def test_half_a_view_sees_the_same(room: MappingInput) -> None:
    view = room.views[0]
    half = halved(view)
    assert half.depth.shape == (30, 40)
    assert torch.equal(half.depth, view.depth[1::2, 1::2])
    assert abs(half.colors.mean() - view.colors.mean()) < 0.01
    assert half.intrinsics.cx * 2 == view.intrinsics.cx


def test_working_size_never_enlarges() -> None:
    k = Intrinsics(300, 200, 250, 250, 150, 100)
    assert working_size(k, 640) == k == working_size(k, 0)
    assert (working_size(k, 150).width, working_size(k, 150).height) == (150, 100)


def test_classes_that_hardly_occur_get_no_channel() -> None:
    labels = np.full((400, 500), 4, np.uint8)
    labels[:200] = 9
    labels[0, 0], labels[1] = 7, VOID
    assert occurring_classes([labels]) == (4, 9)
    assert channel_table((4, 9))[[4, 9, 7, VOID]].tolist() == [0, 1, VOID, VOID]


def test_hold_out_takes_keyframes_and_others_alike() -> None:
    trajectory = walk()
    assert split_frames(trajectory, 0) == ([0, 2, 5], [])
    # Every fourth from 2 on: frame 2, a keyframe; every second from 1 on: 1 and 5, for 3 is lost.
    assert split_frames(trajectory, 4) == ([0, 5], [2])
    assert split_frames(trajectory, 2) == ([0, 2], [1, 5])


def test_scale_field_spans_the_picture() -> None:
    field = scale_field(np.exp(np.array([[0.0, 0.2], [0.0, 0.2]])), (30, 40))
    assert field.shape == (30, 40)
    x = (np.arange(40) + 0.5) / 40
    assert np.abs(np.log(field[7]) - 0.2 * x).max() < 2e-3
    assert DepthScales({}).apply(0, None) is None


def test_overlap_is_one_with_oneself_and_less_elsewhere(room: MappingInput) -> None:
    overlap = overlaps(room.views)
    assert np.allclose(np.diag(overlap), 1)
    assert (overlap >= 0).all()
    assert (overlap <= 1).all()
    neighbours, far = np.diag(overlap, 1).mean(), np.diag(overlap, len(overlap) - 2).mean()
    assert far < neighbours < 1


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


def test_the_map_grows_by_whole_passes(room: MappingInput) -> None:
    n = len(room.views)
    settings = MappingConfig(passes=10.0, min_iterations=0)
    schedule = Schedule.plan(room.views, settings, seed=0, seeding=True, passes=None)
    visits = [schedule.step(i) for i in range(schedule.seeding, schedule.total)]
    assert [i // n for i, s in enumerate(visits) if s.prune] == [0, 3, 5]
    assert Counter(i // n for i, s in enumerate(visits) if s.grow) == {2: n, 4: n}
    assert sum(s.coarse for s in visits) == 2 * n
    refining = Schedule.plan(room.views, settings, seed=0, seeding=False, passes=4.0)
    assert not any(s.coarse for s in map(refining.step, range(refining.total)))


def relative_error(views: list, truth: list) -> float:
    errors = [(v.depth / t.depth - 1).abs()[t.depth > 0] for v, t in zip(views, truth, strict=True)]
    return float(torch.cat(errors).mean())


def test_views_agree_on_a_depth_nearer_the_truth(room: MappingInput) -> None:
    rng = np.random.default_rng(0)
    noisy = [v.with_depth(v.depth * smooth_noise(rng, v.depth.shape), v.reliability) for v in room.views]
    before = relative_error(noisy, room.views)
    by_views = relative_error(agree_on_depth(noisy), room.views)
    with_points = relative_error(agree_on_depth(noisy, room.anchors), room.views)
    assert 0 < with_points < by_views < 0.75 * before
    assert with_points < 0.4 * before


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> torch.Tensor:
    grid = np.exp(rng.normal(0, 0.05, (5, 6)) + 0.03 * rng.normal())
    return torch.from_numpy(scale_field(grid, (shape[0], shape[1])))


def test_true_depth_is_left_alone(room: MappingInput) -> None:
    assert relative_error(agree_on_depth(room.views, room.anchors), room.views) < 0.006
    assert agree_on_depth(room.views[:1])[0] is room.views[0]


def test_wild_points_do_not_drag_the_depth(room: MappingInput) -> None:
    rng = np.random.default_rng(1)
    wild = {
        i: Anchors(a.xy, np.where(rng.random(len(a.depth)) < 0.3, a.depth * 3, a.depth))
        for i, a in room.anchors.items()
    }
    assert relative_error(agree_on_depth(room.views, wild), room.views) < 0.008


def test_depth_that_others_see_through_is_dropped(room: MappingInput) -> None:
    """A patch in the air before one view; the rest of the depth stays."""
    assert all(
        (a.depth > 0).sum() > 0.97 * (b.depth > 0).sum()
        for a, b in zip(without_contradicted_depth(room.views), room.views, strict=True)
    )
    wrong = room.views[5].depth.clone()
    wrong[20:40, 30:50] *= 0.5
    views = [v.with_depth(wrong, v.reliability) if i == 5 else v for i, v in enumerate(room.views)]
    checked = without_contradicted_depth(views)[5].depth
    assert (checked[22:38, 32:48] == 0).float().mean() > 0.8


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
    run.has_proxy = lambda i: i != 2
    loaded = load_views(run, small_run.load_trajectory("tracking"), MappingConfig())  # type: ignore[arg-type]
    assert loaded.views[2].depth.max() == 0
    assert loaded.views[2].trust.max() == 0
    assert (loaded.views[2].channels == VOID).all()
    assert loaded.views[1].depth.max() > 0
    assert replace(loaded.views[1]).frame_id == 1
