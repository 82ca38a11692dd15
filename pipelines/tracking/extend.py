"""New keyframes where structure from motion has none: points from proxy depth, or triangulated from the last one."""

import numpy as np
from numpy.typing import NDArray

from ..depth.align import sample_proxy, scale_at_points
from ..geometry import se3
from ..geometry.camera import project, unproject
from ..sfm.flow import FLOW_SD, corners, follow
from ..types import Array, Intrinsics
from .pictures import Pictures
from .pnp import MIN_INLIERS, POSE_ERROR
from .state import FEATURE_SD, NO_SIGHTINGS, Sightings, TrackState

NEW_POINTS = 300
"""Points that a new keyframe should have."""
MIN_ANGLE = np.radians(1.5)
"""Rays that meet at a smaller angle say nothing of the depth."""


def promote(frame_id: int, state: TrackState, pictures: Pictures) -> int:
    """Make a posed frame a keyframe with new points; returns how many are new."""
    earlier = [k for k in state.nearest_keyframes(frame_id, 2) if state.segment[k] == state.segment[frame_id]]
    state.keyframes = sorted({*state.keyframes, frame_id})
    added = 0
    if earlier:
        added += _triangulate(earlier[0], frame_id, state, pictures)
    return added + _from_proxy(frame_id, state, pictures)


def start_segment(frame_id: int, cam_from_world: Array, state: TrackState, pictures: Pictures) -> bool:
    """A new beginning from one frame's proxy depth; False, and nothing changed, when it has too few points for that."""
    if pictures.proxy(frame_id) is None:
        return False
    before = len(state.points)
    segment = max(state.segment.values(), default=-1) + 1
    state.add_frame(frame_id, cam_from_world, NO_SIGHTINGS, True, segment)
    if _from_proxy(frame_id, state, pictures) >= MIN_INLIERS:
        return True
    state.remove_frame(frame_id)
    state.points, state.colors = state.points[:before], state.colors[:before]
    return False


def _from_proxy(frame_id: int, state: TrackState, pictures: Pictures) -> int:
    """Corners that are no points yet, at the proxy depth, scaled to agree with the points the frame sees."""
    maps = pictures.proxy(frame_id)
    if maps is None:
        return 0
    seen, intrinsics = state.sightings[frame_id], pictures.intrinsics
    count = max(NEW_POINTS - len(seen), 0)
    xy = corners(pictures.grey(frame_id), seen.xy, count, left_out=pictures.left_out(frame_id))
    depth, _ = sample_proxy(maps, xy, intrinsics)
    scale = scale_at_points(maps, seen.xy, state.depths(frame_id), intrinsics, MIN_INLIERS) or 1.0
    good = depth > 0
    in_cam = unproject(xy[good], depth[good] * scale, intrinsics)
    points = se3.transform(se3.inverse(state.poses[frame_id]), in_cam)
    _add(points, {frame_id: xy[good]}, state, pictures)
    return int(good.sum())


def _triangulate(first: int, second: int, state: TrackState, pictures: Pictures) -> int:
    """Corners of the first keyframe that are no points yet, followed into the second."""
    taken, intrinsics = state.sightings[first].xy, pictures.intrinsics
    grey = pictures.grey(first)
    xy = corners(grey, taken, NEW_POINTS, left_out=pictures.left_out(first))
    motion = state.poses[second] @ se3.inverse(state.poses[first])
    depth = _nearby_depth(first, xy, state)
    guess, _ = project(se3.transform(motion, unproject(xy, depth, intrinsics)), intrinsics)
    there, found = follow(grey, pictures.grey(second), xy, guess)
    found &= pictures.is_scene(second, there)
    xy, there = xy[found], there[found]
    in_first, good = triangulate(xy, there, motion, intrinsics, POSE_ERROR)
    points = se3.transform(se3.inverse(state.poses[first]), in_first[good])
    _add(points, {first: xy[good], second: there[good]}, state, pictures)
    return int(good.sum())


def _nearby_depth(frame_id: int, xy: Array, state: TrackState) -> Array:
    """(Q,) depth of the nearest known point in the image: a fair first guess."""
    seen, z = state.sightings[frame_id], state.depths(frame_id)
    ahead = z > 0
    if not ahead.any() or len(xy) == 0:
        return np.ones(len(xy))
    distance = ((xy[:, None] - seen.xy[ahead][None]) ** 2).sum(2)
    return z[ahead][distance.argmin(1)]


def triangulate(
    xy1: Array, xy2: Array, cam2_from_cam1: Array, intrinsics: Intrinsics, max_error: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Points in the first camera (Q, 3) nearest to both rays, and which (Q,) are good: in front of both cameras, rays
    at an angle of at least 1.5 degrees, and within `max_error` pixels in both images."""
    ones = np.ones(len(xy1))
    ray1 = unproject(xy1, ones, intrinsics)
    centre2 = se3.inverse(cam2_from_cam1)[:3, 3]
    ray2 = unproject(xy2, ones, intrinsics) @ cam2_from_cam1[:3, :3]
    ray1 /= np.linalg.norm(ray1, axis=1, keepdims=True)
    ray2 /= np.linalg.norm(ray2, axis=1, keepdims=True)
    cosine = (ray1 * ray2).sum(1)
    # Closest points of two lines; the denominator is the squared sine of their angle.
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along1, along2 = ray1 @ centre2, ray2 @ centre2
    t1 = (along1 - cosine * along2) / sine2
    t2 = (cosine * along1 - along2) / sine2
    points = (ray1 * t1[:, None] + centre2 + ray2 * t2[:, None]) / 2
    good = (t1 > 0) & (t2 > 0) & (np.arccos(np.clip(cosine, -1, 1)) > MIN_ANGLE)
    for motion, xy in ((np.eye(4), xy1), (cam2_from_cam1, xy2)):
        seen, _ = project(se3.transform(motion, points), intrinsics)
        good &= np.nan_to_num(np.linalg.norm(seen - xy, axis=1), nan=np.inf) < max_error
    return points, good


def _add(points: Array, seen_at: dict[int, Array], state: TrackState, pictures: Pictures) -> None:
    """New points (Q, 3) with the pixels (Q, 2) at which keyframes see them: the first, of which the colours are, found
    them, and they were followed into the others."""
    first, xy = next(iter(seen_at.items()))
    colors = pictures.color(first)[xy[:, 1].astype(int), xy[:, 0].astype(int)]
    index = state.add_points(points, colors)
    for frame_id, pixels in seen_at.items():
        is_first = frame_id == first
        extra = Sightings.of(index, pixels, FEATURE_SD if is_first else FLOW_SD, -1 if is_first else first)
        state.sightings[frame_id] = state.sightings[frame_id].joined(extra)
