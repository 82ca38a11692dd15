"""Places where a path is torn, or its scale changes, are found, however good the rest is; what they part is cut."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.frames.findings import warn_of_structure
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm.adjust import adjust_model
from msgs_slam.pipelines.sfm.components import (
    PairCheck,
    Seam,
    are_on_one_plane,
    cut,
    find_components,
    find_leaps,
    find_seams,
    remove_keyframes,
    tracks_of,
    worst_contradictions,
)
from msgs_slam.pipelines.sfm.consistency import MAX_DRIFT, ModelReport, ScaleDrift, judge, scale_drift
from msgs_slam.pipelines.sfm.driver import Structure
from msgs_slam.pipelines.sfm.given import bare_model
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.matching import VerifiedPair
from msgs_slam.pipelines.types import Vocabulary
from tests.pipelines.frames.made_views import REACH as WALK_REACH
from tests.pipelines.frames.made_views import MadeViews, walk_round

COUNT, REACH = 40, 4


def _components(
    placed: Sequence[int], seams: Sequence[Seam], tracks: Sequence[Sequence[int]], breaks: tuple[int, ...] = ()
) -> list[list[int]]:
    """Of tracks whose points lie anywhere."""
    points = np.random.default_rng(0).uniform(size=(len(tracks), 3))
    return find_components(placed, seams, tracks, points, REACH, breaks)


def _checks(torn_at: int) -> list[PairCheck]:
    """Pairs of neighbours that agree, but for those across one place."""
    pairs = [(i, j) for i in range(COUNT) for j in range(i + 1, min(i + REACH + 1, COUNT))]
    return [PairCheck(i, j, 100, 20 if i < torn_at <= j else 95) for i, j in pairs]


def _tracks(torn_at: int = 0, loop: tuple[int, int] | None = None) -> list[list[int]]:
    """Points seen by four neighbours each, none across `torn_at`; fifty more by both ends of a loop."""
    rows = [[i + k for k in range(4) if i + k < COUNT] for i in range(COUNT) for _ in range(20)]
    split = [[k for k in row if (k < torn_at) == (row[0] < torn_at)] for row in rows]
    return [row for row in split if len(row) > 1] + ([[*loop]] * 50 if loop else [])


def test_one_contradicted_seam_among_many_good_ones() -> None:
    seams = find_seams(range(COUNT), _checks(torn_at=25), _tracks(), REACH)
    assert len(seams) == COUNT - 1
    assert [(s.before, s.after) for s in worst_contradictions(seams)] == [(24, 25)]
    assert not any(s.is_weak_link for s in seams)


def test_things_that_repeat_contradict_no_seam() -> None:
    """Most pairs across a corner are false, but those of neighbours have most of the matches."""
    rows = []
    for i in range(COUNT):
        for j in range(i + 1, min(i + REACH + 1, COUNT)):
            false = i < 25 <= j and j - i > 1
            rows.append(PairCheck(i, j, 40 if false else 900 // (j - i) ** 2, 1 if false else 900 // (j - i) ** 2))
    seams = find_seams(range(COUNT), rows, _tracks(), REACH)
    corner = next(s for s in seams if s.after == 25)
    assert corner.pairs == 10
    assert 0.65 < corner.agreement < 0.75
    assert worst_contradictions(seams) == []


def test_far_pairs_say_nothing_of_a_seam() -> None:
    far = [PairCheck(5, 35, 400, 0)] * 50
    assert not any(s.is_contradicted for s in find_seams(range(COUNT), _checks(0) + far, _tracks(), REACH))


def test_what_is_taken_out_leaves_no_observation(made_model: pycolmap.Reconstruction) -> None:
    before = len(made_model.points3D)
    remove_keyframes(made_model, [4, 7])
    assert sorted(made_model.reg_image_ids()) == [1, 2, 3, 4, 6, 7, 9, 10]
    tracks = tracks_of(made_model, 10)
    assert 50 < len(tracks) <= before
    assert not any({4, 7} & set(t) for t in tracks)
    focal = made_model.cameras[1].focal_length
    assert 0 <= adjust_model(made_model, refine_camera=True) < 0.01 * focal
    assert made_model.cameras[1].focal_length == pytest.approx(focal, rel=0.001)


def test_a_model_of_nothing_has_no_part() -> None:
    assert _components([], find_seams([], [], [], REACH), []) == []
    model = pycolmap.Reconstruction()
    model.add_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 300.0, 320, 240))
    report = judge(model, [], [], 4, REACH)
    assert (report.registered, report.score, report.is_sound) == (0, 0.0, False)


def test_keyframes_that_were_not_placed_leave_a_gap() -> None:
    placed = [k for k in range(COUNT) if not 10 <= k < 13]
    checks = [c for c in _checks(0) if c.first in placed and c.second in placed]
    tracks = [t for row in _tracks() if len(t := [k for k in row if k in placed]) > 1]
    seams = find_seams(placed, checks, tracks, REACH)
    assert Seam(9, 13, 20, 4, 1.0) not in seams  # points of four neighbours reach 12 at most
    assert next(s for s in seams if s.before == 9).is_weak_link
    assert _components(placed, seams, tracks) == [list(range(13, COUNT)), list(range(10))]


def test_where_two_structures_share_one_keyframe_alone_nothing_holds_their_sizes() -> None:
    """Each side sees points of the keyframe from itself and other keyframes, and no point is seen from both sides."""
    row = [t for t in _tracks() if t[-1] <= 20 or t[0] >= 20]
    seams = find_seams(range(COUNT), _checks(0), row, REACH)
    assert [s.points for s in seams[19:21]] == [0, 20]  # before the keyframe, and behind it
    assert [len(p) for p in _components(range(COUNT), seams, row)] == [20, 20]
    tied = row + [[19, 20, 21]] * 12
    assert not any(s.is_weak_link for s in find_seams(range(COUNT), _checks(0), tied, REACH))
    skipping = row + [[19, 21]] * 50  # directions from one to the other, but no size
    assert [s.before for s in find_seams(range(COUNT), _checks(0), skipping, REACH) if s.is_weak_link] == [19]


def test_a_loop_holds_two_runs_together() -> None:
    for loop, parts in ((None, [25, 15]), ((2, 38), [COUNT])):
        tracks = _tracks(25, loop)
        found = _components(range(COUNT), find_seams(range(COUNT), _checks(0), tracks, REACH), tracks)
        assert [len(p) for p in found] == parts


def test_no_loop_joins_what_a_break_parts() -> None:
    """Three rooms; the path leaps from the second to the third, which is the first again."""
    tracks = [t for t in _tracks(25) if not t[0] < 12 <= t[-1]] + [[2, 30]] * 110 + [[14, 35]] * 90
    seams = find_seams(range(COUNT), _checks(0), tracks, REACH)

    def sizes(breaks: tuple[int, ...], more: list[list[int]]) -> list[int]:
        return [len(p) for p in _components(range(COUNT), seams, [*tracks, *more], breaks)]

    assert sizes((), []) == [COUNT]
    assert sizes((25,), []) == sizes((25,), [[5, 20]] * 60) == [27, 13]
    assert sizes((25,), [[5, 20]] * 120) == [25, 15]


def test_no_loop_of_one_plane_joins_rooms() -> None:
    """A door that is like another, and is a door of a room; from high above all there is is one plane."""
    rng = np.random.default_rng(0)
    tracks = [*_tracks(25), *[[2, 38]] * 60]
    seams, is_loop = find_seams(range(COUNT), _checks(0), tracks, REACH), np.arange(len(tracks)) >= len(tracks) - 60
    room, door = rng.uniform(0, 4, (len(tracks), 3)), rng.uniform(0, 1, (len(tracks), 3)) * (1, 2, 0)
    for points, parts in (
        (room, [COUNT]),
        (np.where(is_loop[:, None], door, room), [25, 15]),
        (room * (1, 1, 0), [COUNT]),
    ):
        found = find_components(range(COUNT), seams, tracks, points, REACH)
        assert [len(p) for p in found] == parts
    assert are_on_one_plane(room[:3])
    assert not are_on_one_plane(room)


def test_a_keyframe_astray_does_not_part_what_is_around_it() -> None:
    seams = find_seams(range(COUNT), _checks(0), _tracks(), REACH)
    cut_around = [replace(s, points=0) if s.after in (20, 21) else s for s in seams]
    found = _components(range(COUNT), cut_around, _tracks(), (20, 21))
    assert [len(p) for p in found] == [COUNT - 1, 1]
    assert found[1] == [20]


def test_a_path_leaps_where_no_camera_can_follow() -> None:
    times = np.cumsum(np.random.default_rng(0).uniform(0.1, 1.0, COUNT))
    centers = np.outer(times, [0.4, 0.0, 0.1]) * np.linspace(0.5, 1.5, COUNT)[:, None]
    assert find_leaps(centers, times) == []
    centers[25:] += 3
    assert find_leaps(centers, times) == [25]
    centers[10] += 2
    assert find_leaps(centers, times) == [10, 11, 25]
    assert find_leaps(centers[:1], times[:1]) == []


def test_four_fast_steps_are_a_walk() -> None:
    centers, times = np.zeros((COUNT, 3)), np.arange(float(COUNT))
    centers[:, 0] = np.cumsum(np.full(COUNT, 0.1))
    for steps, leaps in ((1, [20]), (3, [20, 21, 22]), (4, []), (10, [])):
        walk = centers.copy()
        walk[:, 0] += np.clip(np.arange(COUNT) - 19, 0, steps) * 0.9
        assert find_leaps(walk, times) == leaps


def test_a_model_is_cut_where_its_camera_leaps(made_model: pycolmap.Reconstruction) -> None:
    """Six keyframes and four more in a row with a long step between, though points are seen from both sides. Where
    nothing matches across it may be a film's cut, unless there is time between for the camera to have moved on."""
    for i in range(1, 11):
        image = made_model.images[i]
        turn = image.cam_from_world().rotation.matrix()
        place = np.array([0.1 * i + 100 * (i > 6), 0.0, 0.0])
        image.frame.rig_from_world = pycolmap.Rigid3d(np.column_stack([turn, -turn @ place]))
    xy = [np.array([p.xy for p in made_model.images[i].points2D]) for i in range(1, 11)]
    near = [VerifiedPair(5, 6, np.zeros((0, 2), np.uint32), 0, np.zeros((3, 3, 3)))]
    times = np.arange(10.0) / 8
    later = times + (np.arange(10) > 5)
    for pairs, taken in ((near, None), ([], times)):
        whole = judge(made_model, pairs, xy, 10, REACH, taken)
        assert (len(whole.largest), whole.leaps) == (10, ())
    for pairs, taken in ((near, times), ([], later)):
        parted = judge(made_model, pairs, xy, 10, REACH, taken)
        assert (parted.components, parted.leaps) == (((0, 1, 2, 3, 4, 5), (6, 7, 8, 9)), (6,))


@pytest.fixture
def made_model() -> pycolmap.Reconstruction:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 10, 120
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def test_after_the_cut_no_point_is_seen_from_two_parts(made_model: pycolmap.Reconstruction) -> None:
    parts = [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9]]
    assert any(min(t) < 6 <= max(t) for t in tracks_of(made_model, 10))
    cut(made_model, parts, 10)
    tracks = tracks_of(made_model, 10)
    assert len(tracks) > 50
    assert all(max(t) < 6 or min(t) >= 6 for t in tracks)
    assert np.bincount([t[0] >= 6 for t in tracks])[0] > 50


def test_a_whole_model_is_not_touched(made_model: pycolmap.Reconstruction) -> None:
    before = tracks_of(made_model, 10)
    cut(made_model, [list(range(10))], 10)
    assert tracks_of(made_model, 10) == before


def _seam(before: int, points: int = 50, agreement: float = 0.9) -> Seam:
    return Seam(before, before + 1, points, 10, agreement)


@pytest.mark.parametrize(
    ("placed", "pairs_agreeing", "seams", "parts", "loose", "wanted"),
    [
        (9, 0.99, [_seam(0)], [range(9)], [], []),
        (9, 0.99, [_seam(4, agreement=0.1)], [range(9)], [], ["folded between frames 8-10"]),
        (9, 0.99, [_seam(4, points=0)], [range(5), range(5, 9)], [], ["2 disconnected components .* 0-8, 10-16"]),
        (9, 0.99, [_seam(7, points=0)], [range(8), [8]], [], ["hardly any points connect frame 16 with the other"]),
        (9, 0.69, [_seam(0)], [range(9)], [], ["far apart contradict .* 69% of the matched pairs"]),
        (6, 0.99, [_seam(5)], [range(3, 9)], [0, 1],
         ["could not place 3 of 9 keyframes", "the pose of frames 0, 2, such as a strip of floor"]),
        (8, 0.99, [_seam(5)], [range(1, 9)], [0],
         ["could not place 1 of 9 keyframes", "the pose of frame 0, such as a strip of floor"]),
        (9, 0.99, [_seam(5)], [range(5), [5], [7]], [], ["hardly any points connect frames 10, 14 with the other"]),
    ],
    ids=["sound", "folded", "two parts", "one alone", "far pairs contradict", "left out", "one left out", "two alone"],
)  # fmt: skip
def test_what_is_wrong_is_said(
    placed: int, pairs_agreeing: float, seams: list[Seam], parts: list[list[int]], loose: list[int], wanted: list[str],
    make_context: Callable[..., StageContext], tmp_path: Path,
) -> None:  # fmt: skip
    report = ModelReport(placed, 9, 500, 0.3, 0.99, pairs_agreeing, tuple(seams), tuple(map(tuple, parts)))
    context, words = make_context(tmp_path), Vocabulary(np.zeros((1, 128)), np.zeros(128))
    structure = Structure(pycolmap.Reconstruction(), report, "global", 0.0, [], words, [], [], [], loose=loose)
    warn_of_structure(context, structure, list(range(0, 18, 2)))
    assert len(context.warnings) == len(wanted)
    assert all(re.search(pattern, said) for pattern, said in zip(wanted, context.warnings, strict=True))


VIEWS = 40


@pytest.fixture(scope="module")
def made() -> tuple[pycolmap.Camera, MadeViews, list[VerifiedPair]]:
    """A walk, and half of the pairs of neighbours."""
    camera = unknown_camera(640, 480, 500.0, is_prior=True)
    views = walk_round(camera, VIEWS)
    pairs = views.pairs(camera)
    kept = np.random.default_rng(0).permutation(len(pairs))[: len(pairs) // 2]
    return camera, views, [pairs[k] for k in sorted(kept)]


def bent(made: MadeViews, growth: float, first: int = 0) -> np.ndarray:
    """(N, 4, 4) the path with steps that grow by this share from one view to the next, from the `first` one on."""
    steps = np.diff(made.centers, axis=0) * np.exp(growth * np.maximum(np.arange(VIEWS - 1) - first, 0))[:, None]
    centers = np.concatenate([made.centers[:1], made.centers[0] + np.cumsum(steps, axis=0)])
    poses = made.cam_from_world.copy()
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centers)
    return poses


@pytest.mark.parametrize("growth", [0.01, -0.01])
def test_score_sees_a_scale_that_grows_by_a_hundredth_a_keyframe(
    made: tuple[pycolmap.Camera, MadeViews, list[VerifiedPair]], growth: float
) -> None:
    camera, views, pairs = made
    xy = [f.xy for f in views.features]
    right, wrong = (
        judge(bare_model(camera, xy, poses), pairs, xy, VIEWS, WALK_REACH)
        for poses in (views.cam_from_world, bent(views, growth))
    )
    assert right.pairs_agreeing == wrong.pairs_agreeing == 1.0
    assert 1 <= right.drift.factor < 1.03
    assert wrong.drift.factor == pytest.approx(np.exp(0.01 * VIEWS), rel=0.15)
    assert (wrong.drift.first, wrong.drift.last) == pytest.approx((0, VIEWS - 1), abs=4)
    assert wrong.drift.factor > MAX_DRIFT
    assert not wrong.is_consistent
    assert wrong.score < 0.8 * right.score


def test_break_between_two_stretches_of_one_scale_each_is_seen(
    made: tuple[pycolmap.Camera, MadeViews, list[VerifiedPair]],
) -> None:
    camera, views, pairs = made
    centers = views.centers.copy()
    centers[20:] = centers[20] + 2 * (centers[20:] - centers[20])
    poses = views.cam_from_world.copy()
    poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], centers)
    xy = [f.xy for f in views.features]
    model = bare_model(camera, xy, poses)
    found, before, behind = (
        scale_drift(model, pairs, xy, VIEWS, WALK_REACH, part) for part in (range(VIEWS), range(20), range(20, VIEWS))
    )
    assert 1.5 < found.factor < 2.1
    assert 20 - 2 * WALK_REACH <= found.first <= 20 <= found.last <= 20 + 2 * WALK_REACH
    assert abs(found.at - 20) <= WALK_REACH, "there it is cut"
    assert max(before.factor, behind.factor) < 1.05, "what matches across the cut says nothing of either side"


def test_without_matches_nothing_is_said(made: tuple[pycolmap.Camera, MadeViews, list[VerifiedPair]]) -> None:
    camera, views, _ = made
    xy = [f.xy for f in views.features]
    assert (
        scale_drift(bare_model(camera, xy, views.cam_from_world), [], xy, VIEWS, WALK_REACH, range(VIEWS))
        == ScaleDrift()
    )
    unknown = [np.full(p.shape, np.nan) for p in xy]
    assert (
        scale_drift(bare_model(camera, xy, bent(views, 0.01)), made[2], unknown, VIEWS, WALK_REACH, range(VIEWS))
        == ScaleDrift()
    )
