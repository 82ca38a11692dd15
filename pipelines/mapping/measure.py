"""Quality of the map in its views: PSNR, SSIM, depth against the proxies, labels against the input's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..gaussian_map import GaussianMap
from ..gaussians.render import Rendering, render
from ..gaussians.ssim import ssim_map
from ..types import VOID
from .views import View


@dataclass(frozen=True)
class ViewFigures:
    """psnr in dB and ssim of the exposed rendering; depth_l1 in the world's unit; label_agreement 0..1; NaN = nothing
    to compare with."""

    psnr: float
    ssim: float
    depth_l1: float
    label_agreement: float


@torch.no_grad()
def measure_view(
    gaussian_map: GaussianMap,
    view: View,
    cam_from_world: NDArray[np.float64],
    log_gain: NDArray[np.float32],
    offset: NDArray[np.float32],
    features: Tensor | None = None,
) -> ViewFigures:
    """Compare the map, seen from `cam_from_world` (4, 4) with the given exposure (3,), with what the view shows of the
    scene; `features`: as of `features_of`, who measures several views makes them once."""
    rendering = draw_map(gaussian_map, view, cam_from_world, features)
    colors = rendering.features[..., :3] * torch.exp(torch.tensor(log_gain)).to(view.image.device)
    colors = (colors + torch.tensor(offset).to(view.image.device)).clamp(0, 1)
    photo = view.of_scene(view.colors, colors)
    error = ((colors - photo).square().mean() / view.shown).clamp(min=1e-10)
    known = view.depth > 0
    depth_l1 = (rendering.depth - view.depth).abs()[known].mean() if known.any() else torch.tensor(float("nan"))
    return ViewFigures(
        psnr=float(-10 * torch.log10(error)),
        ssim=float(ssim_map(colors, photo).mean()),
        depth_l1=float(depth_l1),
        label_agreement=_label_agreement(rendering, view),
    )


def _label_agreement(rendering: Rendering, view: View) -> float:
    logits, known = rendering.features[..., 3:], view.channels != VOID
    if logits.shape[-1] == 0 or not known.any():
        return float("nan")
    return float((logits.argmax(-1) == view.channels)[known].float().mean())


def features_of(gaussian_map: GaussianMap) -> Tensor:
    """(M, 3 + C) colours ++ class logits."""
    return torch.cat([gaussian_map.colors, gaussian_map.class_logits], dim=1)


def draw_map(
    gaussian_map: GaussianMap, view: View, cam_from_world: NDArray[np.float64], features: Tensor | None = None
) -> Rendering:
    """Colours ++ class logits, depth and silhouette from a camera."""
    pose = torch.tensor(cam_from_world, dtype=torch.float64)  # a copy: workers get arrays to read only
    m, drawn = gaussian_map, features_of(gaussian_map) if features is None else features
    return render(m.means, m.radii, m.opacities, drawn, pose, view.intrinsics)


def mean_figures(figures: Sequence[ViewFigures], prefix: str) -> dict[str, float]:
    """Means over views, NaN left out; {} without views."""
    out = {}
    for name in ("psnr", "ssim", "depth_l1", "label_agreement"):
        values = [v for f in figures if np.isfinite(v := getattr(f, name))]
        if values:
            out[f"{prefix}_{name}"] = round(float(np.mean(values)), 5)
    return out
