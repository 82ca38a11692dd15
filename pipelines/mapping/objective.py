"""Objective of the map: the loss of one view, MSGS-SLAM eq. (18), by autograd on the CPU, in one pass on a GPU."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from ..config import MappingConfig
from ..render.api import Rendering
from ..system import gpu
from ..system.ssim import C1, C2, TAPS, WINDOW
from . import losses
from .losses import MAX_GAIN, MIN_PIXELS, NU, OUTLIER, RIDGE, SIZE_LIMIT, SOLID, SSIM_WEIGHT, STRIDE, photo_loss
from .views import View

_BLOCK = 512
"""Numbers a program of the kernels."""

SILHOUETTE_WEIGHT = 0.05
"""Weight (of mean transparency, 0..1) of the pressure towards an opaque map."""


@dataclass(frozen=True)
class Objective:
    """The terms with their weights; `unit`: the scene's median depth."""

    settings: MappingConfig
    unit: float

    def of(
        self,
        view: View,
        exposure: Tensor,
        rendering: Rendering,
        log_radii: Tensor,
        in_view: Tensor | None = None,
    ) -> Tensor:
        """Scalar; `exposure` (2, 3) is the view's, `log_radii` (M,) those of the Gaussians in view, or of all Gaussians
        of a card, of which `in_view` (M,) bool tells them."""
        if in_view is None:
            return self._seen(view, exposure, rendering) + losses.size_loss(log_radii, self.unit)
        weights = TermWeights(SILHOUETTE_WEIGHT, self.settings.depth_weight, self.unit)
        return card_loss(view, exposure, rendering, log_radii, in_view, weights)

    def _seen(self, view: View, exposure: Tensor, rendering: Rendering) -> Tensor:
        """The terms of every view: what `card_loss` has for cards, without the sizes."""
        loss = photo_loss(rendering.features, exposure, view.image, view.scene)
        loss = loss + SILHOUETTE_WEIGHT * losses.silhouette_loss(view.of_scene(rendering.silhouette, 1.0))
        if self.settings.depth_weight > 0:
            weight = losses.depth_weight(view.trust)
            loss = loss + self.settings.depth_weight * losses.depth_loss(rendering.depth, view.depth, weight, self.unit)
        return loss


@dataclass(frozen=True)
class TermWeights:
    """Weights of silhouette and depth beside the photo; `unit`: the scene's median depth."""

    silhouette: float
    depth: float
    unit: float


def card_loss(
    view: View, exposure: Tensor, rendering: Rendering, log_radii: Tensor, in_view: Tensor, weights: TermWeights
) -> Tensor:
    """Scalar, differentiable in the rendering and the log radii (M,), of which those count that are in_view (M,)."""
    images = (rendering.features, rendering.depth, rendering.silhouette)
    return _CardLoss.apply(*images, log_radii, view, exposure, in_view, weights)


@torch.no_grad()
def fit_exposure_on_card(rendering: Rendering, view: View, exposure: Tensor) -> None:
    """`fit_exposure` of what the map covers in a view, in place, on a contiguous exposure (2, 3)."""
    from .loss_kernels import fit_color  # imports triton

    height, width = rendering.silhouette.shape
    shown, silhouette = rendering.features.detach(), rendering.silhouette.detach().contiguous()
    given = (shown, shown.shape[-1], silhouette, view.image, _mask(view), exposure, width, height)
    rules = {"SOLID": SOLID, "MIN_PIXELS": MIN_PIXELS, "OUTLIER": OUTLIER, "RIDGE": RIDGE, "MAX_GAIN": MAX_GAIN}
    gpu.launch(fit_color, 3, *given, STRIDE=STRIDE, **rules, MASKED=view.scene is not None, BLOCK=1024)


def color_errors_on_card(colors: Tensor, view: View, exposure: Tensor) -> Tensor:
    """(H, W) mean difference between the exposed (H, W, C) colours and the view's photo, 0 where that is no scene."""
    from .loss_kernels import color_errors  # imports triton

    errors = torch.empty(colors.shape[:2], device=colors.device)
    given = (colors.contiguous(), colors.shape[-1], exposure, view.image, _mask(view), errors)
    _run(color_errors, errors.numel(), *given, errors.numel(), MASKED=view.scene is not None)
    return errors


def _mask(view: View) -> Tensor:
    """A kernel takes no None: a mask that is not there is not read."""
    return view.image if view.scene is None else view.scene.view(torch.uint8)


def _run(kernel: Any, count: int, *arguments: Any, BLOCK: int = _BLOCK, **settings: Any) -> None:
    gpu.launch(kernel, -(-count // BLOCK), *arguments, BLOCK=BLOCK, **settings)


@lru_cache(maxsize=2)
def _window(device: torch.device) -> Tensor:
    return torch.tensor(WINDOW, dtype=torch.float32, device=device)


class _CardLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        features, depth, silhouette, log_radii = (x.detach().contiguous() for x in arguments[:4])
        view, exposure, in_view, weights = arguments[4:]
        loss, d_features = features.new_zeros(()), torch.empty_like(features)
        _add_photo(features, exposure, view, loss, d_features)
        d_depth, d_silhouette = _add_maps(depth, silhouette, view, weights, loss)
        d_log_radii = _add_sizes(log_radii, in_view, weights.unit, loss)
        ctx.save_for_backward(d_features, d_depth, d_silhouette, d_log_radii)
        return loss

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return *torch._foreach_mul(ctx.saved_tensors, gradients[0]), *[None] * 4


def _add_photo(features: Tensor, exposure: Tensor, view: View, loss: Tensor, gradient: Tensor) -> None:
    """`photo_loss` of the first three features, their gradient into the gradient's first three."""
    from . import loss_kernels as kernels  # imports triton

    size, row, stride = view.image.numel(), 3 * view.image.shape[1], features.shape[-1]
    planes, moments, half = (features.new_empty(5, size) for _ in range(3))
    window = _window(features.device)
    mask: dict[str, Any] = {"MASKED": view.scene is not None, "SHARE": SSIM_WEIGHT}

    def blur(numbers: int, of: Tensor) -> None:
        _run(kernels.blur_planes, numbers, of, half, window, size, row, 3, numbers, TAPS=TAPS)
        _run(kernels.blur_planes, numbers, half, moments, window, size, size, row, numbers, TAPS=TAPS)

    given = (features, stride, exposure, view.image, _mask(view))
    _run(kernels.expose_colors, size, *given, planes, loss, size, **mask)
    blur(5 * size, planes)
    _run(kernels.compare_moments, size, moments, planes, loss, size, C1=C1, C2=C2, SHARE=SSIM_WEIGHT)
    blur(3 * size, planes[2:])
    _run(kernels.differentiate, size, planes, moments, exposure, _mask(view), gradient, stride, size, **mask)


def _add_maps(
    depth: Tensor, silhouette: Tensor, view: View, weights: TermWeights, loss: Tensor
) -> tuple[Tensor, Tensor]:
    """Silhouette and depth; returns their gradients."""
    from .loss_kernels import compare_maps  # imports triton

    d_depth, d_silhouette, pixels = torch.empty_like(depth), torch.empty_like(silhouette), depth.numel()
    given = (depth, silhouette, view.depth, view.reliability, _mask(view), loss, d_depth, d_silhouette, pixels)
    shares = (weights.silhouette, weights.depth / weights.unit)
    _run(compare_maps, pixels, *given, *shares, NU=NU, MASKED=view.scene is not None)
    return d_depth, d_silhouette


def _add_sizes(log_radii: Tensor, in_view: Tensor, unit: float, loss: Tensor) -> Tensor:
    """`size_loss`; returns the gradient."""
    from .loss_kernels import weigh_sizes  # imports triton

    gradient, limit = torch.empty_like(log_radii), math.log(SIZE_LIMIT * unit)
    given = (log_radii, in_view.view(torch.uint8), in_view.sum(), loss, gradient, limit, len(log_radii))
    _run(weigh_sizes, len(log_radii), *given)
    return gradient
