"""Renderings of the finished map: what a view shows (depth, colours, classes), and its PSNR, SSIM, depth and labels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry.posed_depth import PosedDepth
from ..render.api import render_all
from ..render.gaussian_map import GaussianMap
from ..system.ssim import ssim_map
from ..types import VOID, Intrinsics
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
) -> ViewFigures:
    """Compare the map, seen from `cam_from_world` (4, 4) with the given exposure (3,), with what the view shows of the
    scene. NaN for a view that is all masked: what is not compared agrees with nothing."""
    pose = torch.tensor(cam_from_world, dtype=torch.float64)  # a copy: workers get arrays to read only
    seen = render_all(gaussian_map, pose, view.intrinsics)
    colors = seen.colors * torch.exp(torch.tensor(log_gain)).to(view.image.device)
    colors = (colors + torch.tensor(offset).to(view.image.device)).clamp(0, 1)
    photo = view.of_scene(view.colors, colors)
    error = ((colors - photo).square().mean() / view.shown).clamp(min=1e-10)
    known, labelled = view.depth > 0, view.channels != VOID
    judged = 1.0 if view.scene is None or view.scene.any() else float("nan")
    depth_l1 = (seen.depth - view.depth).abs()[known].mean() if known.any() else torch.tensor(float("nan"))
    agrees = (seen.channels == view.channels)[labelled].float()
    return ViewFigures(
        psnr=judged * float(-10 * torch.log10(error)),
        ssim=judged * float(ssim_map(colors, photo).mean()),
        depth_l1=float(depth_l1),
        label_agreement=float(agrees.mean()) if len(agrees) and gaussian_map.class_logits.shape[1] else float("nan"),
    )


def mean_figures(figures: Sequence[ViewFigures], prefix: str) -> dict[str, float]:
    """Means over views, NaN left out; {} without views."""
    out = {}
    for name in ("psnr", "ssim", "depth_l1", "label_agreement"):
        values = [v for f in figures if np.isfinite(v := getattr(f, name))]
        if values:
            out[f"{prefix}_{name}"] = round(float(np.mean(values)), 5)
    return out


@dataclass(frozen=True)
class MeshView:
    """Depth and trust, colors (H, W, 3) uint8 and class channels (H, W) int16, -1 = none; None for a map without.

    unsure (H, W): where a depth may move onto a plane beside it, None for nowhere."""

    shown: PosedDepth
    colors: NDArray[np.uint8]
    channels: NDArray[np.int16] | None
    unsure: NDArray[np.bool_] | None = None

    @property
    def arrays(self) -> list[NDArray]:
        """Depth, trust, colors, and channels and unsure where there are any."""
        some = (self.channels, self.unsure)
        return [self.shown.depth, self.shown.trust, self.colors, *(a for a in some if a is not None)]

    @property
    def size(self) -> int:
        """Memory of the arrays, in bytes."""
        return sum(a.nbytes for a in self.arrays)


class DepthViews(Sequence[PosedDepth]):
    """The depths alone of views that are loaded as they are asked for."""

    def __init__(self, views: Sequence[MeshView]) -> None:
        self._views = views

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> PosedDepth:  # type: ignore[override]
        return self._views[index].shown


@torch.no_grad()
def mesh_view(gaussian_map: GaussianMap, cam_from_world: NDArray[np.float64], camera: Intrinsics) -> MeshView:
    """Median depth with a weight: none where the map is thin or the depth jumps, less far away."""
    seen = render_all(gaussian_map, torch.as_tensor(cam_from_world), camera)
    depth, silhouette = seen.median.cpu().numpy(), seen.silhouette.cpu().numpy()
    solid = (silhouette > 0.7) & (depth > 0) & ~_jumps(depth)
    typical = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    # The error of a depth grows with its square.
    weight = np.where(solid, np.clip(typical / np.maximum(depth, 1e-9), 0.2, 1.5) ** 2 * silhouette, 0)
    channels = seen.channels.cpu().numpy() if gaussian_map.class_logits.shape[1] else None
    colors = (seen.colors.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    return MeshView(
        PosedDepth(camera, cam_from_world, depth.astype(np.float32), weight.astype(np.float32)), colors, channels
    )


def depth_view(gaussian_map: GaussianMap, cam_from_world: NDArray[np.float64], camera: Intrinsics) -> PosedDepth:
    """The depth of a `mesh_view` alone."""
    without_classes = replace(gaussian_map, class_logits=gaussian_map.class_logits[:, :0])
    return mesh_view(without_classes, cam_from_world, camera).shown


def _jumps(depth: NDArray[np.float32], tolerance: float = 0.08) -> NDArray[np.bool_]:
    """Pixels beside a step of the depth, where neither side can be trusted to a pixel."""
    out = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        a, b = np.moveaxis(depth, axis, 0)[:-1], np.moveaxis(depth, axis, 0)[1:]
        step = np.abs(a - b) > tolerance * np.minimum(a, b)
        view = np.moveaxis(out, axis, 0)
        view[:-1] |= step
        view[1:] |= step
    return out
