"""PSNR and SSIM against scikit-image, and against noise of known size; depth L1 of known disturbances."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from msgs_slam.pipelines.evaluation.image_quality import DepthErrorSum, psnr, ssim


@pytest.mark.parametrize("noise", [2, 10, 40])
def test_same_as_scikit_image(noise: int) -> None:
    rng = np.random.default_rng(noise)
    truth = np.clip(np.cumsum(rng.normal(size=(61, 83, 3)), axis=1) * 10 + 120, 0, 255).astype(np.uint8)
    image = np.clip(truth + rng.normal(scale=noise, size=truth.shape), 0, 255).astype(np.uint8)
    assert psnr(image, truth) == pytest.approx(peak_signal_noise_ratio(truth, image), abs=1e-9)
    theirs = structural_similarity(
        truth, image, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert ssim(image, truth) == pytest.approx(theirs, abs=1e-7)
    assert 0 < ssim(image, truth) < 1


def test_psnr_of_known_noise_and_of_a_mask() -> None:
    rng = np.random.default_rng(0)
    truth = np.full((200, 200, 3), 128.0)
    image = truth + rng.normal(scale=5, size=truth.shape)
    assert psnr(image, truth) == pytest.approx(20 * np.log10(255 / 5), abs=0.1)
    mask = np.zeros((200, 200), bool)
    mask[:100] = True
    image[100:] = 0
    assert psnr(image, truth, mask) == pytest.approx(20 * np.log10(255 / 5), abs=0.1)
    assert psnr(image, truth) < 12
    assert psnr(truth, truth) == float("inf")
    assert ssim(truth, truth) == pytest.approx(1)
    with pytest.raises(ValueError, match="no pixel"):
        psnr(image, truth, np.zeros((200, 200), bool))


def test_scale_noise_and_holes_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    errors = DepthErrorSum()
    for _ in range(3):
        truth = rng.uniform(1, 5, (120, 160)).astype(np.float32)
        truth[:12] = 0
        depth = (0.8 * (truth + rng.normal(scale=0.03, size=truth.shape))).astype(np.float32)
        depth[:, :40] = 0
        errors.add(depth, truth)
    result = errors.result()
    assert result is not None
    assert result.scale == pytest.approx(1.25, rel=2e-3)
    assert result.metric_l1 == pytest.approx(0.2 * 3, rel=0.02)
    # The mean of |normal| is sqrt(2 / pi) standard deviations.
    assert result.scaled_l1 == pytest.approx(0.03 * np.sqrt(2 / np.pi), rel=0.03)
    assert result.valid_fraction == pytest.approx(0.75)


def test_equal_depth_has_no_error_and_no_overlap_no_result() -> None:
    truth = np.linspace(1, 2, 64, dtype=np.float32).reshape(8, 8)
    errors = DepthErrorSum()
    errors.add(truth, truth)
    result = errors.result()
    assert result is not None
    assert (result.metric_l1, result.scaled_l1, result.valid_fraction) == (0, 0, 1)
    empty = DepthErrorSum()
    empty.add(np.zeros_like(truth), truth)
    assert empty.result() is None
