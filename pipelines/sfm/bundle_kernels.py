"""Compiled loops of bundle adjustment: residuals, normal equations, elimination of the points.

An observation has three residuals: x and y of its reprojection in units of its standard deviation, and, where the
camera has a proxy depth there, log(z) - log(depth), likewise. Of a point that was followed from one image into another,
x and y are those of its motion between the two. A camera moves by a left twist (translation first). Loops run in the
order of the observations, in one thread: the same input gives the same bytes.

`data`, of all of them: camera (4,), obs_cam (O,), obs_point (O,), source (O,) the observation that each was followed
from (-1 for none), xy (O, 2), inverse_sd (O,), log_depth (O,), depth_weight (O,) and the width of the robust loss.
"""

import numpy as np
from numpy.typing import NDArray

from ..system.jit import kernel

_bare = kernel(_nrt=False)
"""Compiles what makes no arrays, at half of the time."""
MIN_DEPTH = 1e-6
"""Cheirality threshold in world units; observations below it get zero weight."""


@kernel(inline="always")
def _offset(motion, point, camera, xy, inverse_sd):  # type: ignore[no-untyped-def]
    """Point in the camera, and its two residuals from a pixel: no numbers unless it is before the camera."""
    x = motion[0, 0] * point[0] + motion[0, 1] * point[1] + motion[0, 2] * point[2] + motion[0, 3]
    y = motion[1, 0] * point[0] + motion[1, 1] * point[1] + motion[1, 2] * point[2] + motion[1, 3]
    z = motion[2, 0] * point[0] + motion[2, 1] * point[1] + motion[2, 2] * point[2] + motion[2, 3]
    iz = 1.0 / z
    right = (camera[0] * x * iz + camera[2] - xy[0]) * inverse_sd
    down = (camera[1] * y * iz + camera[3] - xy[1]) * inverse_sd
    return x, y, z, right, down


@_bare
def _residual(motion, point, camera, xy, inverse_sd, log_depth, depth_weight, residual, jac_cam, jac_point):  # type: ignore[no-untyped-def]
    """Fill residual (3,), its derivatives by twist (3, 6) and point (3, 3); False if behind the camera."""
    x, y, z, residual[0], residual[1] = _offset(motion, point, camera, xy, inverse_sd)
    if z <= MIN_DEPTH:
        return False
    iz = 1.0 / z
    residual[2] = (np.log(z) - log_depth) * depth_weight
    a, b = camera[0] * iz * inverse_sd, camera[1] * iz * inverse_sd
    for i in range(3):
        if i == 0:
            d0, d1, d2 = a, 0.0, -a * x * iz
        elif i == 1:
            d0, d1, d2 = 0.0, b, -b * y * iz
        else:
            d0, d1, d2 = 0.0, 0.0, depth_weight * iz
        jac_cam[i, 0], jac_cam[i, 1], jac_cam[i, 2] = d0, d1, d2
        jac_cam[i, 3] = d2 * y - d1 * z
        jac_cam[i, 4] = d0 * z - d2 * x
        jac_cam[i, 5] = d1 * x - d0 * y
        for j in range(3):
            jac_point[i, j] = d0 * motion[0, j] + d1 * motion[1, j] + d2 * motion[2, j]
    return True


def _scratch():  # type: ignore[no-untyped-def]
    """Make a row for `_observe`: residual (3,), its derivatives by the twist (3, 6), the point (3, 3) and the twist of
    the camera it was followed from (3, 6), weights (3,); then, of that camera's own residual, the point's and it."""
    return np.zeros(3), np.zeros((3, 6)), np.zeros((3, 3)), np.zeros((3, 6)), np.zeros(3), np.zeros((3, 3)), np.zeros(3)


@kernel(inline="always")
def _observe(o, motions, points, data, row):  # type: ignore[no-untyped-def]
    """Fill a row with an observation, without its weights; False if the point is behind a camera."""
    camera, obs_cam, obs_point, source, xy, inverse_sd, log_depth, depth_weight, _ = data
    residual, jac_cam, jac_point, jac_source, _, point_there, there = row
    point, s = points[obs_point[o]], source[o]
    if not _residual(
        motions[obs_cam[o]], point, camera, xy[o], inverse_sd[o], log_depth[o], depth_weight[o],
        residual, jac_cam, jac_point,
    ):  # fmt: skip
        return False
    if s < 0:
        return True
    if not _residual(
        motions[obs_cam[s]], point, camera, xy[s], inverse_sd[o], 0.0, 0.0, there, jac_source, point_there
    ):  # fmt: skip
        return False
    for i in range(2):
        residual[i] -= there[i]
        for j in range(3):
            jac_point[i, j] -= point_there[i, j]
        for j in range(6):
            jac_source[i, j] = -jac_source[i, j]
    jac_source[2, :] = 0.0
    return True


@_bare
def _cauchy(squared, width):  # type: ignore[no-untyped-def]
    """Cauchy's loss of a squared residual."""
    return width * width * np.log1p(squared / (width * width))


@_bare
def _cauchy_weight(squared, width):  # type: ignore[no-untyped-def]
    """The weight that it gives."""
    return 1.0 / (1.0 + squared / (width * width))


@_bare
def total_cost(motions, points, data):  # type: ignore[no-untyped-def]
    """Robust cost of all observations; one behind its camera costs what a residual of ten widths does."""
    camera, obs_cam, obs_point, source, xy, inverse_sd, log_depth, depth_weight, width = data
    cost = 0.0
    for o in range(len(obs_cam)):
        point, s = points[obs_point[o]], source[o]
        _, _, z, right, down = _offset(motions[obs_cam[o]], point, camera, xy[o], inverse_sd[o])
        nearest = z
        if s >= 0:
            _, _, there, right_there, down_there = _offset(motions[obs_cam[s]], point, camera, xy[s], inverse_sd[o])
            nearest, right, down = min(z, there), right - right_there, down - down_there
        if nearest <= MIN_DEPTH:
            cost += _cauchy(100.0 * width * width, width)
            continue
        seen = _cauchy(right**2 + down**2, width)
        if depth_weight[o] != 0.0:
            seen += _cauchy(((np.log(z) - log_depth[o]) * depth_weight[o]) ** 2, width)
        cost += seen
    return cost


@kernel(inline="always")
def _weighted(o, motions, points, data, row):  # type: ignore[no-untyped-def]
    """`_observe`, and the weights that the robust loss gives its residuals: all zero behind the camera."""
    residual, weight, depth_weight, width = row[0], row[4], data[7], data[8]
    weight[:] = 0.0
    if _observe(o, motions, points, data, row):
        weight[0] = _cauchy_weight(residual[0] ** 2 + residual[1] ** 2, width)
        weight[1] = weight[0]
        if depth_weight[o] != 0.0:
            weight[2] = _cauchy_weight(residual[2] ** 2, width)


@_bare
def _add_product(weight, left, right, block):  # type: ignore[no-untyped-def]
    """Add left^T W right to a block, of derivatives (3, n) and (3, m)."""
    n, m = block.shape
    for i in range(n):
        a, b, c = weight[0] * left[0, i], weight[1] * left[1, i], weight[2] * left[2, i]
        for j in range(m):
            block[i, j] += a * right[0, j] + b * right[1, j] + c * right[2, j]


@_bare
def _subtract_gradient(weight, jacobian, residual, right):  # type: ignore[no-untyped-def]
    """Subtract J^T W r from a right side (n,)."""
    a, b, c = weight[0] * residual[0], weight[1] * residual[1], weight[2] * residual[2]
    for i in range(len(right)):
        right[i] -= a * jacobian[0, i] + b * jacobian[1, i] + c * jacobian[2, i]


def linearise(motions, points, data):  # type: ignore[no-untyped-def]
    """Normal equations: camera blocks (N, 6, 6), (N, 6), point blocks (P, 3, 3), (P, 3). What mixes two of them is made
    again where it is needed: as many blocks as observations would be most of the memory."""
    n, p = len(motions), len(points)
    normal = np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros((p, 3, 3)), np.zeros((p, 3))
    _linearise(motions, points, data, _scratch(), *normal)
    return normal


@_bare
def _linearise(motions, points, data, row, cam_block, cam_right, point_block, point_right):  # type: ignore[no-untyped-def]
    obs_cam, obs_point, source = data[1], data[2], data[3]
    residual, jac_cam, jac_point, jac_source, weight = row[0], row[1], row[2], row[3], row[4]
    for o in range(len(obs_cam)):
        c, q, s = obs_cam[o], obs_point[o], source[o]
        _weighted(o, motions, points, data, row)
        _add_product(weight, jac_cam, jac_cam, cam_block[c])
        _subtract_gradient(weight, jac_cam, residual, cam_right[c])
        _add_product(weight, jac_point, jac_point, point_block[q])
        _subtract_gradient(weight, jac_point, residual, point_right[q])
        if s >= 0:
            _add_product(weight, jac_source, jac_source, cam_block[obs_cam[s]])
            _subtract_gradient(weight, jac_source, residual, cam_right[obs_cam[s]])


def linearise_camera(motion, points, data):  # type: ignore[no-untyped-def]
    """Block (6, 6) and right side (6,) of one camera (1, 4, 4) among points that stay."""
    block, right = np.zeros((6, 6)), np.zeros(6)
    _linearise_camera(motion, points, data, _scratch(), block, right)
    return block, right


@_bare
def _linearise_camera(motion, points, data, row, block, right):  # type: ignore[no-untyped-def]
    for o in range(len(data[1])):
        _weighted(o, motion, points, data, row)
        _add_product(row[4], row[1], row[1], block)
        _subtract_gradient(row[4], row[1], row[0], right)


def displacement(motions, points, camera, obs_cam, obs_point, velocity, late):  # type: ignore[no-untyped-def]
    """(O, 2) pixels by which points move on in cameras of these velocities (N, 6) in `late` (O,) seconds."""
    out = np.zeros((len(obs_cam), 2))
    _displace(motions, points, camera, obs_cam, obs_point, velocity, late, _scratch(), np.zeros(2), out)
    return out


@_bare
def _displace(motions, points, camera, obs_cam, obs_point, velocity, late, row, nowhere, out):  # type: ignore[no-untyped-def]
    residual, jac_cam, jac_point = row[0], row[1], row[2]
    for o in range(len(obs_cam)):
        c = obs_cam[o]
        if _residual(motions[c], points[obs_point[o]], camera, nowhere, 1.0, 0.0, 0.0, residual, jac_cam, jac_point):
            for i in range(2):
                for k in range(6):
                    out[o, i] += late[o] * jac_cam[i, k] * velocity[c, k]


def border(motions, points, data, moved):  # type: ignore[no-untyped-def]
    """Normal equations of one more unknown, of which a unit moves every observation by `moved` (O, 2) pixels: mixed
    with cameras (N, 6) and points (P, 3), its own, and its right side. None of the observations was followed."""
    cams, on_points = np.zeros((len(motions), 6)), np.zeros((len(points), 3))
    own, right = _add_border(motions, points, data, moved, _scratch(), cams, on_points)
    return cams, on_points, own, right


@_bare
def _add_border(motions, points, data, moved, row, cams, on_points):  # type: ignore[no-untyped-def]
    obs_cam, obs_point, inverse_sd, width = data[1], data[2], data[5], data[8]
    residual, jac_cam, jac_point = row[0], row[1], row[2]
    own, right = 0.0, 0.0
    for o in range(len(obs_cam)):
        c, q = obs_cam[o], obs_point[o]
        if not _observe(o, motions, points, data, row):
            continue
        weight = _cauchy_weight(residual[0] ** 2 + residual[1] ** 2, width)
        for i in range(2):
            step = moved[o, i] * inverse_sd[o]
            own += weight * step * step
            right -= weight * step * residual[i]
            for k in range(6):
                cams[c, k] += weight * step * jac_cam[i, k]
            for k in range(3):
                on_points[q, k] += weight * step * jac_point[i, k]
    return own, right


@kernel
def invert_points(point_block, damping):  # type: ignore[no-untyped-def]
    """Inverses (P, 3, 3) of the damped point blocks, which are symmetric and positive definite: by M = L D L^T."""
    out = np.empty_like(point_block)
    for q in range(len(point_block)):
        m, inverse, more = point_block[q], out[q], 1.0 + damping
        floor = 1e-9 * (m[0, 0] + m[1, 1] + m[2, 2]) + 1e-12
        d0 = more * m[0, 0] + floor
        l10, l20 = m[1, 0] / d0, m[2, 0] / d0
        d1 = more * m[1, 1] + floor - l10 * m[1, 0]
        l21 = (m[2, 1] - l20 * m[1, 0]) / d1
        d2 = more * m[2, 2] + floor - l20 * m[2, 0] - l21 * l21 * d1
        down = l10 * l21 - l20  # of the inverse of L, whose others are -l10 and -l21
        inverse[2, 2] = 1.0 / d2
        inverse[2, 1] = inverse[1, 2] = -l21 / d2
        inverse[2, 0] = inverse[0, 2] = down / d2
        inverse[1, 1] = 1.0 / d1 + l21 * l21 / d2
        inverse[1, 0] = inverse[0, 1] = -l10 / d1 - l21 * down / d2
        inverse[0, 0] = 1.0 / d0 + l10 * l10 / d1 + down * down / d2
    return out


def number_blocks(
    starts: NDArray[np.int64], obs_cam: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs a <= b of cameras that share a point, row by row: those of camera a have the numbers from
    rows[a] to rows[a + 1] (N + 1,), their second cameras, ascending, are columns (B,).

    Sorting is left to numpy: numba takes ten seconds to compile a sort.
    """
    ends = np.repeat(starts[1:], np.diff(starts))
    order = np.argsort(obs_cam, kind="stable")
    rows, columns = np.zeros(count + 1, np.int64), np.empty(16 * count, np.int64)
    seen, place = np.full(count, -1, np.int64), 0
    for a in range(count):
        if rows[a] + count > len(columns):
            columns = np.concatenate((columns, np.empty(len(columns) + count, np.int64)))
        place, rows[a + 1] = _list_partners(a, order, place, ends, obs_cam, seen, columns, rows[a])
        columns[rows[a] : rows[a + 1]].sort()
    return rows, columns[: rows[count]].copy()


@kernel
def _list_partners(a, order, place, ends, obs_cam, seen, columns, used):  # type: ignore[no-untyped-def]
    """List camera a and those that share a point with it in `columns`, from `used` on; return the next places."""
    columns[used], seen[a] = a, a
    used += 1
    while place < len(order) and obs_cam[order[place]] == a:
        o = order[place]
        for other in range(o + 1, ends[o]):
            b = obs_cam[other]
            if seen[b] != a:
                columns[used], seen[b] = b, a
                used += 1
        place += 1
    return place, used


@_bare
def _block_of(a, b, rows, columns):  # type: ignore[no-untyped-def]
    """Number of the block of cameras a <= b."""
    number = rows[a]
    while columns[number] < b:
        number += 1
    return number


def eliminate_points(  # type: ignore[no-untyped-def]
    motions, points, data, starts, inverse_block, point_right, rows, columns, blocks, right
):  # fmt: skip
    """Complete the blocks (B, 6, 6) of the reduced camera system and its right side (6N,): what mixes a followed
    observation's two cameras is added, and the points' share subtracted.

    Observations are sorted by point, then camera; starts (P + 1,) are their ranges; `rows` and `columns` as of
    `number_blocks`.
    """
    mixed = np.empty((int(np.diff(starts).max(initial=0)), 6, 3))
    _eliminate(
        motions, points, data, starts, inverse_block, point_right, rows, columns, blocks, right, _scratch(),
        np.empty((6, 3)), mixed,
    )  # fmt: skip


@_bare
def _eliminate(  # type: ignore[no-untyped-def]
    motions, points, data, starts, inverse_block, point_right, rows, columns, blocks, right, row, left, mixed
):  # fmt: skip
    obs_cam, source = data[1], data[3]
    jac_cam, jac_point, jac_source, weight = row[1], row[2], row[3], row[4]
    for q in range(len(starts) - 1):
        first, count = starts[q], starts[q + 1] - starts[q]
        mixed[:count] = 0.0
        for a in range(count):
            _weighted(first + a, motions, points, data, row)
            _add_product(weight, jac_cam, jac_point, mixed[a])
            s = source[first + a]
            if s >= 0:
                _add_product(weight, jac_source, jac_point, mixed[s - first])
                if s < first + a:
                    block = blocks[_block_of(obs_cam[s], obs_cam[first + a], rows, columns)]
                    _add_product(weight, jac_source, jac_cam, block)
                else:
                    block = blocks[_block_of(obs_cam[first + a], obs_cam[s], rows, columns)]
                    _add_product(weight, jac_cam, jac_source, block)
        for a in range(count):
            cam = obs_cam[first + a]
            for i in range(6):
                total = 0.0
                for j in range(3):
                    value = 0.0
                    for k in range(3):
                        value += mixed[a, i, k] * inverse_block[q, k, j]
                    left[i, j] = value
                    total += value * point_right[q, j]
                right[6 * cam + i] -= total
            number = rows[cam]
            for b in range(a, count):
                # The cameras of a point ascend, and all are among the columns of this row.
                while columns[number] < obs_cam[first + b]:
                    number += 1
                block, twice = blocks[number], b != a and obs_cam[first + b] == cam
                for i in range(6):
                    for j in range(6):
                        share = left[i, 0] * mixed[b, j, 0] + left[i, 1] * mixed[b, j, 1] + left[i, 2] * mixed[b, j, 2]
                        block[i, j] -= share
                        if twice:  # b with a lies in the same block as a with b
                            block[j, i] -= share


def point_steps(motions, points, data, inverse_block, point_right, cam_step):  # type: ignore[no-untyped-def]
    """Back substitution: steps (P, 3) of the points for the cameras' steps (N, 6)."""
    rest, out = point_right.copy(), np.zeros_like(point_right)
    _step_points(motions, points, data, inverse_block, cam_step, _scratch(), rest, out)
    return out


@_bare
def _step_points(motions, points, data, inverse_block, cam_step, row, rest, out):  # type: ignore[no-untyped-def]
    obs_cam, obs_point, source = data[1], data[2], data[3]
    jac_cam, jac_point, jac_source, weight = row[1], row[2], row[3], row[4]
    moved = row[0]  # by the cameras' steps, instead of the residual
    for o in range(len(obs_cam)):
        c, q, s = obs_cam[o], obs_point[o], source[o]
        _weighted(o, motions, points, data, row)
        moved[:] = 0.0
        for k in range(3):
            for i in range(6):
                moved[k] += jac_cam[k, i] * cam_step[c, i]
                if s >= 0:
                    moved[k] += jac_source[k, i] * cam_step[obs_cam[s], i]
        _subtract_gradient(weight, jac_point, moved, rest[q])
    for q in range(len(rest)):
        for i in range(3):
            for j in range(3):
                out[q, i] += inverse_block[q, i, j] * rest[q, j]
