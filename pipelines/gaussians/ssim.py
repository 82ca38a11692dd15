"""Structural similarity with its own gradient: eight blurs in all, where autograd would keep every product."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from pipelines.gaussians.render.jit import kernel

C1, C2 = 0.01**2, 0.03**2
"""Constants of Wang et al. 2004 for images in 0..1."""
TAPS, _SIGMA = 11, 1.5


def ssim_map(rendered: Tensor, target: Tensor) -> Tensor:
    """(H, W, 3) local similarity of two float images in 0..1; differentiable in `rendered` alone.

    11-tap Gaussian window of sigma 1.5 (Wang et al., TIP 2004), zeros outside the image as the 3DGS loss has it.
    float32 on a CPU takes compiled loops, everything else plain torch.
    """
    return _Ssim.apply(rendered, target)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        fast = a.device.type == "cpu" and a.dtype == torch.float32
        value, by_mean, by_var, by_cov = _similarity_fast(a, b) if fast else similarity(a, b)
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


def _similarity_fast(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`similarity` in two passes over memory around the five blurs."""
    first, second = (np.ascontiguousarray(x.detach().numpy()) for x in (a, b))
    products = np.empty((3, *first.shape), np.float32)
    _products(first.reshape(-1), second.reshape(-1), products.reshape(3, -1))
    blurred = [_blur_array(x) for x in (first, second, *products)]
    out = np.empty((4, *first.shape), np.float32)
    _similarity_loop(*(x.reshape(-1) for x in blurred), out.reshape(4, -1), C1, C2)
    value, by_mean, by_var, by_cov = torch.from_numpy(out)
    return value, by_mean, by_var, by_cov


@kernel
def _products(a: NDArray, b: NDArray, out: NDArray) -> None:
    for i in range(len(a)):
        out[0, i] = a[i] * a[i]
        out[1, i] = b[i] * b[i]
        out[2, i] = a[i] * b[i]


@kernel
def _similarity_loop(
    mean_a: NDArray, mean_b: NDArray, aa: NDArray, bb: NDArray, ab: NDArray, out: NDArray, c1: float, c2: float
) -> None:
    one, two = np.float32(1), np.float32(2)
    k1, k2 = np.float32(c1), np.float32(c2)
    for i in range(len(mean_a)):
        x, y = mean_a[i], mean_b[i]
        luminance = two * x * y + k1
        contrast = two * (ab[i] - x * y) + k2
        under_l = x * x + y * y + k1
        under_c = aa[i] - x * x + bb[i] - y * y + k2
        inverse = one / (under_l * under_c)
        value = luminance * contrast * inverse
        by_cov = two * luminance * inverse
        by_var = -value / under_c
        out[0, i] = value
        out[1, i] = two * y * contrast * inverse - two * x * value / under_l - two * x * by_var - y * by_cov
        out[2, i] = by_var
        out[3, i] = by_cov


def blur(image: Tensor) -> Tensor:
    """(H, W, C) Gaussian-weighted mean around every pixel, zeros outside the image."""
    if image.device.type == "cpu" and image.dtype in (torch.float32, torch.float64):
        # OpenCV's separable filter is about ten times torch's depthwise convolution on a CPU.
        return torch.from_numpy(_blur_array(np.ascontiguousarray(image.detach().numpy())))
    taps = torch.as_tensor(cv2.getGaussianKernel(TAPS, _SIGMA), dtype=image.dtype, device=image.device).flatten()
    planes = image.permute(2, 0, 1)[:, None]
    planes = functional.conv2d(planes, taps[None, None, :, None], padding=(TAPS // 2, 0))
    planes = functional.conv2d(planes, taps[None, None, None, :], padding=(0, TAPS // 2))
    return planes[:, 0].permute(1, 2, 0)


def _blur_array(image: NDArray) -> NDArray:
    taps = cv2.getGaussianKernel(TAPS, _SIGMA)
    return cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_CONSTANT).reshape(image.shape)
