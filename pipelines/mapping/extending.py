"""The map of a run that was extended: the one that was there, grown where the added images look."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.camera import project
from ..geometry.posed_depth import overlaps
from ..render.gaussian_map import GaussianMap, decided_channels
from ..run.extension import ParentRun
from ..run.files import FRAMES
from ..sfm.given import fit_given_poses
from ..system.progress import Progress
from ..types import Trajectory
from .move_map import move_map, rows_of
from .optimise import optimise_map
from .submap_tasks import SubmapResult, SubmapTask, concatenate, pixels_filled
from .views import View

GROWN = "grown"
"""Kind of a submap's result: the map of the run that is extended, grown."""
_SEES_THE_SAME = 0.08
"""Share of an added view that one of before shows too, from which that is visited again: η of the paper's covisibility.
"""


def grow_submap(task: SubmapTask, progress: Progress) -> None:
    """Leave the map of `task.before` at its keyframes' new poses, grown. What added views and those that see the same
    show of it is optimised with them, seeded first where it has holes; all else stays as it was, with the exposures of
    its views."""
    if task.file(GROWN).exists() or task.before is None:
        return
    exposures, settings = task.before.exposures(), task.config.mapping
    ids, poses, visited, kept = _start(task, task.before, exposures)
    gains, offsets = _exposures(ids, exposures)
    no_depths = np.zeros((0, 1, 1), np.float32)
    if len(visited) == 0:  # no added image has become a keyframe: the map stays as it was
        task.save(GROWN, SubmapResult(kept, ids, poses, gains, offsets, no_depths, np.array([0])))
        return
    views = task.views(rows_of(task.trajectory, ids[visited])).views
    shown = pixels_filled(kept, views) > 0
    made = optimise_map(
        views, len(task.class_ids),
        replace(settings, hold_out=0, max_gaussians=settings.max_gaussians - int((~shown).sum())), task.config.run.seed,
        initial=kept.only(shown), progress=progress, snapshot=task.file(f"{GROWN}_state"),
        exposure=(gains[visited], offsets[visited]), seeding=True,
    )  # fmt: skip
    poses[visited], gains[visited], offsets[visited] = made.cam_from_world, made.log_gains, made.offsets
    grown = concatenate([kept.only(~shown), made.gaussian_map])
    task.save(GROWN, SubmapResult(grown, ids, poses, gains, offsets, no_depths, np.array([made.iterations])))


def _start(
    task: SubmapTask, before: ParentRun, exposures: Mapping[int, object]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], GaussianMap]:
    """Ids (N,) and poses (N, 4, 4) of all keyframes, the rows of those to visit, and the map that is there."""
    views = task.views(task.trajectory).views
    ids, poses = np.array([v.frame_id for v in views]), np.stack([v.cam_from_world.cpu().numpy() for v in views])
    visited = _to_visit(views, np.array([int(i) in exposures for i in ids]))
    frames = task.run.load(FRAMES)
    known = before.poses_of(frames)
    return ids, poses, visited, _kept_map(before, task.trajectory, known, views, len(task.class_ids), task.device)


def _to_visit(views: Sequence[View], was_there: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows of the views that were added, and of those that see something of what these show; none without any added."""
    if was_there.all():
        return np.zeros(0, np.int64)
    seen = overlaps(v.posed_depth() for v in views)[~was_there].max(axis=0).toarray().ravel()
    return np.flatnonzero(~was_there | (seen > _SEES_THE_SAME))


def _exposures(ids: NDArray[np.int64], known: dict[int, tuple[NDArray, NDArray]]) -> tuple[NDArray, NDArray]:
    """Log gains and offsets (N, 3) of these views, none of those that were added."""
    none = np.zeros(3, np.float32), np.zeros(3, np.float32)
    gains, offsets = zip(*(known.get(int(i), none) for i in ids), strict=True)
    return np.array(gains, np.float32), np.array(offsets, np.float32)


def _kept_map(
    before: ParentRun,
    trajectory: Trajectory,
    known: NDArray[np.float64],
    views: Sequence[View],
    classes: int,
    device: str,
) -> GaussianMap:
    """The map of before with every Gaussian moved as its keyframe was since; known (F, 4, 4): the poses of before."""
    rows = np.flatnonzero(trajectory.is_placed & np.isfinite(known[trajectory.frame_ids]).all(axis=(1, 2)))
    ids, now = trajectory.frame_ids[rows], trajectory.cam_from_world[rows]
    agreed = fit_given_poses(known[ids], now)
    ratio = np.full(len(ids), 1.0 if agreed is None else agreed.move.scale)
    kept = move_map(before.load_map(device), ids, known[ids], now, ratio)
    return replace(kept, class_logits=_relabelled(kept, views, classes))


@torch.no_grad()
def _relabelled(kept: GaussianMap, views: Sequence[View], classes: int) -> Tensor:
    """(M, classes) logits: each class of before becomes the one that most of its Gaussians have now in the view they
    were seeded from. Labels are made anew with the added images, and may count otherwise."""
    before = kept.class_logits.shape[1]
    votes = torch.zeros(before, classes)
    decided, anchors = decided_channels(kept.class_logits).cpu(), kept.anchor_frame_ids.cpu()
    for view in views:
        mine = (anchors == view.frame_id) & (decided >= 0)
        pose = view.cam_from_world.numpy()
        xy, _ = project(kept.means[mine].cpu().double().numpy() @ pose[:3, :3].T + pose[:3, 3], view.intrinsics)
        column, row = np.nan_to_num(xy, nan=-1.0).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < view.intrinsics.width) & (row < view.intrinsics.height)
        now = view.channels.cpu()[row[inside], column[inside]].long()
        is_known = now < classes
        votes.index_put_((decided[mine][inside][is_known], now[is_known]), torch.ones(int(is_known.sum())), True)
    out = torch.zeros(len(kept), classes, device=kept.means.device)
    for channel in torch.nonzero(votes.sum(1))[:, 0].tolist():
        new = int(votes[channel].argmax())
        out[:, new] = torch.maximum(out[:, new], kept.class_logits[:, channel])
    return out
