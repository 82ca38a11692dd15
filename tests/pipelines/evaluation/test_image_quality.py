"""PSNR and SSIM against scikit-image, and against noise of known size."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from msgs_slam.pipelines.evaluation.image_quality import psnr, ssim


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
