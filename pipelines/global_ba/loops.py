"""Finding loops: candidates, geometric verification, and the two tests that a false loop of repeated texture fails."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..types import Intrinsics
from .verify import ROTATION, TRANSLATION, KeyframeView, Loop, verify_loop

Array = NDArray[np.float64]

SURE_INLIERS = 80
"""With so many a loop needs no support by its neighbours."""
DRIFT, ANGLE_DRIFT, SCALE_DRIFT = 0.05, 10.0, 1.5
"""A loop is false that claims more drift than this share of the path, more degrees, or a larger factor of scale."""


@dataclass(frozen=True)
class FoundLoops:
    """Accepted loops, and how many pairs were rejected at which test."""

    loops: list[Loop]
    tried: int
    implausible: int
    unsupported: int


def find_loops(
    pairs: Iterable[tuple[int, int]],
    views: Sequence[KeyframeView],
    cam_from_world: Array,
    intrinsics: Intrinsics,
    seed: int,
) -> FoundLoops:
    """Verify candidate pairs of keyframe indices; `views`, which may be made on demand, are at
    cam_from_world (N, 4, 4).

    A verified pair is still refused when the drift it claims is more than the path between its keyframes can have
    collected, or when no neighbouring pair says the same and it has not many inliers itself: two equal posters on a
    wall match perfectly, but contradict the path between them.
    """
    centres = se3.inverse(cam_from_world)[:, :3, 3]
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    verified: dict[tuple[int, int], Loop] = {}
    tried = implausible = 0
    for first, second in pairs:
        tried += 1
        loop = verify_loop(views[first], views[second], intrinsics, seed)
        if loop is None:
            continue
        if not is_plausible(loop, views[first], views[second], float(path[second] - path[first])):
            implausible += 1
        else:
            verified[(first, second)] = loop
    supported = {
        pair: loop
        for pair, loop in verified.items()
        if loop.edge.inliers >= SURE_INLIERS or _has_support(pair, loop, verified, views, intrinsics, seed)
    }
    return FoundLoops(list(supported.values()), tried, implausible, len(verified) - len(supported))


def claimed_drift(loop: Loop, first: KeyframeView, second: KeyframeView) -> tuple[float, float]:
    """Return the motion (distance, radians) of the second camera that the loop asks for."""
    now = second.cam_from_world @ se3.inverse(first.cam_from_world)
    apart = loop.edge.frame2_from_frame1 @ se3.inverse(now)
    centre_now, centre_then = se3.inverse(now)[:3, 3], se3.inverse(loop.edge.frame2_from_frame1)[:3, 3]
    return float(np.linalg.norm(centre_now - centre_then)), float(se3.rotation_angle(apart))


def is_plausible(loop: Loop, first: KeyframeView, second: KeyframeView, path: float) -> bool:
    """Whether a path of that length can have drifted as far as the loop claims."""
    distance, angle = claimed_drift(loop, first, second)
    depth = float(np.nanmedian(first.in_cam[:, 2]))
    scale_drift = abs(np.log(loop.edge.scale))
    return (
        distance <= DRIFT * path + TRANSLATION * depth
        and angle <= np.radians(ANGLE_DRIFT)
        and scale_drift <= np.log(SCALE_DRIFT)
    )


def _has_support(
    pair: tuple[int, int],
    loop: Loop,
    verified: dict[tuple[int, int], Loop],
    views: Sequence[KeyframeView],
    intrinsics: Intrinsics,
    seed: int,
) -> bool:
    """Whether a neighbouring pair is verified too and puts the keyframes in the same places."""
    first, second = pair
    near = [(first + a, second + b) for a in (-2, -1, 0, 1, 2) for b in (-2, -1, 0, 1, 2) if (a, b) != (0, 0)]
    known = [p for p in near if p in verified]
    fresh = [(first + 1, second), (first, second - 1), (first - 1, second), (first, second + 1)]
    for other in known + [p for p in fresh if p not in verified and 0 <= p[0] < p[1] < len(views)]:
        candidate = verified.get(other) or verify_loop(views[other[0]], views[other[1]], intrinsics, seed)
        if candidate is not None and _agree(loop, pair, candidate, other, views):
            return True
    return False


def _agree(
    loop: Loop, pair: tuple[int, int], other: Loop, other_pair: tuple[int, int], views: Sequence[KeyframeView]
) -> bool:
    """Carry the other loop over to this pair along the present poses of the neighbours: the same motion?"""

    def relative(target: int, source: int) -> Array:
        return views[target].cam_from_world @ se3.inverse(views[source].cam_from_world)

    carried = relative(pair[1], other_pair[1]) @ other.edge.frame2_from_frame1 @ relative(other_pair[0], pair[0])
    apart = carried @ se3.inverse(loop.edge.frame2_from_frame1)
    depth = float(np.nanmedian(views[pair[1]].in_cam[:, 2]))
    # Two measurements and the steps between neighbours: three times one measurement's tolerance.
    return bool(
        se3.rotation_angle(apart) < 3 * np.radians(ROTATION) and np.linalg.norm(apart[:3, 3]) < 3 * TRANSLATION * depth
    )
