"""Keyframes whose poses the images do not determine, such as of a strip of floor below a bare wall, are left out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.colmap import pose_of, set_pose
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.sfm import components as module
from msgs_slam.pipelines.sfm.adjust import FEATURE_SD
from msgs_slam.pipelines.sfm.bundle import Bundle, adjust_bundle
from msgs_slam.pipelines.sfm.components import MAX_SD, PoseCovariance, pose_groups, undetermined_cameras
from msgs_slam.pipelines.sfm.consistency import MAX_DRIFT
from msgs_slam.pipelines.sfm.given import posed_model
from msgs_slam.pipelines.sfm.rolling import NO_READOUT, RollingModel
from msgs_slam.pipelines.types import Intrinsics
from tests.pipelines.frames.made_views import REACH, MadeViews, structure_of, walk_along_bare_wall, walk_round
from tests.pipelines.frames.test_frames_given import CAMERA

Array = NDArray[np.float64]
STRIP = list(range(12))
"""Views of the walk along the wall that show nothing else."""


def model_of(made: MadeViews) -> pycolmap.Reconstruction:
    """Triangulated and adjusted from the true poses."""
    model = posed_model(CAMERA, made.views().xy, made.cam_from_world, made.pairs(CAMERA), False, 0)
    assert model is not None
    return model


def bundle_of(made: MadeViews) -> tuple[Bundle, Intrinsics]:
    bundle, _, pinhole = RollingModel(model_of(made), made.views().xy, made.views().times).bundle()
    return bundle, pinhole


@pytest.fixture(scope="module")
def strip() -> tuple[Bundle, Intrinsics]:
    return bundle_of(walk_along_bare_wall(CAMERA))


def test_the_deviations_are_those_of_repeated_adjustments() -> None:
    rng, intrinsics = np.random.default_rng(0), Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 6], (60, 3))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 1, 5)
    cam, point = np.repeat(np.arange(5), 60), np.tile(np.arange(60), 5)
    local = points[point] + poses[cam, :3, 3]
    xy = 500 * local[:, :2] / local[:, 2:] + [320, 240]
    none = np.zeros(len(cam))
    bundle = Bundle(poses, points, cam, point, xy, none + FEATURE_SD, none, none + 1, np.full(len(cam), -1))
    found: list[Array] = []
    for _ in range(40):
        noisy = replace(bundle, obs_xy=xy + rng.normal(0, FEATURE_SD, xy.shape))
        after = adjust_bundle(noisy, intrinsics, width=100.0).bundle.cam_from_world
        found.append(se3.log(after[1] @ se3.inverse(after[0]) @ se3.inverse(poses[1] @ se3.inverse(poses[0]))))
    pairs, sd = PoseCovariance.of(bundle, intrinsics).relative_sds()
    place, turn = np.sqrt((np.array(found) ** 2).mean(0).reshape(2, 3).sum(1))
    told = sd[(pairs == [0, 1]).all(1)]
    assert told == pytest.approx(max(place / np.median(points[:, 2]), turn), rel=0.3)


def test_neither_the_unit_nor_the_world_matters(strip: tuple[Bundle, Intrinsics]) -> None:
    bundle, intrinsics = strip
    motion = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, 1.0, -0.7]))
    moved = replace(
        bundle, cam_from_world=se3.scaled(bundle.cam_from_world @ se3.inverse(motion), 7.0),
        points=7 * se3.transform(motion, bundle.points),
    )  # fmt: skip
    there, here = (PoseCovariance.of(b, intrinsics) for b in (moved, bundle))
    assert np.allclose(there.relative_sds()[1], here.relative_sds()[1], rtol=1e-3)
    before, after = np.arange(12, 20), np.arange(19, 28)
    assert there.scale_sd(before, after) == pytest.approx(here.scale_sd(before, after), rel=1e-3)


def test_views_of_a_strip_are_alone_and_a_room_holds_its_views_together(strip: tuple[Bundle, Intrinsics]) -> None:
    assert pose_groups(*strip) == [list(range(12, 28)), *([k] for k in STRIP)]
    assert pose_groups(*bundle_of(walk_round(CAMERA))) == [list(range(20))]
    pairs, sd = PoseCovariance.of(*strip).relative_sds()
    beside = pairs[:, 1] - pairs[:, 0] == 1
    assert sd[beside & (pairs[:, 1] < 10)].min() > 1.3 * MAX_SD
    assert sd[beside & (pairs[:, 0] > 13)].max() < 0.6 * MAX_SD


@pytest.mark.parametrize(("stride", "groups"), [(0.6, [20]), (0.7, [10, 10])])
def test_a_long_step_parts_only_where_the_scale_beyond_is_unknown(stride: float, groups: list[int]) -> None:
    """Along a corridor of which little is seen at a time; no pair holds the two ends of the step together."""
    rng, intrinsics = np.random.default_rng(0), Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    ahead = 0.2 * np.arange(20) + stride * (np.arange(20) >= 10)
    points = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 2 + ahead[-1]], (400, 3))
    local = points - np.pad(ahead[:, None], ((0, 0), (2, 0)))[:, None]
    xy = 500 * local[..., :2] / local[..., 2:] + [320, 240]
    is_seen = (local[..., 2] > 1.5) & (local[..., 2] < 2.7) & (np.abs(xy - [320, 240]) < [320, 240]).all(2)
    cam, point = np.nonzero(is_seen)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 2, 3] = -ahead
    none = np.zeros(len(cam))
    bundle = Bundle(poses, points, cam, point, xy[is_seen], none + 1, none, none + 1, np.full(len(cam), -1))
    pairs, sd = PoseCovariance.of(bundle, intrinsics).relative_sds()
    assert sd[(pairs[:, 0] < 10) & (pairs[:, 1] >= 10)].min() > MAX_SD
    assert [len(group) for group in pose_groups(bundle, intrinsics)] == groups


def test_windows_of_many_cameras_find_the_same(
    strip: tuple[Bundle, Intrinsics], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = pose_groups(*strip)
    monkeypatch.setattr(module, "_AT_ONCE", 14)
    monkeypatch.setattr(module, "_SHARED", 6)
    monkeypatch.setattr(module, "MIN_POINTS", 200)  # nothing is seen again from far off
    assert pose_groups(*strip) == whole


def test_what_is_seen_again_far_off_holds(strip: tuple[Bundle, Intrinsics], monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs in any order: of one and its neighbours in the list nothing follows."""
    bundle, intrinsics = strip
    order = np.array([*range(12, 28, 2), *range(13, 28, 2)])
    shuffled = module._part(bundle, order)
    monkeypatch.setattr(module, "_AT_ONCE", 6)
    monkeypatch.setattr(module, "_SHARED", 2)
    assert pose_groups(shuffled, intrinsics) == [list(range(16))]


def test_few_are_loose_and_many_are_a_group_of_their_own(strip: tuple[Bundle, Intrinsics]) -> None:
    every = range(28)
    assert undetermined_cameras(*strip, [every], 2, every) == (STRIP, [])
    assert undetermined_cameras(*strip, [every], 1, every) == ([], [[k] for k in STRIP])
    assert undetermined_cameras(*strip, [every], 1, range(12, 28)) == (STRIP, [])  # none of them counts
    half = range(20)  # twelve of twenty are loose: which are right?
    assert undetermined_cameras(*strip, [half], 2, every) == ([], [STRIP])


def test_structure_from_motion_leaves_them_out(tmp_path: Path) -> None:
    for made, wanted in ((walk_along_bare_wall(CAMERA), STRIP), (walk_round(CAMERA), [])):
        model = model_of(made)
        report, loose = structure_of(made, CAMERA, tmp_path)._divided(
            model, made.views(), made.pairs(CAMERA), NO_READOUT
        )
        assert loose == wanted
        count = len(made.features)
        assert sorted(i - 1 for i in model.reg_image_ids()) == sorted(set(range(count)).difference(wanted))
        assert (report.registered, report.total) == (count - len(wanted), count)
        assert made.off(model) < 0.01


def test_structure_is_cut_where_its_scale_changes(tmp_path: Path) -> None:
    """Epipolar lines agree, whatever the step is long; the depths by what is seen from either side do not."""
    made, middle, factor = walk_round(CAMERA, 32), 16, 1.8
    model, pairs = model_of(made), made.pairs(CAMERA)
    whole, _ = structure_of(made, CAMERA, tmp_path)._divided(model, made.views(), pairs, NO_READOUT)
    assert [len(c) for c in whole.components] == [32]
    about = se3.inverse(pose_of(model.images[middle + 1]))[:3, 3]
    for k in range(middle + 1, 32):
        pose = pose_of(model.images[k + 1])
        pose[:3, 3] = -pose[:3, :3] @ (about + factor * (se3.inverse(pose)[:3, 3] - about))
        set_pose(model, k + 1, pose)
    for point in model.points3D.values():
        if min(e.image_id for e in point.track.elements) > middle:
            point.xyz = about + factor * (point.xyz - about)
    report, _ = structure_of(made, CAMERA, tmp_path)._divided(model, made.views(), pairs, NO_READOUT)
    assert report.pairs_agreeing > 0.98
    assert len(report.components) == 2
    assert all(len(c) == pytest.approx(middle, abs=REACH) for c in report.components)
    assert report.drift.factor < MAX_DRIFT
