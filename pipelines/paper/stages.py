"""The paper's method as stages of a run: its frames and proxies come from the stages before, the export follows.

`tracking` is figure 1 frame by frame, `mapping` visits all keyframes once more, `global_ba` closes loops and adjusts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.tensors import load_tensors, save_tensors
from ..depth.fields import DepthFields
from ..geometry import se3
from ..geometry.camera import project
from ..geometry.se3 import Similarity
from ..geometry.sparse_model import SparseModel
from ..mapping.measure import ViewFigures, mean_figures, measure_view
from ..mapping.move_map import follow_keyframes, move_map
from ..mapping.views import View, load_view, survey
from ..render.gaussian_map import GaussianMap
from ..run.files import (
    CALIBRATION,
    CLASSES,
    DEPTH_FIELDS,
    DESCRIPTORS,
    EXPOSURE,
    FIGURES,
    FRAMES,
    LOOPS,
    MAP,
    SPARSE,
    TRAJECTORY,
)
from ..run.stages import StageContext
from ..system.machine import VIEWS_SHARE
from ..system.parallel import LruSequence
from ..system.progress import is_asked
from ..system.values import load_value, save_value
from ..system.wording import stretches
from ..types import Frame, Intrinsics, LoopEdge, Trajectory
from .adjustment import (
    adjust_frame,
    carry,
    close_semantic_loops,
    global_adjustment,
    pose_graph,
    semantic_candidates,
    small_descriptors,
    summarise_labels,
)
from .mapping import draw_together, optimise
from .rendering import Gaussians, scaled_depth
from .slam import Slam
from .uncertainty import constants_of, proxy_depth

WORKING_SIDE = 320
"""Pixels on the long side of the images that frames are tracked with and the map is grown from."""
_POINTS = 200
"""Points that stand for a keyframe's Gaussians in the sparse model, for programs that want one."""

SNAPSHOT_EVERY = 5
"""Frames between two snapshots."""
MAP_PASSES, FINE_PASSES = 1, 12
"""Visits of each keyframe: in `mapping`, and at full size once poses and depths are adjusted."""


def track_by_map(context: StageContext) -> dict[str, Any]:
    """Poses of all frames, and the map that they were found with."""
    _warn(context)
    recording, snapshot = FrameViews(context), context.snapshot / "slam.npz"
    slam, done = Slam(len(recording.class_ids), context.config.run.seed), 0
    if snapshot.exists():
        done, held = load_value(snapshot)
        slam.restore(held)
    constants, frames = constants_of(context.config), recording.frames
    for frame in context.progress.track(frames[done:], "tracking", len(frames) - done):
        slam.step(recording.views[frame.id], recording.views.__getitem__, frame.id not in recording.held, constants)
        done += 1
        if slam.gaussians is not None and (done % SNAPSHOT_EVERY == 0 or is_asked()):
            save_value(snapshot, (done, slam.to_value()))
    if slam.gaussians is None or len(slam.poses) < 2:
        raise InputError(
            f"{context.source}: none of {len(frames)} frames could be tracked by the map. --method paper needs a depth "
            "for its first frames: give --depth files:FOLDER or a network's name"
        )
    trajectory = trajectory_of(frames, slam.poses, slam.keyframes, slam.lost)
    context.save(TRAJECTORY, trajectory)
    context.save(MAP, slam.gaussians.map)
    context.save(SPARSE, sparse_model(slam.gaussians.map, trajectory, recording.full))
    context.save(DEPTH_FIELDS, DepthFields(slam.fields))
    if slam.lost:
        context.warn(f"{len(slam.lost)} frames have no pose: {stretches(slam.lost)}")
    metric = bool(context.run.load(FIGURES["proxy"]).get("metric", False))
    figures = {
        "frames": len(frames), "posed": len(slam.poses), "keyframes": len(slam.fields),
        "lost": {str(i): reason for i, reason in slam.lost.items()}, "scale": "metric" if metric else "free",
        "scale_relative_sd": None, "method": "paper", "gaussians": len(slam.gaussians), "pieces": [],
    }  # fmt: skip
    context.save(FIGURES["tracking"], figures)
    return figures


def _warn(context: StageContext) -> None:
    """Say in what this run departs from the paper."""
    proxy, camera = context.run.load(FIGURES["proxy"]), context.run.load(CALIBRATION)
    if not proxy.get("metric", False):
        context.warn(
            f"--method paper: proxy depth is by {proxy['depth']}, which knows keyframes of structure from motion alone "
            "and no metres, not the metric network of the paper"
        )
    if camera.origin == "self-calibrated":
        context.warn("--method paper: the camera was unknown, and is that of structure from motion")
    if camera.directions > 1:
        raise InputError("--method paper tracks one perspective camera: it cannot be used with panoramas")


def map_keyframes(context: StageContext) -> dict[str, Any]:
    """Every keyframe visited once more, eq. (18)."""
    recording, run = FrameViews(context), context.run
    trajectory, fields = run.load(TRAJECTORY, "tracking"), run.load(DEPTH_FIELDS, "tracking")
    gaussians = Gaussians.of(run.load(MAP, "tracking"))
    ids = trajectory.frame_ids[trajectory.is_keyframe].tolist()
    mirror = draw_together(gaussians, scene_unit(recording, ids, fields), context.config.run.seed)
    _visit(context, recording, gaussians, trajectory, fields, MAP_PASSES, "mapping")
    context.save(MAP, gaussians.map)
    context.save(TRAJECTORY, trajectory)
    _save_exposure(context, trajectory)
    figures = {
        "keyframes": len(ids), "gaussians": len(gaussians), "submaps": 1,
        "iterations": MAP_PASSES * len(ids), "classes": len(recording.class_ids), "symmetry": mirror.confidence,
        **_measure(recording, gaussians.map, trajectory, fields),
    }  # fmt: skip
    context.save(FIGURES["mapping"], {**figures, "class_ids": list(recording.class_ids), "submaps": []})
    return figures


def _visit(
    context: StageContext, recording: FrameViews, gaussians: Gaussians, trajectory: Trajectory, fields: DepthFields,
    passes: int, label: str, begin: int = 0, after: Callable[[int], None] = lambda done: None,
) -> None:  # fmt: skip
    """Adam on (18), keyframe by keyframe in random order, its rate falling; `after` each pass."""
    ids, seed = trajectory.frame_ids[trajectory.is_keyframe].tolist(), context.config.run.seed
    poses = dict(zip(trajectory.frame_ids.tolist(), trajectory.cam_from_world, strict=True))
    unit, constants = scene_unit(recording, ids, fields), constants_of(context.config)
    for number in range(begin, passes):
        order = np.random.default_rng([seed, number, 2]).permutation(ids).tolist()
        for k, i in enumerate(context.progress.track(order, label, len(order))):
            rate = 0.1 ** ((number * len(ids) + k) / (passes * len(ids)))
            view, pose = recording.scaled(i, fields), torch.from_numpy(poses[i])
            optimise(gaussians, view, pose, len(recording.class_ids), unit, rate, constants)
        after(number + 1)


def scene_unit(recording: FrameViews, ids: list[int], fields: DepthFields) -> float:
    """Find the median depth of the first keyframe, the unit of all depth terms."""
    depth = recording.scaled(ids[0], fields).depth
    return float(depth[depth > 0].median())


def _measure(
    recording: FrameViews, gaussian_map: GaussianMap, trajectory: Trajectory, fields: DepthFields
) -> dict[str, float]:
    found: dict[str, list[ViewFigures]] = {"keyframe": [], "held_out": []}
    keys = set(trajectory.frame_ids[trajectory.is_keyframe].tolist())
    nothing = np.zeros(3, np.float32)
    posed = trajectory.is_posed
    for i, pose in zip(trajectory.frame_ids[posed].tolist(), trajectory.cam_from_world[posed], strict=True):
        if i in keys:
            view = recording.scaled(i, fields)
            found["keyframe"].append(measure_view(gaussian_map, view, pose, nothing, nothing))
        elif i in recording.held:
            found["held_out"].append(measure_view(gaussian_map, recording.views[i], pose, nothing, nothing))
    return mean_figures(found["keyframe"], "keyframe") | mean_figures(found["held_out"], "held_out")


def _save_exposure(context: StageContext, trajectory: Trajectory) -> None:
    """The paper has no exposures: none is changed."""
    ids = trajectory.frame_ids[trajectory.is_keyframe]
    nothing = np.zeros((len(ids), 3), np.float32)
    context.save(EXPOSURE, {"frame_ids": ids, "log_gains": nothing, "offsets": nothing})


def close_and_adjust(context: StageContext) -> dict[str, Any]:
    """Loops (21) to (24), then poses and depths together (26), then the map at full size."""
    recording, run = FrameViews(context), context.run
    trajectory, fields = run.load(TRAJECTORY, "mapping"), run.load(DEPTH_FIELDS, "tracking")
    gaussian_map = run.load(MAP, "mapping")
    tried, loops = _loops(context, recording, trajectory, fields, gaussian_map)
    if loops:
        trajectory, gaussian_map = _closed(recording, trajectory, fields, gaussian_map, loops)
    gaussians, trajectory, fields = _adjusted(context, recording, trajectory, fields, gaussian_map)
    context.save(TRAJECTORY, trajectory)
    context.save(SPARSE, sparse_model(gaussians.map, trajectory, recording.full))
    context.save(MAP, gaussians.map)
    _save_exposure(context, trajectory)
    context.save(LOOPS, loops)
    context.save(DEPTH_FIELDS, fields)
    figures = {
        "candidates": tried, "verified": len(loops), "implausible": 0, "unsupported": 0, "loops": len(loops),
        "joint": "kept", **_measure(recording, gaussians.map, trajectory, fields),
    }  # fmt: skip
    context.save(FIGURES["global_ba"], figures)
    return figures


def _loops(
    context: StageContext, recording: FrameViews, trajectory: Trajectory, fields: DepthFields, gaussian_map: GaussianMap
) -> tuple[int, list[LoopEdge]]:
    """Return how many candidates there are, and the loops among them; kept in a snapshot."""
    kept = LOOPS.find(context.snapshot)
    ids = trajectory.frame_ids[trajectory.is_keyframe].tolist()
    classes = len(context.run.load(CLASSES))
    maps = {i: context.run.find_proxy(i) for i in ids}
    summaries = [summarise_labels(m.labels, classes) for m in maps.values() if m is not None]
    learned = context.run.find(DESCRIPTORS) or {}
    known = all(i in learned for i in ids)
    descriptors: NDArray = (
        np.stack([learned[i] for i in ids]) if known else small_descriptors([recording.views[i] for i in ids])
    )
    pairs = semantic_candidates(summaries, descriptors, constants_of(context.config))
    if kept is not None:
        return len(pairs), kept
    poses = trajectory.cam_from_world[trajectory.is_keyframe]
    unit = scene_unit(recording, ids, fields)
    found = close_semantic_loops(
        context.progress.track(pairs, "loops", len(pairs)), ids, poses, lambda n: recording.scaled(ids[n], fields),
        Gaussians.of(gaussian_map), len(recording.class_ids), unit,
    )  # fmt: skip
    LOOPS.save(context.snapshot, found)
    return len(pairs), found


def _closed(
    recording: FrameViews, trajectory: Trajectory, fields: DepthFields, gaussian_map: GaussianMap, loops: list[LoopEdge]
) -> tuple[Trajectory, GaussianMap]:
    """Spread the drift that loops show; Gaussians and frames move with their keyframes."""
    ids, old = trajectory.frame_ids[trajectory.is_keyframe], trajectory.cam_from_world[trajectory.is_keyframe]
    place = {frame_id: n for n, frame_id in enumerate(ids.tolist())}
    new, _ = pose_graph(old, loops, place, scene_unit(recording, ids.tolist(), fields))
    return _following(trajectory, new), move_map(gaussian_map, ids, old, new, np.ones(len(ids)))


def _following(trajectory: Trajectory, new: NDArray[np.float64]) -> Trajectory:
    """All frames after their keyframes moved to new poses (N, 4, 4)."""
    ids, old = trajectory.frame_ids[trajectory.is_keyframe], trajectory.cam_from_world[trajectory.is_keyframe]
    poses = follow_keyframes(trajectory.frame_ids, trajectory.cam_from_world, ids, old, new, np.ones(len(ids)))
    poses[trajectory.is_keyframe] = new
    poses[~trajectory.is_posed] = np.eye(4)
    return replace(trajectory, cam_from_world=poses)


def _adjusted(
    context: StageContext, recording: FrameViews, trajectory: Trajectory, fields: DepthFields, gaussian_map: GaussianMap
) -> tuple[Gaussians, Trajectory, DepthFields]:
    """(26), the world brought back to the proxies' scale, then (18) at full size; goes on from the last pass."""
    snapshot = context.snapshot / "adjusted.safetensors"
    ids = trajectory.frame_ids[trajectory.is_keyframe].tolist()
    if snapshot.exists():
        held = load_tensors(snapshot)
        done, gaussians = int(held["done"]), Gaussians.from_tensors(held)
        poses, bent = held["poses"].numpy(), held["fields"].numpy()
    else:
        done, gaussians = 0, Gaussians.of(gaussian_map)
        old, own = trajectory.cam_from_world[trajectory.is_keyframe], np.stack([fields.of_frame[i] for i in ids])
        unit, classes = scene_unit(recording, ids, fields), len(recording.class_ids)
        constants = constants_of(context.config)
        poses, bent = global_adjustment(recording.views.__getitem__, ids, old, own, classes, unit, constants)
        carry(gaussians, ids, old, poses, bent - own, recording.camera)
        gaussians.resize(-float(bent.mean()))  # the proxies' scale is right on the whole
    kept = {"poses": torch.from_numpy(poses), "fields": torch.from_numpy(bent)}

    def save(passes: int) -> None:
        save_tensors(snapshot, {**gaussians.to_tensors(), **kept, "done": torch.tensor(passes)})

    if done == 0:
        save(0)
    trajectory, shrunk = _following(trajectory, poses), -float(bent.mean())
    trajectory = _between(context, recording, trajectory, DepthFields(dict(zip(ids, bent, strict=True))))
    resized = Similarity(math.exp(shrunk), np.eye(3), np.zeros(3)).apply_to_poses(trajectory.cam_from_world)
    resized[~trajectory.is_posed] = np.eye(4)
    trajectory = replace(trajectory, cam_from_world=resized)
    fields = DepthFields(dict(zip(ids, bent + shrunk, strict=True)))
    fine = FrameViews(context, context.config.mapping.max_side)
    _visit(context, fine, gaussians, trajectory, fields, FINE_PASSES, "mapping", done, save)
    return gaussians, trajectory, fields


def _between(context: StageContext, recording: FrameViews, trajectory: Trajectory, fields: DepthFields) -> Trajectory:
    """(25) for each frame that is no keyframe and its two neighbours that are, of which only the frame moves."""
    keys, poses = trajectory.frame_ids[trajectory.is_keyframe], trajectory.cam_from_world.copy()
    unit = scene_unit(recording, keys.tolist(), fields)
    row = {i: n for n, i in enumerate(trajectory.frame_ids.tolist())}
    views, classes, constants = recording.views.__getitem__, len(recording.class_ids), constants_of(context.config)
    left = trajectory.frame_ids[trajectory.is_posed & ~trajectory.is_keyframe].tolist()
    for i in context.progress.track(left, "adjusting", len(left)):
        after = int(np.clip(np.searchsorted(keys, i), 1, len(keys) - 1))
        ids = [*keys[max(after - 1, 0) : after + 1].tolist(), i]
        own = np.stack([fields.of_frame[k] for k in [*ids[:-1], ids[0]]])
        where = np.stack([poses[row[k]] for k in ids])
        poses[row[i]] = adjust_frame(views, ids, where, own, classes, unit, constants)
    return replace(trajectory, cam_from_world=poses)


class FrameViews:
    """The frames of a run, as views at a size; `held`: ids of those that only measure the map."""

    def __init__(self, context: StageContext, side: int = WORKING_SIDE) -> None:
        run, memory = context.run, context.memory_room
        self.frames: list[Frame] = run.load(FRAMES)
        self.full: Intrinsics = run.load(CALIBRATION).intrinsics
        self.camera = self.full.at_most(side)
        every = context.config.mapping.hold_out
        self.held = {f.id for f in self.frames if every > 0 and f.id % every == every // 2}
        self.class_ids, self.with_depth = survey(run, [f.id for f in self.frames if f.id not in self.held])
        at = np.eye(4)

        def load(i: int) -> View:
            maps = proxy_depth(run, i)
            return load_view(run, self.frames[i], self.camera, at, maps, self.class_ids, "cpu")

        self.views: LruSequence[View] = LruSequence(len(self.frames), load, lambda v: v.nbytes, VIEWS_SHARE * memory)

    def scaled(self, frame_id: int, fields: DepthFields) -> View:
        """Return a frame's view with its proxy depth brought into the world by its field."""
        view = self.views[frame_id]
        return scaled_depth(view, torch.from_numpy(fields.scales(frame_id, *view.depth.shape)))


def trajectory_of(
    frames: Sequence[Frame], poses: Mapping[int, NDArray[np.float64]], keyframes: Sequence[int], lost: Mapping[int, str]
) -> Trajectory:
    """Collect the poses (4, 4) by frame id."""
    keys = set(keyframes)
    return Trajectory(
        np.array([f.id for f in frames]),
        np.array([f.timestamp for f in frames]),
        np.array([poses.get(f.id, np.eye(4)) for f in frames]),
        np.array([f.id in keys for f in frames]),
        tuple("" if f.id in poses else lost.get(f.id, "before the first frame with a depth") for f in frames),
    )


def sparse_model(gaussian_map: GaussianMap, trajectory: Trajectory, camera: Intrinsics) -> SparseModel:
    """Some of each keyframe's Gaussians as points that it observes."""
    ids = trajectory.frame_ids[trajectory.is_keyframe]
    poses = trajectory.cam_from_world[trajectory.is_keyframe]
    anchors, means = gaussian_map.anchor_frame_ids.numpy(), gaussian_map.means.double().numpy()
    rows, frame, xy = [], [], []
    for n, (frame_id, pose) in enumerate(zip(ids.tolist(), poses, strict=True)):
        own = np.flatnonzero(anchors == frame_id)
        own = own[:: max(len(own) // _POINTS, 1)]
        seen, z = project(se3.transform(pose, means[own]), camera)
        inside = (z > 0) & (seen > 0).all(1) & (seen < [camera.width, camera.height]).all(1)
        rows.append(own[inside])
        frame.append(np.full(int(inside.sum()), n))
        xy.append(seen[inside])
    chosen: NDArray[np.int64] = np.concatenate(rows)
    colors = (gaussian_map.colors[torch.from_numpy(chosen)].clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    points = np.arange(len(chosen))
    return SparseModel(ids, poses, means[chosen], colors, np.concatenate(frame), points, np.concatenate(xy))
