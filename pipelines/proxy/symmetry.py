"""Mirror symmetry of the scene (MSGS-SLAM 3.1): planes that map the scene onto itself, and the pixels they pair.

Local features are matched with mirrored ones (Loy and Eklundh, ECCV 2006), but in space: two features that are each
other's mirror image, with depths, give a whole mirror plane, and the planes of a true symmetry agree over the video.
How many agree by chance is measured on the same features with the partners shuffled; a plane that does not stand out
from that is not there, and nothing is paired.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry.camera import pixel_centers, project, unproject, unproject_depth
from msgs_slam.pipelines.proxy.mirror_features import MirroredMatches, mirrored_matches
from msgs_slam.pipelines.proxy.providers import DepthEstimate
from msgs_slam.pipelines.proxy.sequence import Sequence
from msgs_slam.pipelines.system.progress import Progress
from msgs_slam.pipelines.types import Features, Frame, Intrinsics, MirrorPairs

Array = NDArray[np.float64]

_LOOKED_AT = 40
_LEAST_CONFIDENCE = 0.3
_APART = 0.1
"""Partners are this part of their depth apart at least: nearer ones fit any plane between them."""
_TOLERANCE = 0.02
"""How near a mirrored point must come to its partner, as a part of the depth."""
_MOST_PAIRS = 3000
_MOST_PLANES = 3
_LEAST_PLACES = 12
_OVER_CHANCE = 3.0
_SHUFFLES = 3
_STRIDE = 6
_LEAST_PAIR = 0.25


@dataclass(frozen=True)
class MirrorPlane:
    """n · X + d = 0 in the backbone's world: normal (3,), offset; `places` distinct pairs of places agree on it, by
    chance it would be `by_chance`."""

    normal: Array
    offset: float
    places: int
    by_chance: int

    @property
    def confidence(self) -> float:
        """In (0, 1): the share of the agreement that is not chance."""
        return 1 - self.by_chance / self.places if self.places else 0.0

    def in_cam(self, cam_from_world: Array) -> Array:
        """(4,) normal and offset in a camera."""
        normal = cam_from_world[:3, :3] @ self.normal
        return np.append(normal, self.offset - normal @ cam_from_world[:3, 3])


def find_mirror_planes(
    sequence: Sequence,
    frames: list[Frame],
    depth_of: Callable[[Frame], DepthEstimate],
    features_of: Callable[[Frame], Features],
    progress: Progress,
) -> list[MirrorPlane]:
    """The scene's mirror planes, the best supported first; [] where there is none.

    `depth_of` gives depths in the backbone's unit, `features_of` features at map size; frames without a pose are passed
    over.
    """
    posed = [f for f in frames if f.id in sequence.cam_from_world]
    looked_at = posed[:: max(1, -(-len(posed) // _LOOKED_AT))]
    found = [
        _pairs_in_world(sequence, f, depth_of(f), mirrored_matches(features_of(f)))
        for f in progress.track(looked_at, "symmetry", len(looked_at))
    ]
    pairs = np.concatenate([np.zeros((0, 7)), *found])
    pairs = pairs[:: max(1, -(-len(pairs) // _MOST_PAIRS))]
    planes: list[MirrorPlane] = []
    while len(pairs) >= _LEAST_PLACES and len(planes) < _MOST_PLANES:
        plane, agree = _best_plane(pairs)
        if plane.places < max(_LEAST_PLACES, _OVER_CHANCE * plane.by_chance):
            break
        planes.append(plane)
        pairs = pairs[~agree]
    return planes


def _pairs_in_world(sequence: Sequence, frame: Frame, estimate: DepthEstimate, matches: MirroredMatches) -> Array:
    """(Q, 7): the two points of each mirrored match of a frame with reliable depths, and the farther depth."""
    camera = sequence.intrinsics
    column, row = _pixels(matches.xy.reshape(-1, 2), camera).T
    depth = np.where(estimate.confidence >= _LEAST_CONFIDENCE, estimate.depth, 0)[row, column].astype(np.float64)
    points = unproject(matches.xy.reshape(-1, 2), depth, camera).reshape(-1, 2, 3)
    depth = depth.reshape(-1, 2)
    apart = np.linalg.norm(points[:, 0] - points[:, 1], axis=1) > _APART * depth.max(1, initial=0)
    # Mirror images are alike in size: seen from farther they are smaller.
    size = np.abs(np.log(np.maximum(matches.size * depth, 1e-12)) @ [1, -1]) < np.log(1.35)
    keep = (depth > 0).all(1) & apart & size
    world_from_cam = np.linalg.inv(sequence.cam_from_world[frame.id])
    in_world = points[keep] @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    return np.concatenate([in_world.reshape(-1, 6), depth[keep].max(1, keepdims=True)], 1)


def _best_plane(pairs: Array) -> tuple[MirrorPlane, NDArray[np.bool_]]:
    """The plane that most distinct pairs of places agree on, and which of the pairs (Q, 7) do."""
    rng = np.random.default_rng(0)
    by_chance = 0
    for _ in range(_SHUFFLES):
        order = rng.permutation(len(pairs))
        shuffled = np.concatenate([pairs[:, :3], pairs[order, 3:6], np.maximum(pairs[:, 6:], pairs[order, 6:])], 1)
        by_chance = max(by_chance, _search(shuffled)[2])
    normal, offset, places, agree = _search(pairs)
    return MirrorPlane(normal, offset, places, by_chance), agree


def _search(pairs: Array) -> tuple[Array, float, int, NDArray[np.bool_]]:
    """(normal, offset, number of distinct places, which pairs agree) of the best plane that some pair proposes."""
    between = pairs[:, :3] - pairs[:, 3:6]
    normals = between / np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-12)
    offsets = -(normals * (pairs[:, :3] + pairs[:, 3:6]) / 2).sum(1)
    votes = np.concatenate(
        [_agreeing(pairs, normals[i : i + 128], offsets[i : i + 128]).sum(1) for i in range(0, len(pairs), 128)]
    )
    best = (normals[0], float(offsets[0]), 0, np.zeros(len(pairs), bool))
    for i in np.argsort(-votes, kind="stable")[:10]:
        normal, offset = normals[i], float(offsets[i])
        for _ in range(4):
            agree = _agreeing(pairs, normal[None], np.array([offset]))[0]
            if agree.sum() < 3:
                break
            normal, offset = _fit(pairs[agree])
        agree = _agreeing(pairs, normal[None], np.array([offset]))[0]
        places = _count_places(pairs[agree])
        if places > best[2]:
            best = (normal, offset, places, agree)
    return best


def _agreeing(pairs: Array, normals: Array, offsets: Array) -> NDArray[np.bool_]:
    """(H, Q): whether plane h maps the first point of pair q onto the second."""
    height = pairs[:, :3] @ normals.T + offsets
    gap = pairs[:, None, :3] - 2 * height[:, :, None] * normals[None] - pairs[:, None, 3:6]
    return ((gap**2).sum(-1) < (_TOLERANCE * pairs[:, 6:]) ** 2).T


def _fit(pairs: Array) -> tuple[Array, float]:
    """(normal, offset) of the plane that mirrors the pairs best."""
    between = pairs[:, :3] - pairs[:, 3:6]
    normal = np.linalg.eigh(between.T @ between)[1][:, -1]
    return normal, -float(((pairs[:, :3] + pairs[:, 3:6]) / 2 @ normal).mean())


def _count_places(pairs: Array) -> int:
    """The number of distinct pairs of places: the same one seen in ten frames is one."""
    if len(pairs) == 0:
        return 0
    cell = 3 * _TOLERANCE * float(np.median(pairs[:, 6]))
    ends = np.floor(pairs[:, :6].reshape(-1, 2, 3) / cell).astype(np.int64)
    # A pair may come either way round.
    swap = [tuple(a) > tuple(b) for a, b in ends.tolist()]
    ends[swap] = ends[swap][:, ::-1]
    return len(np.unique(ends.reshape(-1, 6), axis=0))


# pairs of pixels ------------------------------------------------------------------------------------------------


def mirror_pairs(
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    reliability: NDArray[np.float32],
    camera: Intrinsics,
    planes: list[tuple[Array, float]],
) -> MirrorPairs:
    """The pixels of one frame that show each other's mirror image, from its image (h, w, 3), depth and U (h, w).

    `planes` are (4,) normal and offset in the camera, in the unit of the depth, with their confidence. A pixel of
    reliable depth is paired with where its mirror image falls, when that looks alike and lies at the mirrored depth, or
    has no reliable depth while most of its neighbours that have do. Pixels are those of `camera`.
    """
    rows = [_pairs_of_plane(image, depth, reliability, camera, plane) * [*[1] * 4, c, 1, 1] for plane, c in planes]
    found = np.concatenate([np.zeros((0, 7)), *rows])
    found = found[found[:, 4] >= _LEAST_PAIR]
    return MirrorPairs(*(found[:, a].astype(np.float32) for a in (slice(0, 4), 4, 5, 6)))


def _pairs_of_plane(
    image: NDArray[np.uint8], depth: NDArray[np.float32], u: NDArray[np.float32], camera: Intrinsics, plane: Array
) -> Array:
    """(Q, 7) candidates on a grid: x, y, x', y', confidence, gain, offset."""
    points = unproject_depth(depth, camera)
    mirrored = points - 2 * (points @ plane[:3] + plane[3])[..., None] * plane[:3]
    xy, z = project(mirrored, camera)
    inside = (depth > 0) & (z > 0) & (xy > 0).all(-1) & (xy < [camera.width, camera.height]).all(-1)
    here = pixel_centers(camera.width, camera.height)
    # On the plane itself a pixel is its own mirror image.
    inside &= np.linalg.norm(xy - here, axis=-1) > 2 * _STRIDE
    at = np.where(inside[..., None], xy, 0).astype(np.float32)
    column, row = _pixels(at, camera).transpose(2, 0, 1)
    their_depth, their_u = depth[row, column], u[row, column]
    seen = cv2.remap(image, at[..., 0] - 0.5, at[..., 1] - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    alike = np.clip(_structure(image, np.asarray(seen, np.uint8)), 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.where(their_depth > 0, np.log(their_depth / np.where(inside, z, 1)), np.inf)
    agree = np.exp(-0.5 * (apart / _TOLERANCE) ** 2)
    sure, both = inside & (u > 0.35), inside & (u > 0.35) & (their_u > 0.35)
    # How much of the surroundings is symmetric: a sofa may be where its room is not.
    window = (2 * (camera.width // 24) + 1,) * 2
    tested, held = (
        cv2.blur(m.astype(np.float32), window, borderType=cv2.BORDER_REFLECT) for m in (both, both * agree * alike)
    )
    around = np.clip(held / np.maximum(tested, 0.05), 0, 1)
    confidence = np.where(both, np.sqrt(agree * around), around) * alike * sure
    rays = unproject(here, np.ones(depth.shape), camera)
    gain = 1 - 2 * plane[2] * (rays @ plane[:3])
    grid = (slice(_STRIDE // 2, None, _STRIDE),) * 2
    columns = [*here[grid].reshape(-1, 2).T, *xy[grid].reshape(-1, 2).T]
    columns += [m[grid].ravel() for m in (confidence, gain, np.full(depth.shape, -2 * plane[2] * plane[3]))]
    rows = np.stack(columns, 1)
    return rows[rows[:, 4] > 0]


def _pixels(xy: NDArray[np.floating], camera: Intrinsics) -> NDArray[np.int64]:
    """(..., 2) column and row under positions in the image: those on its far border, also by rounding, are inside."""
    return np.clip(np.floor(xy).astype(np.int64), 0, [camera.width - 1, camera.height - 1])


def _structure(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(h, w) structural similarity (Wang et al., IEEE TIP 2004) of two colour images, over 9 x 9 windows."""
    x, y = (np.asarray(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), np.float64) / 255 for i in (a, b))

    def mean(values: Array) -> Array:
        return np.asarray(cv2.blur(values, (9, 9)), np.float64)

    mx, my = mean(x), mean(y)
    vx, vy, covariance = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    light = (2 * mx * my + 1e-2**2) / (mx**2 + my**2 + 1e-2**2)
    return np.asarray(light * (2 * covariance + 3e-2**2) / (vx + vy + 3e-2**2), np.float64)
