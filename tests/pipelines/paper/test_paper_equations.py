"""Every numbered equation of the paper: hand-made cases, limits and finite differences; and that none is missing."""

import ast
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from msgs_slam.pipelines import paper
from msgs_slam.pipelines.depth.fields import FINE, field_scales
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.mapping.views import View, make_view
from msgs_slam.pipelines.paper import adjustment, mapping, rendering, rerender, tracking, uncertainty
from msgs_slam.pipelines.paper.rendering import Gaussians, semantic_image
from msgs_slam.pipelines.paper.uncertainty import PAPER
from msgs_slam.pipelines.render.api import Rendering
from msgs_slam.pipelines.types import VOID, Intrinsics, LoopEdge, ProxyMaps

CAMERA = Intrinsics(48, 36, 40.0, 40.0, 24.0, 18.0)


def a_view(frame_id: int = 0, shift: float = 0.0, camera: Intrinsics = CAMERA) -> View:
    """A bumpy textured wall two units away, of two classes; `shift`: how far the camera stands to the right."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    at = (x - camera.cx) / camera.fx * 2 + shift
    down = (y - camera.cy) / camera.fy * 2
    waves = [np.sin(9 * at + 3 * np.sin(5 * down)), np.sin(7 * down + 2 * at), np.cos(11 * at - 4 * down)]
    image = (255 * (0.5 + 0.4 * np.stack(waves, -1))).astype(np.uint8)
    labels = (at > 0.1).astype(np.uint8)
    ones = np.ones(labels.shape, np.float32)
    return make_view(frame_id, camera, np.eye(4), image, ProxyMaps(2 * ones, ones, labels, ones), (0, 1))


def a_map(view: View, pose: Tensor | None = None) -> Gaussians:
    return mapping.grow(None, view, torch.eye(4, dtype=torch.float64) if pose is None else pose, 2)


def named_by_equation() -> dict[int, set[str]]:
    """module.function of all whose docstrings begin with an equation, several, or a term of one."""
    found: dict[int, set[str]] = {}
    for path in Path(paper.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                text = ast.get_docstring(node) or ""
                if match := re.match(r"(?:First term of |Second term of )?Eqs?\. \((\d+)\)(?: to \((\d+)\))?", text):
                    for number in range(int(match[1]), int(match[2] or match[1]) + 1):
                        found.setdefault(number, set()).add(f"{path.stem}.{node.name}")
    return found


def test_every_equation_has_a_function_that_names_it() -> None:
    assert set(named_by_equation()) == set(range(1, 27))


def test_the_table_of_the_method_page_is_that_of_the_code() -> None:
    page = (Path(__file__).parents[3] / "docs" / "method.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \((\d+)\) \| ([^|]+) \|", page, re.MULTILINE)
    assert {int(n): set(re.findall(r"`(\w+\.\w+)`", cell)) for n, cell in rows} == named_by_equation()


# (1) to (3) -----------------------------------------------------------------------------------------------------


def test_2_reliability_by_hand() -> None:
    flat, half = np.full((6, 6), 2, np.float32), np.full((6, 6), 0.5, np.float32)
    assert np.allclose(uncertainty.depth_reliability(flat, half), 0.5**0.8)
    assert np.allclose(uncertainty.depth_reliability(flat, half, theta=0.25), 0.5**0.8 * 0.25**0.5, atol=1e-6)
    step = flat.copy()
    step[:, 3:] *= math.exp(0.1)
    beside = uncertainty.depth_reliability(step, np.ones((6, 6), np.float32))
    assert np.allclose(beside[:, 2], math.exp(-0.7))
    assert np.allclose(beside[:, 0], 1)
    assert (uncertainty.depth_reliability(np.zeros((6, 6), np.float32), half) == 0).all()
    assert np.allclose(uncertainty.depth_reliability(1000 * step, half), uncertainty.depth_reliability(step, half))


def test_3_agreement_is_a_rising_step_around_phi() -> None:
    assert uncertainty.semantic_factor(PAPER.phi) == 0.5
    values = [uncertainty.semantic_factor(m) for m in np.linspace(0, 1, 9)]
    assert values == sorted(values)
    assert values[0] < 0.01
    assert values[-1] > 0.99
    labels = np.array([[0, 0], [1, 1]], np.uint8)
    assert uncertainty.semantic_agreement(labels, labels) == 1
    other = np.array([[0, 0], [1, 0]], np.uint8)
    assert uncertainty.semantic_agreement(labels, other) == pytest.approx((2 / 3 + 1 / 2) / 2)


def test_symmetry_is_found_where_it_is_and_off_where_it_is_not() -> None:
    rng = np.random.default_rng(0)
    half = rng.uniform([0.2, -1, -1], [1.5, 1, 1], (150, 3))
    both, classes = np.concatenate([half, half * [-1, 1, 1]]), np.tile(rng.integers(0, 3, 150), 2)
    found = [uncertainty.mirror_plane(both, classes, 0.02, seed) for seed in range(60)]
    best = max(found, key=lambda plane: plane.confidence)
    assert best.confidence > 0.5
    assert abs(abs(best.normal[0]) - 1) < 1e-6
    assert abs(best.offset) < 1e-6
    shaken = both + rng.normal(0, 0.005, both.shape)
    pulled = uncertainty.symmetry_pull(shaken, classes, best, 0.05)
    assert 0 < np.abs(pulled - both).mean() < 0.95 * np.abs(shaken - both).mean()
    chaos = rng.uniform(-1, 1, (300, 3))
    nothing = uncertainty.mirror_plane(chaos, rng.integers(0, 3, 300), 0.02, 0)
    assert nothing.confidence == 0
    assert (uncertainty.symmetry_pull(chaos, classes, nothing, 0.05) == chaos).all()


# (4) to (9) -----------------------------------------------------------------------------------------------------


def test_4_density_at_the_centre_and_a_radius_away() -> None:
    points = torch.tensor([[1.0, 0, 0], [1, 0.5, 0], [1, 0, 1]])
    f = rendering.density(points, torch.tensor([1.0, 0, 0]), torch.tensor(0.5), torch.tensor(0.8))
    assert torch.allclose(f, 0.8 * torch.exp(torch.tensor([0, -0.5, -2.0])))


def test_5_projection_by_hand() -> None:
    pose = torch.eye(4)
    pose[2, 3] = 1
    xy, radius, depth = rendering.projection(torch.tensor([[0.5, -0.25, 1.0]]), torch.tensor([0.1]), pose, CAMERA)
    assert torch.allclose(xy, torch.tensor([[40 * 0.25 + 24, -40 * 0.125 + 18]]))
    assert torch.allclose(radius, torch.tensor([40 * 0.1 / 2]))
    assert depth.tolist() == [2.0]


def _weights(f: Tensor, hidden: Tensor) -> Tensor:
    before = torch.cat([torch.ones_like(f[:1]), torch.cumprod(1 - hidden, 0)[:-1]])
    return f * before


def blend(values: Tensor, f: Tensor, hidden: Tensor | None = None) -> Tensor:
    """Eqs. (6), (8), (9): Σ v_i f_i Π_{j<i} (1 - f_j) of N Gaussians, near to far: values (N, ...), f (N,)."""
    return torch.tensordot(_weights(f, f if hidden is None else hidden), values, 1)


def blend_depth(depth: Tensor, f: Tensor, proxy: Tensor, kappa: float) -> Tensor:
    """Eq. (7): D = Σ d_i f_i Π_{j<i} (1 - f_j w_d(d_j, D̂)) with w_d of `occluder_weight`: depth, f (N,)."""
    return blend(depth, f, f * rendering.occluder_weight(depth, proxy, kappa))


def stack() -> tuple[Tensor, Tensor]:
    """f and d of three Gaussians of one pixel, near to far."""
    return torch.tensor([0.5, 0.25, 0.8], dtype=torch.float64), torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)


def test_7_an_occluder_that_disagrees_with_the_proxy_hides_less() -> None:
    f, d = stack()
    proxy = torch.tensor(4.0, dtype=torch.float64)
    ordinary = blend(d, f)
    assert torch.allclose(blend_depth(d, f, proxy, 0.0), ordinary)
    hidden = [0.5 * math.exp(-9.0), 0.25 * math.exp(-4.0)]
    expected = 0.5 + 2 * 0.25 * (1 - hidden[0]) + 4 * 0.8 * (1 - hidden[0]) * (1 - hidden[1])
    assert float(blend_depth(d, f, proxy, 1.0)) == pytest.approx(expected)
    assert torch.allclose(blend_depth(d, f, torch.zeros(()).double(), 1.0), ordinary)
    assert torch.autograd.gradcheck(
        lambda a, b: blend_depth(a, b, proxy, 0.7), (d.requires_grad_(), f.requires_grad_())
    )


def test_the_renderer_draws_these_equations() -> None:
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(6, 3, generator=generator) * torch.tensor([0.2, 0.2, 1.0]) + torch.tensor([-0.1, -0.1, 1.5])
    radii, opacities = torch.full((6,), 0.3), torch.rand(6, generator=generator) * 0.8 + 0.1
    features, pose = torch.rand(6, 5, generator=generator), torch.eye(4)
    shown = rendering.draw_semantics(means, radii, opacities, features, pose, CAMERA)
    xy, radius, depth = rendering.projection(means, radii, pose, CAMERA)
    order = torch.argsort(depth)
    pixel = torch.tensor([20.5, 15.5])
    f = torch.stack([rendering.density(pixel, xy[i], radius[i], opacities[i]) for i in order])
    assert torch.allclose(shown.features[15, 20], blend(features[order], f), atol=1e-5)
    assert torch.allclose(shown.silhouette[15, 20], blend(torch.ones(6), f), atol=1e-5)
    proxy = torch.full((36, 48), 2.2)
    for kappa in (0.0, 3.0):
        drawn = rendering.weighted_depth(means, radii, opacities, pose, CAMERA, proxy, kappa)
        hidden = f * rendering.occluder_weight(depth[order], proxy[0, 0], kappa)
        expected = blend_depth(depth[order], f, proxy[0, 0], kappa) / blend(torch.ones(6), f, hidden)
        assert torch.allclose(drawn[15, 20], expected, atol=1e-5)
    ordinary = rendering.weighted_depth(means, radii, opacities, pose, CAMERA, proxy, 0.0)
    assert torch.allclose(ordinary, shown.depth, atol=1e-4)


# (10) to (14) ---------------------------------------------------------------------------------------------------


def test_10_and_11_overlap_counts_points_in_the_image() -> None:
    points = np.array([[0, 0, 2.0], [0.5, 0, 2], [5, 0, 2], [0, 0, -2]])
    assert tracking.overlap(points, np.eye(4), CAMERA) == 0.5
    assert tracking.overlap(points[:0], np.eye(4), CAMERA) == 0
    assert tracking.geometric_keyframes([0.5, 0.08, 0.081, 0.0]) == [0, 2]


def test_12_keeps_those_that_show_something_else() -> None:
    own = np.zeros((4, 4), np.uint8)
    half = own.copy()
    half[2:] = 1
    assert tracking.semantic_keyframes(own, np.stack([own, half, own + 1])).tolist() == [False, True, True]


def test_13_and_14_older_and_less_reliable_keyframes_weigh_less() -> None:
    ages = np.array([0, 1, 10])
    assert np.allclose(tracking.time_weights(ages, np.ones(3)), np.exp(-0.1 * ages))
    assert np.allclose(tracking.depth_certainty(np.array([1.0, 0.5, 0.0])), np.exp([0, -0.5, -1]))


def test_selection_is_at_most_twenty_drawn_by_weight_and_repeatable() -> None:
    overlaps, differs, weights = [0.5] * 60, np.ones(60, bool), np.r_[np.zeros(30) + 1e-9, np.ones(30)]
    chosen = tracking.select_keyframes(overlaps, differs, weights, np.random.default_rng(1))
    assert len(set(chosen)) == 20
    assert min(chosen) >= 30
    assert chosen == tracking.select_keyframes(overlaps, differs, weights, np.random.default_rng(1))
    assert tracking.select_keyframes([0.5, 0.0, 0.4], np.zeros(3, bool), np.ones(3), np.random.default_rng(1)) == [0, 2]
    assert tracking.select_keyframes([0.5, 0.5], np.array([False, True]), np.ones(2), np.random.default_rng(1)) == [1]


# (15), (16) -----------------------------------------------------------------------------------------------------


def test_15_constant_velocity_goes_on() -> None:
    step, first = (se3.exp(np.array(twist)) for twist in ([0.1, 0, 0.02, 0, 0.05, 0.01], [0.3, 0.1, 0, 0.2, 0, 0]))
    assert np.allclose(tracking.predict(first, step @ first), step @ step @ first)
    assert np.allclose(tracking.predict(first, first), first)


def test_16_tracking_loss_by_hand() -> None:
    view = a_view()
    truth = semantic_image(view, 2)
    features = torch.cat([view.colors + 0.1, truth], -1)
    seen = torch.ones(36, 48)
    same = Rendering(torch.cat([view.colors, truth], -1), view.depth, seen)
    assert float(tracking.tracking_loss(same, view, truth, 2.0)) == 0
    shown = Rendering(features, view.depth + 0.5, seen)
    assert float(tracking.tracking_loss(shown, view, truth, 2.0)) == pytest.approx(0.1 + 0.8 * 0.25, rel=1e-4)
    wrong = Rendering(torch.cat([view.colors, truth.flip(-1)], -1), view.depth, seen)
    assert float(tracking.tracking_loss(wrong, view, truth, 2.0)) == pytest.approx(0.3)
    half = torch.where(torch.arange(48) < 24, 0.9, 1.0).expand(36, 48)  # below T_sil nothing counts
    broken = replace(shown, features=torch.where(half[..., None] < 0.95, 7.0, features), silhouette=half)
    assert float(tracking.tracking_loss(broken, view, truth, 2.0)) == pytest.approx(0.3, rel=1e-4)


def test_16_finds_a_pose_again() -> None:
    view = a_view(camera=CAMERA.resized(160, 120))
    gaussians, identity = a_map(view), torch.eye(4, dtype=torch.float64)
    for _ in range(20):  # seeds are not opaque yet
        mapping.optimise(gaussians, view, identity, 2, 2.0)
    start = se3.exp(torch.tensor([0.03, -0.02, 0.02, 0.01, -0.01, 0.01], dtype=torch.float64))

    def pixels_off(pose: Tensor) -> float:
        """Of the wall's points: a turn and a shift that look alike are as good."""
        points = torch.cartesian_prod(torch.linspace(-2, 2, 5), torch.linspace(-1.5, 1.5, 5), torch.tensor([2.0]))
        here, there = (rendering.projection(points, torch.ones(25), p, view.intrinsics)[0] for p in (identity, pose))
        return float((there - here).norm(dim=1).mean())

    found = tracking.track_pose(gaussians, view, [start], 2, 2.0)
    assert 0 < pixels_off(found.cam_from_world) < 0.5
    assert pixels_off(start) > 2
    assert found.covered > 0.9
    assert (found.cam_from_world == tracking.track_pose(gaussians, view, [start], 2, 2.0).cam_from_world).all()
    nothing = se3.exp(torch.tensor([0, 0, 1.0, 0, 0, 0], dtype=torch.float64))  # all half as far again
    for starts in ([start, identity], [start, nothing], [nothing, start]):
        assert pixels_off(tracking.track_pose(gaussians, view, starts, 2, 2.0).cam_from_world) < 0.5


# (17) to (20) ---------------------------------------------------------------------------------------------------


def test_17_region_prior_corrects_unreliable_pixels() -> None:
    y, x = np.mgrid[:60, :80]
    truth = (1 / (0.4 + 0.002 * x + 0.001 * y)).astype(np.float32)
    noise = np.random.default_rng(0)
    weak = np.zeros(truth.shape, bool)
    weak[20:40, 30:60] = True
    depth = np.where(weak, truth * noise.uniform(0.7, 1.4, truth.shape), truth).astype(np.float32)
    reliability = np.where(weak, 0.1, 0.95).astype(np.float32)
    channels = np.zeros(truth.shape, np.uint8)
    corrected = mapping.depth_prior(depth, reliability, channels)
    error = [np.abs(d / truth - 1)[weak].mean() for d in (corrected, depth)]
    assert 0 < error[0] < 0.02 < 0.1 < error[1]
    assert np.abs(corrected / depth - 1)[~weak].max() < 1e-5
    assert np.allclose(mapping.depth_prior(depth, np.ones_like(reliability), channels), depth), "reliable depth stays"


def test_18_map_loss_is_its_weighted_terms() -> None:
    view = a_view()
    truth = semantic_image(view, 2)
    perfect = Rendering(torch.cat([view.colors, truth], -1), view.depth, torch.ones(36, 48))
    small = torch.full((5,), -9.0)
    edges = PAPER.map_edge * mapping.edge_loss(view.depth, view.channels, 2.0)
    assert torch.allclose(mapping.map_loss(perfect, view, small, 2, 2.0), edges, atol=1e-5)
    deeper = replace(perfect, depth=view.depth + 0.2)
    assert float(mapping.map_loss(deeper, view, small, 2, 2.0) - edges) == pytest.approx(0.8 * 0.1, rel=1e-3)
    unsure = replace(view, reliability=torch.full((36, 48), 51, dtype=torch.uint8))  # U = 0.2, w = 0.24
    got = mapping.map_loss(deeper, unsure, small, 2, 2.0)
    assert float(got) == pytest.approx(0.2 * (float(edges) + 0.8 * 0.24 * 0.1), rel=1e-3)
    assert mapping.map_loss(perfect, view, torch.zeros(5), 2, 2.0) > edges + 1  # far too large


def test_19_edges_pull_depth_together_inside_and_apart_across() -> None:
    generator = torch.Generator().manual_seed(0)
    depth = (2 + 0.02 * torch.rand(5, 6, generator=generator, dtype=torch.float64)).requires_grad_()
    channels = torch.zeros(5, 6, dtype=torch.uint8)
    assert torch.autograd.gradcheck(lambda d: mapping.edge_loss(d, channels, 2.0), (depth,))
    step = torch.full((5, 6), 2.0)
    step[:, 3:] = 2.05
    across = channels.clone()
    across[:, 3:] = 1
    flat = torch.full((5, 6), 2.0)
    assert mapping.edge_loss(step, across, 2.0) < mapping.edge_loss(flat, across, 2.0)
    assert mapping.edge_loss(step, channels, 2.0) > mapping.edge_loss(flat, channels, 2.0)
    assert float(mapping.edge_loss(step, torch.full_like(channels, VOID), 2.0)) == 0


def test_20_weighs_the_difference_by_omega() -> None:
    photo = torch.rand(24, 30, 3, generator=torch.Generator().manual_seed(0))
    assert float(mapping.image_loss(photo, photo)) == pytest.approx(0, abs=1e-6)
    only_color = replace(PAPER, omega=1.0)
    assert float(mapping.image_loss(photo + 0.1, photo, only_color)) == pytest.approx(0.1, rel=1e-5)
    assert 0 < float(mapping.image_loss(photo.flip(0), photo)) < 1
    view = a_view()
    truth = semantic_image(view, 2)
    assert float(mapping.semantic_loss(truth, view, 2)) == pytest.approx(0, abs=1e-5)
    assert float(mapping.semantic_loss(truth.flip(-1), view, 2)) > 0.3


def test_the_three_conditions_of_growth() -> None:
    view = a_view()
    truth, seen = semantic_image(view, 2), torch.ones(36, 48)
    same = Rendering(torch.cat([view.colors, truth], -1), view.depth, seen)
    assert not mapping.needed(same, view).any()
    hole = seen.clone()
    hole[3, 4] = 0.5
    assert mapping.uncovered(replace(same, silhouette=hole)).nonzero().tolist() == [[3, 4]]
    behind = view.depth.clone()
    behind[5, 6] += 0.5  # the map is farther than the proxy
    behind[7, 8] -= 0.5  # and here nearer, which says nothing
    assert mapping.nearer(replace(same, depth=behind), view).nonzero().tolist() == [[5, 6]]
    other = same.features.clone()
    other[9, 10, 3:] = truth[9, 10].flip(-1)
    assert mapping.other_class(replace(same, features=other), view).nonzero().tolist() == [[9, 10]]
    gaussians = a_map(view)
    before = len(gaussians)
    assert before == 36 * 48
    assert len(mapping.grow(gaussians, view, torch.eye(4, dtype=torch.float64), 2)) - before < 0.2 * before


def test_gradients_are_clipped_beside_boundaries_alone() -> None:
    channels = torch.zeros(8, 8, dtype=torch.uint8)
    channels[:, 4:] = 1
    channels[0] = VOID
    near = mapping.at_boundary(channels)
    assert near[2].tolist() == [False] * 3 + [True] * 2 + [False] * 3
    image = torch.zeros(8, 8, 2, requires_grad=True)
    shown = image * 1
    mapping.clip_at_boundary(shown, channels, 1.0)
    weights = torch.ones(8, 8, 2)
    weights[2, 3] = 100
    weights[2, 0] = 100
    (shown * weights).sum().backward()
    assert image.grad[2, 0, 0] == 100
    assert 1 < image.grad[2, 3, 0] < 20


# (21) to (26) ---------------------------------------------------------------------------------------------------


def looks(seed: int, classes: int) -> np.ndarray:
    blocks = np.random.default_rng(seed).integers(0, classes, (6, 8)).astype(np.uint8)
    return np.kron(blocks, np.ones((10, 10), np.uint8))


def stripes(count: int) -> np.ndarray:
    return np.repeat(np.arange(count), 120 // count)[None].repeat(90, 0).astype(np.uint8)


def test_22_more_classes_and_borders_are_richer() -> None:
    summaries = [adjustment.summarise_labels(stripes(n), 8) for n in (1, 2, 4, 8)]
    assert np.argsort(adjustment.richness(summaries)).tolist() == [0, 1, 2, 3]
    assert adjustment.rich_keyframes(summaries) == [3]
    assert summaries[0].entropy == 0
    assert summaries[3].entropy == pytest.approx(np.log(8), rel=1e-3)
    assert summaries[1].boundary < summaries[2].boundary


def test_23_proposes_the_place_that_is_seen_again() -> None:
    images = [looks(k, 3) for k in range(20)]
    images[4] = images[19] = looks(77, 6)
    summaries = [adjustment.summarise_labels(labels, 6) for labels in images]
    vectors = np.random.default_rng(0).normal(size=(20, 16))
    vectors[19] = vectors[4]
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    assert adjustment.semantic_candidates(summaries, vectors) == [(4, 19)]
    assert adjustment.semantic_candidates(summaries[:8], vectors[:8]) == []  # too near in time


def test_24_weighs_three_likenesses() -> None:
    one, two = adjustment.summarise_labels(looks(1, 4), 4), adjustment.summarise_labels(looks(2, 4), 4)
    assert adjustment.loop_similarity(one, [one], np.ones(1))[0] == pytest.approx(1)
    alone = replace(PAPER, alpha1=0.0, alpha3=0.0)
    assert adjustment.loop_similarity(one, [one, two], np.array([0.5, -0.5]), alone).tolist() == [0.15, -0.15]
    assert adjustment.loop_similarity(one, [two], np.ones(1))[0] < 0.95
    shuffled = np.array([0, 2, 1, 3], np.uint8)[stripes(4)]
    a, b = (adjustment.summarise_labels(labels, 4).graph for labels in (stripes(4), shuffled))
    same, other = adjustment.structure_similarity(a, np.stack([a, b]))
    assert same == pytest.approx(1)
    assert other < 1


def a_walk(count: int = 4, shake: float = 0.01) -> tuple[list[View], np.ndarray, np.ndarray, np.ndarray]:
    """Views of a wall with their true poses; depth all wrong by a smooth field; the field that undoes it, and other
    poses, of which the first is true."""
    camera = CAMERA.resized(96, 72)
    wrong = np.tile(np.linspace(-0.05, 0.05, FINE.columns), (FINE.rows, 1))
    factor = torch.from_numpy(field_scales(wrong, 72, 96))
    views = [replace(v := a_view(k, 0.08 * k, camera), depth=v.depth * factor) for k in range(count)]
    true = np.tile(np.eye(4), (count, 1, 1))
    true[:, 0, 3] = -0.08 * np.arange(count)
    twists = np.random.default_rng(0).normal(0, shake, (count, 6)) * [1, 1, 1, 0.5, 0.5, 0.5]
    twists[0] = 0
    return views, true, -np.tile(wrong, (count, 1, 1)), se3.exp(twists) @ true


def test_25_a_window_of_keyframes_finds_its_poses_and_depths() -> None:
    """Only what may move does; colours, depths and classes pull the rest to the truth."""
    views, true, field, shaken = a_walk()
    nothing, moves = np.zeros_like(field), np.arange(4) > 0
    poses, fields = adjustment.local_adjustment(
        views.__getitem__, range(4), shaken, nothing, moves, np.ones(4, bool), 2, 2.0
    )

    def off(found: np.ndarray) -> float:
        return float(np.abs(se3.log(found @ se3.inverse(true))).max())

    assert 0 < off(poses) < 0.5 * off(shaken)
    assert 0 < np.abs(fields - field).mean() < 0.8 * np.abs(field).mean()
    assert (poses[0] == shaken[0]).all()
    last = np.arange(4) == 3
    poses, fields = adjustment.local_adjustment(views.__getitem__, range(4), shaken, nothing, last, last, 2, 2.0)
    assert (poses[:3] == shaken[:3]).all()
    assert (fields[:3] == 0).all()
    assert (poses[3] != shaken[3]).any()


def test_25_pose_term_by_hand() -> None:
    start = np.tile(np.eye(4), (2, 1, 1))
    twists = np.array([[0.2, 0, 0, 0, 0, 0.3], [0.0] * 6])
    term = rerender.pose_term(se3.exp(twists), start, 2.0)
    assert np.allclose(term, twists / (rerender.POSE_SD * np.array([2, 2, 2, 1, 1, 1])))


@pytest.mark.parametrize(("i", "j"), [(0, 1), (2, 0)])
def test_25_rows_are_the_slopes_of_the_residuals(i: int, j: int) -> None:
    """Residuals and Jacobian against finite differences, with all pixels that both draw."""
    views, _, field, shaken = a_walk(3, 0.003)
    samples = [rerender.sample(v, 2) for v in views]
    everything = np.ones(3, bool)
    problem = rerender.Rerendering(
        samples, shaken, 0.5 * field.reshape(3, -1), everything, everything, [(i, j)], 2.0, shaken
    )
    seen = problem.drawn(i, j)
    for frame, unknown in [(i, 0), (j, 0), (i, 4), (j, 4), (j, 2), (i, 5)]:
        step = np.zeros((3, 6))
        step[frame, unknown] = 1e-6
        there = replace(problem, poses=se3.exp(step) @ shaken).drawn(i, j)
        both, a, b = np.intersect1d(seen.rows, there.rows, return_indices=True)
        assert len(both) > 50
        jacobian, unknowns, _ = problem.equations(i, j)
        expected = (there.deep[b] - seen.deep[a]) / 1e-6
        columns = unknowns[2::3] == frame * (6 + FINE.size) + unknown
        by_depth = np.sqrt(PAPER.map_depth * samples[i].weight[seen.rows] / (1 + seen.deep**2))
        found = (jacobian[2::3] * columns).sum(1) / by_depth
        assert np.median(np.abs(found[a] - expected)) < 0.02 * np.abs(expected).mean() + 1e-6
        moved = (there.photo[b] - seen.photo[a]) / 1e-6
        two = jacobian.reshape(-1, 3, 20)[:, :2][a]
        assert two.shape[0] == moved.shape[0]


def test_25_a_step_after_which_nothing_is_drawn_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = [rerender.sample(a_view(i, 0.1 * i), 2) for i in range(2)]
    start, fields, second = np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, FINE.size)), np.array([False, True])
    problem = rerender.Rerendering(samples, start, fields, second, second, [(0, 1)], 2.0, start)
    away = start + np.array([[[0.0]], [[100.0]]]) * np.eye(4, k=3)
    monkeypatch.setattr(rerender.Rerendering, "stepped", lambda self, damping: replace(self, poses=away))
    assert len(replace(problem, poses=away).drawn(0, 1).rows) == 0
    assert (problem.minimised(3).poses == start).all()
    assert np.isfinite(replace(problem, poses=away).minimised(3).poses).all()


def test_gaussians_go_with_their_keyframe_and_its_field() -> None:
    view = a_view()
    gaussians = a_map(view)
    before = gaussians.map.means.clone()
    pose, away = np.eye(4)[None], se3.exp(np.array([[0.1, 0, 0, 0, 0.2, 0]]))
    bent = np.full((1, FINE.rows, FINE.columns), 0.1)
    adjustment.carry(gaussians, [1], pose, away, bent, CAMERA)
    assert torch.equal(gaussians.map.means, before), "of another keyframe"
    adjustment.carry(gaussians, [0], pose, away, bent, CAMERA)
    in_cam = se3.transform(away[0], gaussians.map.means.double().numpy())
    assert np.allclose(in_cam, before.numpy() * np.exp(0.1), atol=1e-5)


def test_26_the_pose_graph_spreads_what_a_loop_says() -> None:
    step = se3.exp(np.array([0.1, 0, 0, 0, 2 * np.pi / 12, 0]))
    true = [np.linalg.matrix_power(step, k) for k in range(13)]
    drift = se3.exp(np.array([0.004, 0.002, 0, 0, 0.01, 0]))
    drifted = [np.eye(4)]
    for _ in range(12):
        drifted.append(drift @ step @ drifted[-1])
    loop = LoopEdge(0, 12, true[12] @ np.linalg.inv(true[0]), 1.0, 100)
    place = {k: k for k in range(13)}
    moved, scales = adjustment.pose_graph(np.array(drifted), [loop], place, 1.0)
    error = [np.linalg.norm(p - q) for p, q in zip(moved, true, strict=True)]
    was = [np.linalg.norm(p - q) for p, q in zip(drifted, true, strict=True)]
    assert 0 < max(error) < 0.6 * max(was)
    assert np.allclose(scales, 1, atol=0.1)
    unmoved, _ = adjustment.pose_graph(np.array(true), [loop], place, 1.0)
    assert np.allclose(unmoved, true, atol=1e-6)


def test_26_semantic_residual_is_zero_where_the_map_shows_the_labels() -> None:
    views, true, field, _ = a_walk(2)
    pair = [rerender.sample(v, 2) for v in views]
    wrong = rerender.sample(replace(views[1], channels=1 - views[1].channels), 2)
    every, fields = np.ones(2, bool), field.reshape(2, -1)

    def residuals(other: rerender.Samples) -> float:
        problem = rerender.Rerendering([pair[0], other], true, fields, every, every, [(0, 1)], 2.0, true)
        return float(np.abs(problem.drawn(0, 1).photo[:, 3:]).mean())

    assert residuals(pair[1]) < 0.2 * residuals(wrong)
    assert (rerender.semantic_residual(np.full((1, 6), 0.5), np.full((1, 6), 0.5)) == 0).all()


def test_26_adjusts_all_keyframes_at_once() -> None:
    views, true, field, shaken = a_walk(6)
    poses, _ = adjustment.global_adjustment(views.__getitem__, range(6), shaken, np.zeros_like(field), 2, 2.0)
    errors = [np.abs(se3.log(p @ se3.inverse(true))).max() for p in (poses, shaken)]
    assert 0 < errors[0] < 0.5 * errors[1]
    same, still = adjustment.global_adjustment(views.__getitem__, [0], true[:1], field[:1], 2, 2.0)
    assert (same == true[:1]).all(), "nothing to compare one keyframe with"
    assert (still == field[:1]).all()


def test_mirror_images_in_the_map_are_drawn_together() -> None:
    rng = np.random.default_rng(0)
    half = rng.uniform([0.2, -1, -1], [1.5, 1, 1], (60, 3))
    points = np.concatenate([half, half * [-1, 1, 1] + rng.normal(0, 0.003, half.shape)])
    gaussians = a_map(a_view())
    gaussians.keep(torch.arange(len(gaussians)) < 120)
    means = gaussians.table.values["means"].detach()
    means.copy_(torch.from_numpy(points).float())
    gaussians.table.values["class_logits"].detach()[:] = 0
    found = [mapping.draw_together(replace_means(gaussians, points), 4.0, seed) for seed in range(20)]
    seed = int(np.argmax([plane.confidence for plane in found]))
    assert found[seed].confidence > 0.5
    mapping.draw_together(replace_means(gaussians, points), 4.0, seed)
    moved = gaussians.map.means.double().numpy()
    apart = [np.abs(p[60:] - p[:60] * [-1, 1, 1]).mean() for p in (points, moved)]
    assert 0 < apart[1] < 0.8 * apart[0]
    chaos = rng.uniform(-1, 1, points.shape)
    assert mapping.draw_together(replace_means(gaussians, chaos), 4.0, 0).confidence == 0
    assert np.allclose(gaussians.map.means, chaos, atol=1e-6)


def replace_means(gaussians: Gaussians, points: np.ndarray) -> Gaussians:
    gaussians.table.values["means"].detach().copy_(torch.from_numpy(points).float())
    return gaussians
