"""Whether the camera moved, or only turned."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..geometry.se3 import best_rotation
from .matching import VerifiedPair

HOW_TO_FILM = (
    "Film again while walking: move the camera sideways by a tenth of the distance to what it shows, rather than "
    "turning on the spot"
)
_MOVING_FRACTION = 0.01
_TURN_ONLY_PX = 1.5
_MIN_DISPLACEMENT_PX = 10.0
_SAMPLED_PAIRS = 40
_MAX_MATCH = 0.9
_FEWEST_VIEWS = 3
_COARSE_FOCALS = np.geomspace(0.4, 4.0, 13)
_FINE_FACTORS = np.geomspace(0.85, 1.18, 9)


def require_motion(largest_displacement: float, has_detail: bool) -> None:
    """Raise InputError for a camera that does not move, displacement as a fraction of the image's width and
    height, and for images without detail."""
    if not has_detail:
        raise InputError(
            "no image shows detail that could be followed into another one: they are dark, of plain surfaces, or out "
            "of focus. Look at them; more light, or a view with furniture in it, gives detail"
        )
    if largest_displacement < _MOVING_FRACTION:
        raise InputError(
            f"there is no parallax: over the whole source the image moves by at most {largest_displacement:.2%} of "
            f"its width or height, so no depth can be found. Either the camera stands still, or the images are all the "
            f"same: look at them. {HOW_TO_FILM}"
        )


def require_parallax(
    pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]], size: tuple[int, int], focal: float | None
) -> None:
    """Raise InputError when turning on the spot explains all matches; size = (width, height).

    `focal` in pixels where it is known; else every plausible one is tried, so that no wrong guess of it can hide a
    pure rotation.
    """
    moved = [p for p in pairs if _displacement(p, xy) > _MIN_DISPLACEMENT_PX]
    if not moved:
        return
    moved = moved[:: max(1, len(moved) // _SAMPLED_PAIRS)]
    unexplained = _least_unexplained(moved, xy, size, focal)
    if unexplained < _TURN_ONLY_PX:
        raise InputError(
            f"there is no parallax: turning the camera on the spot explains all matches of {len(moved)} pairs of views "
            f"to {unexplained:.1f} px, so no depth can be found. {HOW_TO_FILM}"
        )


def why_no_structure(views: int, pairs: Sequence[VerifiedPair]) -> str:
    """Say what may be wrong where no model was found of so many views, and what the matching pairs rule out."""
    if views < _FEWEST_VIEWS:
        return (
            f"{views} images are too few: one pair of them does not tell how the camera moved and what its focal "
            f"length is. Take at least {_FEWEST_VIEWS - views} more of the same place, each a step further to the side"
        )
    matched = len({view for pair in pairs for view in (pair.first, pair.second)})
    if matched < _MAX_MATCH * views:
        return (
            f"no structure could be found among {views} views; pairs that match: {len(pairs)}. {views - matched} views "
            "match no other. Possible causes: too little overlap, plain surfaces, blur, darkness, or things that move. "
            "Film more slowly, in better light, or give images closer together"
        )
    return (
        f"no structure could be found among {views} views; pairs that match: {len(pairs)}. {matched} views match "
        "others, which rules out blur and plain surfaces. Possible causes: different lenses, zooms or crops among the "
        "images, a fisheye lens (--camera fisheye, --intrinsics), a camera that hardly moves sideways, or things that "
        "move and fill the image"
    )


def _least_unexplained(
    pairs: Sequence[VerifiedPair], xy: Sequence[NDArray[np.float64]], size: tuple[int, int], focal: float | None
) -> float:
    """Pixels that rotations leave in nine tenths of the pairs, at the best focal length.

    Nine tenths, not half: someone who turns slowly with the camera at arm's length has parallax in few pairs only.
    """

    def unexplained(f: float) -> float:
        return float(np.percentile([rotation_residual(p, xy, size, f) for p in pairs], 90))

    if focal:
        return unexplained(focal)
    coarse = _COARSE_FOCALS * max(size)
    best = coarse[int(np.argmin([unexplained(f) for f in coarse]))]
    return min(unexplained(best * factor) for factor in _FINE_FACTORS)


def rotation_residual(
    pair: VerifiedPair, xy: Sequence[NDArray[np.float64]], size: tuple[int, int], focal: float
) -> float:
    """Pixels within which four fifths of a pair's matches obey the best rotation about the camera's centre."""
    centre = np.array(size) / 2
    first = _rays(xy[pair.first][pair.matches[:, 0]] - centre, focal)
    second = _rays(xy[pair.second][pair.matches[:, 1]] - centre, focal)
    angle = np.linalg.norm(first @ best_rotation(first, second).T - second, axis=1)
    return float(np.percentile(angle, 80) * focal)


def _displacement(pair: VerifiedPair, xy: Sequence[NDArray[np.float64]]) -> float:
    moved = xy[pair.first][pair.matches[:, 0]] - xy[pair.second][pair.matches[:, 1]]
    return float(np.median(np.linalg.norm(moved, axis=1)))


def _rays(xy: NDArray[np.float64], focal: float) -> NDArray[np.float64]:
    rays = np.concatenate([xy, np.full((len(xy), 1), focal)], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
