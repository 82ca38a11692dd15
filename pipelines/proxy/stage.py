"""Stage 2: depth, its reliability, and classes of the keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError
from pipelines.config import Config, ProxyConfig
from pipelines.correspondence.features import extract_features, to_grey
from pipelines.depth.resize import resample_nearest
from pipelines.frames.recording import open_recording
from pipelines.masks.moving import SIDE, MovingView, find_moving
from pipelines.progress import Progress, log
from pipelines.proxy.compact import compact
from pipelines.proxy.inputs import check_proxy, proxy_inputs
from pipelines.proxy.metres import reference_scale, scale_figures
from pipelines.proxy.providers import DepthEstimate, DepthProvider, LabelEstimate, SemanticsProvider
from pipelines.proxy.regions.voxels import to_lab
from pipelines.proxy.reliability import reliability, semantic_agreement, theta, warp_labels
from pipelines.proxy.scale import DepthScale, measure_scale
from pipelines.proxy.scratch import load_scratch, save_scratch
from pipelines.proxy.selection import Surroundings, open_depth, open_semantics
from pipelines.proxy.sequence import Sequence, resize_area
from pipelines.proxy.symmetry import find_mirror_planes, mirror_pairs
from pipelines.run_folder import (
    RunFolder,
    load_left_out,
    load_proxy_maps,
    proxy_path,
    save_classes,
    save_descriptors,
    save_figures,
    save_frame_scales,
    save_left_out,
    save_mirror_pairs,
    save_proxy_maps,
)
from pipelines.stages import Stage, StageContext
from pipelines.types import VOID, Features, Frame, ProxyMaps, any_of

_PORTIONS = 3
"""Tasks a worker, so that all end at about the same time."""


def run(context: StageContext) -> dict[str, Any]:
    """Provide maps of every keyframe (every frame without a backbone, or on request)."""
    config = context.config.proxy
    sequence = _load_sequence(context)
    around = _surroundings(context, sequence)
    depths = open_depth(around)
    semantics = open_semantics(around)
    log.info("proxy: depth by %s, classes by %s", depths.name, semantics.name)
    frames = _frames_to_do(context, sequence, config, depths)
    _warn_of_missing(context, frames, depths, semantics)
    _warn_of_distortion(context, sequence, depths, semantics)
    _depths_by_workers(context, frames)
    _depth_pass(context, sequence, frames, depths)
    scale = measure_scale(sequence, frames, lambda frame: _load_depth(context, frame))
    moving = _moving_pass(context, sequence, frames, scale) if config.moving == "auto" else {}
    reference = reference_scale(context, sequence, frames, depths, scale, lambda frame: _load_depth(context, frame))
    metres = reference.factor if reference else 1.0
    semantics.prepare(frames, lambda frame: scale.in_backbone_unit(_load_depth(context, frame)))
    for message in semantics.warnings():
        context.warn(message)
    save_classes(context.folder, semantics.classes())
    agreements, descriptors = _maps_pass(context, sequence, frames, semantics, scale, metres)
    save_descriptors(context.folder, descriptors)
    save_frame_scales(context.folder, scale.of_frame, scale.spread_in)
    mirrors = (
        _symmetry_pass(context, sequence, frames, scale, metres) if context.config.article.symmetry_weight > 0 else {}
    )
    report = {
        **_report(context, frames, depths, semantics, agreements),
        **scale_figures(depths, scale, reference),
        **mirrors,
        **moving,
    }
    _warn_of_focal(context, sequence, report.get("network_focal_px"))
    save_figures(context.folder, "proxy", report)
    return report


def _surroundings(context: StageContext, sequence: Sequence) -> Surroundings:
    return Surroundings(
        context.source,
        sequence,
        context.config.proxy,
        lambda name: context.snapshot / name,
        context.threads,
        context.config.run.device,
        context.progress,
        open_recording(context.source, context.config.run.format),
        context.config.run.cache_mb,
    )


def _load_sequence(context: StageContext) -> Sequence:
    calibration = context.run.load_calibration()
    camera = calibration.intrinsics.at_most(context.config.proxy.max_side)
    run = context.run

    def left_out(frame: Frame) -> NDArray[np.bool_] | None:
        """By the stage before this one, and by what of this one is done."""
        return any_of((run.mask(frame, "frames"), load_left_out(context.folder / "masks", frame)))

    return Sequence(run.load_frames(), calibration, camera, run.load_backbone(), run.image, left_out)


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
            "towards the borders they lie some pixels off. Give maps of undistorted pictures"
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


# depth ----------------------------------------------------------------------------------------------------------


def _depth_pass(context: StageContext, sequence: Sequence, frames: list[Frame], depths: DepthProvider) -> None:
    """Depth of what every frame shows of the scene, to the snapshot; what is there stays."""
    depths.prepare(frames)
    for frame in context.progress.track(frames, "depth", len(frames)):
        path = _depth_path(context.snapshot, frame)
        if not path.exists():
            estimate = depths.estimate(frame).without(sequence.left_out(frame))
            arrays = {"depth": estimate.depth, "confidence": estimate.confidence, "invalid": np.array(estimate.invalid)}
            normals = {} if estimate.normals is None else {"normals": estimate.normals}
            save_scratch(path, **arrays, **normals)


@dataclass(frozen=True)
class DepthTask:
    """The depths of some frames of a run, into the unfinished folder of this stage."""

    run: RunFolder
    source: Path
    config: Config
    folder: Path
    frame_ids: tuple[int, ...]


def _depths_by_workers(context: StageContext, frames: list[Frame]) -> None:
    """What `_depth_pass` is to find: first what each frame's depth needs of the others, then the depths."""
    if context.workers is None:
        return
    count = min(_PORTIONS * context.workers.at_once, len(frames))
    portions = np.array_split(np.array([f.id for f in frames]), max(count, 1))
    tasks = [
        DepthTask(context.run, context.source, context.config, context.folder, tuple(ids.tolist())) for ids in portions
    ]
    for work in (prepare_depths, make_depths):
        context.each(work, tasks)


def prepare_depths(task: DepthTask, progress: Progress) -> None:
    """The slow passes over the frames."""
    _, _, frames, depths = _opened(task, progress)
    depths.prepare(frames)


def make_depths(task: DepthTask, progress: Progress) -> None:
    """The depths of the frames."""
    _depth_pass(*_opened(task, progress))


def _opened(task: DepthTask, progress: Progress) -> tuple[StageContext, Sequence, list[Frame], DepthProvider]:
    context = StageContext(task.run, task.source, task.config, task.folder, progress)
    sequence = _load_sequence(context)
    wanted = set(task.frame_ids)
    frames = [f for f in sequence.frames if f.id in wanted]
    return context, sequence, frames, open_depth(_surroundings(context, sequence))


def _depth_path(snapshot: Path, frame: Frame) -> Path:
    return snapshot / "depth" / f"{frame.id:06d}.npz"


def _load_depth(context: StageContext, frame: Frame) -> DepthEstimate:
    """Unknown where something moved, once that has been looked for."""
    found = _computed_depth(context, frame)
    moved = load_left_out(context.folder / "masks", frame)
    if moved is None:
        return found
    height, width = found.depth.shape
    return found.without(cv2.resize(moved.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def _computed_depth(context: StageContext, frame: Frame) -> DepthEstimate:
    stored = load_scratch(_depth_path(context.snapshot, frame))
    return DepthEstimate(stored["depth"], stored["confidence"], int(stored["invalid"]), stored.get("normals"))


def _moving_pass(
    context: StageContext, sequence: Sequence, frames: list[Frame], scale: DepthScale
) -> dict[str, float | int]:
    """Masks of what moved; says in how many frames, and how much of those. Made anew from the depth when resumed."""
    posed = [f for f in frames if f.id in sequence.cam_from_world]
    camera = sequence.intrinsics.at_most(SIDE)

    def view(k: int) -> MovingView:
        seen = scale.in_backbone_unit(_computed_depth(context, posed[k]))
        sure = reliability(seen.depth, seen.confidence, 1.0)
        depth, trust = (resample_nearest(a, camera.height, camera.width) for a in (seen.depth, sure))
        lab = to_lab(resize_area(sequence.image(posed[k]), camera.width, camera.height))
        return MovingView(depth, trust, lab, sequence.cam_from_world[posed[k].id])

    poses = np.array([sequence.cam_from_world[f.id] for f in posed]).reshape(-1, 4, 4)
    found = find_moving(poses, view, camera, context.progress)
    full = sequence.calibration.intrinsics
    for k, moved in found.items():
        shown = cv2.resize(moved.astype(np.float32), (full.width, full.height), interpolation=cv2.INTER_LINEAR) > 0.5
        save_left_out(context.folder / "masks", posed[k], shown)
    share = round(float(np.mean([m.mean() for m in found.values()])), 4) if found else 0.0
    return {"moving_frames": len(found), "moving_share": share} if found else {}


# maps -----------------------------------------------------------------------------------------------------------


def _maps_pass(
    context: StageContext,
    sequence: Sequence,
    frames: list[Frame],
    semantics: SemanticsProvider,
    scale: DepthScale,
    metres: float,
) -> tuple[list[float], dict[int, NDArray[np.float32]]]:
    """Labels and reliability of every frame; returns the semantic agreement m_t of each with the one before it, and
    what a network says of how each looks.

    `metres` turns the provider's depth into that of the maps.
    """
    agreements: list[float] = []
    descriptors = {}
    previous: Frame | None = None
    for frame in context.progress.track(frames, "classes", len(frames)):
        path = proxy_path(context.folder, frame.id)
        depth = _load_depth(context, frame)
        seen = scale.in_backbone_unit(depth)
        labels = semantics.estimate(frame, seen).without(sequence.left_out(frame))
        m = _agreement(context, sequence, frame, previous, seen, labels)
        agreements.append(m)
        if labels.descriptor is not None:
            descriptors[frame.id] = labels.descriptor
        if not path.exists():
            trust = theta(m)
            u = reliability(depth.depth, depth.confidence, trust)
            scaled = (depth.depth * np.float32(metres)).astype(np.float32)
            save_proxy_maps(path, compact(ProxyMaps(scaled, u, labels.labels, labels.confidence)))
        previous = frame
    return agreements, descriptors


def _agreement(
    context: StageContext,
    sequence: Sequence,
    frame: Frame,
    previous: Frame | None,
    depth: DepthEstimate,
    labels: LabelEstimate,
) -> float:
    """m_t of eq. (3): against the labels of the frame before, warped through depth and poses; 1 where unknown."""
    poses = sequence.cam_from_world
    if previous is None or frame.id not in poses or previous.id not in poses:
        return 1.0
    before = load_proxy_maps(proxy_path(context.folder, previous.id)).labels
    previous_from_cam = poses[previous.id] @ np.linalg.inv(poses[frame.id])
    sure = np.where(depth.confidence > 0.3, depth.depth, 0).astype(np.float32)
    m = semantic_agreement(labels.labels, warp_labels(before, previous_from_cam, sure, sequence.intrinsics))
    return 1.0 if m is None else m


def _symmetry_pass(
    context: StageContext, sequence: Sequence, frames: list[Frame], scale: DepthScale, metres: float
) -> dict[str, Any]:
    """Mirror planes of the scene, and the pixels they pair in every frame; says how many it found."""
    enlarge = sequence.calibration.intrinsics.width / sequence.intrinsics.width

    def features_of(frame: Frame) -> Features:
        kept = context.run.load_features(frame.id)
        assert kept is not None  # every frame with a pose is a keyframe
        if kept.descriptors.dtype != np.uint8:  # nobody knows how a learned descriptor looks in a mirror
            kept = extract_features(to_grey(context.run.image(frame)), context.config.frames.max_features)
        return replace(kept, keypoints=(kept.keypoints / [enlarge, enlarge, enlarge, 1]).astype(np.float32))

    planes = find_mirror_planes(
        sequence,
        frames,
        lambda frame: scale.in_backbone_unit(_load_depth(context, frame)),
        features_of,
        context.progress,
    )
    pairs_of = {}
    for frame in frames if planes else []:
        if (pose := sequence.cam_from_world.get(frame.id)) is not None:
            maps = load_proxy_maps(proxy_path(context.folder, frame.id))
            # The planes are in the backbone's unit, the maps in the depth's.
            in_cam = [(p.in_cam(pose) * [1, 1, 1, scale.value * metres], p.confidence) for p in planes]
            pairs = mirror_pairs(sequence.image(frame), maps.depth, maps.confidence, sequence.intrinsics, in_cam)
            pairs_of[frame.id] = replace(pairs, pairs=pairs.pairs * np.float32(enlarge))
    save_mirror_pairs(context.folder, pairs_of)
    return {"mirror_planes": len(planes), "mirror_pairs": sum(map(len, pairs_of.values()))}


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
        invalid += _load_depth(context, frame).invalid
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


STAGE = Stage("proxy", run, "depth, reliability and classes of the keyframes", inputs=proxy_inputs, check=check_proxy)
