"""Loops and semantic bundle adjustment (section 3.5): poses, scale fields of the proxy depths, the map that follows.

The adjustments minimise what differs where keyframes are drawn into each other (`rerender`), at half the size and then
the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..depth.fields import FINE
from ..geometry import se3
from ..geometry.camera import project
from ..mapping.views import View, half_view
from ..proxy.maps import mean_iou
from ..tracking.graph import Edges, optimise_pose_graph
from ..types import VOID, Intrinsics, LoopEdge
from .rendering import Gaussians
from .rerender import Rerendering, Samples, sample
from .tracking import overlap, track_pose
from .uncertainty import PAPER, Constants

Array = NDArray[np.float64]
GRID = (40, 30)
"""Size at which label images are compared."""
GAP = 8
"""A loop joins keyframes at least this many apart."""
_MIN_COVERED, _MAX_LOSS = 0.5, 1.5
"""A loop's place must be covered so far by the map around the other end, and (16) be at most so many times that of a
neighbour."""


@dataclass(frozen=True)
class LabelSummary:
    """labels (30, 40) uint8: the image's labels, sampled; entropy in nats; boundary: share of pixels on a boundary;
    graph (C, C): how much border each pair of classes shares (off the diagonal) and each class's area (on it)."""

    labels: NDArray[np.uint8]
    entropy: float
    boundary: float
    graph: Array


def summarise_labels(labels: NDArray[np.uint8], classes: int) -> LabelSummary:
    """The summary of a label image (H, W) with `classes` classes; VOID pixels count nowhere."""
    small = np.asarray(cv2.resize(labels, GRID, interpolation=cv2.INTER_NEAREST), np.uint8)
    known = small[small != VOID]
    share = np.bincount(known, minlength=classes)[:classes] / max(len(known), 1)
    entropy = float(-(share[share > 0] * np.log(share[share > 0])).sum())
    graph = np.diag(share)
    borders = 0
    for first, second in ((small[:, :-1], small[:, 1:]), (small[:-1], small[1:])):
        edge = (first != second) & (first != VOID) & (second != VOID)
        borders += int(edge.sum())
        np.add.at(graph, (first[edge], second[edge]), 1 / small.size)
        np.add.at(graph, (second[edge], first[edge]), 1 / small.size)
    return LabelSummary(small, entropy, borders / (2 * small.size), graph)


def rich_keyframes(summaries: Sequence[LabelSummary], constants: Constants = PAPER) -> list[int]:
    """Eq. (21): the keyframes with S(KF) > 0.9: the tenth that shows most."""
    return np.flatnonzero(richness(summaries, constants) > constants.rich).tolist()


def richness(summaries: Sequence[LabelSummary], constants: Constants = PAPER) -> Array:
    """Eq. (22): S = θ H + (1 - θ) E of entropy and boundary density (N,), as quantiles over the run.

    The result is again a quantile, so that S > 0.9 of (21) means the top tenth. Ties share the higher rank."""

    def quantiles(values: Array) -> Array:
        return np.searchsorted(np.sort(values), values, side="right") / len(values)

    entropy = quantiles(np.array([s.entropy for s in summaries]))
    boundary = quantiles(np.array([s.boundary for s in summaries]))
    return quantiles(constants.theta * entropy + (1 - constants.theta) * boundary)


def semantic_candidates(
    summaries: Sequence[LabelSummary], descriptors: Array, constants: Constants = PAPER
) -> list[tuple[int, int]]:
    """Eq. (23): pairs (i, j) of a semantic keyframe j with an earlier one far apart, where the largest likeness passes
    T_loop; the paper takes the mIoU, and (24) for what it is. looks (N, F): unit descriptors."""
    out = []
    for j in rich_keyframes(summaries, constants):
        before = range(0, j - GAP)
        if not before:
            continue
        alike = loop_similarity(
            summaries[j], [summaries[i] for i in before], descriptors[: len(before)] @ descriptors[j], constants
        )
        best = int(np.argmax(alike))
        if alike[best] > constants.t_loop:
            out.append((best, j))
    return out


def structure_similarity(first: Array, others: Array) -> Array:
    """(K,) StructSim of eq. (24): cosine in 0..1 between the graph of regions (C, C) and others (K, C, C)."""
    norms = np.linalg.norm(first) * np.linalg.norm(others, axis=(1, 2))
    return np.asarray((first * others).sum((1, 2)) / np.where(norms > 0, norms, np.inf), np.float64)


def loop_similarity(
    first: LabelSummary, others: Sequence[LabelSummary], dino: Array, constants: Constants = PAPER
) -> Array:
    """Eq. (24): Sim = α₁ mIoU + α₂ DINOSim + α₃ StructSim (K,) of one keyframe with others; dino (K,) cosines."""
    labels, graphs = np.stack([o.labels for o in others]), np.stack([o.graph for o in others])
    structure = structure_similarity(first.graph, graphs)
    miou = mean_iou(first.labels, labels)
    return constants.alpha1 * miou + constants.alpha2 * np.asarray(dino) + constants.alpha3 * structure


def small_descriptors(views: Sequence[View]) -> Array:
    """(N, F) unit vectors of the images made small, for DINOSim of (24) where no network has given descriptors."""
    rows = [cv2.resize(v.image.numpy(), (16, 12), interpolation=cv2.INTER_AREA).reshape(-1) for v in views]
    descriptors = np.stack(rows).astype(np.float64)
    descriptors -= descriptors.mean(1, keepdims=True)
    descriptors -= descriptors.mean(0)
    return descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)


def close_semantic_loops(
    pairs: Iterable[tuple[int, int]], ids: Sequence[int], poses: Array, view_of: Callable[[int], View],
    gaussians: Gaussians, classes: int, unit: float,
) -> list[LoopEdge]:  # fmt: skip
    """Find the loops: the second frame of a pair is tracked by (16) by what was mapped around the first, from its pose.

    It counts where that map covers it, and explains it about as well as the first frame itself."""
    loops = []
    for i, j in pairs:
        around = np.abs(np.searchsorted(ids, gaussians.anchors.numpy()) - i) <= GAP // 2
        near = Gaussians.of(gaussians.map.only(torch.from_numpy(around)))
        start = torch.from_numpy(poses[i])
        own = track_pose(near, view_of(i), [start], classes, unit)
        found = track_pose(near, view_of(j), [start, torch.from_numpy(poses[j])], classes, unit)
        if found.covered > _MIN_COVERED and found.loss < _MAX_LOSS * own.loss:
            motion = found.cam_from_world.numpy() @ se3.inverse(poses[i])
            loops.append(LoopEdge(int(ids[i]), int(ids[j]), motion, 1.0, int(found.covered * 1000)))
    return loops


PARTNERS, NEAR = 6, 4
"""Keyframes that each is drawn into, of those that share enough with it: that many that share most, and others."""
LOCAL_STEPS, GLOBAL_STEPS = (2, 2), (10, 24)
"""At most, at half the size and at the whole."""
_SHARED = 0.4


def local_adjustment(
    views: Callable[[int], View], ids: Sequence[int], poses: Array, fields: Array, moves: NDArray[np.bool_],
    bends: NDArray[np.bool_], classes: int, unit: float, constants: Constants = PAPER,
) -> tuple[Array, Array]:  # fmt: skip
    """Eq. (25): pose term + semantic, depth and colour re-rendering over a window of keyframes, minimised.

    Returns poses (N, 4, 4) and fields (N, rows, columns) of the frames `ids`, whose poses move and depths bend where
    these (N,) say so; at least one pose has to stay."""
    return _adjusted(views, ids, poses, fields, moves, bends, classes, unit, LOCAL_STEPS, constants)


def adjust_frame(
    views: Callable[[int], View], ids: Sequence[int], poses: Array, fields: Array, classes: int, unit: float,
    constants: Constants = PAPER,
) -> Array:  # fmt: skip
    """Return the pose (4, 4) of the last of the frames `ids` after a local adjustment beside keyframes, which stay."""
    moves = np.arange(len(ids)) == len(ids) - 1
    return local_adjustment(views, ids, poses, fields, moves, moves, classes, unit, constants)[0][-1]


def global_adjustment(
    views: Callable[[int], View], ids: Sequence[int], poses: Array, fields: Array, classes: int, unit: float,
    constants: Constants = PAPER,
) -> tuple[Array, Array]:  # fmt: skip
    """Eq. (26) after its pose graph: all keyframes as in (25); the first pose stays, fields' priors hold the scale."""
    moves = np.arange(len(ids)) > 0
    everywhere = np.ones(len(ids), bool)
    return _adjusted(views, ids, poses, fields, moves, everywhere, classes, unit, GLOBAL_STEPS, constants)


def _adjusted(
    views: Callable[[int], View], ids: Sequence[int], poses: Array, fields: Array, moves: NDArray[np.bool_],
    bends: NDArray[np.bool_], classes: int, unit: float, steps: tuple[int, int], constants: Constants,
) -> tuple[Array, Array]:  # fmt: skip
    start, fields = poses, fields.reshape(len(ids), -1)
    for level, most in zip((1, 0), steps, strict=True):
        samples = [sample(half_view(views(i)) if level else views(i), classes, constants) for i in ids]
        problem = Rerendering(samples, poses, fields, moves, bends, (), unit, start, constants)
        problem = replace(problem, pairs=pairs(samples, poses, fields))
        if problem.pairs:
            problem = problem.minimised(most)
        poses, fields = problem.poses, problem.fields
    return poses, fields.reshape(-1, FINE.rows, FINE.columns)


def pairs(samples: Sequence[Samples], poses: Array, fields: Array) -> list[tuple[int, int]]:
    """Choose which keyframes are drawn into which (i, j): up to PARTNERS that share enough of i by (10), most of
    them those that share most, and the others evenly between these and that which shares least."""
    out = []
    for i, mine in enumerate(samples):
        depth = mine.depth * np.exp(mine.basis.of(fields[i]))
        points = se3.transform(se3.inverse(poses[i]), mine.rays * depth[:, None])[::5]
        shares = np.array([overlap(points, poses[j], samples[j].camera) if j != i else 0.0 for j in range(len(poses))])
        order = np.argsort(-shares, kind="stable")[: int((shares > _SHARED).sum())]
        far = np.linspace(NEAR, len(order) - 1, PARTNERS - NEAR).round().astype(int)
        places = [*range(min(NEAR, len(order))), *(np.unique(far) if len(order) > NEAR else ())]
        out += [(i, int(j)) for j in order[places]]
    return out


@torch.no_grad()
def carry(
    gaussians: Gaussians, ids: Sequence[int], poses: Array, new_poses: Array, bent: Array, camera: Intrinsics
) -> None:
    """Move the Gaussians of keyframes `ids` with their poses (N, 4, 4), and along their rays by the change of the log
    scale fields (N, rows, columns)."""
    place = {frame_id: n for n, frame_id in enumerate(ids)}
    keyframe = np.array([place.get(a, -1) for a in gaussians.anchors.tolist()])
    rows = np.flatnonzero(keyframe >= 0)
    keyframe, at = keyframe[rows], torch.from_numpy(rows)
    means = gaussians.table.values["means"].detach()
    in_cam = _moved(poses[keyframe], means[at].double().numpy())
    xy, _ = project(in_cam, camera)
    logs = FINE.at(np.nan_to_num(xy), camera.width, camera.height).of(bent.reshape(len(ids), -1)[keyframe])
    means[at] = torch.from_numpy(_moved(se3.inverse(new_poses)[keyframe], in_cam * np.exp(logs)[:, None])).float()
    gaussians.table.values["log_radii"].detach()[at] += torch.from_numpy(logs).float()


def _moved(motions: Array, points: Array) -> Array:
    return np.einsum("nij,nj->ni", motions[:, :3, :3], points) + motions[:, :3, 3]


def pose_graph(poses: Array, loops: Sequence[LoopEdge], place: Mapping[int, int], depth: float) -> tuple[Array, Array]:
    """First term of Eq. (26): argmin Σ ‖E_i⁻¹ E_j ⊖ E_ij‖²_Σ over neighbours and loops, (N, 4, 4), and scales (N,).

    A rigid graph over similarities with a robust kernel for loops; `depth` is the scene's, for the covariances."""
    n = len(poses)
    first = [*range(n - 1), *(place[e.frame1_id] for e in loops)]
    second = [*range(1, n), *(place[e.frame2_id] for e in loops)]
    motions = [poses[i + 1] @ se3.inverse(poses[i]) for i in range(n - 1)] + [e.frame2_from_frame1 for e in loops]
    sd = np.tile([0.01 * depth] * 3 + [np.radians(0.5)] * 3 + [0.02], (len(first), 1))
    robust = np.arange(len(first)) >= n - 1
    edges = Edges(np.array(first), np.array(second), np.array(motions), np.ones(len(first)), sd, robust)
    return optimise_pose_graph(poses, np.ones(n), edges)
