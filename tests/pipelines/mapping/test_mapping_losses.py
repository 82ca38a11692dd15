"""The terms of the mapping loss: known values, gradients, units, and what they must ignore."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from msgs_slam.pipelines.mapping import losses
from msgs_slam.pipelines.mapping.losses import expose, fit_exposure, photo_loss, plain_photo_loss
from msgs_slam.pipelines.system.ssim import ssim_map


def pictures(dtype: torch.dtype = torch.float32, size: tuple[int, int] = (24, 31)) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    a, b = (torch.rand(*size, 3, generator=generator, dtype=torch.float64).to(dtype) for _ in range(2))
    return a, (0.7 * a + 0.3 * b)


def test_ssim_agrees_with_scikit_image_inside() -> None:
    a, b = pictures(torch.float64)
    _, truth = structural_similarity(
        a.numpy(), b.numpy(), channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    inside = (slice(6, -6), slice(6, -6))
    assert np.abs(ssim_map(a, b).numpy() - truth)[inside].max() < 1e-9


def test_ssim_gradient() -> None:
    a, b = pictures(torch.float64, (7, 8))
    assert torch.autograd.gradcheck(lambda x: ssim_map(x, b), (a.requires_grad_(),))


def test_photo_loss_weighs_its_two_parts() -> None:
    a, b = pictures()
    photo, nothing = (255 * b).to(torch.uint8), torch.zeros(2, 3)
    expected = 0.8 * (a - photo / 255).abs().mean() + 0.2 * (1 - ssim_map(a, photo / 255).mean())
    assert torch.isclose(photo_loss(a, nothing, photo), expected)
    assert photo_loss(photo / 255, nothing, photo) < 1e-6


@pytest.mark.parametrize("masked", [False, True])
def test_compiled_photo_loss_is_the_plain_one(masked: bool) -> None:
    """Value and gradients; the colours may be some of more features, and the last band of rows may be short."""
    features, photo = torch.cat(pictures(), -1), (255 * pictures()[1]).to(torch.uint8)
    scene = torch.rand(photo.shape[:2], generator=torch.Generator().manual_seed(1)) > 0.3 if masked else None
    exposure = torch.tensor([[0.1, -0.2, 0.05], [0.01, 0.02, -0.1]])
    found = []
    for loss, kind in ((photo_loss, torch.float32), (plain_photo_loss, torch.float64)):
        colors = features.to(kind).requires_grad_()
        value = loss(colors[..., :3], exposure.to(kind), photo, scene)
        found.append([value, *torch.autograd.grad(3 * value, [colors])])
    for mine, theirs in zip(*found, strict=True):
        assert theirs.abs().max() > 0
        assert (mine - theirs).abs().max() < 1e-5 * theirs.abs().max()
    if scene is not None:
        assert found[0][1][~scene].abs().max() == 0


def test_an_exposure_is_fitted_past_what_is_wrong_in_the_map() -> None:
    """Gain and offset of each colour, though a fifth of the picture shows something else; few pixels change nothing."""
    generator = torch.Generator().manual_seed(2)
    shown = torch.rand(120, 160, 3, generator=generator)
    true = torch.tensor([[0.3, -0.2, 0.0], [0.02, -0.05, 0.1]])
    photo = expose(shown, true) + 0.01 * torch.randn(shown.shape, generator=generator)
    photo[:24] = torch.rand(24, 160, 3, generator=generator)
    known, start = torch.ones(120, 160, dtype=torch.bool), torch.zeros(2, 3)
    found = start
    for _ in range(6):
        found = fit_exposure(shown, photo, known, found)
    assert (expose(shown, found) - expose(shown, true)).abs().mean() < 0.01
    known[4:] = False
    assert torch.equal(fit_exposure(shown, photo, known, start), start)


def test_the_same_picture_moves_no_exposure() -> None:
    """Nor does one of a single colour, where gain and offset cannot be told apart."""
    known, start = torch.ones(80, 80, dtype=torch.bool), torch.zeros(2, 3)
    for shown in (torch.full((80, 80, 3), 0.5), torch.rand(80, 80, 3, generator=torch.Generator().manual_seed(3))):
        assert fit_exposure(shown, shown, known, start).abs().max() < 1e-6


def test_depth_loss_has_no_unit_and_ignores_unknown_depth() -> None:
    proxy = torch.tensor([[1.0, 2.0], [0.0, 4.0]])
    rendered = proxy + torch.tensor([[0.1, 0.0], [9.0, -0.2]])
    weight = torch.tensor([[1.0, 1.0], [1.0, 0.5]])
    loss = losses.depth_loss(rendered, proxy, weight, 2.0)
    assert torch.isclose(loss, torch.tensor((0.1 + 0.2 * 0.5) / 4 / 2.0))
    assert torch.isclose(losses.depth_loss(100 * rendered, 100 * proxy, weight, 200.0), loss)
    assert torch.allclose(losses.depth_weight(torch.tensor([0.5, 1.0])), torch.tensor([0.5 * losses.NU, 1.0]))


def test_size_and_silhouette() -> None:
    radii = torch.log(torch.tensor([0.01, 0.1, 0.2]))
    assert losses.size_loss(radii, 0.3 / losses.SIZE_LIMIT) == 0
    assert torch.isclose(losses.size_loss(radii, 0.1 / losses.SIZE_LIMIT), torch.log(torch.tensor(2.0)) ** 2 / 3)
    assert torch.isclose(losses.silhouette_loss(torch.tensor([1.0, 0.5])), torch.tensor(0.25))
