"""Source of the run's metres: the depth itself, something that the user knows, or none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...formats.errors import InputError
from ..depth.scale import DepthScale
from ..engine.stages import StageContext
from ..labels.segments import SegmentLabels
from ..providers import DepthEstimate, DepthProvider, Sequence
from ..run.files import BACKBONE, GIVEN_POSES
from ..run.folder import RunFolder
from ..source.opening import open_source
from ..structure.given import agreement
from ..types import Frame
from .scale_reference import (
    POSES,
    ReferenceScale,
    distance_scale,
    height_scale,
    parse_reference,
)


def reference_scale(
    context: StageContext,
    sequence: Sequence,
    frames: list[Frame],
    depths: DepthProvider,
    scale: DepthScale,
    depth_of: Callable[[Frame], DepthEstimate],
) -> ReferenceScale | None:
    """Metres per unit of the depth by what the user knows; None without that, and where the depth is metric anyway.

    Raises InputError when the reference cannot be measured in this scene.
    """
    config = context.config.proxy
    known = parse_reference(config.scale_ref)
    if known is None:
        is_said = config.scale_ref.strip() == POSES
        return None if depths.metric else given_scale(context.run, scale, is_said)

    if known.picture:
        source = open_source(context.source, context.config.run.format)
        found = distance_scale(known, source, sequence, frames, depth_of)
    else:
        segments = SegmentLabels(sequence, config.max_classes, context.progress)
        heights = segments.heights(frames, lambda frame: scale.in_backbone_unit(depth_of(frame)))
        if len(heights) == 0 or np.median(heights) <= 0:
            raise InputError(
                f"--scale-ref {config.scale_ref}: no floor was found in the scene. Give a distance between two points"
            )
        found = height_scale(known, heights * scale.value)
    if depths.metric:
        context.warn(
            f"{depths.name} is metric, so the reference {config.scale_ref} is not used; it would make lengths "
            f"{found.factor - 1:+.1%} longer"
        )
        return None
    return found


def given_scale(run: RunFolder, scale: DepthScale, is_said: bool) -> ReferenceScale | None:
    """Metres per unit of the depth by poses that the user gave in metres, by their kind or as it `is_said`; None where
    these tell none."""
    given, backbone = run.find(GIVEN_POSES), run.find(BACKBONE)
    if given is None or not (given.is_metric or is_said) or backbone is None:
        return None
    rows = np.flatnonzero(given.known[backbone.frame_ids])
    agreed = agreement(backbone.cam_from_world[rows], given.cam_from_world[backbone.frame_ids[rows]])
    if agreed is None:
        return None
    return ReferenceScale(agreed.move.scale / scale.value, agreed.scale_sd, len(rows))


def scale_figures(depths: DepthProvider, scale: DepthScale, reference: ReferenceScale | None) -> dict[str, Any]:
    """Report the source of the metres, and the backbone's unit in metres.

    independent_depth: whether depth adds to what tracking knows from the correspondences of the images.
    """
    figures: dict[str, Any] = {"independent_depth": depths.metric}
    if reference is not None:
        return figures | {
            "metric": True,
            "scale_from": "reference",
            "metres_per_unit": round(reference.factor * scale.value, 6),
            "reference_relative_sd": round(reference.relative_sd, 5),
            "reference_keyframes": reference.keyframes,
        }
    if not depths.metric:
        return figures | {"scale_from": "nothing: lengths have no unit"}
    figures["scale_from"] = "depth"
    if scale.of_frame:
        figures |= {"metres_per_unit": round(scale.value, 6), "scale_spread": round(scale.spread, 5)}
    return figures
