"""The map: where it grows, and what it is optimised for (section 3.4)."""

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ..mapping.growth import seed_gaussians, useless
from ..mapping.losses import size_loss
from ..mapping.views import View
from ..render.api import Rendering
from ..system.ssim import ssim_map
from ..types import VOID
from .rendering import Gaussians, semantic_image, show
from .uncertainty import PAPER, Constants, MirrorPlane, mirror_plane, symmetry_pull

RATES = {"means": 0.1, "log_radii": 3e-2, "opacity_logits": 8e-2, "colors": 2.5e-2, "class_logits": 5e-2}
"""Of Adam; positions in radii of the Gaussian."""
MIRROR = 0.005
"""Of the scene's depth: how near a mirror image has to be."""
_PALETTE_SEED = 7
_MIN_REGION = 64
_REGION_SAMPLES = 4000


def depth_prior(
    depth: NDArray[np.float32], u: NDArray[np.float32], channels: NDArray[np.uint8], constants: Constants = PAPER
) -> NDArray[np.float32]:
    """Eq. (17): P(D_i | S_i = k) ∝ exp(-(D_i - μ_k)² / 2σ_k²): (H, W) the most probable depth.

    depth, u (H, W) and classes (H, W). μ_k and σ_k come from the reliable pixels of a connected region of one class, as
    a plane in inverse depth, which keeps walls slanted; where U is low they are weighed with the proxy by their
    variances. 0 = unknown.
    """
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    out, trust = inverse.copy(), np.where(depth > 0, u, 0).astype(np.float32)
    for channel in np.unique(channels[channels != VOID]):
        mask = (channels == channel).astype(np.uint8)
        _, regions, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
        for region in 1 + np.flatnonzero(boxes[1:, cv2.CC_STAT_AREA] >= _MIN_REGION):
            left, top, width, height = boxes[region, : cv2.CC_STAT_AREA]
            rows, columns = np.nonzero(regions[top : top + height, left : left + width] == region)
            rows, columns = rows + top, columns + left
            weak = trust[rows, columns] <= constants.tau_low
            reliable = ~weak & (inverse[rows, columns] > 0)
            if not weak.any() or reliable.sum() < _MIN_REGION:
                continue
            mean, spread = _fit_plane(columns, rows, inverse[rows, columns], reliable)
            rows, columns, mean = rows[weak], columns[weak], mean[weak]
            seen, weight = inverse[rows, columns], trust[rows, columns]
            # The proxy's own precision at reliability U is taken as U² / 5 %²; the prior's is its residual spread.
            proxy_precision = np.where(seen > 0, (weight / (0.05 * np.maximum(seen, 1e-9))) ** 2, 0)
            prior_precision = 1 / max(spread, 1e-9) ** 2
            fused = (proxy_precision * seen + prior_precision * mean) / (proxy_precision + prior_precision)
            good = (mean > 0) & (spread < 0.1 * mean)
            out[rows[good], columns[good]] = fused[good]
    return np.divide(1, out, out=np.zeros_like(out), where=out > 0)


def _fit_plane(
    columns: NDArray, rows: NDArray, values: NDArray[np.float32], use: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], float]:
    """Robust plane a x + b y + c through the used values, at all places, and the spread of its residuals."""
    chosen = np.flatnonzero(use)
    chosen = chosen[:: max(len(chosen) // _REGION_SAMPLES, 1)]
    design = np.stack([columns, rows, np.ones(len(rows))], 1) / [1000, 1000, 1]
    target, weights = values[chosen].astype(np.float64), np.ones(len(chosen))
    for _ in range(5):
        a = design[chosen] * weights[:, None]
        plane = np.linalg.lstsq(a, target * weights, rcond=None)[0]
        residual = np.abs(design[chosen] @ plane - target)
        spread = 1.4826 * float(np.median(residual))
        weights = np.sqrt(1 / np.maximum(residual / max(spread, 1e-9), 1))
    return (design @ plane).astype(np.float32), spread


def map_loss(
    shown: Rendering, view: View, log_radii: Tensor, classes: int, unit: float, constants: Constants = PAPER
) -> Tensor:
    """Eq. (18): U_t (λ_D w |D̂ - D| + λ_C L_C + λ_S L_S + λ_R L_reg + λ_E L_edge), means over pixels, w = min(1, ν U).

    Depths in units of the scene's; L_reg presses radii (M,) above 3 % of it down. U_t is the view's mean U.
    """
    trust = view.trust
    frame_trust = trust[view.depth > 0].mean() if bool((view.depth > 0).any()) else torch.ones(())
    depth = ((constants.nu * trust).clamp(max=1) * (view.depth - shown.depth).abs()).mean() / unit
    colors = view.of_scene(view.colors, shown.features[..., :3].detach())
    loss = constants.map_depth * depth + constants.map_color * image_loss(shown.features[..., :3], colors, constants)
    if classes:
        semantics = semantic_loss(shown.features[..., 3:], view, classes, constants)
        edges = edge_loss(shown.depth, view.channels, unit, constants)
        loss = loss + constants.map_semantic * semantics + constants.map_edge * edges
    return frame_trust * (loss + constants.map_size * size_loss(log_radii, unit))


def edge_loss(depth: Tensor, channels: Tensor, unit: float, constants: Constants = PAPER) -> Tensor:
    """Eq. (19): Σ ψ(S_i, S_j) exp(-ζ‖D_i - D_j‖²) over neighbours of depth and channels (H, W), as a mean.

    ψ is 1 across a boundary of classes, where the depth may jump, and -1 inside a region, where it is smooth; pairs
    with a void pixel count nothing.
    """
    total = depth.new_zeros(())
    for axis in (0, 1):
        n = depth.shape[axis] - 1
        a, b = channels.narrow(axis, 0, n), channels.narrow(axis, 1, n)
        near = torch.exp(-constants.zeta * ((depth.narrow(axis, 1, n) - depth.narrow(axis, 0, n)) / unit).square())
        total = total + (torch.where(a == b, -near, near) * ((a != VOID) & (b != VOID))).mean()
    return total / 2


def image_loss(shown: Tensor, photo: Tensor, constants: Constants = PAPER) -> Tensor:
    """Eq. (20): ω |I - C| + (1 - ω)(1 - SSIM), the mean over images (H, W, 3)."""
    color = (photo - shown).abs().mean()
    return constants.omega * color + (1 - constants.omega) * (1 - ssim_map(shown, photo).mean())


def semantic_loss(shown: Tensor, view: View, classes: int, constants: Constants = PAPER) -> Tensor:
    """Eq. (20) for the semantic image (H, W, K), whose SSIM is that of its projection onto three colours.

    Void pixels ask for nothing."""
    truth = semantic_image(view, classes)
    known = (view.channels != VOID)[..., None]
    shown, truth = torch.where(known, shown, 0), torch.where(known, truth, 0)
    palette = torch.rand(classes, 3, generator=torch.Generator().manual_seed(_PALETTE_SEED))
    alike = ssim_map((shown @ palette).contiguous(), (truth @ palette).contiguous()).mean()
    return constants.omega * (truth - shown).abs().sum(-1).mean() + (1 - constants.omega) * (1 - alike)


def needed(shown: Rendering, view: View, constants: Constants = PAPER) -> Tensor:
    """(H, W) the pixels where the map grows: by holes, by a nearer proxy, or by other classes."""
    return uncovered(shown, constants) | nearer(shown, view, constants) | other_class(shown, view)


def uncovered(shown: Rendering, constants: Constants = PAPER) -> Tensor:
    """Condition (a) of growth: Sil < T_sil."""
    return shown.silhouette < constants.t_sil_new


def nearer(shown: Rendering, view: View, constants: Constants = PAPER) -> Tensor:
    """Condition (b) of growth: |D̂ - D| > T_depth where a proxy of at least medium reliability is nearer."""
    return (shown.depth - view.depth > constants.t_depth * view.depth) & (view.trust > constants.tau_low)


def other_class(shown: Rendering, view: View) -> Tensor:
    """Condition (c) of growth: a confident label of another class than the map decidedly shows."""
    semantics = shown.features[..., 3:]
    if semantics.shape[-1] == 0:
        return torch.zeros_like(view.channels, dtype=torch.bool)
    strength, channel = semantics.max(-1)
    return (view.channels != VOID) & (view.label_weight > 0.5) & (strength > 0.5) & (channel != view.channels)


@torch.no_grad()
def grow(
    gaussians: Gaussians | None, view: View, pose: Tensor, classes: int, constants: Constants = PAPER
) -> Gaussians:
    """One Gaussian for each pixel with a depth where the map needs it, of the first frame for every pixel."""
    depth, trust = view.depth.numpy(), view.trust.numpy()
    prior = torch.from_numpy(depth_prior(depth, trust, view.channels.numpy(), constants))
    pixels = prior > 0 if view.scene is None else (prior > 0) & view.scene
    if gaussians is not None:
        shown = show(gaussians.map.only(gaussians.in_view(pose, view.intrinsics)).__dict__, pose, view)
        wanted = needed(shown, view, constants)
        opaque = (shown.silhouette > constants.t_sil_new) & ~nearer(shown, view, constants)
        prior = torch.where(opaque & (shown.depth > 0), shown.depth, prior)  # (c) adds to the surface that is there
        pixels = pixels & wanted
    seeds = seed_gaussians(
        pixels, prior, view.colors, view.channels, 1.0, classes, pose, view.intrinsics, view.frame_id
    )
    seed_trust = view.trust[pixels & (prior > 0)]
    if gaussians is None:
        return Gaussians.of(seeds, seed_trust)
    gaussians.append(seeds, seed_trust)
    return gaussians


@torch.no_grad()
def prune(gaussians: Gaussians, unit: float) -> None:
    """Drop Gaussians that have become transparent or far too large."""
    bad = useless(gaussians.map, 0.03, 0.15 * unit)
    if bool(bad.any()):
        gaussians.keep(~bad)


@torch.no_grad()
def draw_together(gaussians: Gaussians, unit: float, seed: int) -> MirrorPlane:
    """Section 3.1 for the map: Gaussians and mirror images of their class are drawn together, where there are any."""
    means = gaussians.table.values["means"].detach()
    logits = gaussians.table.values["class_logits"].detach()
    classes = logits.argmax(1).numpy() if logits.shape[1] else np.zeros(len(gaussians), np.int64)
    points = means.double().numpy()
    plane = mirror_plane(points, classes, MIRROR * unit, seed)
    means.copy_(torch.from_numpy(symmetry_pull(points, classes, plane, MIRROR * unit)))
    return plane


def clip_at_boundary(image: Tensor, channels: Tensor, limit: float) -> None:
    """Clip the gradient of an image (H, W, C) beside class boundaries, from now on, to `limit` times its mean norm.

    Section 3.4: there a wrong label of one pixel must not move the map."""
    if not image.requires_grad:
        return
    near = at_boundary(channels)

    def clip(gradient: Tensor) -> Tensor:
        norm = gradient.norm(dim=-1)
        factor = (limit * norm.mean() / norm.clamp(min=1e-20)).clamp(max=1.0)
        return gradient * torch.where(near, factor, 1.0)[..., None]

    image.register_hook(clip)


def at_boundary(channels: Tensor) -> Tensor:
    """(H, W) bool: another class within one pixel; void is no class."""
    classes = channels.float()[None, None]
    void = classes == VOID
    high = functional.max_pool2d(torch.where(void, -1.0, classes), 3, 1, 1)
    low = -functional.max_pool2d(-torch.where(void, 256.0, classes), 3, 1, 1)
    return (high > low)[0, 0]


def optimise(
    gaussians: Gaussians, view: View, pose: Tensor, classes: int, unit: float, rate: float = 1.0,
    constants: Constants = PAPER,
) -> float:  # fmt: skip
    """One step of Adam on (18) by one view, of the Gaussians that it sees; returns the loss."""
    rows = gaussians.in_view(pose, view.intrinsics)
    values = gaussians.leaves(rows)
    shown = show(values, pose, view, kappa=constants.kappa / unit**2)
    clip_at_boundary(shown.features, view.channels, constants.clip)
    loss = map_loss(shown, view, values["log_radii"], classes, unit, constants)
    gradients = dict(zip(values, torch.autograd.grad(loss, list(values.values()), allow_unused=True), strict=True))
    # Positions by steps in proportion to the radius, and shorter ones where U is low.
    shares = torch.where(gaussians.trust[rows] > constants.tau_low, 1.0, constants.low_step)
    scales = {"means": torch.exp(values["log_radii"].detach()) * shares}
    gaussians.table.step(gradients, {k: r * rate for k, r in RATES.items()}, scales, rows)
    return float(loss.detach())
