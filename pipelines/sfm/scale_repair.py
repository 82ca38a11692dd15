"""Repair of scale breaks in a path by its matches.

Two structures that share one keyframe may be of any size beside each other. A mapper that has given one of them a wrong
size throws away what contradicts it, the features matched on both sides, though their depths in the shared keyframe,
once from the cameras before and once from those behind it, give the scale of one side against the other.
"""

from collections.abc import Callable, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import pose_of, set_pose
from .adjust import filter_outliers, solve
from .consistency import ModelReport, judge
from .given import complete_tracks
from .matching import VerifiedPair
from .seams import MIN_POINTS, parts_of, tracks_of

_MIN_ANGLE = 0.01
"""Radians between the rays of two cameras below which they give no depth."""

Array = NDArray[np.float64]


def repair_scale_breaks(
    model: pycolmap.Reconstruction, report: ModelReport, pairs: Sequence[VerifiedPair], xy: Sequence[Array],
    total: int, reach: int, seed: int,
) -> tuple[pycolmap.Reconstruction, ModelReport]:  # fmt: skip
    """The model with both sides of its weak links at one scale, where enough matched features give it and the result
    falls into fewer parts without agreeing less; else as it is. Arguments as of `judge`, image i + 1 is keyframe i."""
    for seam in [s for s in report.seams if s.is_weak_link]:
        owner = {k: n for n, part in enumerate(report.parts) for k in part}
        if {owner[k] for k in owner if k <= seam.before} & {owner[k] for k in owner if k >= seam.after}:
            continue  # a loop holds the two sides
        for shared in sorted((seam.before, seam.after), key=_ties(model, total, reach)):
            ratio, count = scale_ratio(model, shared, pairs, xy, reach)
            if count < MIN_POINTS:
                continue
            tried = pycolmap.Reconstruction(model)
            rescale_after(tried, shared, ratio)
            filter_outliers(tried)
            complete_tracks(tried, pairs, seed)
            # What follows only takes observations away.
            if len(parts_of(tried, total, reach)) >= len(report.parts):
                continue
            solve(tried, sorted(tried.reg_image_ids()), refine_camera=False, roughly=True)
            filter_outliers(tried)
            found = judge(tried, pairs, xy, total, reach)
            if len(found.parts) < len(report.parts) and found.pairs_agreeing >= report.pairs_agreeing:
                model, report = tried, found
                break
    return model, report


def _ties(model: pycolmap.Reconstruction, total: int, reach: int) -> Callable[[int], int]:
    """Of a keyframe: points seen before it, behind it and by three or more in all, near it."""
    tracks = tracks_of(model, total)

    def ties(k: int) -> int:
        near = ([i for i in track if abs(i - k) <= reach] for track in tracks)
        return sum(len(n) > 2 and n[0] < k < n[-1] for n in near)

    return ties


def scale_ratio(
    model: pycolmap.Reconstruction, keyframe: int, pairs: Sequence[VerifiedPair], xy: Sequence[Array], reach: int
) -> tuple[float, int]:
    """Return the scale before a keyframe relative to the scale after it, as the median ratio of depths over features
    matched on both sides, and their number. Each side's depth is that of the widest angle."""
    camera, pose = model.cameras[1], pose_of(model.images[keyframe + 1])
    rays = {keyframe: _rays(camera, xy[keyframe])}
    depth, angle = np.ones((2, len(xy[keyframe]))), np.zeros((2, len(xy[keyframe])))
    for pair in pairs:
        if keyframe not in (pair.first, pair.second) or pair.second - pair.first > reach:
            continue
        other, mine = (pair.first, 1) if pair.second == keyframe else (pair.second, 0)
        if other + 1 not in model.images or not model.images[other + 1].has_pose:
            continue
        features, side = pair.matches[:, mine], 1 - mine
        motion = pose_of(model.images[other + 1]) @ np.linalg.inv(pose)
        there = _rays(camera, xy[other])[pair.matches[:, 1 - mine]]
        away, wide = _depths(motion, rays[keyframe][features], there)
        better = (away > 0) & (wide > angle[side, features])
        depth[side, features[better]], angle[side, features[better]] = away[better], wide[better]
    both = (angle > _MIN_ANGLE).all(0)
    ratio = np.log(depth[0, both] / depth[1, both])
    return (float(np.exp(np.median(ratio))), int(both.sum())) if both.any() else (1.0, 0)


def _rays(camera: pycolmap.Camera, xy: Array) -> Array:
    """(F, 3) unit vectors."""
    rays = np.column_stack([np.asarray(camera.cam_from_img(xy)), np.ones(len(xy))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _depths(second_from_first: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Along rays (M, 3) of the first camera, how far those (M, 3) of the second one meet them, and the sines (M,) of
    the angles between them."""
    turned = np.cross(second, first @ second_from_first[:3, :3].T)
    moved = np.cross(second, second_from_first[:3, 3])
    square = np.maximum((turned**2).sum(1), 1e-20)
    return -(turned * moved).sum(1) / square, np.sqrt(square)


def rescale_after(model: pycolmap.Reconstruction, keyframe: int, ratio: float) -> None:
    """Make everything after a keyframe, and the points that are seen mostly from there, larger by `ratio`, about
    the keyframe's position, in place."""
    image = keyframe + 1
    centre = model.images[image].projection_center()
    for i in model.reg_image_ids():
        if i > image:
            pose = model.images[i].cam_from_world().matrix()
            pose[:, 3] = ratio * pose[:, 3] + (ratio - 1) * pose[:, :3] @ centre
            set_pose(model, i, pose)
    for point in model.points3D.values():
        if np.mean([np.sign(e.image_id - image) for e in point.track.elements]) > 0:
            point.xyz = centre + ratio * (point.xyz - centre)
