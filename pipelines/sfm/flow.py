"""Subpixel correspondences by pyramidal Lucas-Kanade, checked forwards and backwards."""

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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


def corners(
    grey: NDArray[np.uint8], taken: Array, count: int, distance: float = 10.0, left_out: NDArray[np.bool_] | None = None
) -> Array:
    """Up to `count` new corners (Q, 2), subpixel, none within `distance` pixels of those taken (R, 2) or each other,
    and none in a mask (H, W)."""
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
