"""A truncated signed distance field in sparse blocks: depth images in, distances out (Curless and Levoy 1996).

The blocks of a long recording are fused region by region, each from the views that can see it: what is in memory at a
time does not grow with the recording.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...formats.splats import morton_codes
from ..geometry.camera import unproject_depth
from ..geometry.posed_depth import PosedDepth
from ..geometry.voxels import cells_of, voxel_keys
from ..system.threads import for_each, fused_kernel, get_threads
from ..types import Intrinsics

SIDE = 8
"""Voxels along the side of a block."""
CHUNK = 8
"""Blocks along the side of a chunk, of which regions are made; surfaces are extracted chunk by chunk."""
BEHIND, HINT = 3.0, 0.01
"""Truncations behind a depth that it takes for solid, and with which share of its weight: so little that what another
view sees there wins. Where views disagree by more than the truncation, the surface steps from one depth to the other
through voxels that no view sees: without these hints it has a slit along every such step."""
_AT_ONCE = 8_000
"""Blocks of a region, 4 kB each, without the layer that it shares with its neighbours."""


@dataclass(frozen=True)
class Frustum:
    """Volume that a view covers: its camera, and the largest depth that it trusts (0: none)."""

    camera: Intrinsics
    cam_from_world: NDArray[np.float64]
    far: float

    @staticmethod
    def of(view: PosedDepth) -> Frustum:
        """Make the frustum of one view."""
        return Frustum(view.intrinsics, view.cam_from_world, float(view.depth[view.trust > 0].max(initial=0)))

    def meets(self, centers: NDArray[np.floating], radius: float, beyond: float) -> NDArray[np.bool_]:
        """(M,) whether balls at `centers` (M, 3) may reach into it, or `beyond` behind the last depth."""
        x, y, z = self.cam_from_world[:3, :3] @ centers.T + self.cam_from_world[:3, 3:]
        k, meets = self.camera, (z > -radius) & (z < self.far + beyond + radius)
        for along, focal, middle, size in ((x, k.fx, k.cx, k.width), (y, k.fy, k.cy, k.height)):
            meets &= focal * along + middle * z > -radius * np.hypot(focal, middle)
            meets &= focal * along + (middle - size) * z < radius * np.hypot(focal, middle - size)
        return meets


@dataclass(frozen=True)
class Volume:
    """blocks (B, 3) int32, sorted block coordinates; distance and weight (B, SIDE, SIDE, SIDE) float32, x first.

    Voxel (i, j, k) of block b lies at (SIDE * blocks[b] + (i, j, k)) * voxel. distance is in units of the truncation,
    positive in front of the surface.
    """

    voxel: float
    blocks: NDArray[np.int32]
    distance: NDArray[np.float32]
    weight: NDArray[np.float32]


@dataclass(frozen=True)
class Grid:
    """The `blocks` (B, 3) near what `frusta`, one a view, see."""

    voxel: float
    truncation: float
    blocks: NDArray[np.int32]
    frusta: Sequence[Frustum]

    def regions(self, at_once: int = _AT_ONCE) -> Iterator[NDArray[np.int32]]:
        """(R, 3) chunks that lie together and have about so many blocks."""
        chunks, counts = np.unique(self.blocks // CHUNK, axis=0, return_counts=True)
        order = np.argsort(morton_codes(chunks - chunks.min(axis=0, initial=0)), kind="stable")
        number = (np.cumsum(counts[order]) - 1) // at_once
        for n in np.unique(number):
            yield chunks[order[number == n]]

    def blocks_of(self, chunks: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the blocks in the chunks and the layer after them, needed for the corners of the last cells."""
        wanted, home = np.sort(chunk_keys(chunks)), self.blocks // CHUNK
        first = self.blocks % CHUNK == 0
        inside = np.zeros(len(self.blocks), bool)
        for back in itertools.product((0, 1), repeat=3):
            inside |= first[:, np.flatnonzero(back)].all(1) & np.isin(chunk_keys(home - np.array(back)), wanted)
        return self.blocks[inside]

    def views_of(self, chunks: NDArray[np.int32]) -> list[int]:
        """The numbers of the views that may see anything of the chunks."""
        side = self.voxel * SIDE
        centers, radius = (chunks * CHUNK + (CHUNK + 1) / 2) * side, (CHUNK + 1) / 2 * side * 3**0.5
        return [
            n for n, f in enumerate(self.frusta) if f.far and f.meets(centers, radius, BEHIND * self.truncation).any()
        ]


Around = Callable[[float], NDArray[np.float64]]


def _nothing(_: float) -> NDArray[np.float64]:
    return np.zeros((0, 3))


def make_grid(
    views: Sequence[PosedDepth], voxel: float, truncation_voxels: float, max_blocks: int, more: Around = _nothing
) -> Grid:
    """The blocks that are needed, also for the points (N, 3) that `more` has for a truncation; the voxels grow until
    they are at most `max_blocks`."""
    frusta = [Frustum.of(view) for view in views]
    blocks = touched_blocks(views, voxel, voxel * truncation_voxels, more)
    while len(blocks) > max_blocks:
        voxel *= 1.25
        blocks = touched_blocks(views, voxel, voxel * truncation_voxels, more)
    return Grid(voxel, voxel * truncation_voxels, blocks, frusta)


def touched_blocks(
    views: Iterable[PosedDepth], voxel: float, truncation: float, more: Around = _nothing
) -> NDArray[np.int32]:
    """(B, 3) coordinates of the blocks within the truncation of a seen surface, or hinted at behind it, sorted.

    Those further than a million blocks from the origin are left out.
    """
    # One number a block: rows of three are sorted ten times as slowly. Sorted in with the others once they are as many.
    found, waiting = np.zeros(0, np.int64), [np.unique(voxel_keys(more(truncation), voxel * SIDE))]
    for view in views:
        world_from_cam = np.linalg.inv(view.cam_from_world)
        points = unproject_depth(view.depth, view.intrinsics)[::3, ::3]
        points = points[(view.trust[::3, ::3] > 0) & (view.depth[::3, ::3] > 0)]
        rays = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
        offsets = np.arange(-1, BEHIND + 0.01, 0.5)[:, None, None] * truncation
        near = ((points + offsets * rays).reshape(-1, 3)) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        waiting.append(np.unique(voxel_keys(near, voxel * SIDE)))
        if sum(map(len, waiting)) > len(found):
            found, waiting = np.unique(np.concatenate([found, *waiting])), []
    found = np.unique(np.concatenate([found, *waiting]))
    return cells_of(found[found >= 0]).astype(np.int32)


def chunk_keys(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """(N, 3) coordinates of chunks → (N,) a number for each."""
    return voxel_keys(cells.astype(np.float64), 1.0)


def fuse(grid: Grid, chunks: NDArray[np.int32], views: Iterable[PosedDepth]) -> Volume:
    """The weighted mean of the views' truncated distances in these chunks; views that see nothing of them may lack."""
    blocks, voxel, truncation = grid.blocks_of(chunks), grid.voxel, grid.truncation
    distance = np.zeros((len(blocks), SIDE, SIDE, SIDE), np.float32)
    weight = np.zeros_like(distance)
    centers, radius = (blocks + 0.5) * (voxel * SIDE), voxel * SIDE * 0.87

    def integrate(view: PosedDepth) -> None:
        rows = np.flatnonzero(Frustum.of(view).meets(centers, radius, BEHIND * truncation))
        parts, pose = np.array_split(rows, get_threads()), np.ascontiguousarray(view.cam_from_world)
        seen = view.depth, view.trust, pose, view.intrinsics.numbers
        for_each(lambda n: _integrate(parts[n], blocks, distance, weight, *seen, voxel, truncation), len(parts))

    for view in views:
        integrate(view)
    return Volume(voxel, blocks, distance, weight)


@fused_kernel
def _integrate(rows, blocks, distance, weight, depth, depth_weight, pose, camera, voxel, truncation):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    fx, fy, cx, cy = camera
    for b in rows:
        bx, by, bz = blocks[b, 0] * SIDE * voxel, blocks[b, 1] * SIDE * voxel, blocks[b, 2] * SIDE * voxel
        for i in range(SIDE):
            for j in range(SIDE):
                for k in range(SIDE):
                    x, y, w = bx + i * voxel, by + j * voxel, bz + k * voxel
                    zc = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * w + pose[2, 3]
                    if zc <= 1e-6:
                        continue
                    xc = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * w + pose[0, 3]
                    yc = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * w + pose[1, 3]
                    u, v = fx * xc / zc + cx, fy * yc / zc + cy
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    column, row = int(u), int(v)
                    d, share = depth[row, column], depth_weight[row, column]
                    if d <= 0 or share <= 0 or d - zc < -BEHIND * truncation:
                        continue
                    value = min(1.0, max(-1.0, (d - zc) / truncation))
                    if d - zc < -truncation:
                        share *= HINT
                    total = weight[b, i, j, k] + share
                    distance[b, i, j, k] += (value - distance[b, i, j, k]) * share / total
                    weight[b, i, j, k] = total
