"""Subpixel correspondences by pyramidal Lucas-Kanade, checked forwards and backwards.

They bridge keyframes that hold the path's size badly: one whose neighbours see nothing in common, at a door or in a
quick turn, has features that match before and behind it, but hardly one that does both: then how long the steps on both
sides are, one against the other, hangs on a few points or on none. Corners followed by optical flow need less of an
image than descriptors that are alike do.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..system.parallel import LruSequence
from ..types import Array, Features
from .matching import VerifiedPair
from .snapshots import Snapshots, features_name, pairs_name

MIN_SHARED = 100
"""Features matched on both sides below which a keyframe is a weak one. On a made-up walk, steps beyond keyframes with
15 to 45 of them change by 1 to 8 %; the weakest of six recordings have 330 and more, of two others next to none."""
_MAX_CORNERS, _DISTANCE = 1000, 3.0
"""Corners of an image, and pixels between them."""
_MIN_GUESS, _GUESS_ERROR = 8, 0.03
"""Matches for a first guess of where corners go, a homography, and their error, as a share of the longer side."""

Picture = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]
"""(H, W) grey, and what is left out of it."""

WINDOW, LEVELS = 21, 3
"""Side in pixels of the patch that is followed, and pyramid levels."""
RETURN_ERROR = 0.7
"""Pixels within which a followed point must come back."""
FLOW_SD = 0.2
"""Pixels: how exactly its motion is then known. It is 0.06 to 0.25, and the errors of one point are alike in
neighbouring frames (correlation of 0.3)."""


def follow(
    grey_from: NDArray[np.uint8],
    grey_to: NDArray[np.uint8],
    xy: Array,
    guess: Array,
    levels: int = LEVELS,
    window: int = WINDOW,
) -> tuple[Array, NDArray[np.bool_]]:
    """Track points (Q, 2) from one image into another, starting at `guess` (Q, 2); returns places (Q, 2), found (Q,).

    A point is found when tracking it back ends within RETURN_ERROR pixels of its start. Points whose guess is not
    finite or far outside the image are not found.
    """
    height, width = grey_to.shape
    found: NDArray[np.bool_] = np.asarray(np.isfinite(guess).all(1))
    found &= (np.where(np.isfinite(guess), guess, -1e9) > -window).all(1)
    found &= (np.where(np.isfinite(guess), guess, 1e9) < np.array([width, height]) + window).all(1)
    out = np.full_like(xy, np.nan)
    if not found.any():
        return out, found
    # OpenCV puts the centre of the first pixel at (0, 0).
    start = (xy[found] - 0.5).astype(np.float32)
    there, ok = _flow(grey_from, grey_to, start, (guess[found] - 0.5).astype(np.float32), levels, window)
    back, ok_back = _flow(grey_to, grey_from, there, start, levels, window)
    inside = ((there >= 0) & (there <= [width - 1, height - 1])).all(1)
    good = ok & ok_back & inside & (np.linalg.norm(back - start, axis=1) < RETURN_ERROR)
    out[found] = there.astype(np.float64) + 0.5
    found[found] = good
    return out, found


def _flow(
    grey_from: NDArray[np.uint8], grey_to: NDArray[np.uint8], xy: NDArray, guess: NDArray, levels: int, window: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003)
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        grey_from, grey_to, xy[:, None], guess[:, None].copy(), winSize=(window, window), maxLevel=levels,
        criteria=criteria, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4,
    )  # fmt: skip
    return there.reshape(-1, 2).astype(np.float32), status.reshape(-1).astype(bool)


def find_corners(
    grey: NDArray[np.uint8], taken: Array, count: int, distance: float = 10.0, left_out: NDArray[np.bool_] | None = None
) -> Array:
    """Find up to `count` new corners (Q, 2), subpixel, none within `distance` pixels of those taken (R, 2) or each
    other, and none in a mask (H, W)."""
    if count <= 0:  # OpenCV takes 0 for "as many as there are"
        return np.zeros((0, 2))
    mask = np.full(grey.shape, 255, np.uint8)
    if left_out is not None:
        mask[left_out] = 0
    for x, y in np.asarray(taken).reshape(-1, 2):
        cv2.circle(mask, (int(x), int(y)), int(distance), 0, -1)
    found = cv2.goodFeaturesToTrack(grey, count, 0.005, distance, mask=mask, blockSize=5)
    if found is None:
        return np.zeros((0, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    found = cv2.cornerSubPix(grey, found, (3, 3), (-1, -1), criteria)
    xy = found.reshape(-1, 2).astype(np.float64) + 0.5
    # Refinement may push a corner over the border.
    return xy[((xy > 0) & (xy < grey.shape[::-1])).all(1)]


def weakly_connected(pairs: Sequence[VerifiedPair], count: int, reach: int) -> list[int]:
    """Find keyframes that match both neighbours, and of whose features fewer than MIN_SHARED are matched with keyframes
    at most `reach` before as well as with such behind them."""
    before: list[list[NDArray[np.uint32]]] = [[] for _ in range(count)]
    behind: list[list[NDArray[np.uint32]]] = [[] for _ in range(count)]
    for pair in pairs:
        if pair.second - pair.first <= reach:
            behind[pair.first].append(pair.matches[:, 0])
            before[pair.second].append(pair.matches[:, 1])
    steps = {p.first for p in pairs if p.second == p.first + 1}

    def ties(k: int) -> int:
        return len(np.intersect1d(np.concatenate(before[k]), np.concatenate(behind[k])))

    return [k for k in range(1, count - 1) if {k - 1, k} <= steps and ties(k) < MIN_SHARED]


def with_bridges(
    features: LruSequence[Features],
    pairs: Sequence[VerifiedPair],
    weak: Iterable[int],
    picture: Callable[[int], Picture],
    stored: Snapshots,
) -> tuple[LruSequence[Features], list[VerifiedPair]]:
    """Run `bridged` once and keep its features in the snapshots: those of all keyframes would fill the memory."""

    def save(k: int, found: Features) -> None:
        stored.value(features_name(k), lambda: found)

    more = {
        (p.first, p.second): p
        for p in stored.value(pairs_name(0), lambda: bridged(features, pairs, weak, picture, save))
    }
    touched = {k for pair in more for k in pair}
    changed = features.changed(lambda k, f: stored.value(features_name(k), lambda: f) if k in touched else f)
    return changed, [more.get((p.first, p.second), p) for p in pairs]


def bridged(
    features: Sequence[Features],
    pairs: Sequence[VerifiedPair],
    weak: Iterable[int],
    picture: Callable[[int], Picture],
    save: Callable[[int, Features], object],
) -> list[VerifiedPair]:
    """Corners of weak keyframes (numbers k, ascending) that are found in k - 1 and k + 1 too, as features without a
    descriptor (zeros) behind the others: keyframes that have more features are saved one after the other, pairs that
    have more matches returned.

    The pairs keep their geometry: verified again with the corners, a wall that fills the view takes it over; and where
    it comes from few matches, half of the corners that are right do not obey it.
    """
    steps = {(p.first, p.second): p for p in pairs if p.second == p.first + 1}
    more: set[tuple[int, int]] = set()
    found: dict[int, Features] = {}
    for k in weak:
        for n in [n for n in found if n < k - 1]:
            save(n, found.pop(n))
        numbers, sides = (k - 1, k, k + 1), (steps[k - 1, k], steps[k, k + 1])
        around = [found[n] if n in found else features[n] for n in numbers]
        followed = _followed([picture(n) for n in numbers], around, *sides)
        rows = np.arange(len(followed[0]), dtype=np.uint32)
        for i, pair in enumerate(sides):
            new = np.stack([rows + np.uint32(len(around[i])), rows + np.uint32(len(around[i + 1]))], axis=1)
            steps[pair.first, pair.second] = replace(pair, matches=np.concatenate([pair.matches, new]))
        more |= {(k - 1, k), (k, k + 1)}
        found.update({n: _more(f, xy) for n, f, xy in zip(numbers, around, followed, strict=True)})
    for n in list(found):
        save(n, found.pop(n))
    return [steps[at] for at in sorted(more)]


def _followed(
    pictures: Sequence[Picture], features: Sequence[Features], before: VerifiedPair, behind: VerifiedPair
) -> list[Array]:
    """Pixels (Q, 2) of corners of the middle image that are found in both others, in each of the three."""
    (first, hidden_first), (middle, hidden), (last, hidden_last) = pictures
    xy = find_corners(middle, np.zeros((0, 2)), _MAX_CORNERS, _DISTANCE, hidden)
    there, seen = [], np.ones(len(xy), np.bool_)
    sides = (
        (first, hidden_first, features[0], before.matches[:, ::-1]),
        (last, hidden_last, features[2], behind.matches),
    )
    for grey, left_out, other, matches in sides:
        guess = _guess(features[1].xy[matches[:, 0]], other.xy[matches[:, 1]], xy, max(grey.shape))
        at, ok = follow(middle, grey, xy, guess)
        if left_out is not None:
            column, row = np.nan_to_num(at).astype(np.int64).T
            ok &= ~left_out[row.clip(0, grey.shape[0] - 1), column.clip(0, grey.shape[1] - 1)]
        there.append(at)
        seen &= ok
    return [there[0][seen], xy[seen], there[1][seen]]


def _guess(source: Array, target: Array, xy: Array, side: int) -> Array:
    """(Q, 2) where points are about, by the homography of most matches: what far things do, and turns."""
    nowhere = np.full_like(xy, np.nan)
    if len(source) < _MIN_GUESS:
        return nowhere
    homography, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, _GUESS_ERROR * side)
    if homography is None or len(xy) == 0:
        return nowhere
    moved = np.c_[xy, np.ones(len(xy))] @ homography.T
    return np.where(moved[:, 2:] > 0, moved[:, :2] / np.where(moved[:, 2:] > 0, moved[:, 2:], 1.0), np.nan)


def _more(features: Features, xy: Array) -> Features:
    """With points (Q, 2) behind the others: no descriptor, one pixel large, not turned."""
    keypoints = np.c_[xy, np.ones(len(xy)), np.zeros(len(xy))].astype(np.float32)
    descriptors = np.zeros((len(xy), features.descriptors.shape[1]), features.descriptors.dtype)
    return replace(
        features, keypoints=np.r_[features.keypoints, keypoints],
        descriptors=np.r_[features.descriptors, descriptors],
    )  # fmt: skip
