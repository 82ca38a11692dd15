"""Structural similarity with its own gradient: eight blurs in all, where autograd would keep every product."""

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

C1, C2 = 0.01**2, 0.03**2
"""Constants of Wang et al. 2004 for images in 0..1."""
TAPS = 11
WINDOW = cv2.getGaussianKernel(TAPS, 1.5)[:, 0]
"""The window, along rows and along columns."""


def ssim_map(rendered: Tensor, target: Tensor) -> Tensor:
    """(H, W, 3) local similarity of two float images in 0..1; differentiable in `rendered` alone.

    11-tap Gaussian window of sigma 1.5 (Wang et al., TIP 2004), zeros outside the image as the 3DGS loss has it.
    """
    return _Ssim.apply(rendered, target)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        value, by_mean, by_var, by_cov = similarity(a, b)
        ctx.save_for_backward(a, b, by_mean, by_var, by_cov)
        return value

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (grad,) = grads
        a, b, by_mean, by_var, by_cov = ctx.saved_tensors
        # The window is symmetric and the border zero, so the blur is its own adjoint.
        return blur(grad * by_mean).add_(blur(grad * by_var).mul_(a).mul_(2)).add_(blur(grad * by_cov).mul_(b)), None


def similarity(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The similarity map and its derivatives by the window's mean, variance and covariance of `a`."""
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a * mean_a, blur(b * b) - mean_b * mean_b
    cov = blur(a * b) - mean_a * mean_b
    luminance, contrast = 2 * mean_a * mean_b + C1, 2 * cov + C2
    under_l, under_c = mean_a * mean_a + mean_b * mean_b + C1, var_a + var_b + C2
    value = luminance * contrast / (under_l * under_c)
    by_cov = 2 * luminance / (under_l * under_c)
    by_var = -value / under_c
    # The mean enters the luminance, and through var = E[a²] - mean² and cov = E[ab] - mean mean also the contrast.
    by_mean = 2 * mean_b * contrast / (under_l * under_c) - 2 * mean_a * value / under_l
    by_mean = by_mean - 2 * mean_a * by_var - mean_b * by_cov
    return value, by_mean, by_var, by_cov


def blur(image: Tensor) -> Tensor:
    """(H, W, C) Gaussian-weighted mean around every pixel, zeros outside the image."""
    if image.device.type == "cpu" and image.dtype in (torch.float32, torch.float64):
        # OpenCV's separable filter is about ten times torch's depthwise convolution on a CPU.
        return torch.from_numpy(blur_array(np.ascontiguousarray(image.detach().numpy())))
    taps = torch.as_tensor(WINDOW, dtype=image.dtype, device=image.device)
    planes = image.permute(2, 0, 1)[:, None]
    planes = functional.conv2d(planes, taps[None, None, :, None], padding=(TAPS // 2, 0))
    planes = functional.conv2d(planes, taps[None, None, None, :], padding=(0, TAPS // 2))
    return planes[:, 0].permute(1, 2, 0)


def blur_array(image: NDArray, out: NDArray | None = None) -> NDArray:
    """Blur an array, into `out` where it is given."""
    return cv2.sepFilter2D(image, -1, WINDOW, WINDOW, out, borderType=cv2.BORDER_CONSTANT).reshape(image.shape)
