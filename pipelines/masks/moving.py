"""Detection of moving things without any network: the other keyframes see the background behind them.

Depth and poses carry the surfaces of other keyframes into each one. Where several of them say what should be seen and
the image shows another colour, something was there that was gone for them. A thing of the scene is there for the
others too and explains itself, and a surface of one colour gives no evidence. A thing close to the camera may
lie outside what the others see: at first only those accuse that have its place in sight. RobustNeRF (Sabour et al.,
CVPR 2023) too leaves out what the rest of the views does not agree on, there while a map is fitted.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project, unproject_depth
from ..system.jit import kernel
from ..system.progress import Progress
from ..types import Intrinsics
from .still import close_gaps

SIDE = 160
"""Pixels along the long side; all numbers below were chosen with it, on a woman pasted into the keyframes of one room
(36 and 37), and on five recordings of rooms where nothing moves, in which nothing is found."""
_WITNESSES = 12
_FAR = 1.3
"""Keyframes farther apart (distance over median depth, plus two for a radian) see little of each other."""
_UNLIKE, _LIKE = 12.0, 7.2
"""Difference in CIE Lab (lightness counts 0.6) from and up to which a colour is another and the same."""
_MIN_WITNESSES = 3
"""Witnesses against a pixel."""
_SURE_COUNT = 200
"""Pixels needed to estimate how much brighter one image is than another."""
_KEPT = 128
"""Views that are kept in memory."""


@dataclass(frozen=True)
class Rules:
    """Depth of what confidence may accuse; over what gap (share of the longer side) pieces are one thing; whether a
    witness must have the place in sight at which the accused pixel's own depth puts it."""

    confidence: float
    gap: float
    in_sight: bool


_FIRST, _AGAIN = Rules(0.42, 0.03, True), Rules(0.24, 0.04, False)
"""Depth that may be off by more than 2.5 % (the first): a guess that is wrong in most views accuses a whole cupboard.
Once something is found in an image, less will do for the rest of it (7 %)."""
_ROUNDS = 3
_MIN_SHARE = 0.006
"""Of the image: the evidence in a thing; and of the thing itself:"""
_DENSE = 0.5
_RIM = 5


@dataclass(frozen=True)
class MovingView:
    """A keyframe of `SIDE` pixels: depth (h, w), 0 = unknown, confidence (h, w), CIE Lab (h, w, 3), and where from."""

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    lab: NDArray[np.float32]
    cam_from_world: NDArray[np.float64]


def find_moving(
    poses: NDArray[np.float64],
    load: Callable[[int], MovingView],
    camera: Intrinsics,
    progress: Progress,
    first: dict[int, NDArray[np.bool_]],
) -> dict[int, NDArray[np.bool_]]:
    """Find what moved: index of a keyframe → (h, w), for those with any.

    A second and third round let what was found before speak neither for nor against.

    Args:
        poses: (N, 4, 4) cam_from_world of the keyframes.
        load: loads the view of a keyframe by its index.
        camera: intrinsics at the size of the views.
        progress: shows the rounds.
        first: what `find_moving_once` at all keyframes has found.
    """
    found = first
    for _ in range(_ROUNDS - 1 if found else 0):
        found = {**found, **find_moving_once(sorted(found), poses, load, camera, progress, found, _AGAIN)}
    return found


def find_moving_once(
    asked: Sequence[int],
    poses: NDArray[np.float64],
    load: Callable[[int], MovingView],
    camera: Intrinsics,
    progress: Progress,
    before: Mapping[int, NDArray[np.bool_]] = MappingProxyType({}),
    rules: Rules = _FIRST,
) -> dict[int, NDArray[np.bool_]]:
    """Do one round of `find_moving` over some of the keyframes, with what the one before has found."""
    view, found = lru_cache(_KEPT)(load), {}
    for k in progress.track(asked, "moving", len(asked)):
        depth = view(k).depth
        if not (depth > 0).any():
            continue
        others = _witnesses(poses, k, float(np.median(depth[depth > 0])))
        witnesses = ((view(o), before.get(o)) for o in others)
        new = _things(_evidence(view(k), witnesses, camera, rules), rules.gap, before.get(k))
        if new.any():
            found[k] = new
    return found


def _witnesses(poses: NDArray[np.float64], k: int, depth: float) -> list[int]:
    """Keyframes that look where this one does, evenly from near to far: neighbours in time show the thing too."""
    centres = -np.einsum("nij,ni->nj", poses[:, :3, :3], poses[:, :3, 3])
    turned = np.arccos(np.clip(poses[:, 2, :3] @ poses[k, 2, :3], -1, 1))
    apart = np.linalg.norm(centres - centres[k], axis=1) / depth + 2 * turned
    apart[k] = np.inf
    order = np.argsort(apart, kind="stable")[: int((apart < _FAR).sum())]
    if len(order) > _WITNESSES:
        order = order[np.unique(np.linspace(1, len(order) - 1, _WITNESSES).round().astype(np.int64))]
    return [int(i) for i in order]


def _evidence(
    view: MovingView, witnesses: Iterator[tuple[MovingView, NDArray[np.bool_] | None]], camera: Intrinsics, rules: Rules
) -> NDArray[np.bool_]:
    """(h, w) where more witnesses, each with what of it moved, expect another colour than expect this one."""
    weight = np.array([0.6, 1, 1], np.float32)
    own, votes = np.ascontiguousarray(view.lab * weight), np.zeros((2, *view.depth.shape), np.int64)
    lens = camera.numbers
    for other, moved in witnesses:
        view_from_other = view.cam_from_world @ np.linalg.inv(other.cam_from_world)
        depth = other.depth if moved is None else np.where(moved, np.float32(0), other.depth)
        source = _nearest(np.ascontiguousarray(depth), view_from_other, lens)
        expected = np.ascontiguousarray((other.lab * weight).reshape(-1, 3)[source])
        confidence = np.where(source >= 0, other.confidence.ravel()[source], np.float32(0))
        sure = confidence > 0.5
        if sure.sum() > _SURE_COUNT:
            expected = expected + np.median((own - expected)[sure], 0)
        may_accuse = confidence > rules.confidence
        if rules.in_sight:
            may_accuse &= _in_sight(view.depth, np.linalg.inv(view_from_other), camera)
        _judge(own, expected, source >= 0, may_accuse, votes)
    against, for_it = votes
    return cv2.medianBlur(((against >= _MIN_WITNESSES) & (against > for_it)).astype(np.uint8), 3) > 0


@kernel
def _nearest(depth: NDArray, m: NDArray[np.float64], lens: NDArray[np.float64]) -> NDArray[np.int64]:
    """(h, w) the pixel of another view whose surface is nearest at each of this one's, -1: none; m: view_from_other."""
    height, width = depth.shape
    source = np.full((height, width), -1, np.int64)
    front = np.full((height, width), np.inf)
    fx, fy, cx, cy = lens
    for y in range(height):
        for x in range(width):
            if depth[y, x] <= 0:
                continue
            right, down = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            px = depth[y, x] * (m[0, 0] * right + m[0, 1] * down + m[0, 2]) + m[0, 3]
            py = depth[y, x] * (m[1, 0] * right + m[1, 1] * down + m[1, 2]) + m[1, 3]
            pz = depth[y, x] * (m[2, 0] * right + m[2, 1] * down + m[2, 2]) + m[2, 3]
            column, row = np.floor(fx * px / pz + cx), np.floor(fy * py / pz + cy)
            if pz > 0 and 0 <= column < width and 0 <= row < height and pz <= front[int(row), int(column)]:
                front[int(row), int(column)] = pz
                source[int(row), int(column)] = y * width + x
    return source


def _in_sight(
    depth: NDArray[np.float32], other_from_view: NDArray[np.float64], camera: Intrinsics
) -> NDArray[np.bool_]:
    """(h, w) whether a depth map's surface projects into another view; unknown depth may be anywhere."""
    points = unproject_depth(depth, camera) @ other_from_view[:3, :3].T + other_from_view[:3, 3]
    xy, z = project(points.reshape(-1, 3), camera)
    inside = (z > 0) & (xy >= 0).all(1) & (xy < [camera.width, camera.height]).all(1)
    return np.asarray(inside.reshape(depth.shape) | (depth <= 0))


@kernel
def _judge(
    own: NDArray, expected: NDArray, known: NDArray[np.bool_], may_accuse: NDArray[np.bool_], votes: NDArray[np.int64]
) -> None:
    """Count a witness in `votes` (2, h, w), against and for, by the least colour difference around a pixel."""
    height, width = known.shape
    for y in range(height):
        for x in range(width):
            if known[y, x]:
                least = np.inf
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        far = 0.0
                        for c in range(3):
                            far += (own[v, u, c] - expected[y, x, c]) ** 2
                        least = min(least, far)
                votes[0, y, x] += may_accuse[y, x] and least > _UNLIKE**2
                votes[1, y, x] += least < _LIKE**2


def _things(evidence: NDArray[np.bool_], gap: float, before: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """(h, w) pieces of evidence that are close together, as things with a rim; with `before` those that touch it."""
    count, piece, stats, _ = cv2.connectedComponentsWithStats(close_gaps(evidence, gap).astype(np.uint8))
    inside = np.bincount(piece.ravel(), evidence.ravel(), count)
    keep = (inside >= _MIN_SHARE * evidence.size) & (inside > _DENSE * stats[:, cv2.CC_STAT_AREA])
    if before is not None:
        keep &= np.bincount(piece.ravel(), before.ravel(), count) > 0
    keep[0] = False
    thing = cv2.dilate(keep[piece].astype(np.uint8), np.ones((_RIM, _RIM))) > 0
    return np.asarray(thing if before is None else thing | before)
