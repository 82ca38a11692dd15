"""Which views to match a keyframe with, and where to look for its depth: both from the sparse points."""

import numpy as np
from numpy.typing import NDArray

from ...geometry.camera import project
from ...geometry.sparse_model import SparseModel
from ...types import Intrinsics

_MAX_POINTS = 400
_UNSEEN_WEIGHT = 0.3
"""Weight of a point that should be in the other view but was not matched there: it may be hidden."""
_NEAR_MARGIN, _FAR_MARGIN = 0.45, 1.5
"""What is plain has no points: a near sofa may stand well before the nearest of them, and beyond the range nothing can
be found."""
_MIN_POINTS = 12
_MAX_CANDIDATES = 128
"""So many that share points, and so many of the nearest, are compared: a longer recording has no better ones."""


def choose_neighbours(
    model: SparseModel, intrinsics: Intrinsics, index: int, count: int, best_angle: float
) -> NDArray[np.int64]:
    """Choose the keyframes to match one with: their indices, best first.

    A view is good when it sees the same points under an angle near the best (as in MVSNet, Yao et al., ECCV 2018), and
    when it does not repeat a view already chosen.

    Args:
        model: the sparse model of structure from motion.
        intrinsics: of the camera that the observations are of.
        index: of the keyframe.
        count: most views to choose.
        best_angle: degrees between the rays to a point.
    """
    points, ids = _points_of(model, index)
    if len(points) == 0 or len(model.frame_ids) < 2:
        return np.empty(0, np.int64)
    others = _candidates(model, index)
    centers = model.centers[others]
    center = model.centers[index]
    scores = np.array([_pair_score(model, intrinsics, points, ids, center, j, best_angle) for j in others.tolist()])
    chosen: list[int] = []
    for _ in range(min(count, len(others))):
        best = int(scores.argmax())
        if scores[best] < 0.02 * min(len(points), _MAX_POINTS):
            break
        chosen.append(int(others[best]))
        reach = 0.35 * np.linalg.norm(centers[best] - center) + 1e-12
        similarity = np.exp(-0.5 * (np.linalg.norm(centers - centers[best], axis=1) / reach) ** 2)
        scores *= 1 - 0.9 * similarity
        scores[best] = 0
    return np.array(chosen, np.int64)


def _candidates(model: SparseModel, index: int) -> NDArray[np.int64]:
    """Sorted indices of the keyframes worth a look: those that share most points, and the nearest ones."""
    shared = np.asarray(model.seen_by[model.points_of(index)].sum(0)).ravel()
    sharing = np.argsort(-shared, kind="stable")[:_MAX_CANDIDATES]
    nearest = model.tree.query(model.centers[index], min(_MAX_CANDIDATES, len(model.frame_ids)))[1]
    found = np.union1d(sharing[shared[sharing] > 0], nearest)
    return found[found != index]


def depth_range(model: SparseModel, index: int, companions: NDArray[np.int64]) -> tuple[float, float] | None:
    """(near, far) that hold the depths of keyframe `index`, with a margin; None with too few points to say.

    Points of the companion views that lie in front count as well: a keyframe may have few of its own.
    """
    depths = []
    for j in (index, *companions.tolist()):
        points, _ = _points_of(model, j, everything=True)
        z = points @ model.cam_from_world[index, 2, :3] + model.cam_from_world[index, 2, 3]
        depths.append(z[z > 0])
    own = depths[0]
    every = np.concatenate(depths)
    if len(every) < _MIN_POINTS:
        return None
    trusted = own if len(own) >= 4 * _MIN_POINTS else every
    near, far = np.percentile(trusted, [1, 99])
    # Companions may look at what lies behind a corner; let them widen the range, but not without bound.
    near = min(near, max(float(np.percentile(every, 2)), 0.5 * near))
    far = max(far, min(float(np.percentile(every, 98)), 2.0 * far))
    return float(near * _NEAR_MARGIN), float(far * _FAR_MARGIN)


def _points_of(
    model: SparseModel, index: int, everything: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points a keyframe observes and their ids, an even sample of them unless `everything`."""
    ids = model.points_of(index)
    if not everything and len(ids) > _MAX_POINTS:
        ids = ids[np.linspace(0, len(ids) - 1, _MAX_POINTS).astype(np.int64)]
    return model.points_in_world[ids], ids


def _pair_score(
    model: SparseModel,
    intrinsics: Intrinsics,
    points: NDArray[np.float64],
    ids: NDArray[np.int64],
    center: NDArray[np.float64],
    other: int,
    best_angle: float,
) -> float:
    other_from_world = model.cam_from_world[other]
    xy, z = project(points @ other_from_world[:3, :3].T + other_from_world[:3, 3], intrinsics)
    inside = (z > 0) & (xy > 0).all(1) & (xy < [intrinsics.width, intrinsics.height]).all(1)
    if not inside.any():
        return 0.0
    a, b = points - center, points - model.centers[other]
    cosine = (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    spread = np.where(angle < best_angle, 0.4 * best_angle, 1.5 * best_angle)
    weight = np.exp(-0.5 * ((angle - best_angle) / spread) ** 2)
    seen = np.isin(ids, model.points_of(other), assume_unique=True)
    return float((inside * weight * np.where(seen, 1.0, _UNSEEN_WEIGHT)).sum())
