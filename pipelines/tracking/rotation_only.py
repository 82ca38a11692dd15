"""Frames that only turn: matches with a posed frame determine a rotation where they determine no depth."""

from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project, unproject
from ..geometry.se3 import best_rotation
from ..sfm.flow import corners, follow
from ..sfm.matching import match_descriptors
from ..types import Intrinsics
from .pictures import Pictures
from .pnp import MAX_GAP, MIN_INLIERS
from .state import NO_SIGHTINGS, TrackState

Array = NDArray[np.float64]

TOLERANCE = 0.01
"""Of the image's long side: within so much a rotation explains a match. A hand that turns a camera moves it, too.
This and the two below were chosen on the turn of a phone past a blank wall and on a rendered one."""
_LEAST_MATCHES, _LEAST_SHARE = 8, 0.6
"""Features that agree on a rotation before flow is asked; the share of all matches that must agree in the end."""
_TRIALS, _CORNERS = 200, 300


def set_rotation_only_poses(state: TrackState, pictures: Pictures, seed: int) -> None:
    """Pose lost frames next to posed ones by rotation alone, in place: each is put where the nearer of the posed frames
    beside its stretch does, and has no sightings. They are noted in `state.turned`, no other frame is changed. A turn
    leads panoramas away from nothing."""
    if len(state.rig) > 1:
        return
    for _, numbered in groupby(enumerate(sorted(state.lost)), lambda pair: pair[1] - pair[0]):
        lost = [frame_id for _, frame_id in numbered]
        found: dict[int, tuple[int, int, Array]] = {}
        for anchor, order in ((lost[0] - 1, lost), (lost[-1] + 1, lost[::-1])):
            if anchor in state.poses:
                for i, pose in _turns(anchor, order, state.poses[anchor], pictures, seed).items():
                    found[i] = min(found.get(i, (len(pictures.frames), 0, pose)), (abs(i - anchor), anchor, pose))
        for i, (_, anchor, pose) in found.items():
            state.add_frame(i, pose, NO_SIGHTINGS, False, state.segment[anchor])
            state.turned.append(i)


def _turns(anchor: int, ids: list[int], cam_from_world: Array, pictures: Pictures, seed: int) -> dict[int, Array]:
    """Poses of the frames `ids`, which lead away from the posed frame `anchor`, as far as rotations reach.

    Each is compared with the farthest frame back that still shows the same: that way a slow walk, which no two
    neighbours distinguish from a turn, comes to an end.
    """
    poses, reference, last = {anchor: cam_from_world}, anchor, anchor
    for i in ids:
        for before in dict.fromkeys((reference, last)):
            turned = turn_between(before, i, pictures, seed)
            if turned is not None:
                # Camera centres coincide, so that the translation turns along with the camera.
                poses[i], reference, last = turned @ poses[before], before, i
                break
        if abs(i - last) >= MAX_GAP:
            break
    return {i: pose for i, pose in poses.items() if i != anchor}


def turn_between(first: int, second: int, pictures: Pictures, seed: int) -> Array | None:
    """second_from_first (4, 4), a rotation about the camera's centre, where features agree on one and most of the
    corners that are followed from where it puts them do, too."""
    camera, ours, theirs = pictures.intrinsics, pictures.features(first), pictures.features(second)
    pairs = match_descriptors(ours.descriptors, theirs.descriptors)
    if len(pairs) < _LEAST_MATCHES:
        return None
    xy1, xy2 = ours.xy[pairs[:, 0]], theirs.xy[pairs[:, 1]]
    rotation, agree = fit_rotation(xy1, xy2, camera, np.random.default_rng([seed, first, second]))
    if agree.sum() < _LEAST_MATCHES:
        return None
    here = corners(pictures.grey(first), xy1[agree], _CORNERS, left_out=pictures.left_out(first))
    guess, _ = project(_rays(here, camera) @ rotation.T, camera)
    there, found = follow(pictures.grey(first), pictures.grey(second), here, guess)
    found &= pictures.is_scene(second, there)
    xy1, xy2 = np.concatenate([xy1, here[found]]), np.concatenate([xy2, there[found]])
    rotation, agree = _settle(rotation, xy1, xy2, camera)
    if agree.sum() < max(MIN_INLIERS, _LEAST_SHARE * len(agree)):
        return None
    motion = np.eye(4)
    motion[:3, :3] = rotation
    return motion


def fit_rotation(
    xy1: Array, xy2: Array, camera: Intrinsics, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """The rotation (3, 3) of the camera that most of the matched pixels (M, 2) obey, and which (M,): RANSAC over pairs
    of matches."""
    picked = rng.integers(0, len(xy1), (_TRIALS, 2))
    rays1, rays2 = _rays(xy1, camera), _rays(xy2, camera)
    tried = [best_rotation(rays1[p], rays2[p]) for p in picked]
    best = max(tried, key=lambda rotation: int(_agree(rotation, xy1, xy2, camera).sum()))
    return _settle(best, xy1, xy2, camera)


def _settle(rotation: Array, xy1: Array, xy2: Array, camera: Intrinsics) -> tuple[Array, NDArray[np.bool_]]:
    for _ in range(3):
        agree = _agree(rotation, xy1, xy2, camera)
        if agree.sum() >= 2:
            rotation = best_rotation(_rays(xy1[agree], camera), _rays(xy2[agree], camera))
    return rotation, _agree(rotation, xy1, xy2, camera)


def _agree(rotation: Array, xy1: Array, xy2: Array, camera: Intrinsics) -> NDArray[np.bool_]:
    seen, _ = project(_rays(xy1, camera) @ rotation.T, camera)
    tolerance = TOLERANCE * max(camera.width, camera.height)
    return np.nan_to_num(np.linalg.norm(seen - xy2, axis=1), nan=np.inf) < tolerance


def _rays(xy: Array, camera: Intrinsics) -> Array:
    rays = unproject(xy, np.ones(len(xy)), camera)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
