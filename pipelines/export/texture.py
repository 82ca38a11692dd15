"""The mesh with a texture painted from photographs: each texel a mean of the keyframes that see it, the best first."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ...formats.glb import ClassMesh
from ...formats.ply import MeshArrays, normal_sums
from ..geometry.camera import resample_nearest
from ..geometry.posed_depth import PosedDepth
from ..run.outcome import Outcome
from ..system.jit import kernel
from ..system.parallel import LruSequence
from ..system.progress import Progress
from ..system.raster import draw_faces
from ..system.threads import for_each
from ..types import Frame, Intrinsics
from .light import areas

TEXTURE_SIDE = 4096
"""A texture has at most this many pixels a side: what viewers on the web and phones take."""

_SAME = 0.01
"""Relative difference up to which a texel is what a view has of the mesh in its pixel, beside the slope in a pixel."""
_HIDDEN = 0.1
"""A view does not see a place whose depth the map has in front of it by more than this part."""
POWER = 2.0
"""A view counts with this power of its pixels a length on the surface, times how sharp it is. The mean of many views
lies nearer to each of them than that of the best: on kitchen 24.4 dB instead of 23.5 with six views and 4."""
_FEATHER = 0.04
"""Weights fade over this part of the image's longer side beside its rim and beside what is hidden."""
_BAND = 64

_GUTTER = 2
"""Empty texels around a chart, beyond those that bilinear sampling reaches."""
_PART = 4000
"""Faces that are cut into charts together: the time for it grows faster than their number (11 s for the 35,000 of
whiteroom at once, 5 s in parts)."""
_FILLED = 0.7
"""The part of the square that charts of rooms fill (kitchen 0.70, whiteroom 0.75)."""


@dataclass(frozen=True)
class Atlas:
    """A mesh whose corners lie in an image too.

    corners (K, 2) float64 texels, the first texel's centre at (0.5, 0.5), and corner_vertex (K,) the vertex of each;
    corner_faces (F, 3) are the faces in corners; width and height in texels.
    """

    mesh: MeshArrays
    corners: NDArray[np.float64]
    corner_vertex: NDArray[np.int64]
    corner_faces: NDArray[np.int32]
    width: int
    height: int


@dataclass(frozen=True)
class Shot:
    """A keyframe to paint from: what it sees as depth, its full camera, how sharp it is among the others (1 = as most),
    and `photo` () -> (H, W, 3) float32 0..1 without exposure, and what of it is `hidden` (H, W), None = nothing."""

    depth_view: PosedDepth
    camera: Intrinsics
    sharpness: float
    photo: Callable[[], NDArray[np.float32]]
    hidden: NDArray[np.bool_] | None = None


def texels_wanted(vertices: NDArray[np.float32], faces: NDArray[np.int32], shots: Sequence[Shot]) -> float:
    """Texels a unit of length at which nine tenths of what is seen of the surface keep the pixels of the view that sees
    it closest."""
    total = normal_sums(vertices.astype(np.float64), faces)
    normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    seen = (_density(vertices, normals, shot) for shot in shots)
    density = functools.reduce(np.maximum, seen, np.zeros(len(vertices)))
    order = np.argsort(density)
    around = np.bincount(faces.reshape(-1), np.repeat(areas(vertices, faces), 3), len(vertices))[order]
    share = np.cumsum(np.where(density[order] > 0, around, 0))
    return float(density[order][np.searchsorted(share, 0.9 * share[-1])]) if (density > 0).any() else 1.0


def paint_texture(atlas: Atlas, shots: Sequence[Shot], progress: Progress) -> NDArray[np.uint8]:
    """(height, width, 3) RGB; a face that no view sees has its vertices' colours, a part of one those beside it."""
    owner = owners(atlas)
    total = np.zeros((atlas.height, atlas.width, 4), np.float32)
    for shot in progress.track(shots, "texture", len(shots)):
        _add(total, owner, atlas, shot)
    base, is_painted = (
        (atlas.mesh.colors / np.float32(255))[atlas.corner_vertex],
        np.zeros(len(atlas.corner_faces), bool),
    )
    is_painted[owner[(owner >= 0) & (total[..., 3] > 0)]] = True
    of_mesh = (atlas.corners, atlas.corner_faces, base, is_painted)
    _in_bands(atlas.height, lambda a, b: _finish(total[a:b], owner[a:b], a, *of_mesh))
    return np.round(_filled(total)[..., :3].clip(0, 1) * 255).astype(np.uint8)


def _density(vertices: NDArray[np.float32], normals: NDArray[np.float64], shot: Shot) -> NDArray[np.float64]:
    """(V,) pixels a unit of length along the foreshortened direction, 0 for vertices that the map hides."""
    view, pose = shot.depth_view, shot.depth_view.cam_from_world
    xy, z, inside = view.seen(vertices.astype(np.float64))
    column, row = np.where(inside.reshape(-1, 1), xy, 0).astype(np.int64).T
    seen = inside & (view.trust[row, column] > 0) & (view.depth[row, column] > (1 - _HIDDEN) * z)
    in_cam = vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    towards = -(normals @ pose[:3, :3].T * in_cam).sum(1) / np.maximum(np.linalg.norm(in_cam, axis=1), 1e-9)
    return np.where(seen, (shot.camera.fx * towards / np.where(seen, z, 1)).clip(0), 0)


def _seen(atlas: Atlas, shot: Shot) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """(H, W) of the photograph: depth of the mesh, and 0..1 how far from the rim of what shows it a pixel lies, in
    units of `_FEATHER`; (F,) the faces that show, or have a corner in common with one that does. What the map knows in
    front of the mesh hides it, but no step that the map has a few pixels beside the mesh's: painted by that, rims would
    have the colours of what is behind them."""
    view, camera, faces = shot.depth_view, shot.camera, atlas.mesh.faces
    drawn = draw_faces(atlas.mesh.vertices, faces, view.cam_from_world, camera)
    known = np.where(view.trust > 0, view.depth, np.inf).astype(np.float32)
    shows = (drawn.face >= 0) & (resample_nearest(known, camera.height, camera.width) > (1 - _HIDDEN) * drawn.depth)
    if shot.hidden is not None:
        shows &= ~shot.hidden
    touched = np.zeros(len(atlas.mesh.vertices), np.bool_)
    touched[faces[drawn.face[shows]]] = True
    away = cv2.distanceTransform(np.pad(shows.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    trust = np.minimum(away / (_FEATHER * max(camera.width, camera.height)), 1).astype(np.float32)
    return drawn.depth, trust, np.asarray(touched[faces].any(axis=1))


def _in_bands(rows: int, task: Callable[[int, int], None]) -> None:
    for_each(lambda n: task(n * _BAND, min((n + 1) * _BAND, rows)), -(-rows // _BAND))


def _add(total: NDArray[np.float32], owner: NDArray[np.int32], atlas: Atlas, shot: Shot) -> None:
    """Add what the shot shows at each texel, times its weight there."""
    pose, photo = shot.depth_view.cam_from_world, np.ascontiguousarray(shot.photo(), np.float32)
    in_cam = (atlas.mesh.vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])[atlas.corner_vertex]
    camera, (depth, trust, shows) = np.array(shot.camera.numbers, np.float64), _seen(atlas, shot)
    seen = (atlas.corners, atlas.corner_faces, in_cam, shows, photo, depth, trust, camera, shot.sharpness, POWER, _SAME)
    _in_bands(atlas.height, lambda a, b: _sample(total[a:b], owner[a:b], a, *seen))


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
def _sample(total, owner, top, corners, faces, in_cam, shows, photo, depth, trust, camera, sharpness, power, same):  # type: ignore[no-untyped-def]
    rows, columns = owner.shape
    height, width = depth.shape
    fx, fy, cx, cy = camera
    nx, ny, nz, last = 0.0, 0.0, 0.0, -1
    for row in range(rows):
        for column in range(columns):
            f = owner[row, column]
            if f < 0 or not shows[f]:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            if f != last:
                ux, uy, uz = in_cam[b, 0] - in_cam[a, 0], in_cam[b, 1] - in_cam[a, 1], in_cam[b, 2] - in_cam[a, 2]
                vx, vy, vz = in_cam[c, 0] - in_cam[a, 0], in_cam[c, 1] - in_cam[a, 1], in_cam[c, 2] - in_cam[a, 2]
                nx, ny, nz, last = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx, f
                size = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-300)
                nx, ny, nz = nx / size, ny / size, nz / size
            p, q, r = _shares(column + 0.5, row + top + 0.5, corners, a, b, c)
            x = p * in_cam[a, 0] + q * in_cam[b, 0] + r * in_cam[c, 0]
            y = p * in_cam[a, 1] + q * in_cam[b, 1] + r * in_cam[c, 1]
            z = p * in_cam[a, 2] + q * in_cam[b, 2] + r * in_cam[c, 2]
            if z <= 0:
                continue
            u, v = fx * x / z + cx, fy * y / z + cy
            if u < 0.5 or v < 0.5 or u >= width - 0.5 or v >= height - 0.5:
                continue
            along = abs(nx * x + ny * y + nz * z) / np.sqrt(x * x + y * y + z * z)
            if abs(depth[int(v), int(u)] - z) >= (same + 1 / (fx * max(along, 1e-3))) * z:
                continue
            share = trust[int(v), int(u)] * (sharpness * fx * along / z) ** power
            if share <= 0:
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
def _finish(total, owner, top, corners, faces, base, is_painted):  # type: ignore[no-untyped-def]
    """Sums become colours with weight 1; in faces to which nothing was added, those of the vertices. Others stay 0."""
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            f = owner[row, column]
            if f < 0:
                continue
            weight = total[row, column, 3]
            if weight == 0 and is_painted[f]:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            p, q, r = _shares(column + 0.5, row + top + 0.5, corners, a, b, c)
            for k in range(3):
                if weight > 0:
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


def textured(
    outcome: Outcome, mesh: MeshArrays, labels: NDArray[np.uint8], views: Sequence[PosedDepth], progress: Progress
) -> ClassMesh:
    """The mesh with the labels (F,) of its faces and a picture painted from the keyframes of the `views`."""
    shots = _shots(outcome, views)
    atlas = unwrapped(mesh, texels_wanted(mesh.vertices, mesh.faces, shots), TEXTURE_SIDE)
    texture = paint_texture(atlas, shots, progress)
    uv = (atlas.corners / (atlas.width, atlas.height)).astype(np.float32)
    return ClassMesh(mesh.vertices, mesh.colors, labels, atlas.corner_vertex, uv, atlas.corner_faces, texture)


def _shots(outcome: Outcome, views: Sequence[PosedDepth]) -> Sequence[Shot]:
    frame_of = {f.id: f for f in outcome.frames}
    frames = [frame_of[int(i)] for i in outcome.trajectory.frame_ids[outcome.trajectory.is_keyframe]]
    measured = np.array([f.sharpness for f in frames])
    # Blank walls count as blurred in themselves: neighbours, which see about the same, define what is sharp there.
    usual = median_filter(measured, size=7, mode="nearest")
    sharpness = np.sqrt(np.minimum(measured / np.maximum(usual, 1e-9), 1))
    return LruSequence(len(frames), lambda n: _shot(outcome, frames[n], views[n], float(sharpness[n])), lambda _: 1, 1)


def _shot(outcome: Outcome, frame: Frame, view: PosedDepth, sharpness: float) -> Shot:
    def photo() -> NDArray[np.float32]:
        picture = outcome.run.image(frame).astype(np.float32) / np.float32(255)
        return picture if outcome.exposure is None else outcome.exposure.remove(picture, frame.timestamp)

    return Shot(view, outcome.calibration.intrinsics, sharpness, photo, outcome.run.left_out(frame))


def unwrapped(mesh: MeshArrays, texels_per_unit: float, most: int) -> Atlas:
    """The mesh cut into charts that lie flat beside each other, in an image of at most that many texels a side."""
    import xatlas

    # xatlas takes faces for nothing whose area is below 1e-7, whatever the unit: with this one they are 1 on the whole.
    scale = np.float32(1 / np.sqrt(areas(mesh.vertices, mesh.faces).mean().clip(1e-30)))
    square = float(np.sqrt(len(mesh.faces) / _FILLED))
    packing = xatlas.PackOptions()
    packing.texels_per_unit, packing.padding = min(texels_per_unit / float(scale), 0.97 * most / square), _GUTTER
    atlas, parts = xatlas.Atlas(), _parts(mesh)
    vertices_of = [np.unique(mesh.faces[part], return_inverse=True) for part in parts]
    for used, renumbered in vertices_of:
        atlas.add_mesh(scale * mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.uint32))
    atlas.generate(pack_options=packing)
    pieces = [atlas[i] for i in range(len(parts))]
    vertex = np.concatenate([used[own] for (used, _), (own, _, _) in zip(vertices_of, pieces, strict=True)])
    firsts = np.cumsum([0, *(len(own) for own, _, _ in pieces)])
    faces = np.empty_like(mesh.faces)
    for part, first, (_, of_part, _) in zip(parts, firsts, pieces, strict=False):
        faces[part] = of_part + first
    uv = np.concatenate([of_part for _, _, of_part in pieces])
    # How well charts fill a square is known afterwards only.
    shrunk = min(most / max(atlas.width, atlas.height, 1), 1.0)
    width, height = max(int(atlas.width * shrunk), 1), max(int(atlas.height * shrunk), 1)
    corners = uv * np.array([width, height], np.float64)
    return Atlas(mesh, corners, vertex.astype(np.int64), faces, width, height)


def _parts(mesh: MeshArrays) -> list[NDArray[np.int64]]:
    """The faces (by number) in boxes of at most `_PART`, halved along their longest side."""
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    waiting, parts = [np.arange(len(mesh.faces))], []
    while waiting:
        part = waiting.pop()
        if len(part) <= _PART:
            parts.append(np.sort(part))
            continue
        along = part[np.argsort(middles[part][:, np.ptp(middles[part], axis=0).argmax()], kind="stable")]
        waiting += [along[len(part) // 2 :], along[: len(part) // 2]]
    return parts


def owners(atlas: Atlas) -> NDArray[np.int32]:
    """(height, width) the face that each texel lies in, or next to within a texel and a half; -1 = none."""
    owner = np.full((atlas.height, atlas.width), -1, np.int32)
    for reach in (0.0, 1.5):
        _own(atlas.corners, atlas.corner_faces, owner, reach)
    return owner


@kernel
def _own(corners, faces, owner, reach):  # type: ignore[no-untyped-def]
    height, width = owner.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay = corners[a, 0], corners[a, 1]
        bx, by = corners[b, 0], corners[b, 1]
        cx, cy = corners[c, 0], corners[c, 1]
        twice = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if twice == 0:
            continue
        # Distances from the sides in texels, positive inside.
        sign = 1.0 if twice > 0 else -1.0
        ab = sign / max(np.hypot(bx - ax, by - ay), 1e-9)
        bc = sign / max(np.hypot(cx - bx, cy - by), 1e-9)
        ca = sign / max(np.hypot(ax - cx, ay - cy), 1e-9)
        first_row = max(int(min(ay, by, cy) - reach), 0)
        last_row = min(int(max(ay, by, cy) + reach), height - 1)
        first_column = max(int(min(ax, bx, cx) - reach), 0)
        last_column = min(int(max(ax, bx, cx) + reach), width - 1)
        for row in range(first_row, last_row + 1):
            y = row + 0.5
            for column in range(first_column, last_column + 1):
                x = column + 0.5
                if (
                    owner[row, column] < 0
                    and ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) * ab >= -reach
                    and ((cx - bx) * (y - by) - (cy - by) * (x - bx)) * bc >= -reach
                    and ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)) * ca >= -reach
                ):
                    owner[row, column] = f
