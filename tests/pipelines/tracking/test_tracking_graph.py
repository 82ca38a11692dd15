"""The graph over similarities: it finds the truth again, spreads what a loop is off, and shrugs off a lie."""

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.tracking.graph import Edges, apply_step, optimise_pose_graph, residuals

Array = NDArray[np.float64]


def random_nodes(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    poses = se3.exp(np.cumsum(rng.normal(size=(count, 6)) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1], axis=0))
    return poses, np.exp(np.cumsum(rng.normal(size=count) * 0.05))


def true_edges(poses: Array, scales: Array, pairs: list[tuple[int, int]], robust_from: int) -> Edges:
    """Edges that the nodes satisfy exactly."""
    first, second = (np.array(x) for x in zip(*pairs, strict=True))
    ratio = scales[second] / scales[first]
    motions = np.tile(np.eye(4), (len(pairs), 1, 1))
    motions[:, :3, :3] = poses[second, :3, :3] @ np.swapaxes(poses[first, :3, :3], 1, 2)
    turned = np.einsum("eij,ej->ei", motions[:, :3, :3], poses[first, :3, 3])
    motions[:, :3, 3] = poses[second, :3, 3] - ratio[:, None] * turned
    sd = np.tile([0.01] * 3 + [0.005] * 3 + [0.01], (len(pairs), 1))
    return Edges(first, second, motions, ratio, sd, np.arange(len(pairs)) >= robust_from)


def chain(count: int) -> list[tuple[int, int]]:
    return [(i, i + 1) for i in range(count - 1)]


def test_truth_has_no_residual_and_is_found_again() -> None:
    rng = np.random.default_rng(0)
    poses, scales = random_nodes(rng, 20)
    edges = true_edges(poses, scales, [*chain(20), (0, 19), (3, 15)], 19)
    assert np.abs(residuals(poses, scales, edges)).max() < 1e-9
    step = rng.normal(size=(20, 7)) * 0.05
    step[0] = 0
    found, found_scales = optimise_pose_graph(*apply_step(poses, scales, step), edges)
    assert np.allclose(found, poses, atol=1e-5)
    assert np.allclose(found_scales, scales, atol=1e-5)


def test_a_loop_spreads_its_correction() -> None:
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = np.arange(11)
    scales = np.ones(11)
    exact = true_edges(poses, scales, [*chain(11), (0, 10)], 11)
    motions = exact.second_from_first.copy()
    motions[-1, 0, 3] -= 0.05
    edges = Edges(exact.first, exact.second, motions, exact.scale, exact.sd, exact.robust)
    found, _ = optimise_pose_graph(poses, scales, edges)
    steps = np.diff(found[:, 0, 3])
    assert np.allclose(found[0], np.eye(4))
    assert 0.02 < 10 - found[10, 0, 3] < 0.05
    # No single step takes half of it.
    assert np.abs(steps - 1).max() < 0.025


def test_one_false_loop_among_good_ones_loses_its_pull() -> None:
    rng = np.random.default_rng(1)
    poses, scales = random_nodes(rng, 20)
    good = true_edges(poses, scales, [*chain(20), (0, 19), (1, 18), (2, 17), (5, 12)], 19)
    motions = good.second_from_first.copy()
    motions[-1, :3, 3] += 2.0
    found, _ = optimise_pose_graph(
        poses, scales, Edges(good.first, good.second, motions, good.scale, good.sd, good.robust)
    )
    believed = Edges(good.first, good.second, motions, good.scale, good.sd, np.zeros_like(good.robust))
    pulled, _ = optimise_pose_graph(poses, scales, believed)
    moved, dragged = (np.linalg.norm(x[:, :3, 3] - poses[:, :3, 3], axis=1).max() for x in (found, pulled))
    assert moved < 0.05 < 0.2 < dragged
