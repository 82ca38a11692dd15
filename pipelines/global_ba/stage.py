"""Stage 5: loops, the global adjustment, and the map moved and refined with it (MSGS-SLAM 3.5)."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ..depth.align import sample_proxy
from ..geometry import se3
from ..geometry.sparse_model import SparseModel
from ..mapping.move_map import follow_keyframes, move_map, move_trajectory
from ..mapping.stage import Refined, refine_map
from ..mapping.views import with_rigid_panoramas
from ..render.gaussian_map import GaussianMap
from ..run.files import (
    CALIBRATION,
    DEPTH_FIELDS,
    EXPOSURE,
    FIGURES,
    LOOPS,
    MAP,
    MATCHED_PAIRS,
    SPARSE,
    TRAJECTORY,
)
from ..run.stages import StageContext
from ..sfm.adjust import FEATURE_SD
from ..sfm.bundle import reprojection_errors
from ..sfm.features import GlobalDescriptors, compute_global_descriptors
from ..system.parallel import LruSequence
from ..system.values import load_value, save_value
from ..tracking.adjust import align_depths, has_independent_depth
from ..tracking.pictures import Pictures, load_shutter
from ..tracking.state import TrackState, sparse_model_of
from ..types import Array, Intrinsics, Trajectory
from .between import pose_every_frame
from .close import Closed, adjust_with_loops
from .loops import FoundLoops, KeyframeView, Loop, find_loops, loop_candidates, make_keyframe_view

DRIFT_PX = 6.0
"""A loop that is off by more pixels starts a pose graph."""
JOINT_PX = 0.5
"""What counts as moved."""
JOINT_PASSES = 4.0
"""Visits of each keyframe as map and poses are refined together."""
_VIEWS_ROOM = 100e6
"""Bytes of features of keyframes that are kept for the next pair."""


def run(context: StageContext) -> dict[str, Any]:
    """Find loops; where there are any, adjust everything with them and take the map along; refine both together."""
    context = with_rigid_panoramas(context)
    model = context.run.load(SPARSE, "tracking")
    trajectory = context.run.load(TRAJECTORY, "mapping")
    fields = context.run.load(DEPTH_FIELDS, "tracking")

    # Loops of panoramas are those that structure from motion closes: the pose graph knows no places.
    is_rig = context.run.load(CALIBRATION).directions > 1
    found = FoundLoops([], 0, 0, 0) if is_rig else search(context, model)
    closed = apply_loops(context, model, found)
    gaussian_map: GaussianMap | None = None  # as mapping left it
    moved_px = 0.0
    if closed is not None:
        before = poses_of(trajectory, model.frame_ids)
        ratio = depth_ratios(closed.state, model)
        moved_px = largest_motion(context, closed.state, model)
        trajectory = correct_trajectory(trajectory, closed.state, model, ratio)
        after = poses_of(trajectory, model.frame_ids)
        gaussian_map = context.run.load(MAP, "mapping").to(context.device)
        gaussian_map = move_map(gaussian_map, model.frame_ids, before, after, ratio)
        model = sparse_model_of(closed.state)
        fields = align_depths(model, closed.report, context.run.load(CALIBRATION).intrinsics, context.run.find_proxy)
    context.save(DEPTH_FIELDS, fields)
    refined = None
    if moved_px >= JOINT_PX:
        if gaussian_map is None:
            gaussian_map = context.run.load(MAP, "mapping").to(context.device)
        refined = refine_map(context, gaussian_map, trajectory, fields, JOINT_PASSES)
    figures, trajectory = save(context, model, trajectory, gaussian_map, found, closed, refined, moved_px)
    figures |= pose_every_frame(context, model, trajectory)
    context.save(FIGURES["global_ba"], figures)
    return figures


def search(context: StageContext, model: SparseModel) -> FoundLoops:
    """Find candidates by appearance and verify them; kept in a snapshot."""
    snapshot = context.snapshot / "loops.npz"
    if snapshot.exists():
        return load_value(snapshot)
    run, seed = context.run, context.config.run.seed
    pictures = Pictures(run, context.config.frames)
    views = keyframe_views(context, model, pictures)
    ids = model.frame_ids.tolist()
    all_features = map(pictures.features, context.progress.track(ids, "features", len(ids)))
    descriptors = GlobalDescriptors((compute_global_descriptors(all_features, len(ids), pictures.vocabulary),))
    refused = {pair for pair, matches in run.load(MATCHED_PAIRS).items() if matches == 0}
    pairs = loop_candidates(model, descriptors, refused)
    tracked = context.progress.track(pairs, "loops", len(pairs))
    found = find_loops(tracked, views, model.cam_from_world, run.load(CALIBRATION).intrinsics, seed)
    save_value(snapshot, found)
    return found


def keyframe_views(context: StageContext, model: SparseModel, pictures: Pictures) -> LruSequence[KeyframeView]:
    """Features of every keyframe, with what is known of their depth; those asked for last are kept."""
    run = context.run
    intrinsics = run.load(CALIBRATION).intrinsics
    fields = run.load(DEPTH_FIELDS, "tracking")
    state = TrackState.from_backbone(model, 1.0)

    def load(k: int) -> KeyframeView:
        frame_id = int(model.frame_ids[k])
        features = pictures.features(frame_id)
        depth = np.zeros(len(features.xy))
        if (maps := run.find_proxy(frame_id)) is not None:
            depth, _ = sample_proxy(fields.in_world(frame_id, maps), features.xy, intrinsics)
        pose, seen = model.cam_from_world[k], state.sightings[frame_id]
        return make_keyframe_view(frame_id, pose, features, seen, model.points_in_world, depth, intrinsics)

    return LruSequence(len(model.frame_ids), load, lambda view: view.features.nbytes, _VIEWS_ROOM)


def apply_loops(context: StageContext, model: SparseModel, found: FoundLoops) -> Closed | None:
    """Everything adjusted with the loops; None without loops, or when they contradict what was known before."""
    if not found.loops:
        return None
    run, _config = context.run, context.config
    intrinsics = run.load(CALIBRATION).intrinsics
    state = TrackState.from_backbone(model, FEATURE_SD, shutter=load_shutter(run))
    drift = max(loop_drift_px(loop, state, intrinsics) for loop in found.loops)

    report = run.load(FIGURES["proxy"])
    metric = bool(report.get("metric", False))
    use_depth = has_independent_depth(report)
    drifted = drift > DRIFT_PX
    closed = adjust_with_loops(state, found.loops, drifted, intrinsics, run.find_proxy, metric, use_depth)
    if closed.error_after > 1.5 * closed.error_before + 0.05:
        context.warn(
            f"{len(found.loops)} loops were refused: with them the reprojection error of what was known before rises "
            f"from {closed.error_before:.2f} to {closed.error_after:.2f} px"
        )
        return None
    return closed


def loop_drift_px(loop: Loop, state: TrackState, intrinsics: Intrinsics) -> float:
    """Median distance in pixels between where the poses put the loop's points in the second picture and where it sees
    them."""
    motion, seen = state.poses[loop.edge.frame2_id], loop.in_second
    if len(seen) == 0:
        return 0.0
    in_cam = state.points[seen.point] @ motion[:3, :3].T + motion[:3, 3]
    longer = max(intrinsics.width, intrinsics.height)
    return float(min(np.median(reprojection_errors(in_cam, seen.xy, intrinsics)), longer))


def poses_of(trajectory: Trajectory, frame_ids: NDArray[np.int64]) -> Array:
    """(N, 4, 4) poses of these frames."""
    return trajectory.cam_from_world[np.searchsorted(trajectory.frame_ids, frame_ids)]


def depth_ratios(state: TrackState, model: SparseModel) -> Array:
    """(N,) how much farther, as a factor, each keyframe's points are after the adjustment than in `model`."""
    out = np.ones(len(model.frame_ids))
    for k, frame_id in enumerate(model.frame_ids.tolist()):
        point = state.sightings[frame_id].point
        new, old = state.poses[frame_id], model.cam_from_world[k]
        z_new = state.points[point] @ new[2, :3] + new[2, 3]
        z_old = model.points_in_world[point] @ old[2, :3] + old[2, 3]
        good = (z_new > 0) & (z_old > 0)
        if good.sum() >= 5:
            out[k] = float(np.exp(np.median(np.log(z_new[good] / z_old[good]))))
    return out


def correct_trajectory(trajectory: Trajectory, state: TrackState, model: SparseModel, ratio: Array) -> Trajectory:
    """Every frame moved as its keyframes were. What mapping had refined since stays: the correction comes on top."""
    new = np.array([state.poses[i] for i in model.frame_ids.tolist()])
    old, refined = model.cam_from_world, poses_of(trajectory, model.frame_ids)
    # new_from_refined = (new_from_old in the camera), with distances stretched by the keyframe's ratio.
    small = se3.scaled(refined @ se3.inverse(old), ratio)
    poses = follow_keyframes(
        trajectory.frame_ids, trajectory.cam_from_world, model.frame_ids, refined, small @ new, ratio
    )
    poses[~trajectory.is_posed] = np.eye(4)
    return replace(trajectory, cam_from_world=poses)


def largest_motion(context: StageContext, state: TrackState, model: SparseModel) -> float:
    """Measure how far, in pixels, the keyframes have moved against each other: the largest over keyframes."""
    new = np.array([state.poses[i] for i in model.frame_ids.tolist()])
    moved = se3.inverse(new) @ model.cam_from_world
    apart = se3.inverse(moved[:1]) @ moved
    centres = se3.inverse(model.cam_from_world)[:, :3, 3]
    shift = np.linalg.norm(np.einsum("nij,nj->ni", apart[:, :3, :3], centres) + apart[:, :3, 3] - centres, axis=1)
    depth = np.array([state.median_depth(i) for i in model.frame_ids.tolist()])
    focal = context.run.load(CALIBRATION).intrinsics.fx
    return float((focal * (se3.rotation_angle(apart) + shift / depth)).max())


def save(
    context: StageContext,
    model: SparseModel,
    trajectory: Trajectory,
    gaussian_map: GaussianMap | None,
    found: FoundLoops,
    closed: Closed | None,
    refined: Refined | None,
    moved_px: float,
) -> tuple[dict[str, Any], Trajectory]:
    """Write the result, with mapping's own map where there is no other; returns its key figures and the poses."""
    exposure = context.run.load(EXPOSURE)
    if refined is not None and refined.is_better:
        result = refined.result
        gaussian_map = result.gaussian_map
        trajectory = move_trajectory(trajectory, exposure["frame_ids"], result.cam_from_world)
        exposure |= {"log_gains": result.log_gains, "offsets": result.offsets}
    context.save(TRAJECTORY, trajectory)
    context.save(SPARSE, model)
    if gaussian_map is None:
        copy_file(context.run.file("mapping", MAP.name), MAP.path(context.folder))
    else:
        context.save(MAP, gaussian_map)
    context.save(EXPOSURE, exposure)
    context.save(LOOPS, [loop.edge for loop in found.loops] if closed is not None else [])
    kept = refined is not None and refined.is_better
    figures = ({"keyframe_psnr": round(refined.psnr_after, 5)} if refined is not None and kept else {}) | {
        "candidates": found.tried,
        "verified": len(found.loops) + found.unsupported + found.implausible,
        "implausible": found.implausible,
        "unsupported": found.unsupported,
        "loops": len(found.loops) if closed is not None else 0,
        "moved_px": round(moved_px, 3),
        "reprojection_px": None if closed is None else closed.report.figures["reprojection_px"],
        "joint": "not run" if refined is None else "kept" if kept else "thrown away",
        "joint_psnr_before": None if refined is None else round(refined.psnr_before, 3),
        "joint_psnr_after": None if refined is None else round(refined.psnr_after, 3),
    }
    return figures, trajectory
