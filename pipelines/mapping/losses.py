"""Loss of the map in one view (MSGS-SLAM eqs. 18-20) and its terms: colour, depth, size and silhouette, scalars without
a unit; and the exposure of a view, gain and offset of each colour from the map to its photo.

By autograd on the CPU; `cuda_losses` beside this does the same on a GPU in one pass.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..config import MappingConfig
from ..render.api import Rendering
from ..system.lanes import iota, load, splat, store, total, where
from ..system.ssim import C1, C2, blur_array, ssim_map
from ..system.threads import Floats, for_each, fused_kernel, inner
from .views import View

SSIM_WEIGHT = 0.2
"""Share of 1 - SSIM in eq. (20)."""
_ROWS = 16
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_C1, _C2, _SHARE = np.float32(C1), np.float32(C2), np.float32(SSIM_WEIGHT)

NU = 1.2
"""ν of eq. (18)."""
SIZE_LIMIT = 0.03
"""Radius above which a Gaussian is too large, in units of the scene's median depth."""
SILHOUETTE_WEIGHT = 0.05
"""Weight (of mean transparency, 0..1) of the pressure towards an opaque map."""


@dataclass(frozen=True)
class Objective:
    """The terms with their weights; `unit`: the scene's median depth."""

    settings: MappingConfig
    unit: float

    def of(self, view: View, exposure: Tensor, rendering: Rendering, log_radii: Tensor) -> Tensor:
        """Scalar; `exposure` (2, 3) is the view's, `log_radii` (M,) those of the Gaussians in view."""
        loss = photo_loss(rendering.features, exposure, view.image, view.scene)
        loss = loss + SILHOUETTE_WEIGHT * silhouette_loss(view.of_scene(rendering.silhouette, 1.0))
        if (weight := self.settings.depth_weight) > 0:
            loss = loss + weight * depth_loss(rendering.depth, view.depth, depth_weight(view.trust), self.unit)
        return loss + size_loss(log_radii, self.unit)


def depth_weight(reliability: Tensor) -> Tensor:
    """min(1, ν U) of eq. (18), (H, W)."""
    return (NU * reliability).clamp(max=1.0)


def depth_loss(rendered: Tensor, proxy: Tensor, weight: Tensor, unit: float) -> Tensor:
    """w |D̂ - D| of eq. (18), in units of the scene's depth; mean over all H x W pixels, unknown proxy (0) counts 0."""
    known = proxy > 0
    return ((rendered - proxy).abs() * weight * known).mean() / unit


def size_loss(log_radii: Tensor, unit: float) -> Tensor:
    """L_reg of eq. (18): mean squared log excess of (M,) radii over the limit, `unit` being the scene's depth.

    0 without a Gaussian.
    """
    excess = (log_radii - torch.log(torch.tensor(SIZE_LIMIT * unit, device=log_radii.device))).clamp(min=0)
    return (excess * excess).sum() / max(len(excess), 1)


def silhouette_loss(silhouette: Tensor) -> Tensor:
    """Mean transparency left over: presses the map to be opaque, without which it slowly turns to fog."""
    return (1 - silhouette).mean()


def photo_loss(shown: Tensor, exposure: Tensor, photo: Tensor, scene: Tensor | None = None) -> Tensor:
    """(1 - w) |C - I| + w (1 - SSIM), mean over the picture, with C = shown * exp(exposure[0]) + exposure[1].

    shown (H, W, 3) 0..1, exposure (2, 3), photo (H, W, 3) uint8; differentiable in the first. Where
    scene (H, W) is False the photo is no part of the scene: there it looks as the map does, and asks for nothing.
    The paper prints ω = 0.2 before the absolute difference; the weights of 3DGS, which has the same formula, are the
    other way round, and so are the ones here. float32 on a CPU takes compiled loops, everything else plain torch; of a
    card's views it is a part of `card_loss`.
    """
    if shown.device.type == "cpu" and shown.dtype == torch.float32:
        return _PhotoLoss.apply(shown, exposure, photo, scene)
    return plain_photo_loss(shown, exposure, photo, scene)


def plain_photo_loss(shown: Tensor, exposure: Tensor, photo: Tensor, scene: Tensor | None) -> Tensor:
    """Return the photo loss by torch's own functions."""
    colors, target = expose(shown, exposure), photo.to(shown.dtype) / 255
    if scene is not None:
        own = colors.detach()
        colors, target = (torch.where(scene[..., None], x, own) for x in (colors, target))
    difference = (colors - target).abs().mean()
    return (1 - SSIM_WEIGHT) * difference + SSIM_WEIGHT * (1 - ssim_map(colors, target).mean())


@lru_cache(maxsize=2)
def _room(planes: int, size: int) -> tuple[Floats, Floats]:
    """Two times `planes` of `size` numbers to work in: fresh pages would take as long as the work does."""
    return np.zeros((planes, size), np.float32), np.zeros((planes, size), np.float32)


class _PhotoLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, shown: Tensor, exposure: Tensor, photo: Tensor, scene: Tensor | None) -> Tensor:
        # Rendered colours may be a slice of more features: the loops take them as they lie.
        picture, target = shown.detach().numpy(), photo.numpy()
        mask = None if scene is None else scene.numpy()
        gain_offset = torch.stack([exposure[0].exp(), exposure[1]]).numpy()
        height, width = target.shape[:2]
        bands, shape = -(-height // _ROWS), target.shape
        planes, moments = _room(5, bands * _ROWS * width * 3)
        sums = np.zeros((bands, 2))

        def blur(first: int) -> None:
            def of_plane(k: int) -> None:
                pictures = (x[: target.size].reshape(shape) for x in (planes[first + k], moments[k]))
                blur_array(*pictures)

            for_each(of_plane, 5 - first)  # OpenCV's filter takes one thread

        def rows(band: int) -> slice:
            return slice(band * _ROWS, min((band + 1) * _ROWS, height))

        def of_scene(band: int) -> NDArray[np.bool_] | None:
            return None if mask is None else mask[rows(band)]

        def work(kernel_: Any, *arrays: NDArray) -> None:
            for_each(
                lambda b: kernel_(
                    picture[rows(b)], target[rows(b)], of_scene(b), gain_offset, b * _ROWS * width * 3, planes, *arrays,
                    sums[b],
                ),
                bands,
            )  # fmt: skip

        work(_expose)
        blur(0)
        for_each(lambda b: _similarity(b, _ROWS * width * 3, target.size, moments, planes, sums[b]), bands)
        gradient = np.empty(shape, np.float32)
        blur(2)
        work(_differentiate, moments, gradient)
        difference, likeness = sums.sum(0) / target.size
        ctx.save_for_backward(torch.from_numpy(gradient))
        loss = (1 - SSIM_WEIGHT) * difference + SSIM_WEIGHT * (1 - likeness)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.saved_tensors[0] * grads[0], None, None, None


@fused_kernel
def _expose(
    shown: Floats, photo: NDArray[np.uint8], scene: NDArray[np.bool_] | None, exposure: Floats, start: int,
    planes: Floats, sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """A band's colours a, photo b and products aa, bb and ab, into the planes from `start` on; the summed |a - b|."""
    height, width, _ = shown.shape
    scale, i = np.float32(1 / 255), start
    for y in range(height):
        row = np.float32(0)
        for x in range(width):
            for c in range(3):
                a = shown[y, x, c] * exposure[0, c] + exposure[1, c]
                b = np.float32(photo[y, x, c]) * scale
                if scene is not None:
                    b = b if scene[y, x] else a
                planes[0, i], planes[1, i] = a, b
                planes[2, i], planes[3, i], planes[4, i] = a * a, b * b, a * b
                row += abs(a - b)
                i += 1
        sums[0] += row


@fused_kernel
def _similarity(
    band: int, length: int, count: int, moments: Floats, planes: Floats,
    sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """The derivatives of a band's similarity by mean, variance and covariance, into planes 2 to 4, and its sum.

    As `pipelines.system.ssim.similarity`, with one division.
    """
    size = planes.shape[1]
    flat, out = moments.reshape(-1), planes.reshape(-1)
    for i in range(band * length, band * length + length, 16):
        x, y = load(flat, i), load(flat, size + i)
        xx, yy, xy = x * x, y * y, x * y
        luminance, contrast = xy * _TWO + _C1, (load(flat, 4 * size + i) - xy) * _TWO + _C2
        under_l, under_c = xx + yy + _C1, load(flat, 2 * size + i) - xx + load(flat, 3 * size + i) - yy + _C2
        inverse = _ONE / (under_l * under_c)
        value = luminance * contrast * inverse
        by_cov = luminance * inverse * _TWO
        by_var = splat(_ZERO) - value * inverse * under_l
        by_mean = y * contrast * inverse * _TWO - x * value * inverse * under_c * _TWO - x * by_var * _TWO - y * by_cov
        store(out, 2 * size + i, by_mean)
        store(out, 3 * size + i, by_var)
        store(out, 4 * size + i, by_cov)
        # The last band may reach over the end of the picture.
        sums[1] += total(where(iota(np.float32(i - count)) < splat(_ZERO), value))


@fused_kernel
def _differentiate(
    shown: Floats, photo: NDArray[np.uint8], scene: NDArray[np.bool_] | None, exposure: Floats, start: int,
    planes: Floats, blurred: Floats, gradient: Floats, sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """A band's gradient by what was shown."""
    height, width, _ = shown.shape
    size, flat, blurs = planes.shape[1], planes.reshape(-1), blurred.reshape(-1)
    each, first = np.float32(1 / gradient.size), start // (3 * width)
    for y in range(height):
        for x in range(width):
            out, i = gradient[first + y, x], start + 3 * (y * width + x)
            is_scene = scene is None or scene[y, x]
            for c in range(3):
                out[c] = _gradient_at(flat, blurs, i + c, size) * (exposure[0, c] * each) if is_scene else _ZERO


@inner
def _gradient_at(planes: Floats, blurred: Floats, i: int, size: int) -> np.float32:
    """n times the gradient of the loss by one number of the exposed colours.

    The window is symmetric and the border zero, so the blur is its own adjoint.
    """
    a, b = planes[i], planes[size + i]
    likeness = blurred[i] + _TWO * a * blurred[size + i] + b * blurred[2 * size + i]
    sign = np.float32(a > b) - np.float32(a < b)
    return (_ONE - _SHARE) * sign - _SHARE * likeness


# exposure -------------------------------------------------------------------------------------------------------

STRIDE = 4
"""Pixels from one that the exposure is fitted to to the next, in both directions."""
SOLID = 0.9
"""Silhouette (0..1) up to which the colours of the map say nothing yet."""
MIN_PIXELS = 100
"""Pixels (of those fitted to) below which the exposure stays as it was."""
OUTLIER = 0.02
"""Difference of colours (0..1) from which a pixel counts the less the larger it is: light and shade on what is wrong in
the map are not the camera's."""
RIDGE = 0.003
"""Weight of no change at all beside the variance of what the view shows, in colours of the photo, and beside all pixels
for the offset: exposures are relative, and drift together with the map's colours. What is newly seen shows a little
less contrast than its photo, so that gains fall from keyframe to keyframe; a pull in colours of the map, whose contrast
then grows, would lose hold of it (on a walk of 20 minutes gains fell to the limit, and the map by 15 dB). On a surface
of one colour gain and offset say the same."""
MAX_GAIN = 5.0
"""Factor between colours of the map and of the photo, at most, and its inverse at least."""


@torch.no_grad()
def fit_exposure(shown: Tensor, photo: Tensor, known: Tensor, exposure: Tensor) -> Tensor:
    """(2, 3) log gain and offset by which the map's colours `shown` (H, W, 3) are nearest to `photo` (H, W, 3).

    One step of iteratively reweighted least squares towards the least absolute difference, in closed form, from
    `exposure` (2, 3); `known` (H, W) are the pixels to use. Taken whole at every visit: Adam moves an exposure by a
    few per cent in all the visits of a view together, and a camera that adapts to a window does more from one image
    to the next. Chosen on five whole recordings, two by cameras, all of which gain; a made room of 13 views, whose map
    stays far from its images, loses by it, and gains where only a third of each step is taken.
    """
    part = (slice(None, None, STRIDE),) * 2
    use = known[part].reshape(-1, 1).double()
    enough = use.sum() >= MIN_PIXELS
    if exposure.device.type == "cpu" and not enough:  # a card would make the host wait for the answer
        return exposure
    x, y = (colors[part].reshape(-1, 3).double() for colors in (shown, photo))
    log_gain, offset = exposure.double()
    weight = use / (y - x * log_gain.exp() - offset).abs().clamp(min=OUTLIER)
    weight = weight / weight.sum(0)
    mean_x, mean_y = (weight * x).sum(0), (weight * y).sum(0)
    variance = (weight * (x - mean_x) ** 2).sum(0)
    gain = (weight * (x - mean_x) * (y - mean_y)).sum(0) / variance.clamp(min=1e-12)
    gain = gain.clamp(1 / MAX_GAIN, MAX_GAIN)
    spread = gain**2 * variance
    log_gain = gain.log() * spread / (spread + RIDGE)
    found = torch.stack([log_gain, (mean_y - log_gain.exp() * mean_x) / (1 + RIDGE)]).to(exposure)
    return torch.where(enough, found, exposure)


def expose(colors: Tensor, exposure: Tensor) -> Tensor:
    """(H, W, 3) colours of the map as a view of this exposure (2, 3) shows them."""
    return colors * torch.exp(exposure[0]) + exposure[1]
