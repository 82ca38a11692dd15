"""Orientation cues for class names: floors and ceilings are horizontal, walls vertical."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.room_layout import FLOOR, Gravity
from ..geometry.voxels import Voxels

_LYING = frozenset({"floor", "rug", "carpet", "floor mat", "earth", "road", "sidewalk", "grass", "field", "path"})
_OVERHEAD = frozenset({"ceiling"})
_STANDING = frozenset(
    {"wall", "building", "house", "door", "window", "windowpane", "picture", "painting", "poster", "mirror", "curtain"}
    | {"blind", "blinds", "whiteboard"}
)
_LIES, _STANDS = np.cos(np.radians(45)), np.cos(np.radians(35))
_ON_FLOOR = 0.25
"""Up to this share of the cameras' height over the floor a thing may be above it and still count as lying on it."""
_AGAINST = float(np.exp(-2.0))
"""Probability left to a name that the geometry contradicts: normals of stereo depth err too. Factors e^-2 and e^-4 did
equally well on two recordings."""


def name_likelihood(
    names: tuple[str, ...], voxels: Voxels, gravity: Gravity, kind: NDArray[np.int64], eye: float
) -> NDArray[np.float32]:
    """(V, C) factor of every name's probability: 1, or less where slope or height of the surface speak against it.

    kind (V,) is the structure of `name_structure`, `eye` the cameras' height along `gravity.up`. All 1 where no
    direction is surely up; names that mean nothing here are left alone.
    """
    factor = np.ones((len(voxels), len(names)), np.float32)
    if not gravity.is_sure:
        return factor
    upward, height = voxels.normal @ gravity.up, voxels.position @ gravity.up
    is_floor = kind == FLOOR
    floor = float(np.median(height[is_floor])) if is_floor.any() else -np.inf
    lifted = height > floor + _ON_FLOOR * (eye - floor) if is_floor.any() else np.zeros(len(voxels), bool)
    lying = np.array([n.lower() in _LYING for n in names])
    against = {
        "lying": (upward < _LIES) | lifted,
        "overhead": (upward > -_LIES) | (height < eye),
        "standing": np.abs(upward) > _STANDS,
    }
    for kinds, members in (("lying", _LYING), ("overhead", _OVERHEAD), ("standing", _STANDING)):
        named = np.array([n.lower() in members for n in names])
        factor[np.ix_(against[kinds], named)] *= _AGAINST
    factor[np.ix_(is_floor, ~lying)] *= _AGAINST
    return factor
