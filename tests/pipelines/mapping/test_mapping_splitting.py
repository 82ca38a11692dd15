"""Who answers for an error, and what takes the place of a Gaussian that is split."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.mapping.growth import CHILDREN, Growth, split
from msgs_slam.pipelines.mapping.state import MapParameters
from msgs_slam.pipelines.render.api import blending_weights, render
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.render.rules import GaussianStats
from msgs_slam.pipelines.types import Intrinsics

CAMERA = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
POSE = torch.eye(4, dtype=torch.float64)


def wall(spacing: float, slope: float = 0.0, radius: float = 0.7) -> GaussianMap:
    """Gaussians side by side on a plane in front of the camera: z = 2 + slope * x."""
    x, y = (torch.from_numpy(a.ravel()).float() for a in np.mgrid[-1.4:1.4:spacing, -1.2:1.2:spacing])
    m = len(x)
    return GaussianMap(
        means=torch.stack([x, y, 2 + slope * x], 1),
        log_radii=torch.full((m,), radius * spacing).log(),
        opacity_logits=torch.full((m,), 1.0),
        colors=torch.rand(m, 3, generator=torch.Generator().manual_seed(0)),
        class_logits=torch.zeros(m, 0),
        anchor_frame_ids=torch.arange(m),
    )


def noted(m: GaussianMap, error_of: Callable[[torch.Tensor], torch.Tensor]) -> GaussianStats:
    stats = GaussianStats()
    shown = render(m.means, m.radii, m.opacities, m.colors.clone().requires_grad_(), POSE, CAMERA, stats=stats).features
    stats.errors = error_of(shown.detach())
    shown.sum().backward()
    return stats


def test_a_gaussian_answers_for_errors_by_its_part_in_the_pixel() -> None:
    m = wall(0.2)
    everywhere = noted(m, lambda colors: torch.ones(colors.shape[:2]))
    total, _ = blending_weights(m, POSE, CAMERA)
    assert torch.allclose(everywhere.error_share, total, rtol=1e-3, atol=1e-4)
    assert total.max() > 10

    def in_the_left_half(colors: torch.Tensor) -> torch.Tensor:
        return (torch.arange(CAMERA.width) < CAMERA.width // 2).float().expand(colors.shape[:2])

    left = noted(m, in_the_left_half).error_share
    assert torch.equal(left[m.means[:, 0] > 0.6], torch.zeros_like(left)[m.means[:, 0] > 0.6])
    inside = m.means[:, 0] < -0.6
    assert torch.allclose(left[inside], everywhere.error_share[inside])


def test_the_worst_view_counts_where_a_gaussian_is_large_enough() -> None:
    parameters = MapParameters.from_map(wall(1.5))
    growth = Growth([], 0, MappingConfig(), SimpleNamespace(parameters=parameters), 10.0)
    rows, large, small = torch.tensor([0, 2]), torch.tensor([3.0, 3.0]), torch.tensor([3.0, 0.5])
    for error_share, footprints in (([1.0, 5.0], large), ([2.0, 9.0], small)):
        stats = GaussianStats()
        stats.largest, stats.error_share = torch.tensor([0.5, 0.1]), torch.tensor(error_share)
        growth.note(stats, rows, footprints)
    assert parameters.noted.tolist() == [[0.5, 2.0], [0.0, 0.0], [pytest.approx(0.1), 5.0], [0.0, 0.0]]
    parameters.append(wall(1.5), torch.ones(4), weight=1.0)
    growth.prune(by_weight=True)
    assert len(parameters) == 6
    assert not parameters.noted.any()


def test_children_lie_on_the_surface_and_cover_what_their_parent_did() -> None:
    slope = 0.4
    m = wall(0.2, slope)
    rows = torch.tensor([40, 41, 60])
    children = split(m, rows)
    assert len(children) == CHILDREN * len(rows)
    x, _, z = children.means.T
    assert (z - 2 - slope * x).abs().max() < 0.01
    assert children.anchor_frame_ids.tolist() == [40, 41, 60] * CHILDREN
    parents = m.means[rows].repeat(CHILDREN, 1)
    distance = (children.means - parents).norm(dim=1) / m.radii[rows].repeat(CHILDREN)
    assert torch.allclose(distance, torch.tensor(0.6 * 2**0.5), rtol=1e-3)

    def drawn(part: GaussianMap) -> torch.Tensor:
        return render(part.means, part.radii, part.opacities, part.colors, POSE, CAMERA).silhouette.sum()

    everything = split(m, torch.arange(len(m)))
    assert 0.9 < drawn(everything) / drawn(m) < 1.1


def test_a_map_smaller_than_a_neighbourhood_is_split_too() -> None:
    m = wall(1.5)
    assert len(m) == 4
    children = split(m, torch.arange(4))
    assert torch.isfinite(children.means).all()
    assert (children.means[:, 2] - 2).abs().max() < 1e-3
