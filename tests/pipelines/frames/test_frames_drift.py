"""A path whose scale changes along the way, which no pair of views contradicts."""

import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.sfm.consistency import MAX_DRIFT, ScaleDrift, judge, scale_drift
from msgs_slam.pipelines.sfm.given import bare_model
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.matching import VerifiedPair
from tests.pipelines.frames.made_views import REACH, MadeViews, walk_round

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
        judge(bare_model(camera, xy, poses), pairs, xy, VIEWS, REACH)
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
    found = scale_drift(bare_model(camera, xy, poses), pairs, xy, VIEWS, REACH)
    assert 1.5 < found.factor < 2.1
    assert 20 - 2 * REACH <= found.first <= 20 <= found.last <= 20 + 2 * REACH


def test_without_matches_nothing_is_said(made: tuple[pycolmap.Camera, MadeViews, list[VerifiedPair]]) -> None:
    camera, views, _ = made
    xy = [f.xy for f in views.features]
    assert scale_drift(bare_model(camera, xy, views.cam_from_world), [], xy, VIEWS, REACH) == ScaleDrift()
    unknown = [np.full(p.shape, np.nan) for p in xy]
    assert scale_drift(bare_model(camera, xy, bent(views, 0.01)), made[2], unknown, VIEWS, REACH) == ScaleDrift()
