"""The last word: map and poses refined together against all keyframes (second term of MSGS-SLAM eq. 26)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.gaussian_map import GaussianMap
from msgs_slam.pipelines.mapping.measure import measure_view
from msgs_slam.pipelines.mapping.optimise import optimise_map
from msgs_slam.pipelines.mapping.views import View


@dataclass(frozen=True)
class Refined:
    """The map, keyframe poses (N, 4, 4), exposures (N, 3) each, mean keyframe PSNR before and after.

    `kept` says whether the refinement is in them or was thrown away because it made the keyframes worse.
    """

    gaussian_map: GaussianMap
    cam_from_world: NDArray[np.float64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]
    psnr_before: float
    psnr_after: float
    kept: bool


def refine_together(
    context: StageContext,
    gaussian_map: GaussianMap,
    views: Sequence[View],
    exposure: tuple[NDArray[np.float32], NDArray[np.float32]],
    classes: int,
    settings: MappingConfig,
    passes: float,
) -> Refined:
    """Visit every view `passes` times; goes on from its snapshot."""
    poses = np.array([v.cam_from_world.cpu().numpy() for v in views])
    before = keyframe_psnr(gaussian_map, views, poses, *exposure)
    result = optimise_map(
        views, classes, settings, context.config.run.seed, initial=gaussian_map, passes=passes,
        progress=context.progress, snapshot=context.snapshot / "joint.safetensors", label="refining", exposure=exposure,
        paper=context.config.paper,
    )  # fmt: skip
    after = keyframe_psnr(result.gaussian_map, views, result.cam_from_world, result.log_gains, result.offsets)
    if after < before:
        return Refined(gaussian_map, poses, *exposure, before, after, False)
    return Refined(result.gaussian_map, result.cam_from_world, result.log_gains, result.offsets, before, after, True)


@torch.no_grad()
def keyframe_psnr(
    gaussian_map: GaussianMap,
    views: Sequence[View],
    poses: NDArray[np.float64],
    log_gains: NDArray[np.float32],
    offsets: NDArray[np.float32],
) -> float:
    """Mean over the views, dB."""
    rows = zip(views, poses, log_gains, offsets, strict=True)
    return float(np.mean([measure_view(gaussian_map, *row).psnr for row in rows]))
