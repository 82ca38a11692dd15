"""The terms of the mapping loss (MSGS-SLAM eqs. 18-20), each a scalar that does not depend on the unit of depth."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from pipelines.gaussians.entropy import weighted_entropy
from pipelines.gaussians.ssim import ssim_map
from pipelines.mapping.mirrors import Mirrors, at
from pipelines.types import VOID


def image_loss(rendered: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """MSGS-SLAM eq. (20): (1 - w) |I - C| + w (1 - SSIM), mean over (H, W, channels) images in 0..1.

    The article prints ω = 0.2 before the absolute difference; the weights of 3DGS, which has the same formula, are the
    other way round, and so are the ones here.
    """
    difference = (rendered - target).abs().mean()
    if ssim_weight == 0:
        return difference
    return (1 - ssim_weight) * difference + ssim_weight * (1 - ssim_map(rendered, target).mean())


def depth_weight(reliability: Tensor, nu: float) -> Tensor:
    """min(1, ν U) of eq. (18), (H, W)."""
    return (nu * reliability).clamp(max=1.0)


def depth_loss(rendered: Tensor, proxy: Tensor, weight: Tensor, unit: float) -> Tensor:
    """w |D̂ - D| of eq. (18), in units of the scene's depth; mean over all H x W pixels, unknown proxy (0) counts 0."""
    known = proxy > 0
    return ((rendered - proxy).abs() * weight * known).mean() / unit


def label_loss(logits: Tensor, labels: Tensor, weight: Tensor) -> Tensor:
    """Cross-entropy of (H, W, C) rendered logits with (H, W) labels, void ignored, weighted; mean over all pixels."""
    return weighted_entropy(logits, labels, weight)


def label_image_loss(logits: Tensor, labels: Tensor, weight: Tensor, ssim_weight: float) -> Tensor:
    """Eq. (20) for the semantic image: rendered probabilities against one-hot labels; void pixels count 0."""
    known = (labels != VOID)[..., None]
    target = functional.one_hot(torch.where(known[..., 0], labels, 0).long(), logits.shape[-1]).to(logits.dtype)
    probabilities = torch.where(known, logits.softmax(-1), target)
    difference = ((probabilities - target).abs().sum(-1) * weight).mean() / 2
    if ssim_weight == 0:
        return difference
    return (1 - ssim_weight) * difference + ssim_weight * (1 - ssim_map(probabilities, target).mean())


def edge_loss(depth: Tensor, labels: Tensor, sharpness: float, unit: float) -> Tensor:
    """MSGS-SLAM eq. (19) over horizontal and vertical neighbours of an (H, W) rendered depth.

    exp(-ζ Δ²) where the class changes (the depth may jump), 1 - exp(-ζ Δ²) inside a region (it is smooth); pairs with a
    void pixel count 0. Δ is in units of the scene's depth.
    """
    total = depth.new_zeros(())
    for dim in (0, 1):
        n = depth.shape[dim] - 1
        a, b = labels.narrow(dim, 0, n), labels.narrow(dim, 1, n)
        step = (depth.narrow(dim, 1, n) - depth.narrow(dim, 0, n)) / unit
        near = torch.exp(-sharpness * step * step)
        term = torch.where(a == b, 1 - near, near)
        total = total + (term * ((a != VOID) & (b != VOID))).mean()
    return total / 2


def symmetry_loss(depth: Tensor, mirrors: Mirrors, unit: float) -> Tensor:
    """Mean over the pairs, weighed by their confidence: how far the second depth is from what the first one says."""
    expected = mirrors.gain * at(depth, mirrors.first) + mirrors.offset
    return (mirrors.confidence * (at(depth, mirrors.second) - expected).abs()).mean() / unit


def label_symmetry_loss(logits: Tensor, mirrors: Mirrors) -> Tensor:
    """Mean over the pairs, weighed by their confidence: the total variation between the two pixels' classes."""
    first, second = at(logits, mirrors.first).softmax(-1), at(logits, mirrors.second).softmax(-1)
    return (mirrors.confidence * (first - second).abs().sum(-1)).mean() / 2


def size_loss(log_radii: Tensor, largest: float) -> Tensor:
    """L_reg of eq. (18): mean squared log excess of (M,) radii over `largest`."""
    excess = (log_radii - torch.log(torch.tensor(largest, device=log_radii.device))).clamp(min=0)
    return (excess * excess).mean()


def silhouette_loss(silhouette: Tensor) -> Tensor:
    """Mean transparency left over: presses the map to be opaque, without which it slowly turns to fog."""
    return (1 - silhouette).mean()
