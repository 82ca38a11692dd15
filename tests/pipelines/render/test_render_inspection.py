"""Median depth and blending weights against what the images already say."""

from dataclasses import replace

import pytest
import reference
import torch
from render_scenes import Room, random_gaussians, room

from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.render.api import (
    blending_weights,
    choose_backend,
    class_weights,
    in_view,
    median_depth,
    render,
    render_all,
)
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.render.rules import GaussianStats
from msgs_slam.pipelines.system.threads import set_threads

POSE = torch.eye(4, dtype=torch.float64)


def map_of(scene: Room, classes: int = 0, kind: torch.dtype = torch.float32) -> GaussianMap:
    """The scene's Gaussians as a map without any class said."""
    m, ids = scene, torch.zeros(len(scene.means), dtype=torch.int64)
    values = (m.means, m.radii.log(), m.opacities.logit(), m.colors, torch.zeros(len(ids), classes))
    return GaussianMap(*(x.to(kind) for x in values), ids)


@pytest.mark.parametrize("seed", range(3))
def test_both_backends_agree(seed):
    scene = random_gaussians(3000, 70, 90, 1, seed, sigma=(0.3, 30.0), opacity=(0.01, 0.6))
    arguments = [scene[name] for name in ("u", "v", "sigma_px", "z", "opacity")]
    counts = torch.rand(90, 70, generator=torch.Generator().manual_seed(seed))
    exact = reference.inspect(*(x.double() for x in arguments), 70, 90, 0.0, counts.double())
    for threads in (1, 3):
        set_threads(threads)
        ours = choose_backend("cpu", scene["u"]).inspect(*arguments, 70, 90, 0.0, counts)
        for name, mine, theirs in zip(("median", "total", "largest"), ours, exact, strict=False):
            torch.testing.assert_close(mine.double(), theirs, rtol=1e-4, atol=1e-5, msg=name)
    set_threads(0)
    assert (ours[0] > 0).float().mean() > 0.1


def test_median_depth_is_a_surface_and_not_a_mean():
    """Before a gap between two walls the mean depth floats between them, the median stands on one."""
    scene = room(64, 48, 2000, 1)
    median = median_depth(map_of(scene), POSE, scene.intrinsics)
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
    ones = torch.ones(2000, 3, requires_grad=True)
    render(scene.means, scene.radii, scene.opacities, ones, POSE, scene.intrinsics).features.sum().backward()
    total, largest = blending_weights(map_of(scene), POSE, scene.intrinsics)
    torch.testing.assert_close(total, ones.grad[:, 0], rtol=1e-4, atol=1e-5)
    assert (largest <= total + 1e-6).all()
    assert 0.3 < largest.max() <= 0.99


def test_weights_by_class_are_those_of_the_pixels_of_the_class():
    """Compiled, and by the gradient of the readable renderer; in patches, so that tiles show one class or several."""
    scene = room(90, 70, 2000, 1)
    generator = torch.Generator().manual_seed(0)
    patches = torch.randint(0, 5, (4, 5), generator=generator, dtype=torch.uint8).repeat_interleave(18, 0)
    channels, counts = patches.repeat_interleave(18, 1)[:70, :90], torch.rand(70, 90, generator=generator)
    beside = (POSE, scene.intrinsics)
    for classes in (1, 4):
        given = map_of(scene, classes)
        found = torch.zeros(2000, classes).index_add_(0, *class_weights(given, *beside, channels, counts))
        exact = map_of(scene, classes, torch.float64)
        rows, plain = class_weights(exact, *beside, channels, counts.double(), backend=reference)
        assert len(rows) == 2000
        torch.testing.assert_close(found.double(), plain, rtol=1e-4, atol=1e-5)
        counted = torch.where(channels < classes, counts, 0.0)
        total, _ = blending_weights(given, *beside, counts=counted)
        torch.testing.assert_close(found.sum(1), total, rtol=1e-4, atol=1e-5)
    assert (found > 0.01).float().mean(0).min() > 0.05


def test_the_backward_pass_stats_what_an_inspection_finds():
    """Of every backend; all pixels count for the largest weight, or half of them."""
    scene = room(90, 70, 2000, 1)
    seen, beside = (scene.means, scene.radii, scene.opacities), (POSE, scene.intrinsics)
    given = map_of(scene)
    _, largest = blending_weights(given, *beside)
    half = (torch.arange(90) < 45).expand(70, 90)
    for backend, counted in (("cpu", None), ("cpu", half), (reference, None), (reference, half)):
        stats = GaussianStats(counted)
        shown = render(*seen, scene.colors.clone().requires_grad_(), *beside, backend=backend, stats=stats).features
        stats.errors = (shown.detach() - 0.3).abs().mean(-1)
        shown.sum().backward()
        error_share, _ = blending_weights(given, *beside, counts=stats.errors)
        torch.testing.assert_close(stats.error_share, error_share, rtol=1e-4, atol=1e-5)
        if counted is None:
            torch.testing.assert_close(stats.largest, largest, rtol=1e-4, atol=1e-5)
        else:
            inside, _ = blending_weights(given, *beside, counts=half.float())
            assert (stats.largest[inside == 0] == 0).all()
            assert (stats.largest <= largest + 1e-5).all()
    assert error_share.max() > 0.1
    shown = render(*seen, scene.colors.clone().requires_grad_(), *beside, stats=GaussianStats()).features
    with pytest.raises(ValueError, match="errors of the pixels have to be set"):
        shown.sum().backward()


def test_unseen_gaussians_weigh_nothing():
    scene = room(32, 24, 100, 1)
    behind = map_of(replace(scene, means=scene.means * torch.tensor([1.0, 1.0, -1.0])))
    assert all((weights == 0).all() for weights in blending_weights(behind, POSE, scene.intrinsics))
    assert (median_depth(behind, POSE, scene.intrinsics) == 0).all()


def test_what_is_in_view_is_all_that_a_picture_depends_on():
    """On both backends, and no more than a rim beside it."""
    scene = room(64, 48, 2000, 1)
    turned = se3.exp(torch.tensor([0.3, 0.0, 0.2, 0.0, 0.5, 0.1], dtype=torch.float64))
    for backend, kind in (("cpu", torch.float32), (reference, torch.float64)):
        arguments = [x.to(kind) for x in (scene.means, scene.radii, scene.opacities, scene.colors)]
        rows = in_view(*arguments[:2], turned, scene.intrinsics)
        part, whole = (
            render(*given, turned, scene.intrinsics, backend=backend).features
            for given in ([x[rows] for x in arguments], arguments)
        )
        torch.testing.assert_close(part, whole, rtol=0, atol=0)
        seen = blending_weights(map_of(scene, kind=kind), turned, scene.intrinsics, backend)[0] > 0
        assert 100 < seen.sum() < len(rows) < 1.3 * seen.sum() + 50 < 2000


@pytest.mark.parametrize("classes", [0, 1, 5])
def test_one_look_shows_what_single_drawings_show(classes):
    """Colours, depths and coverage bit by bit; each pixel has the class for which the readable renderer says most."""
    scene, k = room(90, 70, 2000, 1), room(90, 70, 2000, 1).intrinsics
    logits = 3 * torch.rand(2000, classes, generator=torch.Generator().manual_seed(classes)) ** 2
    own = replace(map_of(scene), class_logits=logits)
    found, exact = render_all(own, POSE, k), render_all(own, POSE, k, backend=reference)
    with torch.no_grad():
        drawn = render(own.means, own.radii, own.opacities, own.colors, POSE, k)
    assert torch.equal(found.colors, drawn.features)
    assert torch.equal(found.depth, drawn.depth)
    assert torch.equal(found.silhouette, drawn.silhouette)
    assert torch.equal(found.median, median_depth(own, POSE, k))
    torch.testing.assert_close(found.colors, exact.colors, rtol=1e-4, atol=1e-5)
    assert (found.channels == exact.channels).float().mean() > 0.999
    shown = [(found.channels == c).float().mean() for c in range(-1, classes)]
    assert min(shown) > 0.03 if classes else shown == [1]
