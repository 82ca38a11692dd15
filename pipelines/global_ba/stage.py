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
from ..tracking.state import Pictures, TrackState, load_shutter, sparse_model_of
from ..types import Array, Intrinsics, Trajectory
from .between import pose_every_frame
from .close import Closed, adjust_with_loops
from .loops import FoundLoops, KeyframeView, Loop, LoopSearch, loop_candidates, make_keyframe_view

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
    return GlobalStage(context).run()


class GlobalStage:
    """The stage: `run` is the order of its work. `closed` is None without loops that agree with what was known before,
    `refined` where nothing has moved, and `gaussian_map` where it is as mapping left it."""

    closed: Closed | None = None
    refined: Refined | None = None
    gaussian_map: GaussianMap | None = None
    moved_px = 0.0

    def __init__(self, context: StageContext) -> None:
        self.context = with_rigid_panoramas(context)
        self.model = context.run.load(SPARSE, "tracking")
        self.trajectory = context.run.load(TRAJECTORY, "mapping")
        self.fields = context.run.load(DEPTH_FIELDS, "tracking")
        self.calibration = context.run.load(CALIBRATION)
        self.intrinsics = self.calibration.intrinsics

    def run(self) -> dict[str, Any]:
        """Do the steps in order; returns the figures."""
        # Loops of panoramas are those that structure from motion closes: the pose graph knows no places.
        self.found = FoundLoops([], 0, 0, 0) if self.calibration.directions > 1 else self.search()
        self.close_loops()
        if self.closed is not None:
            self.take_along(self.closed)
        self.context.save(DEPTH_FIELDS, self.fields)
        if self.moved_px >= JOINT_PX:
            self.refine()
        self.save()
        figures = self.figures() | pose_every_frame(self.context, self.model, self.trajectory)
        self.context.save(FIGURES["global_ba"], figures)
        return figures

    def search(self) -> FoundLoops:
        """Find candidates by appearance and verify them; kept in a snapshot."""
        context, model = self.context, self.model
        snapshot = context.snapshot / "loops.npz"
        if snapshot.exists():
            return load_value(snapshot)
        pictures = Pictures(context.run, context.config.frames)
        ids = model.frame_ids.tolist()
        all_features = map(pictures.features, context.progress.track(ids, "features", len(ids)))
        descriptors = GlobalDescriptors((compute_global_descriptors(all_features, len(ids), pictures.vocabulary),))
        refused = {pair for pair, matches in context.run.load(MATCHED_PAIRS).items() if matches == 0}
        pairs = loop_candidates(model, descriptors, refused)
        views, seed = self._keyframe_views(pictures), context.config.run.seed
        search = LoopSearch(views, model.cam_from_world, self.intrinsics, seed)
        found = search.find(context.progress.track(pairs, "loops", len(pairs)))
        save_value(snapshot, found)
        return found

    def _keyframe_views(self, pictures: Pictures) -> LruSequence[KeyframeView]:
        """Features of every keyframe, with what is known of their depth; those asked for last are kept."""
        model, state = self.model, TrackState.from_backbone(self.model, 1.0)

        def load(k: int) -> KeyframeView:
            frame_id = int(model.frame_ids[k])
            features = pictures.features(frame_id)
            depth = np.zeros(len(features.xy))
            if (maps := pictures.proxy(frame_id)) is not None:
                depth, _ = sample_proxy(self.fields.in_world(frame_id, maps), features.xy, self.intrinsics)
            pose, seen = model.cam_from_world[k], state.sightings[frame_id]
            return make_keyframe_view(frame_id, pose, features, seen, model.points_in_world, depth, self.intrinsics)

        return LruSequence(len(model.frame_ids), load, lambda view: view.features.nbytes, _VIEWS_ROOM)

    def close_loops(self) -> None:
        """Adjust everything with the loops, unless they contradict what was known before."""
        run, loops = self.context.run, self.found.loops
        if not loops:
            return
        state = TrackState.from_backbone(self.model, FEATURE_SD, shutter=load_shutter(run))
        drifted = max(loop_drift_px(loop, state, self.intrinsics) for loop in loops) > DRIFT_PX
        report = run.load(FIGURES["proxy"])
        metric, use_depth = bool(report.get("metric", False)), has_independent_depth(report)
        closed = adjust_with_loops(state, loops, drifted, self.intrinsics, run.find_proxy, metric, use_depth)
        if closed.error_after > 1.5 * closed.error_before + 0.05:
            self.context.warn(
                f"{len(loops)} loops were refused: with them the reprojection error of what was known before rises "
                f"from {closed.error_before:.2f} to {closed.error_after:.2f} px"
            )
        else:
            self.closed = closed

    def take_along(self, closed: Closed) -> None:
        """Move frames and map, and fit the depths anew, as keyframes and points were moved."""
        state, old, ids = closed.state, self.model, self.model.frame_ids
        before, ratio = poses_of(self.trajectory, ids), depth_ratios(closed.state, self.model)
        self.moved_px = largest_motion(state, old, self.intrinsics.fx)
        self.trajectory = correct_trajectory(self.trajectory, state, old, ratio)
        after = poses_of(self.trajectory, ids)
        self.gaussian_map = move_map(self._mapped(), ids, before, after, ratio)
        self.model = sparse_model_of(state)
        self.fields = align_depths(self.model, closed.report, self.intrinsics, self.context.run.find_proxy)

    def _mapped(self) -> GaussianMap:
        return self.context.run.load(MAP, "mapping").to(self.context.device)

    def refine(self) -> None:
        """Refine map and poses together; kept where it helps."""
        given = self._mapped() if self.gaussian_map is None else self.gaussian_map
        self.refined = refine_map(self.context, given, self.trajectory, self.fields, JOINT_PASSES)

    def save(self) -> None:
        """Write the result, with mapping's own map where there is no other."""
        exposure = self.context.run.load(EXPOSURE)
        if self.refined is not None and self.refined.is_better:
            result = self.refined.result
            self.gaussian_map = result.gaussian_map
            self.trajectory = move_trajectory(self.trajectory, exposure["frame_ids"], result.cam_from_world)
            exposure |= {"log_gains": result.log_gains, "offsets": result.offsets}
        self.context.save(TRAJECTORY, self.trajectory)
        self.context.save(SPARSE, self.model)
        if self.gaussian_map is None:
            copy_file(self.context.run.file("mapping", MAP.name), MAP.path(self.context.folder))
        else:
            self.context.save(MAP, self.gaussian_map)
        self.context.save(EXPOSURE, exposure)
        self.context.save(LOOPS, [loop.edge for loop in self.found.loops] if self.closed is not None else [])

    def figures(self) -> dict[str, Any]:
        """Return the figures, but for those of the images between."""
        found, closed, refined = self.found, self.closed, self.refined
        kept = refined is not None and refined.is_better
        return ({"keyframe_psnr": round(refined.psnr_after, 5)} if refined is not None and kept else {}) | {
            "candidates": found.tried,
            "verified": len(found.loops) + found.unsupported + found.implausible,
            "implausible": found.implausible,
            "unsupported": found.unsupported,
            "loops": len(found.loops) if closed is not None else 0,
            "moved_px": round(self.moved_px, 3),
            "reprojection_px": None if closed is None else closed.report.figures["reprojection_px"],
            "joint": "not run" if refined is None else "kept" if kept else "thrown away",
            "joint_psnr_before": None if refined is None else round(refined.psnr_before, 3),
            "joint_psnr_after": None if refined is None else round(refined.psnr_after, 3),
        }


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


def largest_motion(state: TrackState, model: SparseModel, focal: float) -> float:
    """Measure how far, in pixels, the keyframes have moved against each other: the largest over keyframes."""
    new = np.array([state.poses[i] for i in model.frame_ids.tolist()])
    moved = se3.inverse(new) @ model.cam_from_world
    apart = se3.inverse(moved[:1]) @ moved
    centres = se3.inverse(model.cam_from_world)[:, :3, 3]
    shift = np.linalg.norm(np.einsum("nij,nj->ni", apart[:, :3, :3], centres) + apart[:, :3, 3] - centres, axis=1)
    depth = np.array([state.median_depth(i) for i in model.frame_ids.tolist()])
    return float((focal * (se3.rotation_angle(apart) + shift / depth)).max())
