"""The reference renderer against a dense table of all pixels and Gaussians, and against finite differences."""

import pytest
import reference
import torch
from render_scenes import IMAGES, NAMES, dense_composite, random_gaussians
from torch import Tensor

from msgs_slam.pipelines.render.api import composite
from msgs_slam.pipelines.render.rules import ALPHA_MIN

WIDTH, HEIGHT = 23, 17


def leaves(gaussians: dict[str, Tensor], dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    return {name: tensor.to(dtype).requires_grad_() for name, tensor in gaussians.items()}


@pytest.mark.parametrize(("count", "opacity"), [(0, (0.1, 1)), (1, (0.5, 0.6)), (300, (0.001, 0.3)), (300, (0.9, 1.0))])
def test_images_and_gradients_equal_the_dense_table(count, opacity):
    scene = random_gaussians(count, WIDTH, HEIGHT, 3, seed=count, opacity=opacity)
    torch.manual_seed(0)
    upstream = [torch.randn(HEIGHT, WIDTH, 3).double(), *torch.randn(3, HEIGHT, WIDTH).double()]
    ours, dense = leaves(scene), leaves(scene)
    image = composite(**ours, width=WIDTH, height=HEIGHT, backend=reference)
    expected = dense_composite(dense, WIDTH, HEIGHT)
    for name in IMAGES:
        torch.testing.assert_close(getattr(image, name), expected[name], rtol=0, atol=1e-9)
    if count == 0:
        return
    torch.autograd.backward([getattr(image, name) for name in IMAGES], upstream)
    torch.autograd.backward([expected[name] for name in IMAGES], upstream)
    for name in NAMES:
        scale = dense[name].grad.abs().max().clamp(min=1)
        assert (ours[name].grad - dense[name].grad).abs().max() < 1e-9 * scale, name


def test_gradients_equal_finite_differences():
    scene = random_gaussians(6, 5, 4, 2, seed=3, sigma=(0.8, 2.0), opacity=(0.2, 0.9), behind=0.0)

    def images(*tensors):
        image = composite(*tensors, 5, 4, backend=reference)
        return tuple(getattr(image, name) for name in IMAGES)

    # Where a Gaussian ends, its opacity jumps: no finite difference may cross that circle.
    u, v, sigma, opacity = (scene[name].double() for name in ("u", "v", "sigma_px", "opacity"))
    x, y = torch.meshgrid(torch.arange(5) + 0.5, torch.arange(4) + 0.5, indexing="xy")
    distance = ((x.reshape(-1, 1) - u) ** 2 + (y.reshape(-1, 1) - v) ** 2).sqrt()
    reach = sigma * (2 * torch.log(opacity / ALPHA_MIN)).clamp(max=9).sqrt()
    assert (distance - reach).abs().min() > 1e-4
    assert torch.autograd.gradcheck(images, tuple(leaves(scene).values()), eps=1e-6, atol=1e-6)
