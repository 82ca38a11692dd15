"""What moved while it was filmed, without any network: the other keyframes see what lies behind it.

Depth and poses carry the surfaces of other keyframes into each one. Where several of them say what should be seen and
the picture shows another colour, something stood there that was gone for them. A thing of the scene is there for the
others too and explains itself, and over a surface of one colour nobody accuses anybody. RobustNeRF (Sabour et al., CVPR
2023) too leaves out what the rest of the views does not agree on, there while a map is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.camera import project, unproject_depth
from pipelines.progress import Progress
from pipelines.types import Intrinsics

SIDE = 160
"""Pixels along the long side; all numbers below were chosen with it, on a woman pasted into 37 keyframes of one room,
and on three recordings (204 keyframes) of rooms where nothing moves, in which nothing is found."""
_WITNESSES = 12
_FAR = 1.3
"""Keyframes farther apart (distance over median depth, plus two for a radian) see little of each other."""
_UNLIKE, _LIKE = 12.0, 7.2
"""Difference in CIE Lab (lightness counts 0.6) from and up to which a colour is another and the same."""
_LEAST = 3
"""Witnesses against a pixel."""
_SURE_COUNT = 200
"""Pixels that tell how much brighter one picture is than another."""
_KEPT = 128
"""Views that are kept in memory."""


@dataclass(frozen=True)
class Rules:
    """Depth of what confidence may accuse; over what gap (share of the width) pieces are one thing."""

    confidence: float
    gap: float


_FIRST, _AGAIN = Rules(0.2, 0.03), Rules(0.1, 0.04)
"""Once something is found in a picture, less will do for the rest of it."""
_ROUNDS = 3
_LEAST_SHARE = 0.006
"""Of the picture: the evidence in a thing; and of the thing itself:"""
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
    poses: NDArray[np.float64], load: Callable[[int], MovingView], camera: Intrinsics, progress: Progress
) -> dict[int, NDArray[np.bool_]]:
    """Index of a keyframe → (h, w) what of it moved, for those with any. `camera` has the size of the views, poses
    (N, 4, 4) cam_from_world. A second and third round let what was found before speak neither for nor against."""
    view = lru_cache(_KEPT)(load)
    found: dict[int, NDArray[np.bool_]] = {}
    for number in range(_ROUNDS):
        before = dict(found)
        asked = range(len(poses)) if number == 0 else sorted(before)
        for k in progress.track(asked, "moving", len(asked)):
            depth = view(k).depth
            if not (depth > 0).any():
                continue
            others = _witnesses(poses, k, float(np.median(depth[depth > 0])))
            seen = (_carried(view(o), view(k), before.get(o), camera) for o in others)
            rules = _AGAIN if number else _FIRST
            new = _things(_evidence(view(k).lab, seen, rules.confidence), rules.gap, before.get(k))
            if new.any():
                found[k] = new
        if not found:
            break
    return found


def to_lab(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w, 3) RGB → CIE Lab."""
    return np.asarray(cv2.cvtColor((image / np.float32(255)).astype(np.float32), cv2.COLOR_RGB2LAB), np.float32)


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


def _carried(
    other: MovingView, view: MovingView, moved: NDArray[np.bool_] | None, camera: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """What the other sees, in this picture: Lab (h, w, 3) as bright as here, confidence (h, w), where at all (h, w)."""
    height, width = view.depth.shape
    view_from_other = view.cam_from_world @ np.linalg.inv(other.cam_from_world)
    points = unproject_depth(other.depth, camera).reshape(-1, 3) @ view_from_other[:3, :3].T + view_from_other[:3, 3]
    xy, z = project(points, camera)
    place = np.floor(np.nan_to_num(xy, nan=-1.0).clip(-1, max(height, width))).astype(np.int64)
    use = (other.depth.ravel() > 0) & (z > 0) & ((place >= 0) & (place < [width, height])).all(1)
    if moved is not None:
        use &= ~moved.ravel()
    which = np.flatnonzero(use)
    which = which[np.argsort(-z[which], kind="stable")]
    source = np.full((height, width), -1, np.int64)
    source[place[which, 1], place[which, 0]] = which
    known = source >= 0
    lab = other.lab.reshape(-1, 3)[source]
    confidence = np.where(known, other.confidence.ravel()[source], np.float32(0))
    sure = confidence > 0.5
    if sure.sum() > _SURE_COUNT:
        lab = lab + np.median((view.lab - lab)[sure], 0)
    return lab, confidence, known


def _evidence(
    lab: NDArray[np.float32],
    seen: Iterator[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]],
    least: float,
) -> NDArray[np.bool_]:
    """(h, w) where more witnesses say that another colour belongs there than this one."""
    against, for_it = np.zeros(lab.shape[:2], np.int64), np.zeros(lab.shape[:2], np.int64)
    for expected, confidence, known in seen:
        unlike = _difference(lab, expected)
        against += known & (confidence > least) & (unlike > _UNLIKE)
        for_it += known & (unlike < _LIKE)
    return cv2.medianBlur(((against >= _LEAST) & (against > for_it)).astype(np.uint8), 3) > 0


def _difference(lab: NDArray[np.float32], expected: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) least difference of the expected colour to those of a pixel and its neighbours."""
    height, width = lab.shape[:2]
    weight = np.array([0.6, 1, 1], np.float32)
    around = cv2.copyMakeBorder(lab * weight, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    steps = (around[y : y + height, x : x + width] - expected * weight for y in range(3) for x in range(3))
    return np.asarray(np.sqrt(np.minimum.reduce([(s**2).sum(-1) for s in steps])), np.float32)


def _things(evidence: NDArray[np.bool_], gap: float, before: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """(h, w) pieces of evidence that lie close together, as things with a rim; with `before` those that touch it."""
    reach = max(1, round(gap * evidence.shape[1]))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    around = cv2.copyMakeBorder(evidence.astype(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(around, cv2.MORPH_CLOSE, disc)[reach:-reach, reach:-reach]
    count, piece, stats, _ = cv2.connectedComponentsWithStats(np.ascontiguousarray(closed))
    inside = np.bincount(piece.ravel(), evidence.ravel(), count)
    keep = (inside >= _LEAST_SHARE * evidence.size) & (inside > _DENSE * stats[:, cv2.CC_STAT_AREA])
    if before is not None:
        keep &= np.bincount(piece.ravel(), before.ravel(), count) > 0
    keep[0] = False
    thing = cv2.dilate(keep[piece].astype(np.uint8), np.ones((_RIM, _RIM))) > 0
    return np.asarray(thing if before is None else thing | before)
