"""The mapping loss on a GPU: Triton kernels of what `losses` does, value and gradient in one pass, and their launches.

The sums are atomic additions: their last bits may differ from run to run. The interpreter of Triton (environment
variable TRITON_INTERPRET=1) runs these kernels on CPU tensors.
"""

import math
from functools import lru_cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..render.api import Rendering
from ..system import gpu
from ..system.ssim import C1, C2, TAPS, WINDOW
from .losses import (
    MAX_GAIN,
    MIN_PIXELS,
    NU,
    OUTLIER,
    RIDGE,
    SILHOUETTE_WEIGHT,
    SIZE_LIMIT,
    SOLID,
    SSIM_WEIGHT,
    STRIDE,
    Objective,
)  # fmt: skip
from .views import View

_BLOCK = 512
"""Numbers a program of the kernels."""


def card_loss(
    objective: Objective, view: View, exposure: Tensor, rendering: Rendering, log_radii: Tensor, in_view: Tensor
) -> Tensor:
    """Scalar, differentiable in the rendering and the log radii (M,), of which those count that are in_view (M,)."""
    images = (rendering.features, rendering.depth, rendering.silhouette)
    return _CardLoss.apply(*images, log_radii, view, exposure, in_view, objective)


@torch.no_grad()
def fit_exposure_on_card(rendering: Rendering, view: View, exposure: Tensor) -> None:
    """`fit_exposure` of what the map covers in a view, in place, on a contiguous exposure (2, 3)."""
    height, width = rendering.silhouette.shape
    shown, silhouette = rendering.features.detach(), rendering.silhouette.detach().contiguous()
    given = (shown, shown.shape[-1], silhouette, view.image, _mask(view), exposure, width, height)
    rules = {"SOLID": SOLID, "MIN_PIXELS": MIN_PIXELS, "OUTLIER": OUTLIER, "RIDGE": RIDGE, "MAX_GAIN": MAX_GAIN}
    gpu.launch(fit_color, 3, *given, STRIDE=STRIDE, **rules, MASKED=view.scene is not None, BLOCK=1024)


def color_errors_on_card(colors: Tensor, view: View, exposure: Tensor) -> Tensor:
    """(H, W) mean difference between the exposed (H, W, C) colours and the view's photo, 0 where that is no scene."""
    errors = torch.empty(colors.shape[:2], device=colors.device)
    given = (colors.contiguous(), colors.shape[-1], exposure, view.image, _mask(view), errors)
    _run(color_errors, errors.numel(), *given, errors.numel(), MASKED=view.scene is not None)
    return errors


def _mask(view: View) -> Tensor:
    """A kernel takes no None: a mask that is not there is not read."""
    return view.image if view.scene is None else view.scene.view(torch.uint8)


def _run(kernel: Any, count: int, *arguments: Any, **settings: Any) -> None:
    gpu.launch(kernel, -(-count // _BLOCK), *arguments, BLOCK=_BLOCK, **settings)


@lru_cache(maxsize=2)
def _window(device: torch.device) -> Tensor:
    return torch.tensor(WINDOW, dtype=torch.float32, device=device)


class _CardLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        features, depth, silhouette, log_radii = (x.detach().contiguous() for x in arguments[:4])
        view, exposure, in_view, objective = arguments[4:]
        loss = features.new_zeros(())
        pulls = [torch.empty_like(x) for x in (features, depth, silhouette, log_radii)]
        _add_photo(features, exposure, view, loss, pulls[0])
        weights = (SILHOUETTE_WEIGHT, objective.settings.depth_weight / objective.unit)
        given = (depth, silhouette, view.depth, view.reliability, _mask(view), loss, *pulls[1:3], depth.numel())
        _run(compare_maps, depth.numel(), *given, *weights, NU=NU, MASKED=view.scene is not None)
        sizes = (log_radii, in_view.view(torch.uint8), in_view.sum(), loss, pulls[3])
        _run(weigh_sizes, len(log_radii), *sizes, math.log(SIZE_LIMIT * objective.unit), len(log_radii))
        ctx.save_for_backward(*pulls)
        return loss

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return *torch._foreach_mul(ctx.saved_tensors, gradients[0]), *[None] * 4


def _add_photo(features: Tensor, exposure: Tensor, view: View, loss: Tensor, gradient: Tensor) -> None:
    """`photo_loss` of the first three features, their gradient into the gradient's first three."""
    size, row, stride = view.image.numel(), 3 * view.image.shape[1], features.shape[-1]
    planes, moments, half = (features.new_empty(5, size) for _ in range(3))
    window = _window(features.device)
    mask: dict[str, Any] = {"MASKED": view.scene is not None, "SHARE": SSIM_WEIGHT}

    def blur(numbers: int, of: Tensor) -> None:
        _run(blur_planes, numbers, of, half, window, size, row, 3, numbers, TAPS=TAPS)
        _run(blur_planes, numbers, half, moments, window, size, size, row, numbers, TAPS=TAPS)

    given = (features, stride, exposure, view.image, _mask(view))
    _run(expose_colors, size, *given, planes, loss, size, **mask)
    blur(5 * size, planes)
    _run(compare_moments, size, moments, planes, loss, size, C1=C1, C2=C2, SHARE=SSIM_WEIGHT)
    blur(3 * size, planes[2:])
    _run(differentiate, size, planes, moments, exposure, _mask(view), gradient, stride, size, **mask)


@triton.jit
def compare_maps(
    depth: tl.tensor, silhouette: tl.tensor, proxy: tl.tensor, reliability: tl.tensor, scene: tl.tensor,
    loss: tl.tensor, d_depth: tl.tensor, d_silhouette: tl.tensor, pixels: tl.tensor, by_silhouette: tl.tensor,
    by_depth: tl.tensor, NU: tl.constexpr, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Add up the terms of silhouette and depth over a block of pixels, each times its weight and a mean over all."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    is_scene = scene_at(scene, pixel, inside, MASKED)
    missing = tl.where(is_scene, 1.0 - tl.load(silhouette + pixel, mask=inside, other=0.0), 0.0)
    tl.store(d_silhouette + pixel, tl.where(is_scene, -by_silhouette / pixels, 0.0), mask=inside)
    known = tl.load(proxy + pixel, mask=inside, other=0.0)
    trust = tl.minimum(NU * (tl.load(reliability + pixel, mask=inside, other=0).to(tl.float32) / 255), 1.0)
    trust = tl.where(known > 0, trust, 0.0)
    off = tl.load(depth + pixel, mask=inside, other=0.0) - known
    side = tl.where(off > 0, 1.0, 0.0) - tl.where(off < 0, 1.0, 0.0)
    tl.store(d_depth + pixel, by_depth / pixels * trust * side, mask=inside)
    total = by_silhouette * missing + by_depth * trust * tl.abs(off)
    tl.atomic_add(loss, tl.sum(tl.where(inside, total, 0.0), axis=0) / pixels)


@triton.jit
def weigh_sizes(
    log_radii: tl.tensor, in_view: tl.tensor, number: tl.tensor, loss: tl.tensor, d_log_radii: tl.tensor,
    limit: tl.tensor, count: tl.tensor, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The squared excess of log radii over the limit, a mean over the `number` (one number on the card) in view."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    seen = tl.load(in_view + row, mask=inside, other=0) != 0
    excess = tl.maximum(tl.load(log_radii + row, mask=inside, other=0.0) - limit, 0.0)
    share = tl.where(seen, excess, 0.0) / tl.maximum(tl.load(number), 1).to(tl.float32)
    tl.store(d_log_radii + row, 2.0 * share, mask=inside)
    tl.atomic_add(loss, tl.sum(share * excess, axis=0))


@triton.jit
def scene_at(scene: tl.tensor, pixel: tl.tensor, inside: tl.tensor, MASKED: tl.constexpr) -> tl.tensor:
    """Which of some pixels show the scene: all inside where the view has no mask."""
    is_scene = inside
    if MASKED:
        is_scene = tl.load(scene + pixel, mask=inside, other=0) != 0
    return is_scene


@triton.jit
def photo_at(photo: tl.tensor, number: tl.tensor, inside: tl.tensor) -> tl.tensor:
    """Numbers of a photo in 0..1."""
    return tl.load(photo + number, mask=inside, other=0).to(tl.float32) / 255


@triton.jit
def expose_colors(
    shown: tl.tensor, stride: tl.tensor, exposure: tl.tensor, photo: tl.tensor, scene: tl.tensor, planes: tl.tensor,
    loss: tl.tensor, size: tl.tensor, SHARE: tl.constexpr, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Exposed colours a, photo b and the products aa, bb and ab into the five planes; adds what |a - b| counts."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    pixel, color = i // 3, i % 3
    gain = tl.exp(tl.load(exposure + color))
    a = tl.load(shown + pixel * stride + color, mask=inside, other=0.0) * gain + tl.load(exposure + 3 + color)
    b = tl.where(scene_at(scene, pixel, inside, MASKED), photo_at(photo, i, inside), a)
    tl.store(planes + i, a, mask=inside)
    tl.store(planes + size + i, b, mask=inside)
    tl.store(planes + 2 * size + i, a * a, mask=inside)
    tl.store(planes + 3 * size + i, b * b, mask=inside)
    tl.store(planes + 4 * size + i, a * b, mask=inside)
    tl.atomic_add(loss, tl.sum(tl.where(inside, tl.abs(a - b), 0.0), axis=0) * ((1 - SHARE) / size))


@triton.jit
def blur_planes(
    planes: tl.tensor, out: tl.tensor, window: tl.tensor, size: tl.tensor, row: tl.tensor, step: tl.tensor,
    numbers: tl.tensor, TAPS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The window's mean of `numbers` numbers of planes of `size`, along rows of `row` numbers with step 3, or along
    columns, whose `row` is the whole plane, with the step of an image's row; zeros outside the image."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < numbers
    place = (i % size) % row
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(TAPS):
        off = (k - TAPS // 2) * step
        here = inside & (place + off >= 0) & (place + off < row)
        total += tl.load(window + k) * tl.load(planes + i + off, mask=here, other=0.0)
    tl.store(out + i, total, mask=inside)


@triton.jit
def compare_moments(
    moments: tl.tensor, planes: tl.tensor, loss: tl.tensor, size: tl.tensor,
    C1: tl.constexpr, C2: tl.constexpr, SHARE: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The similarity's derivatives by mean, variance and covariance into planes 2 to 4; adds what it counts."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    x = tl.load(moments + i, mask=inside, other=0.0)
    y = tl.load(moments + size + i, mask=inside, other=0.0)
    var_x = tl.load(moments + 2 * size + i, mask=inside, other=0.0) - x * x
    var_y = tl.load(moments + 3 * size + i, mask=inside, other=0.0) - y * y
    luminance = 2 * x * y + C1
    contrast = 2 * (tl.load(moments + 4 * size + i, mask=inside, other=0.0) - x * y) + C2
    under_l, under_c = x * x + y * y + C1, var_x + var_y + C2
    inverse = 1.0 / (under_l * under_c)
    value = luminance * contrast * inverse
    by_cov = 2 * luminance * inverse
    by_var = -value / under_c
    by_mean = 2 * y * contrast * inverse - 2 * x * value / under_l - 2 * x * by_var - y * by_cov
    tl.store(planes + 2 * size + i, by_mean, mask=inside)
    tl.store(planes + 3 * size + i, by_var, mask=inside)
    tl.store(planes + 4 * size + i, by_cov, mask=inside)
    tl.atomic_add(loss, tl.sum(tl.where(inside, 1.0 - value, 0.0), axis=0) * (SHARE / size))


@triton.jit
def differentiate(
    planes: tl.tensor, blurred: tl.tensor, exposure: tl.tensor, scene: tl.tensor, gradient: tl.tensor,
    stride: tl.tensor, size: tl.tensor, SHARE: tl.constexpr, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """The loss's gradient by what was shown, a pixel every `stride` numbers; `blurred`: the three derivatives, 0 where
    there is no scene."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < size
    a = tl.load(planes + i, mask=inside, other=0.0)
    b = tl.load(planes + size + i, mask=inside, other=0.0)
    likeness = tl.load(blurred + i, mask=inside, other=0.0)
    likeness += 2 * a * tl.load(blurred + size + i, mask=inside, other=0.0)
    likeness += b * tl.load(blurred + 2 * size + i, mask=inside, other=0.0)
    sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
    found = ((1 - SHARE) * sign - SHARE * likeness) * tl.exp(tl.load(exposure + i % 3)) / size
    found = tl.where(scene_at(scene, i // 3, inside, MASKED), found, 0.0)
    tl.store(gradient + (i // 3) * stride + i % 3, found, mask=inside)


@triton.jit
def color_errors(
    shown: tl.tensor, stride: tl.tensor, exposure: tl.tensor, photo: tl.tensor, scene: tl.tensor, errors: tl.tensor,
    pixels: tl.tensor, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Mean difference of each pixel's three exposed colours from the photo's, 0 where it shows no scene."""
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    total = tl.zeros((BLOCK,), tl.float32)
    for k in tl.static_range(3):
        a = tl.load(shown + pixel * stride + k, mask=inside, other=0.0) * tl.exp(tl.load(exposure + k))
        total += tl.abs(a + tl.load(exposure + 3 + k) - photo_at(photo, pixel * 3 + k, inside))
    tl.store(errors + pixel, tl.where(scene_at(scene, pixel, inside, MASKED), total / 3, 0.0), mask=inside)


@triton.jit
def fit_color(
    shown: tl.tensor, stride: tl.tensor, silhouette: tl.tensor, photo: tl.tensor, scene: tl.tensor,
    exposure: tl.tensor, width: tl.tensor, height: tl.tensor,
    STRIDE: tl.constexpr, SOLID: tl.constexpr, MIN_PIXELS: tl.constexpr, OUTLIER: tl.constexpr, RIDGE: tl.constexpr,
    MAX_GAIN: tl.constexpr, MASKED: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """`losses.fit_exposure` of one colour, in place; one program sees all pixels that tell, so that sums are those of
    one order."""
    color = tl.program_id(0)
    across = (width + STRIDE - 1) // STRIDE
    spread = across * ((height + STRIDE - 1) // STRIDE)
    old_gain, old_offset = tl.load(exposure + color), tl.load(exposure + 3 + color)
    gain, offset = tl.exp(old_gain.to(tl.float64)), old_offset.to(tl.float64)
    # In double precision, as variances from sums of squares want.
    nothing = tl.zeros((BLOCK,), tl.float64)
    used, total, sum_x, sum_y, sum_xx, sum_xy = nothing, nothing, nothing, nothing, nothing, nothing
    first = 0
    while first < spread:
        place = first + tl.arange(0, BLOCK)
        inside = place < spread
        pixel = (place // across) * STRIDE * width + (place % across) * STRIDE
        solid = tl.load(silhouette + pixel, mask=inside, other=0.0) > SOLID
        solid = solid & scene_at(scene, pixel, inside, MASKED)
        x = tl.load(shown + pixel * stride + color, mask=inside, other=0.0).to(tl.float64)
        y = photo_at(photo, pixel * 3 + color, inside).to(tl.float64)
        weight = tl.where(solid, 1.0, 0.0).to(tl.float64)
        used += weight
        weight = weight / tl.maximum(tl.abs(y - x * gain - offset), OUTLIER)
        total += weight
        sum_x += weight * x
        sum_y += weight * y
        sum_xx += weight * x * x
        sum_xy += weight * x * y
        first += BLOCK
    weights = tl.maximum(tl.sum(total, axis=0), 1e-30)
    mean_x, mean_y = tl.sum(sum_x, axis=0) / weights, tl.sum(sum_y, axis=0) / weights
    variance = tl.maximum(tl.sum(sum_xx, axis=0) / weights - mean_x * mean_x, 0.0)
    together = tl.sum(sum_xy, axis=0) / weights - mean_x * mean_y
    slope = tl.minimum(tl.maximum(together / tl.maximum(variance, 1e-12), 1 / MAX_GAIN), MAX_GAIN)
    certain = slope * slope * variance
    log_gain = tl.log(slope) * certain / (certain + RIDGE)
    new_offset = (mean_y - tl.exp(log_gain) * mean_x) / (1 + RIDGE)
    enough = tl.sum(used, axis=0) >= MIN_PIXELS
    tl.store(exposure + color, tl.where(enough, log_gain.to(tl.float32), old_gain))
    tl.store(exposure + 3 + color, tl.where(enough, new_offset.to(tl.float32), old_offset))
