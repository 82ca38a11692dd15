"""Who answers for an error, and what takes the place of a Gaussian that is split."""

import numpy as np
import torch

from msgs_slam.pipelines.mapping.growth import CHILDREN, DensificationError, densification_error, split
from msgs_slam.pipelines.render.api import in_view, render
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.render.inspection import blending_weights
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


def test_blame_is_the_error_weighed_by_the_part_in_the_pixel() -> None:
    m = wall(0.2)
    everywhere = densification_error(m, POSE, CAMERA, lambda colors: torch.ones(colors.shape[:2]))
    weights = blending_weights(m.means, m.radii, m.opacities, POSE, CAMERA)
    assert torch.allclose(everywhere.error, weights.total, rtol=1e-3, atol=1e-4)
    assert weights.total.max() > 10

    def in_the_left_half(colors: torch.Tensor) -> torch.Tensor:
        return (torch.arange(CAMERA.width) < CAMERA.width // 2).float().expand(colors.shape[:2])

    left = densification_error(m, POSE, CAMERA, in_the_left_half).error
    assert torch.equal(left[m.means[:, 0] > 0.6], torch.zeros_like(left)[m.means[:, 0] > 0.6])
    inside = m.means[:, 0] < -0.6
    assert torch.allclose(left[inside], everywhere.error[inside])


def test_blame_is_shown_the_colors_of_the_map() -> None:
    m, shown = wall(0.2), []
    densification_error(m, POSE, CAMERA, lambda colors: shown.append(colors) or torch.zeros(colors.shape[:2]))
    expected = render(m.means, m.radii, m.opacities, m.colors, POSE, CAMERA).features
    assert torch.allclose(shown[0], expected, atol=1e-5)


def test_footprints_are_radii_in_pixels() -> None:
    m = wall(0.2, radius=0.5)
    found = densification_error(m, POSE, CAMERA, lambda colors: torch.zeros(colors.shape[:2]))
    seen = in_view(m.means, m.radii, POSE, CAMERA)
    assert len(seen) > 0
    assert torch.allclose(found.footprint[seen], torch.tensor(0.1 / 2 * 60))


def test_the_worst_view_counts() -> None:
    first = DensificationError(torch.tensor([1.0, 5.0]), torch.tensor([3.0, 4.0]))
    second = DensificationError(torch.tensor([2.0, 0.5]), torch.tensor([6.0, 7.0]))
    worst = first.worst_of(second)
    assert worst.error.tolist() == [2.0, 5.0]
    assert worst.footprint.tolist() == [6.0, 4.0]


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
