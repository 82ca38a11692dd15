"""The stereo kernels against slow references and known scenes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.completion.fill import SURE, evidence_of, smooth_confidence
from msgs_slam.pipelines.depth.stereo import matching
from msgs_slam.pipelines.depth.stereo.consistency import fuse_depths
from msgs_slam.pipelines.depth.stereo.matching import (
    CLEAR,
    MARGIN,
    StereoImages,
    best_count,
    match_planes,
    planes_to_try,
)
from msgs_slam.pipelines.depth.stereo.provider import at_stops
from msgs_slam.pipelines.depth.stereo.sweep import refine_inverse_depth, sweep_cost, warps_to
from msgs_slam.pipelines.depth.stereo.volume import (
    TILE,
    UNREACHED,
    Bands,
    least_planes,
    pick_planes,
    smooth_cost,
    tiles_of,
)
from msgs_slam.pipelines.depth.stereo.window import (
    LIKENESS,
    RADIUS,
    STEP,
    VARIANCE_FLOOR,
    surface_contrast,
    upsample_depth,
)
from tests.dense_volumes import of_dense, to_dense

HEIGHT, WIDTH, FOCAL = 40, 60, 50.0
MATRIX = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def texture(x: NDArray, y: NDArray) -> NDArray[np.float32]:
    return (0.5 + 0.2 * np.sin(9 * x + 3 * y) + 0.15 * np.sin(17 * y - 5 * x) + 0.1 * np.sin(31 * x)).astype(np.float32)


def view_of_plane(cam_from_world: NDArray, slope: float) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Picture and depth of the textured plane z = 2 + slope·x, from a camera that is only shifted."""
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    center = -cam_from_world[:3, 3]
    depth = (2 + slope * center[0] - center[2]) / (1 - slope * rays[..., 0])
    points = rays * depth[..., None] + center
    return texture(points[..., 0], points[..., 1]), depth


def shifted(x: float, y: float = 0.0) -> NDArray[np.float64]:
    cam_from_world = np.eye(4)
    cam_from_world[:2, 3] = x, y
    return cam_from_world


CAMERAS = [shifted(0.12), shifted(-0.12), shifted(0.0, 0.15), shifted(-0.1, -0.1)]


def scene(slope: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray, NDArray]:
    image, depth = view_of_plane(np.eye(4), slope)
    others = np.stack([view_of_plane(c, slope)[0] for c in CAMERAS])
    return image, others, warps_to(MATRIX, np.eye(4), [MATRIX] * 4, CAMERAS), depth


def slow_score(image: NDArray, other: NDArray, warp: NDArray, inverse: float, y: int, x: int) -> float:
    """Normalised correlation of one weighted window, written out."""
    values = []
    for j in range(-RADIUS, RADIUS + 1, STEP):
        for i in range(-RADIUS, RADIUS + 1, STEP):
            q = warp @ np.array([x + i + 0.5, y + j + 0.5, 1, inverse])
            px, py = q[0] / q[2] - 0.5, q[1] / q[2] - 0.5
            ix, iy = int(px), int(py)
            fx, fy = px - ix, py - iy
            patch = other[iy : iy + 2, ix : ix + 2]
            sample = np.array([1 - fy, fy]) @ patch @ np.array([1 - fx, fx])
            values.append((image[y + j, x + i], sample))
    a, b = np.array(values, np.float64).T
    weights = np.exp(-0.5 * ((a - image[y, x]) / LIKENESS) ** 2)
    a, b = a - np.average(a, weights=weights), b - np.average(b, weights=weights)
    covariance, var_a, var_b = (np.average(v, weights=weights) for v in (a * b, a * a, b * b))
    return covariance / np.sqrt((var_a + VARIANCE_FLOOR) * (var_b + VARIANCE_FLOOR))


def test_sweep_is_the_correlation_written_out() -> None:
    image, others, warps, _ = scene(0.3)
    planes = np.linspace(1 / 3, 1 / 1.4, 7)
    cost = to_dense(sweep_cost(image, others, warps, planes, 2, Bands(1)))
    for y, x, d in ((15, 25, 1), (20, 30, 3), (24, 36, 6)):
        scores = sorted(slow_score(image, o, w, planes[d], y, x) for o, w in zip(others, warps, strict=True))
        assert cost[y, x, d] == pytest.approx(1 - np.mean(scores[-2:]), abs=2e-4)


def test_only_planes_that_are_tried_are_compared_and_searched() -> None:
    """Costs elsewhere are those of a whole sweep, and paths as if the planes left out were out of reach."""
    image, others, warps, _ = scene(0.3)
    planes = np.linspace(1 / 3, 1 / 1.4, 24)
    tried = np.zeros((*tiles_of(HEIGHT, WIDTH), 24), np.bool_)
    rng = np.random.default_rng(5)
    for tile in np.ndindex(tried.shape[:2]):
        first = rng.integers(0, 16)
        tried[tile][first : first + rng.integers(2, 8)] = True
        tried[tile][first] = True
    pixels = tried.repeat(TILE, 0)[:HEIGHT].repeat(TILE, 1)[:, :WIDTH]
    whole = to_dense(sweep_cost(image, others, warps, planes, 2, Bands(1)))
    cost = sweep_cost(image, others, warps, planes, 2, Bands(1), tried)
    np.testing.assert_array_equal(to_dense(cost), np.where(pixels, whole, UNREACHED))
    assert cost.values.size < np.prod((*tiles_of(HEIGHT, WIDTH), TILE, TILE, 32))
    total = smooth_cost(cost, image, 0.1, 1.2, 0.05, Bands(1))
    far_off = of_dense(np.where(pixels, whole, np.float32(1e5)))
    expected = to_dense(smooth_cost(far_off, image, 0.1, 1.2, 0.05, Bands(1)))
    np.testing.assert_array_equal(to_dense(total)[pixels], expected[pixels])
    assert (to_dense(total)[~pixels] == UNREACHED).all()
    picked = np.round(pick_planes(total)).astype(np.int64)
    assert np.take_along_axis(pixels, picked[..., None], 2).mean() > 0.9


def test_planes_near_the_coarse_ones_are_tried_and_what_is_thin_too() -> None:
    found, alone, least = (
        np.full((20, 40), 9.0, np.float32),
        np.zeros((20, 40), np.int64),
        np.ones((20, 40), np.float32),
    )
    alone[:, 21], least[:, 21] = 40, CLEAR / 2
    tried = planes_to_try(found, alone, least, (40, 80), 64)
    assert tried.shape == (*tiles_of(40, 80), 64)
    wall, bar = np.zeros(64, np.bool_), np.zeros(64, np.bool_)
    wall[9 - MARGIN : 9 + MARGIN + 1], bar[40 - MARGIN : 40 + MARGIN + 1] = True, True
    np.testing.assert_array_equal(tried[0], [wall, wall, wall | bar, wall, wall])
    assert not planes_to_try(found, alone, least + 1, (40, 80), 64)[..., 40].any()


@pytest.mark.parametrize("large", [200, 40])
def test_a_bar_thinner_than_the_coarse_window_is_found(monkeypatch: pytest.MonkeyPatch, large: int) -> None:
    """Before a wall twice as far, by the whole match at two sizes, and at three."""
    monkeypatch.setattr(matching, "LARGE", large)

    def view(cam_from_world: NDArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        v, u = (np.indices((80, 120)) + 0.5) / 2
        x, y = (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
        near, far = (np.stack([x, y], -1) * z - cam_from_world[:2, 3] for z in (1.5, 3.0))
        on_bar = np.abs(near[..., 0]) < 0.06
        bar, wall = (0.6 * (texture(p[..., 0], p[..., 1]) - 0.5) for p in (near, far))
        return np.where(on_bar, 0.75 + bar, 0.3 + wall).astype(np.float32), on_bar

    matrix = np.array([[2 * FOCAL, 0, WIDTH], [0, 2 * FOCAL, HEIGHT], [0, 0, 1]])
    image, on_bar = view(np.eye(4))
    pictures = StereoImages(
        image, np.stack([view(c)[0] for c in CAMERAS]), warps_to(matrix, np.eye(4), [matrix] * 4, CAMERAS)
    )
    found = match_planes(pictures, np.linspace(1 / 4, 1, 48), Bands(1))[10:-10, 20:-20]
    on_bar = on_bar[10:-10, 20:-20]
    assert np.median(np.abs(found[on_bar] * 1.5 - 1)) < 0.03
    assert np.median(np.abs(found[~on_bar] * 3 - 1)) < 0.03


def test_views_that_do_not_see_the_point_do_not_count() -> None:
    image, others, warps, _ = scene(0.0)
    behind = warps.copy()
    behind[:, 2] *= -1
    planes = np.linspace(0.3, 0.6, 5)
    assert (to_dense(sweep_cost(image, others, behind, planes, 3, Bands(1))) == 1).all()
    mixed = np.concatenate([warps[:2], behind[2:]])
    alone = to_dense(sweep_cost(image, others[:2], warps[:2], planes, 3, Bands(1)))
    np.testing.assert_array_equal(to_dense(sweep_cost(image, others, mixed, planes, 3, Bands(1))), alone)


def board_before_wall(cam_from_world: NDArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A bright board at depth 1.5 before a dark wall at 3, both with little texture; where the board is."""
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    x, y = (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
    center = -cam_from_world[:2, 3]
    near, far = (np.stack([x, y], -1) * z + center for z in (1.5, 3.0))
    on_board = np.abs(near).max(-1) < 0.3
    board, wall = (0.1 * (texture(p[..., 0], p[..., 1]) - 0.5) for p in (near, far))
    return np.where(on_board, 0.8 + board, 0.3 + wall).astype(np.float32), on_board


def test_windows_that_touch_what_is_no_scene_are_not_compared() -> None:
    image, others, warps, _ = scene(0.3)
    planes = np.linspace(1 / 3, 1 / 1.4, 7)
    alone = to_dense(sweep_cost(image, others[1:], warps[1:], planes, 2, Bands(1)))
    others[0] = np.nan
    assert np.array_equal(to_dense(sweep_cost(image, others, warps, planes, 2, Bands(1))), alone)


def test_objects_do_not_grow_into_what_lies_behind_them() -> None:
    image, on_board = board_before_wall(np.eye(4))
    others = np.stack([board_before_wall(c)[0] for c in CAMERAS])
    warps, planes = warps_to(MATRIX, np.eye(4), [MATRIX] * 4, CAMERAS), np.linspace(1 / 4, 1, 40)
    found = planes[least_planes(sweep_cost(image, others, warps, planes, 2, Bands(1)))[0]]
    around = np.indices((HEIGHT, WIDTH))
    reach = np.maximum(np.abs(around[0] + 0.5 - HEIGHT / 2), np.abs(around[1] + 0.5 - WIDTH / 2))
    # The border itself is mixed of both; a square window takes nearly all of the ring for the board.
    ring = (reach > 0.3 / 1.5 * FOCAL + 1) & (reach < 0.3 / 1.5 * FOCAL + RADIUS)
    assert not on_board[ring].any()
    assert (np.abs(found[ring] - 1 / 1.5) < 0.1).mean() < 0.1


INNER = (slice(6, -6), slice(8, -8))


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_sweep_and_smoothing_find_the_plane(slope: float) -> None:
    image, others, warps, truth = scene(slope)
    planes = np.linspace(1 / 4, 1, 40)
    total = smooth_cost(sweep_cost(image, others, warps, planes, 2, Bands(2)), image, 0.05, 0.4, 0.05, Bands(2))
    found = planes[0] + pick_planes(total) * (planes[1] - planes[0])
    assert 0 < np.median(np.abs(found * truth - 1)[INNER]) < 0.008  # a fifth of the distance between two planes


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_refinement_comes_closer_to_the_plane(slope: float) -> None:
    image, others, warps, truth = scene(slope)
    start = (1 / truth + 0.05).astype(np.float32)  # a third of a pixel in the other views
    fine = refine_inverse_depth(image, others, warps, start, 0.03, 2, 1e-4, 2, Bands(2))
    before, after = (np.median(np.abs(x * truth - 1)[INNER]) for x in (start, fine))
    assert 0 < after < 0.2 * before


def test_bytes_do_not_depend_on_the_threads() -> None:
    image, others, warps, _ = scene(0.3)
    planes = np.linspace(0.3, 0.7, 9)
    results = []
    for threads in (1, 2, 3):
        cost = sweep_cost(image, others, warps, planes, 2, Bands(threads))
        total = smooth_cost(cost, image, 0.05, 0.4, 0.05, Bands(threads))
        start = (planes[0] + pick_planes(total) * 0.05).astype(np.float32)
        fine = refine_inverse_depth(image, others, warps, start, 0.01, 2, 0.01, 2, Bands(threads))
        results.append(to_dense(total).tobytes() + fine.tobytes())
    assert results[0] == results[1] == results[2]


def slow_path(cost: NDArray, image: NDArray, small: float, large: float, edge: float) -> NDArray:
    """Path costs from left to right along every row, written out."""
    out = np.zeros_like(cost, dtype=np.float64)
    for y in range(cost.shape[0]):
        out[y, 0] = cost[y, 0]
        for x in range(1, cost.shape[1]):
            before = out[y, x - 1]
            jump = max(large / (1 + abs(image[y, x] - image[y, x - 1]) / edge), small)
            for d in range(cost.shape[2]):
                ways = [before[d], before.min() + jump]
                ways += [before[k] + small for k in (d - 1, d + 1) if 0 <= k < cost.shape[2]]
                out[y, x, d] = cost[y, x, d] + min(ways) - before.min()
    return out


def test_smoothing_sums_the_paths_written_out() -> None:
    rng = np.random.default_rng(0)
    cost = rng.random((5, 7, 6)).astype(np.float32)
    image = rng.random((5, 7)).astype(np.float32)
    expected = np.zeros((5, 7, 6))
    for flip in (False, True):
        for turn in (False, True):
            c, i = (a.transpose(1, 0, *range(2, a.ndim)) if turn else a for a in (cost, image))
            c, i = (a[:, ::-1] if flip else a for a in (c, i))
            path = slow_path(c, i, 0.1, 0.5, 0.2)
            path = path[:, ::-1] if flip else path
            expected += path.transpose(1, 0, 2) if turn else path
    for dy, dx in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        expected += slow_diagonal(cost, image, dy, dx)
    found = to_dense(smooth_cost(of_dense(cost), image, 0.1, 0.5, 0.2, Bands(2)))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def slow_diagonal(cost: NDArray, image: NDArray, dy: int, dx: int) -> NDArray:
    c, i = cost[::dy, ::dx], image[::dy, ::dx]
    out = np.zeros_like(c, dtype=np.float64)
    for start in range(-c.shape[0] + 1, c.shape[1]):
        cells = [(y, y + start) for y in range(c.shape[0]) if 0 <= y + start < c.shape[1]]
        rows, columns = np.array(cells).T
        out[rows, columns] = slow_path(c[rows, columns][None], i[rows, columns][None], 0.1, 0.5, 0.2)[0]
    return out[::dy, ::dx]


def test_agreeing_views_support_and_better_the_depth_and_liars_do_not() -> None:
    rng = np.random.default_rng(1)
    truth = view_of_plane(np.eye(4), 0.3)[1]
    others = np.stack([view_of_plane(c, 0.3)[1] for c in CAMERAS])
    back = np.array([warps_to(MATRIX, c, [MATRIX], [np.eye(4)])[0][2] for c in CAMERAS])
    warps = warps_to(MATRIX, np.eye(4), [MATRIX] * 4, CAMERAS)

    def noisy(depth: NDArray) -> NDArray[np.float32]:
        return (depth * (1 + 0.004 * rng.standard_normal(depth.shape))).astype(np.float32)

    own = noisy(truth)
    fused, support, conflict = fuse_depths(own, noisy(others), warps, back, 0.01, Bands(2))
    inner = (slice(8, -8), slice(10, -10))
    assert np.abs(fused / truth - 1)[inner].mean() < 0.7 * np.abs(own / truth - 1)[inner].mean()
    assert support[inner].mean() > 3
    assert conflict.max() == 0
    in_front = (own * 0.8).astype(np.float32)
    _, support, conflict = fuse_depths(in_front, noisy(others), warps, back, 0.01, Bands(2))
    assert support.max() == 0
    assert conflict[inner].mean() > 3
    nothing = np.zeros_like(own)
    fused, support, _ = fuse_depths(nothing, others.astype(np.float32), warps, back, 0.01, Bands(1))
    assert fused.max() == support.max() == 0


def test_a_chance_match_in_a_blank_wall_is_not_sure_for_it_stands_alone() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    image[:, 30:] = np.random.default_rng(3).integers(0, 40, (HEIGHT, 30, 3))
    confidence = np.where(np.arange(WIDTH)[None] < 30, 0.02, 0.8).repeat(HEIGHT, 0).astype(np.float32)
    confidence[20, 10] = 0.8
    judged = smooth_confidence(confidence, image)
    assert judged[20, 10] < SURE / 2
    assert judged[:, 36:].min() > 0.6
    one_surface = smooth_confidence(np.full((HEIGHT, WIDTH), 0.8, np.float32), image)
    np.testing.assert_allclose(one_surface, 0.64**0.9, rtol=1e-4)


def test_the_ends_of_the_sweep_are_no_matches() -> None:
    planes = np.linspace(0.2, 1.2, 51)
    found = at_stops(np.array([0.2, 0.215, 0.23, 0.7, 1.17, 1.19, 1.2], np.float32), planes)
    np.testing.assert_array_equal(found, [True, True, False, False, False, True, True])


def test_the_better_half_of_many_views_counts() -> None:
    assert [best_count(n) for n in (2, 6, 8, 10, 12)] == [3, 3, 4, 5, 5]


def test_agreement_on_a_blank_surface_is_little_evidence_also_beside_its_border() -> None:
    image = view_of_plane(np.eye(4), 0.0)[0]
    image[:, :30] = 0.05 + 0.001 * np.random.default_rng(4).standard_normal((HEIGHT, 30)).astype(np.float32)
    evidence = evidence_of(surface_contrast(image))
    assert np.quantile(evidence[:, 27:30], 0.9) < 0.5  # the windows of these columns reach into the texture
    assert evidence[:, 30:].mean() > 0.9
    assert evidence[:, 30:].max() < 1


def test_enlarged_depth_has_its_edge_where_the_picture_has_it() -> None:
    image = np.zeros((80, 120, 3), np.uint8)
    image[:, 63:] = 200
    depth = np.where(np.arange(60) < 31, 1.0, 3.0)[None].repeat(40, 0).astype(np.float32)
    confidence = np.full((40, 60), 0.8, np.float32)
    enlarged = upsample_depth(depth, confidence, image)
    assert set(np.unique(np.round(enlarged.depth, 3))) == {1.0, 3.0}
    assert (enlarged.depth[:, :62] < 2).all()
    assert (enlarged.depth[:, 64:] > 2).all()
