"""Fields that bring depths into one world: nearer the truth, not dragged off it; their scales, honestly uncertain."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.depth import align as alignment
from msgs_slam.pipelines.depth import fields as solve
from msgs_slam.pipelines.depth.align import COARSE, align_keyframes, fit_fields
from msgs_slam.pipelines.depth.fields import FINE, DepthFields, Equations, contradicted, field_scales, solve_fields
from msgs_slam.pipelines.geometry.posed_depth import CANDIDATES, PosedDepth, overlaps
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.mapping.views import MappingInput
from msgs_slam.pipelines.run.files import CALIBRATION, DEPTH_FIELDS, PROXY_MAPS, SPARSE
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import Intrinsics, ProxyMaps

Maps = dict[int, ProxyMaps]


@pytest.fixture(scope="module")
def truth(small_run: RunFolder) -> Maps:
    return {i: small_run.load(PROXY_MAPS, of=i) for i in small_run.load(SPARSE, "tracking").frame_ids.tolist()}


@pytest.fixture(scope="module")
def align(small_run: RunFolder) -> Callable[..., DepthFields]:
    model, intrinsics = small_run.load(SPARSE, "tracking"), small_run.load(CALIBRATION).intrinsics

    def run(maps: Maps, points: bool = True, expected: Mapping[int, NDArray] | None = None) -> DepthFields:
        return align_keyframes(model if points else without_points(model), intrinsics, maps.get, expected or {})

    return run


def without_points(model: SparseModel) -> SparseModel:
    return replace(model, obs_frame=model.obs_frame[:0], obs_point=model.obs_point[:0], obs_xy=model.obs_xy[:0])


def with_scaled_depth(maps: Maps, scale: Callable[[tuple[int, ...]], NDArray]) -> Maps:
    return {i: replace(m, depth=(m.depth * scale(m.depth.shape)).astype(np.float32)) for i, m in maps.items()}


def relative_error(maps: Maps, truth: Maps, fields: DepthFields | None = None) -> float:
    found = {i: (fields or DepthFields({})).in_world(i, m).depth for i, m in maps.items()}
    known = {i: t.depth > 0 for i, t in truth.items()}
    return float(np.mean(np.concatenate([np.abs(found[i] / truth[i].depth - 1)[known[i]] for i in maps])))


def smooth_noise() -> Callable[[tuple[int, ...]], NDArray]:
    rng = np.random.default_rng(0)
    return lambda shape: field_scales(rng.normal(0, 0.05, (5, 6)) + 0.03 * rng.normal(), shape[0], shape[1])


def test_a_field_spans_the_picture() -> None:
    field = field_scales(np.array([[0.0, 0.2], [0.0, 0.2]]), 30, 40)
    assert field.shape == (30, 40)
    x = (np.arange(40) + 0.5) / 40
    assert np.abs(np.log(field[7]) - 0.2 * x).max() < 2e-3


def test_views_agree_on_a_depth_nearer_the_truth(truth: Maps, align: Callable[..., DepthFields]) -> None:
    noisy = with_scaled_depth(truth, smooth_noise())
    before = relative_error(noisy, truth)
    by_views = relative_error(noisy, truth, align(noisy, points=False))
    with_points = relative_error(noisy, truth, align(noisy))
    assert 0 < with_points < by_views < 0.75 * before
    assert with_points < 0.4 * before


def test_depth_of_another_unit_comes_into_the_world(truth: Maps, align: Callable[..., DepthFields]) -> None:
    """A keyframe whose own points say nothing takes the scale of the others, and then agrees with them."""
    tripled = with_scaled_depth(truth, lambda shape: np.full(shape, 3.0))
    known = {i: np.full(FINE.size, -np.log(3.0)) for i in list(truth)[:-2]}
    assert 0 < relative_error(tripled, truth, align(tripled, expected=known)) < 0.006


def test_true_depth_is_left_alone(truth: Maps, align: Callable[..., DepthFields]) -> None:
    assert relative_error(truth, truth, align(truth)) < 0.006
    one = dict(list(truth.items())[:1])
    assert relative_error(one, truth, align(one)) < 0.006


def test_pixels_left_out_do_not_move_the_others() -> None:
    """A floor that recedes, at twice the size at which depths are compared: half a pixel aside it is 0.3 % as far."""
    camera, poses = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 0.3 * np.arange(4)
    height = np.arange(480)[:, None] + 0.5 - camera.cy
    floor = np.where(height > 60, 500 * 1.5 / np.maximum(height, 1), 0) * np.ones((1, 640))
    maps = ProxyMaps(floor.astype(np.float32), *[np.ones((480, 640), np.float32)] * 3)
    xy = np.random.default_rng(0).uniform((100, 310), (400, 480), (2000, 2))
    z = 500 * 1.5 / (xy[:, 1] - camera.cy)
    points = np.stack([(xy[:, 0] - camera.cx) / 500 * z, np.full(2000, 1.5), z], 1)
    seen = [(points[:, :2] + [0.3 * k, 0]) / z[:, None] * 500 + [camera.cx, camera.cy] for k in range(4)]
    frame, point = np.repeat(np.arange(4), 2000), np.tile(np.arange(2000), 4)
    model = SparseModel(np.arange(4), poses, points, np.zeros((2000, 3), np.uint8), frame, point, np.concatenate(seen))
    fields = align_keyframes(model, camera, lambda _: maps, {})
    assert np.mean([f[7:] for f in fields.of_frame.values()]) == pytest.approx(0, abs=2e-4)


def test_wild_points_do_not_drag_the_depth(truth: Maps, small_run: RunFolder) -> None:
    rng = np.random.default_rng(1)
    model = small_run.load(SPARSE, "tracking")
    center = model.points_in_world.mean(0)
    wild = rng.random(len(model.points_in_world)) < 0.2
    points = np.where(wild[:, None], center + 3 * (model.points_in_world - center), model.points_in_world)
    camera = small_run.load(CALIBRATION).intrinsics
    fields = align_keyframes(replace(model, points_in_world=points), camera, truth.get, {})
    assert relative_error(truth, truth, fields) < 0.01


def test_fields_come_back_from_disk(tmp_path, truth: Maps, align: Callable[..., DepthFields]) -> None:  # type: ignore[no-untyped-def]
    run, fields = RunFolder(tmp_path), align(with_scaled_depth(truth, smooth_noise()))
    for some in (fields, DepthFields({})):
        DEPTH_FIELDS.save(run.stage("tracking"), some)
        back = run.load(DEPTH_FIELDS, "tracking")
        assert list(back.of_frame) == list(some.of_frame)
        assert all(np.array_equal(back.of_frame[i], f) for i, f in some.of_frame.items())
    maps = truth[0]
    assert np.array_equal(DepthFields({}).in_world(0, maps).depth, maps.depth)
    assert fields.in_world(99, maps).depth.max() == 0


def test_overlap_is_one_with_oneself_and_less_elsewhere(room: MappingInput) -> None:
    overlap = overlaps([v.posed_depth() for v in room.views]).toarray()
    assert np.allclose(np.diag(overlap), 1)
    assert (overlap >= 0).all()
    assert (overlap <= 1).all()
    neighbours, far = np.diag(overlap, 1).mean(), np.diag(overlap, len(overlap) - 2).mean()
    assert far < neighbours < 1


def test_overlap_is_compared_only_where_a_view_may_see(room: MappingInput) -> None:
    """As by comparing every pair, for views of one room; nothing for those of a room far away."""
    posed = [v.posed_depth() for v in room.views]
    found = overlaps(posed).toarray()
    for i, view in enumerate(posed):
        points = view.in_world(*view.grid(16)[:2])
        every = np.array([1.0 if other is view else other.seen(points)[2].mean() for other in posed])
        assert found[i] == pytest.approx(every, abs=1e-9)
    away = np.eye(4)
    away[:3, 3] = 1000
    there = [replace(v, cam_from_world=v.cam_from_world @ away) for v in posed]
    both = overlaps([*posed, *there]).toarray()
    assert both[: len(posed), : len(posed)] == pytest.approx(found)
    assert not both[: len(posed), len(posed) :].any()


def test_of_very_many_views_a_spread_is_compared(room: MappingInput) -> None:
    small = replace(room.views[0].posed_depth().intrinsics.resized(4, 3))
    depth = np.ones((3, 4), np.float32)
    crowd = []
    for k in range(CANDIDATES + 50):
        pose = np.eye(4)
        pose[0, 3] = 1e-3 * k
        crowd.append(PosedDepth(small, pose, depth, depth))
    overlap = overlaps(crowd)
    assert np.diff(overlap.indptr).max() == CANDIDATES + 1
    assert overlap[0, [1, CANDIDATES + 49]].toarray().min() > 0.5  # the nearest and the farthest


def test_equations_in_parts_have_the_same_solution(room: MappingInput, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a long recording there are never all equations at once."""
    posed = [v.posed_depth() for v in room.views[:6]]
    at_once = fit_fields(posed, {})
    monkeypatch.setattr(solve, "_ROWS_AT_ONCE", 900)
    in_parts = fit_fields(posed, {})
    assert np.abs(at_once).max() > 1e-4
    assert in_parts == pytest.approx(at_once, abs=1e-9)


def test_windows_of_a_long_recording_agree_with_all_at_once(
    room: MappingInput, monkeypatch: pytest.MonkeyPatch
) -> None:
    posed = [v.posed_depth() for v in room.views[:9]]
    tilted = [replace(p, depth=p.depth * np.float32(1 + 0.04 * (-1) ** n)) for n, p in enumerate(posed)]
    at_once = fit_fields(tilted, {})
    monkeypatch.setattr(alignment, "ALIGNED_TOGETHER", 4)
    in_windows = fit_fields(tilted, {})
    assert np.abs(at_once).mean() > 0.02
    assert np.abs(in_windows - at_once).mean() < 0.01  # windows of three views, which share most of what they see


def test_depth_that_others_see_through_is_found(room: MappingInput) -> None:
    """A patch in the air before one view; the rest of the depth stays."""
    posed = [v.posed_depth() for v in room.views]
    assert all(
        (wrong & (v.depth > 0)).sum() < 0.03 * (v.depth > 0).sum()
        for wrong, v in zip(contradicted(posed), posed, strict=True)
    )
    patched = posed[5].depth.copy()
    patched[20:40, 30:50] *= 0.5
    posed[5] = replace(posed[5], depth=patched)
    assert list(contradicted(posed))[5][22:38, 32:48].mean() > 0.8


CAMERA = Intrinsics(640, 480, 500, 500, 320, 240)


def test_weighted_median_counts_weights() -> None:
    assert alignment.weighted_median(np.array([3.0, 1.0, 2.0]), np.array([1.0, 1.0, 1.0])) == 2.0
    assert alignment.weighted_median(np.array([3.0, 1.0, 2.0]), np.array([5.0, 1.0, 1.0])) == 3.0


def test_basis_sums_to_one_and_meets_the_corners() -> None:
    rng = np.random.default_rng(0)
    basis = COARSE.at(rng.uniform(0, 1, (50, 2)) * [640, 480], 640, 480)
    assert np.allclose(basis.weights.sum(1), 1)
    assert (basis.weights >= 0).all()
    nodes = np.arange(12.0)
    assert np.allclose(COARSE.at(np.array([[0.0, 0.0], [640.0, 480.0]]), 640, 480).of(nodes), [0, 11])
    assert np.allclose(basis.of(np.tile(nodes, (50, 1))), basis.of(nodes))


def test_a_finer_grid_holds_the_same_field() -> None:
    slanted = (np.arange(3)[:, None] * 0.1 + np.arange(4) * 0.02).ravel()
    fine = alignment.as_fine(slanted).reshape(9, 12)
    assert np.allclose(fine[[0, 0, -1, -1], [0, -1, 0, -1]], slanted[[0, 3, 8, 11]])
    assert np.allclose(np.diff(fine, axis=0), 0.2 / 8)


def test_field_follows_a_smooth_error_despite_outliers() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 1, (600, 2)) * [640, 480]
    truth = 0.2 + 0.08 * xy[:, 0] / 640 - 0.05 * xy[:, 1] / 480
    values = truth + rng.normal(size=600) * 0.01
    values[:60] += 1.0
    basis, one = COARSE.at(xy, 640, 480), np.ones(600)
    middle = alignment.keyframe_scale(values, one)
    (field,) = alignment.fit_to_points(np.zeros(600, int), basis, values, one, np.array([middle]))
    error = np.abs(basis.of(field) - truth)[60:]
    assert 0 < np.median(error) < 0.006
    assert np.median(error) < 0.4 * np.median(np.abs(middle - truth)[60:])


def test_field_without_points_is_flat() -> None:
    nothing = COARSE.at(np.zeros((0, 2)), 640, 480)
    fields = alignment.fit_to_points(np.zeros(0, int), nothing, np.zeros(0), np.zeros(0), np.array([0.0, 0.3]))
    assert np.allclose(fields, [[0.0] * 12, [0.3] * 12])


@pytest.mark.parametrize("broken", [True, False])
def test_a_field_that_does_not_converge_stays_as_it_was_and_that_is_said(
    broken: bool, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(0)
    basis = COARSE.at(rng.uniform(0, 1, (40, 2)), 1, 1)
    residual = rng.normal(0, 0.1, 40)
    residual[0] = np.nan if broken else 0.0
    parts = [Equations.of_places(0, basis, COARSE.size, residual, np.full(40, 0.05), 1.0)]
    before = np.full((1, COARSE.size), 0.2)
    after = solve_fields(parts, before, before, alignment.POINTS_PRIOR)
    assert np.array_equal(after, before) == broken
    assert np.isfinite(after).all()
    assert ("did not converge" in caplog.text) == broken


def test_sampling_reads_the_pixel_under_the_point() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(3, 4) + 1
    confidence = np.ones_like(depth)
    confidence[0, 0] = 0.05
    maps = ProxyMaps(depth, confidence, np.zeros((3, 4), np.uint8), confidence)
    xy = np.array([[0.5, 0.5], [639.5, 479.5], [170.0, 10.0]])
    found, reliability = alignment.sample_proxy(maps, xy, CAMERA)
    assert found.tolist() == [0.0, 12.0, 2.0]
    assert reliability[0] == pytest.approx(0.05)
