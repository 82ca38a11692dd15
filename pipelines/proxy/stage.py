"""Stage 2: depth, its reliability, and classes of the keyframes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import ProxyConfig
from msgs_slam.pipelines.engine.stages import Stage, StageContext
from msgs_slam.pipelines.masks.moving import find_moving
from msgs_slam.pipelines.proxy.inputs import check_proxy, left_to_auto, proxy_inputs
from msgs_slam.pipelines.proxy.metres import reference_scale, scale_figures
from msgs_slam.pipelines.proxy.providers import (
    DepthProvider,
    SemanticsProvider,
    prepared,
)
from msgs_slam.pipelines.proxy.scale import DepthScale, measure_scale
from msgs_slam.pipelines.proxy.selection import open_depth, open_semantics
from msgs_slam.pipelines.proxy.sequence import Sequence
from msgs_slam.pipelines.proxy.tasks import (
    by_workers,
    depth_pass,
    load_depth,
    load_sequence,
    look_at_pictures,
    look_for_moving,
    make_depths,
    make_maps,
    maps_pass,
    moving_views,
    prepare_depths,
    surroundings,
)
from msgs_slam.pipelines.run.folder import (
    save_classes,
    save_descriptors,
    save_figures,
    save_frame_scales,
    save_left_out,
)
from msgs_slam.pipelines.run.proxy_files import load_proxy_maps, proxy_path
from msgs_slam.pipelines.system.progress import log
from msgs_slam.pipelines.types import VOID, Frame


def run(context: StageContext) -> dict[str, Any]:
    """Provide maps of every keyframe (every frame without a backbone, or on request)."""
    config = context.config.proxy
    sequence = load_sequence(context)
    around = surroundings(context, sequence)
    depths = open_depth(around)
    semantics = open_semantics(around)
    log.info("proxy: depth by %s, classes by %s", depths.name, semantics.name)
    frames = _frames_to_do(context, sequence, config, depths)
    _warn_of_missing(context, frames, depths, semantics)
    _warn_of_distortion(context, sequence, depths, semantics)
    by_workers(context, prepare_depths, frames)
    depths.prepare(frames)
    by_workers(context, make_depths, frames, depths=prepared(depths))
    depth_pass(context, sequence, frames, depths)
    scale = measure_scale(sequence, frames, lambda frame: load_depth(context, frame))
    moving = _moving_pass(context, sequence, frames, scale) if config.moving == "auto" else {}
    reference = reference_scale(context, sequence, frames, depths, scale, lambda frame: load_depth(context, frame))
    metres = reference.factor if reference else 1.0
    by_workers(context, look_at_pictures, frames)
    semantics.prepare(frames, lambda frame: scale.in_backbone_unit(load_depth(context, frame)))
    for message in semantics.warnings():
        context.warn(message)
    save_classes(context.folder, semantics.classes())
    made = by_workers(context, make_maps, frames, scale=scale, metres=metres, semantics=prepared(semantics))
    made = made or [maps_pass(context, sequence, frames, None, semantics, scale, metres)]
    agreements = [m for part, _ in made for m in part]
    save_descriptors(context.folder, {i: looks for _, part in made for i, looks in part.items()})
    save_frame_scales(context.folder, scale.of_frame, scale.spread_in)
    report = {
        **_report(context, frames, depths, semantics, agreements),
        **scale_figures(depths, scale, reference),
        **moving,
    }
    _warn_of_focal(context, sequence, report.get("network_focal_px"))
    save_figures(context.folder, "proxy", report)
    return report


def _frames_to_do(context: StageContext, sequence: Sequence, config: ProxyConfig, depths: DepthProvider) -> list[Frame]:
    if (config.frames == "all" and depths.metric) or sequence.backbone is None:
        return sequence.frames
    if config.frames == "all":
        context.warn(f"proxy.frames=all: {depths.name} knows only keyframes, the other frames get no maps")
    return [f for f in sequence.frames if f.id in sequence.cam_from_world]


def _warn_of_missing(
    context: StageContext, frames: list[Frame], depths: DepthProvider, semantics: SemanticsProvider
) -> None:
    for kind, provider in (("depth", depths), ("label", semantics)):
        missing = provider.missing(frames)
        if len(missing) == len(frames):
            raise InputError(f"{provider.name}: no {kind} map belongs to any keyframe. Check the names of the files")
        if missing:
            context.warn(f"{len(missing)} of {len(frames)} frames have no {kind} map, the first is {missing[0].name}")


def _warn_of_distortion(
    context: StageContext, sequence: Sequence, depths: DepthProvider, semantics: SemanticsProvider
) -> None:
    """Files show the source; the frames have had their distortion removed."""
    strongest = max(map(abs, sequence.calibration.distortion))
    if strongest > 0.005 and any(p.name.startswith("files:") for p in (depths, semantics)):
        context.warn(
            f"the frames were undistorted (coefficients up to {strongest:.3f}), but map files are taken as they are: "
            "towards the borders they are some pixels off. Give maps of undistorted images"
        )


def _warn_of_focal(context: StageContext, sequence: Sequence, network_focal: float | None) -> None:
    """A network that tells the camera from one picture is good to some per cent: it can only doubt a calibration."""
    calibration = sequence.calibration
    focal = calibration.intrinsics.fx
    if network_focal is None or calibration.origin == "given" or abs(network_focal / focal - 1) < 0.15:
        return
    context.warn(
        f"the depth network sees a focal length of {network_focal:.0f} pixels, the calibration ({calibration.origin}) "
        f"says {focal:.0f} +- {calibration.focal_sd:.0f}: give --intrinsics if you know the camera"
    )


def _moving_pass(
    context: StageContext, sequence: Sequence, frames: list[Frame], scale: DepthScale
) -> dict[str, float | int]:
    """Masks of what moved; says in how many frames, and how much of those. Made anew from the depth when resumed."""
    posed = [f for f in frames if f.id in sequence.cam_from_world]
    parts = by_workers(context, look_for_moving, posed, scale=scale)
    first = {k: moved for part in parts for k, moved in part.items()} if parts else None
    found = find_moving(*moving_views(context, sequence, posed, scale), context.progress, first)
    full = sequence.calibration.intrinsics
    for k, moved in found.items():
        shown = cv2.resize(moved.astype(np.float32), (full.width, full.height), interpolation=cv2.INTER_LINEAR) > 0.5
        save_left_out(context.folder / "masks", posed[k], shown)
    share = round(float(np.mean([m.mean() for m in found.values()])), 4) if found else 0.0
    return {"moving_frames": len(found), "moving_share": share} if found else {}


# report ---------------------------------------------------------------------------------------------------------


def _report(
    context: StageContext,
    frames: list[Frame],
    depths: DepthProvider,
    semantics: SemanticsProvider,
    agreements: list[float],
) -> dict[str, Any]:
    sizes, reliable, void = [], [], []
    invalid = 0
    for frame in frames:
        path = proxy_path(context.folder, frame.id)
        invalid += load_depth(context, frame).invalid
        maps = load_proxy_maps(path)
        sizes.append(path.stat().st_size)
        reliable.append(float((maps.confidence > 0.35).mean()))
        void.append(float((maps.labels == VOID).mean()))
    if invalid:
        context.warn(f"{invalid} depth values were NaN, infinite or negative; they count as unknown")
    return {
        "depth": depths.name,
        "semantics": semantics.name,
        "metric": depths.metric,
        "frames": len(frames),
        "classes": len(semantics.classes()),
        "reliable_pixels": round(float(np.mean(reliable)), 4),
        "void_pixels": round(float(np.mean(void)), 4),
        "label_agreement": round(float(np.mean(agreements)), 4),
        "kilobytes_a_frame": round(float(np.mean(sizes)) / 1000, 1),
        "invalid_depth_values": invalid,
        **depths.figures(),
        **semantics.figures(),
    }


STAGE = Stage(
    "proxy",
    run,
    "depth, reliability and classes of the keyframes",
    inputs=proxy_inputs,
    check=check_proxy,
    auto=left_to_auto,
)
