"""Removal of depth in front of what other views see there: it is wrong, and would become a floater."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..geometry.posed_depth import PosedDepth, neighbours
from ..system.jit import kernel

STRIDE = 2
AGREES = 0.03
"""Relative difference up to which another view confirms a depth."""
SEES_THROUGH = 0.08
"""Relative difference from which the other view's surface is plainly behind it."""
_TRUSTED = 0.5


def contradicted(views: Sequence[PosedDepth]) -> Iterator[NDArray[np.bool_]]:
    """(H, W) of each view in turn: pixels whose depth more of the others (two at least) see through than confirm."""
    seeing: dict[int, list[int]] = {}
    for i, j in neighbours(views):
        seeing.setdefault(i, []).append(j)
    for i, view in enumerate(views):
        votes = np.zeros((2, *view.depth[::STRIDE, ::STRIDE].shape), np.int16)
        for j in seeing.get(i, []):
            _vote(view, views[j], votes)
        confirmed, through = votes
        bad = (through >= 2) & (through > confirmed)
        height, width = view.depth.shape
        yield np.repeat(np.repeat(bad, STRIDE, axis=0), STRIDE, axis=1)[:height, :width]


def _vote(view: PosedDepth, other: PosedDepth, votes: NDArray[np.int16]) -> None:
    """Add to votes (2, h, w), of the view's strided pixels: the other view confirms the depth; it sees through it."""
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    cameras = np.stack([view.intrinsics.numbers, other.intrinsics.numbers])
    _count(view.depth, other.depth, other.trust, relative, cameras, votes)


@kernel
def _count(
    depth: NDArray[np.float32],
    seen_depth: NDArray[np.float32],
    trust: NDArray[np.float32],
    relative: NDArray[np.float64],
    cameras: NDArray[np.float64],
    votes: NDArray[np.int16],
) -> None:
    """See `_vote`; relative (4, 4): other camera from this one; cameras (2, 4): fx, fy, cx, cy of both."""
    height, width = seen_depth.shape
    for row in range(votes.shape[1]):
        for column in range(votes.shape[2]):
            d = np.float64(depth[row * STRIDE, column * STRIDE])
            if d <= 0:
                continue
            x = (column * STRIDE + 0.5 - cameras[0, 2]) / cameras[0, 0] * d
            y = (row * STRIDE + 0.5 - cameras[0, 3]) / cameras[0, 1] * d
            z = relative[2, 0] * x + relative[2, 1] * y + relative[2, 2] * d + relative[2, 3]
            if z <= 0:
                continue
            u = relative[0, 0] * x + relative[0, 1] * y + relative[0, 2] * d + relative[0, 3]
            v = relative[1, 0] * x + relative[1, 1] * y + relative[1, 2] * d + relative[1, 3]
            u, v = cameras[1, 0] * u / z + cameras[1, 2], cameras[1, 1] * v / z + cameras[1, 3]
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            there = np.float64(seen_depth[int(v), int(u)])
            if there > 0 and trust[int(v), int(u)] > _TRUSTED:
                if abs(z - there) < AGREES * there:
                    votes[0, row, column] += 1
                elif z < (1 - SEES_THROUGH) * there:
                    votes[1, row, column] += 1
