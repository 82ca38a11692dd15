"""Semantic bundle adjustment (section 3.5): poses and scale fields of the proxy depths, and the map that follows them.

Both minimise what differs where keyframes are drawn into each other (`rerender`), at half the size and then the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..depth.fields import FINE
from ..geometry import se3
from ..geometry.camera import project
from ..global_ba.close import Edges, optimise_pose_graph
from ..mapping.views import View, halved
from ..types import Intrinsics, LoopEdge
from .constants import PAPER, Constants
from .gaussians import Gaussians
from .keyframes import overlap
from .rerender import Rerendering, Samples, sample

Array = NDArray[np.float64]
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


def beside(
    views: Callable[[int], View], ids: Sequence[int], poses: Array, fields: Array, classes: int, unit: float,
    constants: Constants = PAPER,
) -> Array:  # fmt: skip
    """Return the pose (4, 4) of the last of the frames `ids`, which is no keyframe, after a local adjustment beside the
    keyframes before it, which stay."""
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
        samples = [sample(halved(views(i)) if level else views(i), classes, constants) for i in ids]
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
