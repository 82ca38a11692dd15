"""Bundle adjustment with proxy depths: camera poses and points, robustly, by Levenberg-Marquardt.

An own solver, because pycolmap's Ceres interface has no residual for the depth of a point; without depths both reach
the same minimum (the tests compare them). Points are eliminated (Schur complement), so the cost grows linearly with
them; the reduced system over the cameras has a block for each pair that shares points, and is solved densely for few
cameras, sparsely for many: along a walk its cost, too, grows linearly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_matrix, csc_matrix
from scipy.sparse.linalg import splu

from ..geometry import se3
from ..geometry.camera import ONE_CAMERA, Rig, project, reduce_to_rig
from ..types import Array, Intrinsics, require_shape
from . import bundle_kernels as kernels

DENSE_CAMERAS = 250
"""Up to so many a dense factorisation of the reduced system is faster than a sparse one."""
_MIN_GAIN = 1e-5
"""An adjustment ends with a step that lowers the cost by less, relatively."""


@dataclass(frozen=True)
class Bundle:
    """Cameras, points and what ties them.

    cam_from_world (N, 4, 4), points (P, 3) in the world; observations: obs_cam (O,), obs_point (O,) indices,
    obs_xy (O, 2) pixels, obs_sd (O,) their standard deviation in pixels, obs_depth (O,) the proxy depth at that pixel
    in the world's unit (0 = none), obs_depth_sd (O,) its relative standard deviation, and obs_source (O,) the camera
    from whose observation of the same point it was followed, -1 for none. One followed is as far off as the one it
    comes from, so that its `obs_sd` is of the difference between both.
    """

    cam_from_world: Array
    points: Array
    obs_cam: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_xy: Array
    obs_sd: Array
    obs_depth: Array
    obs_depth_sd: Array
    obs_source: NDArray[np.int64]

    def __post_init__(self) -> None:
        require_shape("cam_from_world", self.cam_from_world, (None, 4, 4))
        require_shape("points", self.points, (None, 3))
        require_shape("obs_xy", self.obs_xy, (len(self.obs_cam), 2))
        for name in ("obs_point", "obs_sd", "obs_depth", "obs_depth_sd", "obs_source"):
            require_shape(name, getattr(self, name), (len(self.obs_cam),))

    def select(self, keep: NDArray) -> Bundle:
        """Only the observations of a mask or of indices (O,); cameras and points stay."""
        names = ("obs_cam", "obs_point", "obs_xy", "obs_sd", "obs_depth", "obs_depth_sd", "obs_source")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})

    def points_in_cam(self) -> Array:
        """(O, 3): every observed point in its camera."""
        motions, points = self.cam_from_world[self.obs_cam], self.points[self.obs_point]
        return np.einsum("oij,oj->oi", motions[:, :3, :3], points) + motions[:, :3, 3]

    def source_rows(self) -> NDArray[np.int64]:
        """(O,) the observation that each was followed from, -1 for none, or where that one is not there."""
        key = self.obs_point * len(self.cam_from_world) + self.obs_cam
        order = np.argsort(key, kind="stable")
        wanted = self.obs_point * len(self.cam_from_world) + self.obs_source
        rows = order[np.minimum(np.searchsorted(key, wanted, sorter=order), max(len(key) - 1, 0))]
        return np.where((self.obs_source >= 0) & (key[rows] == wanted), rows, -1)

    def reprojection_errors(self, intrinsics: Intrinsics) -> Array:
        """(O,) pixels; infinite behind the camera."""
        return reprojection_errors(self.points_in_cam(), self.obs_xy, intrinsics)

    def errors(self, intrinsics: Intrinsics) -> Array:
        """(O,) the errors that the adjustment minimises, in standard deviations: of what was followed the difference to
        where it was followed from. Infinite behind a camera."""
        off, source = _offsets(self.points_in_cam(), self.obs_xy, intrinsics), self.source_rows()
        off -= np.where(source[:, None] >= 0, off[source], 0.0)
        return np.nan_to_num(np.hypot(*off.T), nan=np.inf) / self.obs_sd


def reprojection_errors(points_in_cam: Array, xy: Array, intrinsics: Intrinsics) -> Array:
    """(O,) distances in pixels between projected points (O, 3) and pixels (O, 2); infinite behind the camera."""
    return np.nan_to_num(np.hypot(*_offsets(points_in_cam, xy, intrinsics).T), nan=np.inf)


def _offsets(points_in_cam: Array, xy: Array, intrinsics: Intrinsics) -> Array:
    """(O, 2) from pixels to the points projected, NaN behind the camera."""
    shown, z = project(points_in_cam, intrinsics)
    return np.where(z[:, None] > kernels.MIN_DEPTH, shown - xy, np.nan)


@dataclass(frozen=True)
class AdjustedBundle:
    """The adjusted bundle, in the order it was given, with the robust costs before and after."""

    bundle: Bundle
    initial_cost: float
    cost: float


def adjust_bundle(
    bundle: Bundle,
    intrinsics: Intrinsics,
    iterations: int = 20,
    width: float = 2.0,
    ids: NDArray[np.int64] | None = None,
    rig: Rig = ONE_CAMERA,
) -> AdjustedBundle:
    """Minimise reprojection and depth errors, each under Cauchy's loss of `width` standard deviations.

    The free motion of the whole is left to the damping, so poses stay near where they were. `ids` (N,): the cameras'
    frames, of which those at one place of the `rig` move together. Stops when a step hardly lowers the cost.
    """
    problem = Problem(bundle, intrinsics, width, ids, rig)
    motions, points = bundle.cam_from_world.copy(), bundle.points.copy()
    cost = initial = problem.cost(motions, points)
    damping = 1e-4
    for _ in range(iterations):
        normal = problem.linearise(motions, points)
        accepted = False
        while damping < 1e8:
            step = problem.solve((motions, points), normal, damping)
            if step is not None:
                moved, shifted = se3.exp(step[0]) @ motions, points + step[1]
                tried = problem.cost(moved, shifted)
                if tried < cost:
                    accepted = True
                    break
            damping *= 8
        if not accepted:
            break
        gain, cost, motions, points = (cost - tried) / cost, tried, moved, shifted
        damping = max(damping / 5, 1e-8)
        if gain < _MIN_GAIN:
            break
    return AdjustedBundle(replace(bundle, cam_from_world=motions, points=points), initial, cost)


class Problem:
    """The arrays of a bundle in the order the kernels want: by point, then by camera."""

    def __init__(
        self, bundle: Bundle, intrinsics: Intrinsics, width: float = 2.0,
        ids: NDArray[np.int64] | None = None, rig: Rig = ONE_CAMERA,
    ) -> None:  # fmt: skip
        order = np.lexsort((bundle.obs_cam, bundle.obs_point))
        b = bundle.select(order)
        known = b.obs_depth > 0
        log_depth = np.log(np.where(known, b.obs_depth, 1.0))
        weight = np.where(known, 1 / np.where(known, b.obs_depth_sd, 1.0), 0.0)
        self.obs_cam, self.obs_point = b.obs_cam.astype(np.int64), b.obs_point.astype(np.int64)
        places = self.obs_cam, self.obs_point, b.source_rows()
        self.data = (intrinsics.numbers, *places, b.obs_xy, 1 / b.obs_sd, log_depth, weight, width)
        self.starts = np.searchsorted(self.obs_point, np.arange(len(b.points) + 1))
        self.rows, columns = kernels.number_blocks(self.starts, self.obs_cam, len(b.cam_from_world))
        self.pairs = np.column_stack([np.repeat(np.arange(len(b.cam_from_world)), np.diff(self.rows)), columns])
        self.ids, self.rig = np.arange(len(b.cam_from_world)) if ids is None else ids, rig

    def cost(self, motions: Array, points: Array) -> float:
        return float(kernels.total_cost(motions, points, self.data))

    def linearise(self, motions: Array, points: Array) -> tuple[Array, ...]:
        return kernels.linearise(motions, points, self.data)

    def reduced(
        self, at: tuple[Array, Array], normal: tuple[Array, ...], damping: float
    ) -> tuple[Array, Array, Array]:  # fmt: skip
        """Return the system over the cameras alone: blocks (B, 6, 6) at `pairs`, the right side (6 N,), and the inverse
        blocks (P, 3, 3) of the points that were eliminated."""
        cam_block, cam_right, point_block, point_right = normal
        blocks, right = np.zeros((len(self.pairs), 6, 6)), cam_right.ravel().copy()
        diagonal = np.einsum("nii->ni", cam_block)
        own = self.rows[:-1]
        blocks[own] = cam_block
        for i in range(6):
            blocks[own, i, i] += damping * diagonal[:, i] + 1e-9
        inverse = kernels.invert_points(point_block, damping)
        index = self.rows, np.ascontiguousarray(self.pairs[:, 1])
        kernels.eliminate_points(*at, self.data, self.starts, inverse, point_right, *index, blocks, right)
        return blocks, right, inverse

    def solve(
        self, at: tuple[Array, Array], normal: tuple[Array, ...], damping: float
    ) -> tuple[Array, Array] | None:  # fmt: skip
        """Steps of cameras (N, 6) and points (P, 3) from the motions and points at which the normal equations were
        made; None where the system is not positive definite."""
        n, point_right = len(normal[0]), normal[3]
        blocks, right, inverse = self.reduced(at, normal, damping)
        pairs, turns, place = self.pairs, None, np.arange(n)
        if len(self.rig) > 1:
            blocks, pairs, right, place, turns = reduce_to_rig(blocks, pairs, right, self.ids, self.rig)
        solved = solve_blocks(blocks, pairs, right)
        if solved is None:
            return None
        cam_step = solved.reshape(-1, 6)[place]
        if turns is not None:
            cam_step = np.einsum("nij,nj->ni", turns, cam_step)
        shift = kernels.point_steps(*at, self.data, inverse, point_right, cam_step)
        return cam_step, shift


def solve_blocks(blocks: Array, pairs: NDArray[np.int64], right: Array) -> Array | None:
    """Solve the symmetric system of upper blocks (B, 6, 6) at pairs (B, 2) with the right side (6 * count,).

    Dense Cholesky for up to DENSE_CAMERAS, else sparse LU. None where it has no (positive definite) solution.
    """
    count = len(right) // 6
    if not (np.isfinite(blocks).all() and np.isfinite(right).all()):
        return None
    if count <= DENSE_CAMERAS:
        dense = np.zeros((count, 6, count, 6))
        dense[pairs[:, 0], :, pairs[:, 1], :] = blocks
        try:
            factor = cho_factor(dense.reshape(6 * count, 6 * count), lower=False)
        except LinAlgError:
            return None
        return cho_solve(factor, right)
    matrix = _symmetric(blocks, pairs, count)
    try:
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(right)
    except RuntimeError:  # exactly singular
        return None


def _symmetric(blocks: Array, pairs: NDArray[np.int64], count: int) -> csc_matrix:
    """The matrix (6 * count, 6 * count) of upper blocks and their mirror images."""
    off = np.flatnonzero(pairs[:, 0] != pairs[:, 1])
    rows, columns = (np.concatenate([pairs[:, a], pairs[off, b]]) for a, b in ((0, 1), (1, 0)))
    order = np.lexsort((columns, rows))
    values = blocks[np.concatenate([np.arange(len(pairs)), off])[order]]
    mirrored = order >= len(pairs)
    values[mirrored] = np.swapaxes(values[mirrored], 1, 2)
    starts = np.searchsorted(rows[order], np.arange(count + 1))
    by_row = bsr_matrix((values, columns[order], starts), shape=(6 * count, 6 * count)).tocsr()
    # Rows of a symmetric matrix are its columns: scipy's own conversion takes several times its memory.
    return csc_matrix((by_row.data, by_row.indices, by_row.indptr), by_row.shape)


def adjust_pose(
    cam_from_world: Array,
    points: Array,
    xy: Array,
    sd: Array,
    intrinsics: Intrinsics,
    iterations: int = 15,
    width: float = 2.0,
) -> Array:
    """Motion-only adjustment: (4, 4) pose of one camera that sees known points (Q, 3) at pixels (Q, 2) of sd (Q,)."""
    motion = np.ascontiguousarray(cam_from_world, dtype=np.float64)
    index, none = np.zeros(len(points), np.int64), np.zeros(len(points))
    places = index, np.arange(len(points)), index - 1
    data = (intrinsics.numbers, *places, np.ascontiguousarray(xy), 1 / sd, none, none, width)
    points = np.ascontiguousarray(points)
    cost, damping = kernels.total_cost(motion[None], points, data), 1e-4
    for _ in range(iterations):
        block, right = kernels.linearise_camera(motion[None], points, data)
        step = np.linalg.solve(block + np.diag(damping * np.diag(block) + 1e-9), right)
        moved = se3.exp(step) @ motion
        tried = kernels.total_cost(moved[None], points, data)
        if tried < cost:
            motion, gain, cost, damping = moved, (cost - tried) / cost, tried, damping / 5
            if gain < 1e-6:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return motion
