"""Ray casting against the solids of a world: compiled loops, the same bytes for any number of threads."""

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from msgs_slam.pipelines.system.jit import kernel
from tests.world.shapes import BOX, CYLINDER, FACE_COUNT, ROOM, SPHERE, Solid

TILE = 8
NOTHING = 1e30


@dataclass(frozen=True)
class SolidArrays:
    """S solids as arrays. shape, first_face (S,) int32; center, half (S, 3); turn (S, 2) = cos, sin of the yaw;
    bound (S,) radius of the enclosing sphere."""

    shape: NDArray[np.int32]
    first_face: NDArray[np.int32]
    center: NDArray[np.float64]
    half: NDArray[np.float64]
    turn: NDArray[np.float64]
    bound: NDArray[np.float64]

    @property
    def arguments(self) -> tuple[NDArray, ...]:
        """What the compiled functions take."""
        return self.shape, self.center, self.half, self.turn, self.bound


def pack_solids(solids: list[Solid]) -> SolidArrays:
    """Arrays of the solids."""
    half = np.array([s.size for s in solids], np.float64) / 2
    counts = np.array([FACE_COUNT[s.shape] for s in solids], np.int32)
    bound = np.linalg.norm(half, axis=1)
    for i, s in enumerate(solids):
        if s.shape == SPHERE:
            bound[i] = half[i, 0]
        elif s.shape == CYLINDER:
            bound[i] = np.hypot(half[i, 0], half[i, 2])
    return SolidArrays(
        shape=np.array([s.shape for s in solids], np.int32),
        first_face=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int32),
        center=np.array([s.center for s in solids], np.float64),
        half=half,
        turn=np.array([(np.cos(s.yaw), np.sin(s.yaw)) for s in solids], np.float64),
        bound=bound,
    )


@kernel(inline="always")
def _to_local(x, y, z, turn):  # type: ignore[no-untyped-def]
    return turn[0] * x + turn[1] * y, -turn[1] * x + turn[0] * y, z


@kernel
def hit_slabs(ox, oy, oz, dx, dy, dz, half, inside):  # type: ignore[no-untyped-def]
    """(t, face) where a ray enters a box, or leaves it when `inside`; local coordinates; NOTHING if it misses."""
    near, far = -NOTHING, NOTHING
    near_face, far_face = 0, 0
    for axis in range(3):
        o = ox if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        if abs(d) < 1e-12:
            if abs(o) > half[axis]:
                return NOTHING, 0
            continue
        t0, t1 = (-half[axis] - o) / d, (half[axis] - o) / d
        first, last = 2 * axis + 1, 2 * axis
        if t0 > t1:
            t0, t1 = t1, t0
            first, last = last, first
        if t0 > near:
            near, near_face = t0, first
        if t1 < far:
            far, far_face = t1, last
    if inside:
        return (far, far_face) if far > 1e-6 else (NOTHING, 0)
    if near > far or near < 1e-6:
        return NOTHING, 0
    return near, near_face


@kernel
def hit_round(ox, oy, oz, dx, dy, dz, half, is_sphere):  # type: ignore[no-untyped-def]
    """(t, face) where a ray enters a sphere or a standing cylinder (side 0, top 1, bottom 2)."""
    r = half[0]
    lift = 1.0 if is_sphere else 0.0
    a = dx * dx + dy * dy + lift * dz * dz
    b = ox * dx + oy * dy + lift * oz * dz
    c = ox * ox + oy * oy + lift * oz * oz - r * r
    discriminant = b * b - a * c
    if a > 1e-14 and discriminant > 0:
        t = (-b - np.sqrt(discriminant)) / a
        if t > 1e-6 and (is_sphere or abs(oz + t * dz) <= half[2]):
            return t, 0
    if not is_sphere and abs(dz) > 1e-12:
        t = ((half[2] if dz < 0 else -half[2]) - oz) / dz
        x, y = ox + t * dx, oy + t * dy
        if t > 1e-6 and x * x + y * y <= r * r:
            return t, 1 if dz < 0 else 2
    return NOTHING, 0


@kernel
def trace(ox, oy, oz, dx, dy, dz, chosen, count, shape, center, half, turn, bound):  # type: ignore[no-untyped-def]
    """(t, solid, face) of the nearest hit among the first `count` solids of `chosen`; solid -1 if none."""
    best, solid, side = NOTHING, -1, 0
    dd = dx * dx + dy * dy + dz * dz
    for k in range(count):
        s = chosen[k]
        x, y, z = ox - center[s, 0], oy - center[s, 1], oz - center[s, 2]
        along = x * dx + y * dy + z * dz
        outside = x * x + y * y + z * z - bound[s] * bound[s]
        if outside > 0 and (along > 0 or along * along < dd * outside):
            continue
        lx, ly, lz = _to_local(x, y, z, turn[s])
        ex, ey, ez = _to_local(dx, dy, dz, turn[s])
        if shape[s] == ROOM or shape[s] == BOX:
            t, face = hit_slabs(lx, ly, lz, ex, ey, ez, half[s], shape[s] == ROOM)
        else:
            t, face = hit_round(lx, ly, lz, ex, ey, ez, half[s], shape[s] == SPHERE)
        if t < best:
            best, solid, side = t, s, face
    return best, solid, side


@kernel
def surface(px, py, pz, s, face, shape, center, half, turn):  # type: ignore[no-untyped-def]
    """(u, v, nx, ny, nz) of world point p on a face: texture coordinates and the normal to the visible side."""
    x, y, z = _to_local(px - center[s, 0], py - center[s, 1], pz - center[s, 2], turn[s])
    qx, qy, qz = x / half[s, 0], y / half[s, 1], z / half[s, 2]
    nx, ny, nz = 0.0, 0.0, 0.0
    v = (1 - qz) / 2
    if shape[s] == SPHERE:
        u, v = np.arctan2(qy, qx) / (2 * np.pi) + 0.5, np.arccos(min(1.0, max(-1.0, qz))) / np.pi
        nx, ny, nz = qx, qy, qz
    elif shape[s] == CYLINDER:
        if face == 0:
            u = np.arctan2(qy, qx) / (2 * np.pi) + 0.5
            nx, ny = qx, qy
        else:
            u, v, nz = (1 + qx) / 2, (1 - qy) / 2, 3.0 - 2 * face
    else:
        sign = 1.0 - 2 * (face % 2)
        if face < 2:
            u, nx = (1 + sign * qy) / 2, sign
        elif face < 4:
            u, ny = (1 - sign * qx) / 2, sign
        else:
            u, v, nz = (1 + qx) / 2, (1 - sign * qy) / 2, sign
        if shape[s] == ROOM:
            u, nx, ny, nz = 1 - u, -nx, -ny, -nz
    c, w = turn[s, 0], turn[s, 1]
    return u, v, c * nx - w * ny, w * nx + c * ny, nz


@kernel
def point_on_face(u, v, s, face, shape, center, half, turn):  # type: ignore[no-untyped-def]
    """World point (x, y, z) of texture coordinates on a face: the inverse of `surface`."""
    qx, qy, qz = 0.0, 0.0, 1 - 2 * v
    if shape[s] == SPHERE or (shape[s] == CYLINDER and face == 0):
        angle = (u - 0.5) * 2 * np.pi
        ring = np.sin(v * np.pi) if shape[s] == SPHERE else 1.0
        qx, qy = ring * np.cos(angle), ring * np.sin(angle)
        if shape[s] == SPHERE:
            qz = np.cos(v * np.pi)
    elif shape[s] == CYLINDER:
        qx, qy, qz = 2 * u - 1, 1 - 2 * v, 3.0 - 2 * face
    else:
        if shape[s] == ROOM:
            u = 1 - u
        sign = 1.0 - 2 * (face % 2)
        if face < 2:
            qx, qy = sign, sign * (2 * u - 1)
        elif face < 4:
            qx, qy = -sign * (2 * u - 1), sign
        else:
            qx, qy, qz = 2 * u - 1, sign * (1 - 2 * v), sign
    x, y, z = qx * half[s, 0], qy * half[s, 1], qz * half[s, 2]
    c, w = turn[s, 0], turn[s, 1]
    return center[s, 0] + c * x - w * y, center[s, 1] + w * x + c * y, center[s, 2] + z


@kernel
def solids_in_cone(ox, oy, oz, ax, ay, az, half_angle, shape, center, bound, chosen):  # type: ignore[no-untyped-def]
    """Fill `chosen` with the solids that a cone (unit axis, half angle) may touch; returns their number."""
    count = 0
    for s in range(shape.shape[0]):
        x, y, z = center[s, 0] - ox, center[s, 1] - oy, center[s, 2] - oz
        distance = np.sqrt(x * x + y * y + z * z)
        if shape[s] != ROOM and distance > bound[s]:
            cosine = min(1.0, max(-1.0, (x * ax + y * ay + z * az) / distance))
            if np.arccos(cosine) > half_angle + np.arcsin(bound[s] / distance):
                continue
        chosen[count] = s
        count += 1
    return count


@kernel
def sample_texture(u, v, face, level, atlas, levels, out):  # type: ignore[no-untyped-def]
    """Bilinear sample of one mip level into `out` (3,), in linear light."""
    offset, h, w = levels[face, level, 0], levels[face, level, 1], levels[face, level, 2]
    x, y = min(max(u * w - 0.5, 0.0), w - 1.0), min(max(v * h - 0.5, 0.0), h - 1.0)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    fx, fy = x - x0, y - y0
    for c in range(3):
        top = atlas[offset + (y0 * w + x0) * 3 + c] * (1 - fx) + atlas[offset + (y0 * w + x1) * 3 + c] * fx
        bottom = atlas[offset + (y1 * w + x0) * 3 + c] * (1 - fx) + atlas[offset + (y1 * w + x1) * 3 + c] * fx
        code = (top * (1 - fy) + bottom * fy) / 255.0
        out[c] = code * code


@kernel
def shade(u, v, face, footprint, atlas, levels, level_count, texel, low, high, out):  # type: ignore[no-untyped-def]
    """Trilinear sample for a pixel that covers `footprint` metres of the face; `low`, `high` are scratch (3,)."""
    fine = max(0.0, min(np.log2(max(footprint / texel[face], 1e-6)), level_count[face] - 1.0))
    level = int(fine)
    sample_texture(u, v, face, level, atlas, levels, low)
    rest = fine - level
    if rest > 0:
        sample_texture(u, v, face, level + 1, atlas, levels, high)
        for c in range(3):
            low[c] += rest * (high[c] - low[c])
    for c in range(3):
        out[c] += low[c]


@kernel(parallel=True)
def render_rays(  # type: ignore[no-untyped-def]
    world_from_cam, center_xy, sub_xy, pixel, shape, center, half, turn, bound, first_face,
    atlas, levels, level_count, texel, color, depth, solid_at,
):  # fmt: skip
    """Fill color (H, W, 3) linear light, depth (H, W) z and solid_at (H, W), -1 where nothing is hit.

    center_xy (H, W, 2): normalised camera coordinates of the pixel centres; sub_xy (H, W, n, 2) those of the samples
    whose mean is the colour; `pixel`: the size of a sample at z = 1. Every pixel is computed by one thread.
    """
    height, width = depth.shape
    rows, columns = (height + TILE - 1) // TILE, (width + TILE - 1) // TILE
    r = world_from_cam
    ox, oy, oz = r[0, 3], r[1, 3], r[2, 3]
    for tile in prange(rows * columns):
        top, left = (tile // columns) * TILE, (tile % columns) * TILE
        bottom, right = min(top + TILE, height), min(left + TILE, width)
        chosen = np.empty(shape.shape[0], np.int32)
        ax, ay, az, angle = _tile_cone(r, center_xy, top, bottom - 1, left, right - 1, pixel)
        count = solids_in_cone(ox, oy, oz, ax, ay, az, angle, shape, center, bound, chosen)
        low, high, total = np.empty(3), np.empty(3), np.empty(3)
        for i in range(top, bottom):
            for j in range(left, right):
                x, y = center_xy[i, j, 0], center_xy[i, j, 1]
                dx, dy, dz = _ray(r, x, y)
                t, s, _ = trace(ox, oy, oz, dx, dy, dz, chosen, count, shape, center, half, turn, bound)
                depth[i, j] = t if s >= 0 else 0.0
                solid_at[i, j] = s
                total[:] = 0
                for k in range(sub_xy.shape[2]):
                    dx, dy, dz = _ray(r, sub_xy[i, j, k, 0], sub_xy[i, j, k, 1])
                    t, s, face = trace(ox, oy, oz, dx, dy, dz, chosen, count, shape, center, half, turn, bound)
                    if s < 0:
                        continue
                    u, v, nx, ny, nz = surface(
                        ox + t * dx, oy + t * dy, oz + t * dz, s, face, shape, center, half, turn
                    )
                    length = np.sqrt(dx * dx + dy * dy + dz * dz)
                    cosine = max(abs(nx * dx + ny * dy + nz * dz) / length, 0.08)
                    shade(
                        u, v, first_face[s] + face, t * pixel / np.sqrt(cosine),
                        atlas, levels, level_count, texel, low, high, total,
                    )  # fmt: skip
                for c in range(3):
                    color[i, j, c] = total[c] / sub_xy.shape[2]


@kernel(inline="always")
def _ray(r, x, y):  # type: ignore[no-untyped-def]
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2],
        r[1, 0] * x + r[1, 1] * y + r[1, 2],
        r[2, 0] * x + r[2, 1] * y + r[2, 2],
    )


@kernel
def _tile_cone(r, xy, top, bottom, left, right, pixel):  # type: ignore[no-untyped-def]
    """Unit axis and half angle of a cone round all rays of a tile, a pixel to spare."""
    x, y = xy[(top + bottom) // 2, (left + right) // 2, 0], xy[(top + bottom) // 2, (left + right) // 2, 1]
    widest = 0.0
    for i in (top, bottom):
        for j in (left, right):
            cross = (x * xy[i, j, 0] + y * xy[i, j, 1] + 1) / np.sqrt(
                (x * x + y * y + 1) * (xy[i, j, 0] ** 2 + xy[i, j, 1] ** 2 + 1)
            )
            widest = max(widest, np.arccos(min(1.0, cross)))
    dx, dy, dz = _ray(r, x, y)
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    return dx / length, dy / length, dz / length, widest + 3 * pixel
