"""Stage 2: depth, its reliability, and classes of the keyframes."""

from typing import Any

import cv2
import numpy as np

from ...formats.errors import InputError
from ..depth.files import NO_DEPTH
from ..depth.fused import DepthScale, measure_scale
from ..depth.stereo.provider import MultiviewDepth
from ..masks.moving import find_moving
from ..providers import dump_state
from ..run.files import CLASSES, DESCRIPTORS, FIGURES, FRAME_SCALES, LEFT_OUT, PROXY_MAPS
from ..run.stages import StageContext
from ..system.progress import log
from ..types import VOID, Frame
from .reference import ReferenceScale, reference_scale, scale_figures
from .tasks import (
    ProxyWork,
    in_frames,
    look_for_depth,
    look_for_labels,
    look_for_moving,
    make_depths,
    make_maps,
)

_MOSTLY_MATCHED = 0.55
"""Share of reliable pixels below which depth is a guess in large parts: of five recordings two have less (0.40, 0.49;
depth of the map 6 to 7 % off after one scale), three more (0.63 to 0.82; 0.7 to 2 %)."""


def run(context: StageContext) -> dict[str, Any]:
    """Provide maps of every keyframe (every frame without a backbone, or on request)."""
    work = ProxyWork(context)
    log.info("proxy: depth by %s, classes by %s", work.depths.name, work.semantics.name)
    frames = _frames_to_do(work)
    _warn_of_missing(work, frames)
    _compute_depths(work, frames)
    _warn_of_empty(work, frames)
    scale = measure_scale(work.sequence, frames, work.computed_depth)
    moving = _leave_out_moving(work, frames, scale)
    reference = reference_scale(context, work.sequence, frames, work.depths, scale, work.depth)
    _compute_maps(work, frames, scale, reference)
    figures = _figures(work, frames) | scale_figures(work.depths, scale, reference) | moving
    _warn_of_focal(work, figures.get("network_focal_px"))
    _warn_of_guesses(work, figures["reliable_pixels"])
    FIGURES["proxy"].save(context.folder, figures)
    return figures


def _frames_to_do(work: ProxyWork) -> list[Frame]:
    sequence, wanted = work.sequence, work.context.config.proxy.frames
    if (wanted == "all" and work.depths.metric) or sequence.backbone is None:
        return sequence.frames
    if wanted == "all":
        work.context.warn(f"proxy.frames=all: {work.depths.name} knows only keyframes, the other frames get no maps")
    return work.posed(sequence.frames)


def _warn_of_missing(work: ProxyWork, frames: list[Frame]) -> None:
    """Warn of frames without a map, and of map files that show the lens distortion which the frames have lost.

    Raises InputError where no frame has a map."""
    for kind, provider in (("depth", work.depths), ("label", work.semantics)):
        missing = provider.missing(frames)
        if len(missing) == len(frames):
            name = missing[0].name
            raise InputError(f"{provider.name}: no {kind} map is named like any keyframe, for example {name}")
        if missing:
            work.context.warn(
                f"{len(missing)} of {len(frames)} frames have no {kind} map, the first is {missing[0].name}"
            )
    strongest = max(map(abs, work.sequence.calibration.distortion))
    if strongest > 0.005 and any(p.name.startswith("files:") for p in (work.depths, work.semantics)):
        work.context.warn(
            f"the frames were undistorted (coefficients up to {strongest:.3f}), but map files are taken as they are: "
            "towards the borders they are some pixels off. Give maps of undistorted images"
        )


def _compute_depths(work: ProxyWork, frames: list[Frame]) -> None:
    """Compute the depth of every frame and store it in the snapshot."""
    in_frames(work, look_for_depth, frames)
    work.depths.fit(frames)
    in_frames(work, make_depths, frames, depths=dump_state(work.depths))


def _warn_of_empty(work: ProxyWork, frames: list[Frame]) -> None:
    """Of depth files in which nothing is known. Raises InputError where that is so of all keyframes."""
    if not work.depths.name.startswith("files:"):
        return
    missing = {f.id for f in work.depths.missing(frames)}
    read = [f for f in frames if f.id not in missing]
    empty = [f for f in read if not (work.computed_depth(f).depth > 0).any()]
    if read and len(empty) == len(read):
        raise InputError(f"{work.depths.name}: of the keyframes {NO_DEPTH}")
    if empty:
        work.context.warn(
            f"{len(empty)} of {len(read)} depth files hold no depth (every value is 0, 65535, negative, infinite or "
            f"NaN), the first is that of {empty[0].name}: depth of these frames is unknown"
        )


def _compute_maps(work: ProxyWork, frames: list[Frame], scale: DepthScale, reference: ReferenceScale | None) -> None:
    """Compute labels and the stored maps of every frame, in metres where there is a `reference`."""
    folder, semantics = work.context.folder, work.semantics
    in_frames(work, look_for_labels, frames)
    semantics.fit(frames, lambda frame: scale.in_backbone_unit(work.depth(frame)))
    for message in semantics.warnings():
        work.context.warn(message)
    CLASSES.save(folder, semantics.classes())
    metres = reference.factor if reference else 1.0
    made = in_frames(work, make_maps, frames, scale=scale, metres=metres, semantics=dump_state(semantics))
    if descriptors := {i: looks for part in made for i, looks in part.items()}:
        DESCRIPTORS.save(folder, descriptors)
    scales = scale.of_frame.items()
    FRAME_SCALES.save(
        folder, [{"frame_id": i, "scale": round(s, 6), "spread": round(scale.spread_in[i], 6)} for i, s in scales]
    )


def _warn_of_focal(work: ProxyWork, network_focal: float | None) -> None:
    """Warn where the depth network sees quite another focal length than the calibration has; from one image it is good
    to some per cent, and can only doubt a calibration."""
    calibration = work.sequence.calibration
    focal = calibration.intrinsics.fx
    if network_focal is None or calibration.origin == "given" or abs(network_focal / focal - 1) < 0.15:
        return
    work.context.warn(
        f"the depth network sees a focal length of {network_focal:.0f} pixels, the calibration ({calibration.origin}) "
        f"says {focal:.0f} +- {calibration.focal_sd:.0f}: give --intrinsics if you know the camera"
    )


def _warn_of_guesses(work: ProxyWork, reliable: float) -> None:
    """Warn where most of the depth is filled in: an image of the map does not show it."""
    if work.depths.name == MultiviewDepth.name and reliable < _MOSTLY_MATCHED:
        work.context.warn(
            f"only {reliable:.0%} of the pixels could be matched between views; elsewhere (bare walls, plain floors) "
            "depth is filled in from around them, and surfaces there may be 10 % or more too close. Film closer and "
            "with more texture in view, or let a depth network help: `msgs-slam models pull --best`"
        )


def _leave_out_moving(work: ProxyWork, frames: list[Frame], scale: DepthScale) -> dict[str, float | int]:
    """Store masks of what moved; return in how many frames, and how much of those. Made anew from the depth when
    resumed."""
    if work.context.config.proxy.moving != "auto":
        return {}
    posed = work.posed(frames)
    first = {k: moved for part in in_frames(work, look_for_moving, posed, scale=scale) for k, moved in part.items()}
    found = find_moving(*work.moving_views(posed, scale), work.context.progress, first)
    full = work.sequence.calibration.intrinsics
    for k, moved in found.items():
        shown = cv2.resize(moved.astype(np.float32), (full.width, full.height), interpolation=cv2.INTER_LINEAR) > 0.5
        LEFT_OUT.save(work.context.folder, shown, posed[k].name)
    share = round(float(np.mean([m.mean() for m in found.values()])), 4) if found else 0.0
    return {"moving_frames": len(found), "moving_share": share} if found else {}


def _figures(work: ProxyWork, frames: list[Frame]) -> dict[str, Any]:
    """Summarise the stage for the report."""
    sizes, reliable, void = [], [], []
    invalid = 0
    for frame in frames:
        path = PROXY_MAPS.path(work.context.folder, frame.id)
        invalid += work.depth(frame).invalid
        maps = PROXY_MAPS.read(path)
        sizes.append(path.stat().st_size)
        reliable.append(float((maps.confidence > 0.35).mean()))
        void.append(float((maps.labels == VOID).mean()))
    if invalid:
        work.context.warn(f"{invalid} depth values were NaN, infinite or negative; they count as unknown")
    depths, semantics = work.depths, work.semantics
    return {
        "depth": depths.name,
        "semantics": semantics.name,
        "metric": depths.metric,
        "frames": len(frames),
        "classes": len(semantics.classes()),
        "reliable_pixels": round(float(np.mean(reliable)), 4),
        "void_pixels": round(float(np.mean(void)), 4),
        "kilobytes_a_frame": round(float(np.mean(sizes)) / 1000, 1),
        "invalid_depth_values": invalid,
        **depths.figures(),
        **semantics.figures(),
    }
