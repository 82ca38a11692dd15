"""A camera that looks in several directions at once: each panorama is the six sides of a cube about its centre."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import require_shape

Array = NDArray[np.float64]

LEVEL = 4
"""The first so many sides look to the horizon."""
_AHEAD = np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 1, 0]], np.float64)
_DOWN = np.array([[0, 1, 0]] * LEVEL + [[0, 0, 1], [0, 0, -1]], np.float64)
CUBE = np.stack([np.cross(_DOWN, _AHEAD), _DOWN, _AHEAD], axis=1)
"""(6, 3, 3) side_from_rig: front, right, back, left, up, down; the rig's axes are those of its front."""


@dataclass(frozen=True)
class Rig:
    """Cameras of one kind that look from one point: at each of `stations` places camera c takes frame
    c * stations + place, so that the frames of one camera follow each other.

    cam_from_rig (C, 3, 3): how each is turned. Of a single camera every frame is a place.
    """

    stations: int
    cam_from_rig: Array

    def __post_init__(self) -> None:
        require_shape("cam_from_rig", self.cam_from_rig, (None, 3, 3))

    def __len__(self) -> int:
        return len(self.cam_from_rig)

    def frames_of(self, stations: Iterable[int]) -> list[int]:
        """Return the frames of all cameras at these stations, camera by camera."""
        return [c * self.stations + s for c in range(len(self)) for s in stations]

    @property
    def motions(self) -> Array:
        """(C, 4, 4) cam_from_rig."""
        out = np.tile(np.eye(4), (len(self), 1, 1))
        out[:, :3, :3] = self.cam_from_rig
        return out


ONE_CAMERA = Rig(1 << 62, np.eye(3)[None])
"""Whatever the number of a frame, it is a place of its own."""


def rig_of(directions: int, frames: int) -> Rig:
    """Return the rig of `frames` frames in all, taken in 1 or 6 directions."""
    return Rig(frames // len(CUBE), CUBE) if directions == len(CUBE) else ONE_CAMERA


def tie_cameras(
    blocks: Array, pairs: NDArray[np.int64], right: Array, frame_ids: NDArray[np.int64], rig: Rig
) -> tuple[Array, NDArray[np.int64], Array, NDArray[np.int64], Array]:
    """The upper blocks (B, 6, 6) at pairs (B, 2) and right sides (6 N,) of N cameras as those of their S places.

    A step d of a place moves its camera c by adjoint(cam_from_rig[c]) d, which here is a turn of both halves: see
    Sola et al., A micro Lie theory for state estimation in robotics, eq. (20). Returns blocks, pairs, right sides, the
    place of each camera (N,) and the turns (N, 6, 6).
    """
    _, place = np.unique(frame_ids % rig.stations, return_inverse=True)
    turns = np.zeros((len(rig), 6, 6))
    turns[:, :3, :3] = turns[:, 3:, 3:] = rig.cam_from_rig
    turns = turns[frame_ids // rig.stations]
    moved = np.swapaxes(turns[pairs[:, 0]], 1, 2) @ blocks @ turns[pairs[:, 1]]
    first, second = place[pairs[:, 0]], place[pairs[:, 1]]
    within = (first == second) & (pairs[:, 0] != pairs[:, 1])
    moved[within] += np.swapaxes(moved[within], 1, 2)
    turned = first > second
    moved[turned] = np.swapaxes(moved[turned], 1, 2)
    of_places = np.stack([np.minimum(first, second), np.maximum(first, second)], axis=1)
    kept, row = np.unique(of_places, axis=0, return_inverse=True)
    total = np.zeros((len(kept), 6, 6))
    np.add.at(total, row.ravel(), moved)
    pull = np.zeros((int(place.max()) + 1, 6))
    np.add.at(pull, place, np.einsum("nji,nj->ni", turns, right.reshape(-1, 6)))
    return total, kept, pull.ravel(), place, turns
