"""Median depth and blending weights against what the images already say."""

import pytest
import torch
from render_scenes import random_gaussians, room

from pipelines.gaussians.render import blending_weights, median_depth, render, set_threads
from pipelines.gaussians.render.compositing import choose_backend

POSE = torch.eye(4, dtype=torch.float64)


@pytest.mark.parametrize("seed", range(3))
def test_both_backends_agree(seed):
    scene = random_gaussians(3000, 70, 90, 1, seed, sigma=(0.3, 30.0), opacity=(0.01, 0.6))
    arguments = [scene[name] for name in ("u", "v", "sigma_px", "z", "opacity")]
    counts = torch.rand(90, 70, generator=torch.Generator().manual_seed(seed))
    exact = choose_backend("reference", scene["u"]).inspect(
        *(x.double() for x in arguments), 70, 90, 0.0, counts.double()
    )
    for threads in (1, 3):
        set_threads(threads)
        ours = choose_backend("cpu", scene["u"]).inspect(*arguments, 70, 90, 0.0, counts)
        for name, mine, theirs in zip(("median", "total", "largest"), ours, exact, strict=True):
            torch.testing.assert_close(mine.double(), theirs, rtol=1e-4, atol=1e-5, msg=name)
    set_threads(0)
    assert (ours[0] > 0).float().mean() > 0.1


def test_median_depth_is_a_surface_and_not_a_mean():
    """Before a gap between two walls the mean depth floats between them, the median stands on one."""
    scene = room(64, 48, 2000, 1)
    median = median_depth(scene.means, scene.radii, scene.opacities, POSE, scene.intrinsics)
    mean = render(scene.means, scene.radii, scene.opacities, scene.colors, POSE, scene.intrinsics)
    assert median.shape == (48, 64)
    covered = mean.silhouette > 0.55
    assert covered.float().mean() > 0.9
    assert (median[covered] > 0).all()
    assert torch.isin(median[covered], scene.means[:, 2].contiguous()).all()
    assert (median[covered] - mean.depth[covered]).abs().median() < 0.05
    assert (median[mean.silhouette < 0.45] == 0).all()


def test_summed_weights_are_the_gradient_of_a_feature_of_ones():
    scene = room(64, 48, 2000, 1)
    ones = torch.ones(2000, 1, requires_grad=True)
    render(scene.means, scene.radii, scene.opacities, ones, POSE, scene.intrinsics).features.sum().backward()
    weights = blending_weights(scene.means, scene.radii, scene.opacities, POSE, scene.intrinsics)
    torch.testing.assert_close(weights.total, ones.grad[:, 0], rtol=1e-4, atol=1e-5)
    assert (weights.largest <= weights.total + 1e-6).all()
    assert 0.3 < weights.largest.max() <= 0.99


def test_unseen_gaussians_weigh_nothing():
    scene = room(32, 24, 100, 1)
    behind = scene.means * torch.tensor([1.0, 1.0, -1.0])
    weights = blending_weights(behind, scene.radii, scene.opacities, POSE, scene.intrinsics)
    assert (weights.total == 0).all()
    assert (weights.largest == 0).all()
    assert (median_depth(behind, scene.radii, scene.opacities, POSE, scene.intrinsics) == 0).all()
