"""The mesh with a texture painted from photographs: each texel a mean of the keyframes that see it, the best first."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ....formats.mesh import MeshArrays, TexturedMesh
from ...compute.threads import for_each
from ...geometry.camera import project
from ...geometry.posed_depth import PosedDepth
from ...outcome import Outcome
from ...system.jit import kernel
from ...system.parallel import LruSequence
from ...system.progress import Progress
from ...types import Frame, Intrinsics
from .atlas import Atlas, owners, simplified, unwrapped
from .holes import filled, normal_sums

TEXTURE_SIDE = 4096
"""A texture has at most this many pixels a side: what viewers on the web and phones take."""

AGREES = 0.03
"""Relative difference up to which the depth of a view confirms that it sees a place."""
POWER = 2.0
"""A view counts with this power of its pixels a length on the surface, times how sharp it is. The mean of many views
lies nearer to each of them than that of the best: on kitchen 24.4 dB instead of 23.5 with six views and 4."""
_FEATHER = 0.04
"""Weights fade over this part of the image's width beside its rim and beside steps of the depth."""
_BAND = 64


@dataclass(frozen=True)
class Shot:
    """A keyframe to paint from: what it sees as depth, its full camera, how sharp it is among the others (1 = as most),
    and `photo` () -> (H, W, 3) float32 0..1 without exposure."""

    depth_view: PosedDepth
    camera: Intrinsics
    sharpness: float
    photo: Callable[[], NDArray[np.float32]]


def texels_wanted(vertices: NDArray[np.float32], faces: NDArray[np.int32], shots: Sequence[Shot]) -> float:
    """Texels a unit of length at which nine of ten vertices keep the pixels of the view that sees them closest."""
    normals = vertex_normals(vertices, faces)
    density = functools.reduce(np.maximum, (_density(vertices, normals, shot)[0] for shot in shots))
    return float(np.quantile(density[density > 0], 0.9)) if (density > 0).any() else 1.0


def paint_texture(atlas: Atlas, shots: Sequence[Shot], progress: Progress) -> NDArray[np.uint8]:
    """(height, width, 3) RGB; what no view sees has its vertices' colours, what no face covers those beside it."""
    vertices, faces = atlas.mesh.vertices, atlas.mesh.faces
    normals, owner = vertex_normals(vertices, faces), owners(atlas)
    of_each = (view_weights(vertices, normals, shot) for shot in shots)
    best = np.maximum(functools.reduce(np.maximum, of_each), np.finfo(np.float32).tiny)
    total = np.zeros((atlas.height, atlas.width, 4), np.float32)
    for shot in progress.track(shots, "texture", len(shots)):
        weight = (view_weights(vertices, normals, shot) / best).astype(np.float32, copy=False)
        if weight.any():
            _add(total, owner, atlas, shot, weight[atlas.corner_vertex])
    base = (atlas.mesh.colors / np.float32(255))[atlas.corner_vertex]
    _in_bands(atlas.height, lambda a, b: _finish(total[a:b], owner[a:b], a, atlas.corners, atlas.corner_faces, base))
    return np.round(_filled(total)[..., :3].clip(0, 1) * 255).astype(np.uint8)


def vertex_normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """(V, 3) unit normals, faces weighted by their area; 0 for a vertex without faces."""
    total = normal_sums(vertices.astype(np.float64), faces)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def view_weights(vertices: NDArray[np.float32], normals: NDArray[np.float64], shot: Shot) -> NDArray[np.float32]:
    """(V,) how much a shot counts at each vertex beside others: 0 where it does not see it."""
    weights = np.zeros(len(vertices), np.float32)
    density, place = _density(vertices, normals, shot)
    seen = density > 0
    feather = _feather(shot.depth_view)[place[seen, 1], place[seen, 0]]
    weights[seen] = (shot.sharpness * density[seen]) ** POWER * feather
    return weights


def _density(
    vertices: NDArray[np.float32], normals: NDArray[np.float64], shot: Shot
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(V,) pixels a unit of length along the foreshortened direction, 0 where unseen; (V, 2) pixel of the view."""
    view, pose = shot.depth_view, shot.depth_view.cam_from_world
    in_cam = vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    xy, z = project(in_cam, view.intrinsics)
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    inside = np.all((xy >= 0) & (xy < size), axis=1)
    place = np.where(inside.reshape(-1, 1), xy, 0).astype(np.int64)
    depth, weight = view.depth[place[:, 1], place[:, 0]], view.trust[place[:, 1], place[:, 0]]
    seen = inside & (weight > 0) & (np.abs(depth - z) < AGREES * np.abs(z))
    towards = -(normals @ pose[:3, :3].T * in_cam).sum(1) / np.maximum(np.linalg.norm(in_cam, axis=1), 1e-9)
    density = shot.camera.fx * towards / np.where(seen, z, 1)
    return np.where(seen, density.clip(0), 0), place


def _feather(view: PosedDepth) -> NDArray[np.float32]:
    """(H, W) 0..1: distance from the rim of what the view sees, in units of `_FEATHER`."""
    valid = np.pad((view.trust > 0).astype(np.uint8), 1)
    away = cv2.distanceTransform(valid, cv2.DIST_L2, 3)[1:-1, 1:-1]
    return np.minimum(away / (_FEATHER * view.depth.shape[1]), 1).astype(np.float32)


def _in_bands(rows: int, task: Callable[[int, int], None]) -> None:
    for_each(lambda n: task(n * _BAND, min((n + 1) * _BAND, rows)), -(-rows // _BAND))


def _add(
    total: NDArray[np.float32], owner: NDArray[np.int32], atlas: Atlas, shot: Shot, weight: NDArray[np.float32]
) -> None:
    """Add what the shot shows at each texel, times its weight there."""
    view, k, small = shot.depth_view, shot.camera, shot.depth_view.intrinsics
    pose, photo = view.cam_from_world, np.ascontiguousarray(shot.photo(), np.float32)
    in_cam = (atlas.mesh.vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])[atlas.corner_vertex]
    camera = np.array([k.fx, k.fy, k.cx, k.cy, small.width / k.width, small.height / k.height])
    depth = np.where(view.trust > 0, view.depth, 0).astype(np.float32)

    def band(a: int, b: int) -> None:
        _sample(
            total[a:b], owner[a:b], a, atlas.corners, atlas.corner_faces, in_cam, weight, photo, depth, camera, AGREES
        )

    _in_bands(atlas.height, band)


@kernel
def _shares(x, y, corners, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric coordinates of a texel; beyond the sides, where they are negative, they go on."""
    ax, ay = corners[a, 0], corners[a, 1]
    bx, by = corners[b, 0], corners[b, 1]
    cx, cy = corners[c, 0], corners[c, 1]
    twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    second = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / twice
    third = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / twice
    return 1 - second - third, second, third


@kernel
def _sample(total, owner, top, corners, faces, in_cam, weight, photo, depth, camera, agrees):  # type: ignore[no-untyped-def]
    rows, columns = owner.shape
    height, width = photo.shape[:2]
    fx, fy, cx, cy, ratio_x, ratio_y = camera
    for row in range(rows):
        for column in range(columns):
            f = owner[row, column]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            if weight[a] + weight[b] + weight[c] <= 0:
                continue
            p, q, r = _shares(column + 0.5, row + top + 0.5, corners, a, b, c)
            share = p * weight[a] + q * weight[b] + r * weight[c]
            z = p * in_cam[a, 2] + q * in_cam[b, 2] + r * in_cam[c, 2]
            if share <= 0 or z <= 0:
                continue
            u = fx * (p * in_cam[a, 0] + q * in_cam[b, 0] + r * in_cam[c, 0]) / z + cx
            v = fy * (p * in_cam[a, 1] + q * in_cam[b, 1] + r * in_cam[c, 1]) / z + cy
            if u < 0.5 or v < 0.5 or u >= width - 0.5 or v >= height - 0.5:
                continue
            if abs(depth[int(v * ratio_y), int(u * ratio_x)] - z) >= agrees * z:
                continue
            left, above = int(u - 0.5), int(v - 0.5)
            right, below = min(left + 1, width - 1), min(above + 1, height - 1)
            s, t = u - 0.5 - left, v - 0.5 - above
            for k in range(3):
                upper = photo[above, left, k] * (1 - s) + photo[above, right, k] * s
                lower = photo[below, left, k] * (1 - s) + photo[below, right, k] * s
                total[row, column, k] += share * (upper * (1 - t) + lower * t)
            total[row, column, 3] += share


@kernel
def _finish(total, owner, top, corners, faces, base):  # type: ignore[no-untyped-def]
    """Sums become colours with weight 1; where nothing was added, those of the vertices. Texels of no face stay 0."""
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            f = owner[row, column]
            if f < 0:
                continue
            weight = total[row, column, 3]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            p, q, r = _shares(column + 0.5, row + top + 0.5, corners, a, b, c)
            for k in range(3):
                if weight > 1e-12:
                    total[row, column, k] /= weight
                else:
                    total[row, column, k] = p * base[a, k] + q * base[b, k] + r * base[c, k]
            total[row, column, 3] = 1


def _filled(total: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, 4) colours times weights: texels without weight get the mean of those near, by ever coarser images
    (pull and push), so that no viewer's filter or small image of the texture shows a seam."""
    height, width = total.shape[:2]
    if min(height, width) < 2:
        return total
    coarse = np.asarray(cv2.resize(total, (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA), np.float32)
    weight = coarse[..., 3:]
    coarse = np.where(weight > 0, coarse / np.maximum(weight, 1e-9), 0).astype(np.float32)
    fine = np.asarray(cv2.resize(_filled(coarse), (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    empty = total[..., 3] == 0
    total[empty] = fine[empty]
    return total


def make_textured(outcome: Outcome, mesh: MeshArrays, views: Sequence[PosedDepth], progress: Progress) -> TexturedMesh:
    """Close slits, keep a tenth of the mesh's vertices, and paint an image of it from the keyframes of the `views`."""
    shots = _shots(outcome, views)
    light = simplified(filled(mesh, views))
    atlas = unwrapped(light, texels_wanted(light.vertices, light.faces, shots), TEXTURE_SIDE)
    texture = paint_texture(atlas, shots, progress)
    uv = (atlas.corners / (atlas.width, atlas.height)).astype(np.float32)
    return TexturedMesh(light.vertices, light.labels, atlas.corner_vertex, uv, atlas.corner_faces, texture)


def _shots(outcome: Outcome, views: Sequence[PosedDepth]) -> Sequence[Shot]:
    frame_of = {f.id: f for f in outcome.frames}
    frames = [frame_of[int(i)] for i in outcome.trajectory.frame_ids[outcome.trajectory.is_keyframe]]
    measured = np.array([f.sharpness for f in frames])
    # Blank walls count as blurred in themselves: neighbours, which see about the same, define what is sharp there.
    usual = median_filter(measured, size=7, mode="nearest")
    sharpness = np.sqrt(np.minimum(measured / np.maximum(usual, 1e-9), 1))
    return LruSequence(
        len(frames), lambda n: _shot(outcome, frames[n], views[n], float(sharpness[n])), lambda shot: 1, 1
    )


def _shot(outcome: Outcome, frame: Frame, view: PosedDepth, sharpness: float) -> Shot:
    hidden = outcome.run.left_out(frame)
    if hidden is not None:
        size = (view.depth.shape[1], view.depth.shape[0])
        kept = cv2.resize(hidden.astype(np.uint8), size, interpolation=cv2.INTER_AREA) == 0
        view = replace(view, trust=np.where(kept, view.trust, 0).astype(np.float32))

    def photo() -> NDArray[np.float32]:
        picture = outcome.run.image(frame).astype(np.float32) / np.float32(255)
        return picture if outcome.exposure is None else outcome.exposure.remove(picture, frame.timestamp)

    return Shot(view, outcome.calibration.intrinsics, sharpness, photo)
