"""What workers do of a proxy stage, some frames at a time: networks, depths, labels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.resize import resample_nearest
from msgs_slam.pipelines.engine.chunks import Chunk, in_chunks
from msgs_slam.pipelines.engine.stages import StageContext
from msgs_slam.pipelines.masks.moving import SIDE, MovingView, look_once
from msgs_slam.pipelines.proxy.compact import compact
from msgs_slam.pipelines.proxy.providers import (
    DepthEstimate,
    DepthProvider,
    LabelEstimate,
    SemanticsProvider,
    take_prepared,
)
from msgs_slam.pipelines.proxy.reliability import reliability, semantic_agreement, theta, warp_labels
from msgs_slam.pipelines.proxy.scale import DepthScale
from msgs_slam.pipelines.proxy.scratch import load_scratch, save_scratch
from msgs_slam.pipelines.proxy.selection import ProviderContext, open_depth, open_semantics
from msgs_slam.pipelines.proxy.sequence import Sequence, resize_area
from msgs_slam.pipelines.run.folder import load_left_out
from msgs_slam.pipelines.run.proxy_files import proxy_path, save_proxy_maps
from msgs_slam.pipelines.source.recording import open_recording
from msgs_slam.pipelines.system.progress import Progress
from msgs_slam.pipelines.types import Frame, Intrinsics, ProxyMaps, any_of
from msgs_slam.pipelines.voxels.voxels import to_lab

R = TypeVar("R")

MadeMaps = tuple[list[float], dict[int, NDArray[np.float32]]]
"""Semantic agreement m_t of each frame with the one before it, and what a network says of how frames look, by id."""


@dataclass(frozen=True)
class _Opened:
    """The stage's context, its sequence, all frames that it is about, those of the portion, what is known of all."""

    context: StageContext
    sequence: Sequence
    frames: list[Frame]
    part: list[Frame]
    known: dict[str, Any]

    @property
    def around(self) -> ProviderContext:
        """What the providers are made from."""
        return surroundings(self.context, self.sequence)


def by_workers(
    context: StageContext, work: Callable[[Chunk, Progress], R], frames: list[Frame], **known: Any
) -> list[R]:
    """`in_chunks` of the frames; nothing where this process is alone."""
    if context.workers is None:
        return []
    ids = np.array([f.id for f in frames], np.int64)
    return in_chunks(context, work, len(frames), frame_ids=ids, **known)


def _opened(task: Chunk, progress: Progress) -> _Opened:
    context, known = task.context(progress), task.known
    sequence, wanted = load_sequence(context), set(known["frame_ids"].tolist())
    frames = [f for f in sequence.frames if f.id in wanted]
    return _Opened(context, sequence, frames, frames[task.first : task.last], known)


def prepare_depths(task: Chunk, progress: Progress) -> None:
    """What each frame's depth needs of the others: the slow passes over the frames."""
    o = _opened(task, progress)
    open_depth(o.around).prepare(o.part)


def make_depths(task: Chunk, progress: Progress) -> None:
    """The depths of the frames."""
    o = _opened(task, progress)
    depths = open_depth(o.around)
    take_prepared(depths, o.known["depths"])
    depth_pass(o.context, o.sequence, o.part, depths)


def look_for_moving(task: Chunk, progress: Progress) -> dict[int, NDArray[np.bool_]]:
    """The first round of `find_moving` over the frames."""
    o = _opened(task, progress)
    return look_once(task.numbers, *moving_views(o.context, o.sequence, o.frames, o.known["scale"]), progress)


def look_at_pictures(task: Chunk, progress: Progress) -> None:
    """What a network says of each frame by itself."""
    o = _opened(task, progress)
    open_semantics(o.around).look(o.part)


def make_maps(task: Chunk, progress: Progress) -> MadeMaps:
    """The maps of the frames."""
    o = _opened(task, progress)
    semantics = open_semantics(o.around)
    take_prepared(semantics, o.known["semantics"])
    previous = o.frames[task.first - 1] if task.first else None
    return maps_pass(o.context, o.sequence, o.part, previous, semantics, o.known["scale"], o.known["metres"])


def surroundings(context: StageContext, sequence: Sequence) -> ProviderContext:
    """What the providers are made from."""
    return ProviderContext(
        context.source,
        sequence,
        context.config.proxy,
        lambda name: context.snapshot / name,
        context.threads,
        context.device,
        context.progress,
        open_recording(context.source, context.config.run.format),
        context.config.run.cache_mb,
    )


def load_sequence(context: StageContext) -> Sequence:
    """The frames, and what is known of their cameras."""
    calibration = context.run.load_calibration()
    camera = calibration.intrinsics.at_most(context.config.proxy.max_side)
    run = context.run

    def left_out(frame: Frame) -> NDArray[np.bool_] | None:
        """By the stage before this one, and by what of this one is done."""
        return any_of((run.mask(frame, "frames"), load_left_out(context.folder / "masks", frame)))

    return Sequence(run.load_frames(), calibration, camera, run.load_backbone(), run.image, left_out)


def depth_pass(context: StageContext, sequence: Sequence, frames: list[Frame], depths: DepthProvider) -> None:
    """Depth of what every frame shows of the scene, to the snapshot; what is there stays."""
    for frame in context.progress.track(frames, "depth", len(frames)):
        path = _depth_path(context.snapshot, frame)
        if not path.exists():
            estimate = depths.estimate(frame).without(sequence.left_out(frame))
            arrays = {"depth": estimate.depth, "confidence": estimate.confidence, "invalid": np.array(estimate.invalid)}
            normals = {} if estimate.normals is None else {"normals": estimate.normals}
            save_scratch(path, **arrays, **normals)


def _depth_path(snapshot: Path, frame: Frame) -> Path:
    return snapshot / "depth" / f"{frame.id:06d}.npz"


def load_depth(context: StageContext, frame: Frame) -> DepthEstimate:
    """Unknown where something moved, once that has been looked for."""
    found = computed_depth(context, frame)
    moved = load_left_out(context.folder / "masks", frame)
    if moved is None:
        return found
    height, width = found.depth.shape
    return found.without(cv2.resize(moved.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)


def computed_depth(context: StageContext, frame: Frame) -> DepthEstimate:
    """What `depth_pass` has left."""
    stored = load_scratch(_depth_path(context.snapshot, frame))
    return DepthEstimate(stored["depth"], stored["confidence"], int(stored["invalid"]), stored.get("normals"))


def moving_views(
    context: StageContext, sequence: Sequence, posed: list[Frame], scale: DepthScale
) -> tuple[NDArray[np.float64], Callable[[int], MovingView], Intrinsics]:
    """What `find_moving` is to look at: poses, views, and their camera."""
    camera = sequence.intrinsics.at_most(SIDE)

    def view(k: int) -> MovingView:
        seen = scale.in_backbone_unit(computed_depth(context, posed[k]))
        sure = reliability(seen.depth, seen.confidence, 1.0)
        depth, trust = (resample_nearest(a, camera.height, camera.width) for a in (seen.depth, sure))
        lab = to_lab(resize_area(sequence.image(posed[k]), camera.width, camera.height))
        return MovingView(depth, trust, lab, sequence.cam_from_world[posed[k].id])

    return np.array([sequence.cam_from_world[f.id] for f in posed]).reshape(-1, 4, 4), view, camera


def maps_pass(
    context: StageContext,
    sequence: Sequence,
    frames: list[Frame],
    previous: Frame | None,
    semantics: SemanticsProvider,
    scale: DepthScale,
    metres: float,
) -> MadeMaps:
    """Labels and reliability of every frame; `previous` stands before the first of them.

    `metres` turns the provider's depth into that of the maps.
    """
    agreements: list[float] = []
    descriptors = {}

    def labels_of(frame: Frame, seen: DepthEstimate) -> LabelEstimate:
        return semantics.estimate(frame, seen).without(sequence.left_out(frame))

    before = None
    if previous is not None:
        before = labels_of(previous, scale.in_backbone_unit(load_depth(context, previous))).labels
    for frame in context.progress.track(frames, "classes", len(frames)):
        path = proxy_path(context.folder, frame.id)
        depth = load_depth(context, frame)
        seen = scale.in_backbone_unit(depth)
        labels = labels_of(frame, seen)
        m = _agreement(sequence, frame, previous, seen, labels.labels, before)
        agreements.append(m)
        if labels.descriptor is not None:
            descriptors[frame.id] = labels.descriptor
        if not path.exists():
            trust = theta(m)
            u = reliability(depth.depth, depth.confidence, trust)
            scaled = (depth.depth * np.float32(metres)).astype(np.float32)
            save_proxy_maps(path, compact(ProxyMaps(scaled, u, labels.labels, labels.confidence)))
        previous, before = frame, labels.labels
    return agreements, descriptors


def _agreement(
    sequence: Sequence,
    frame: Frame,
    previous: Frame | None,
    depth: DepthEstimate,
    labels: NDArray[np.uint8],
    before: NDArray[np.uint8] | None,
) -> float:
    """m_t of eq. (3): against the labels of the frame before, warped through depth and poses; 1 where unknown."""
    poses = sequence.cam_from_world
    if previous is None or before is None or frame.id not in poses or previous.id not in poses:
        return 1.0
    previous_from_cam = poses[previous.id] @ np.linalg.inv(poses[frame.id])
    sure = np.where(depth.confidence > 0.3, depth.depth, 0).astype(np.float32)
    m = semantic_agreement(labels, warp_labels(before, previous_from_cam, sure, sequence.intrinsics))
    return 1.0 if m is None else m
