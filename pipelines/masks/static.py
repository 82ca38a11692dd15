"""Regions that look like something that moves, judged by whether they do.

A network knows what a person looks like, and takes teddy bears, statues and posters for people; they stand as still as
the room. So structure from motion is made of everything first: where matches inside a region lie on points of it about
as often as matches outside, the region is scene. What moves contradicts the structure; what stays at one place of the
image while the camera moves has no parallax, and leaves no points either.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...formats.colmap import ModelArrays
from ..sfm.driver import Structure
from ..sfm.matching import VerifiedPair, match_features

_SIDE, _NEAR = 160, 5
"""Pixels along the long side of a map of regions, and over how many of them pieces are one region."""
_PARTNERS = 6
"""Keyframes with which each one that shows a region is matched: of those that it shares the geometry with, from first
to last."""
_STILL = 0.7
"""Least share of a region's matches on points of the structure, over that of the matches outside of all regions: what
stands has 0.8 and more, who walks 0 to 0.6 (five made recordings and two real ones)."""
_WINDOW, _SIDE_OF_BOTH = 21, 0.2
"""Pixels of a map of regions around each of which matches say whether it moves, and least share of a region of which
one side moves, and of its other side."""
_FEW, _FEW_OUTSIDE = 20, 100
"""Matches of a region, and outside of all, below which nothing follows from them."""
_BROKEN = 0.3
"""Share of the matches outside on points of the structure below which it is not the structure of the scene."""
_SAME = 0.5
"""Overlap, over the union, of regions of close keyframes that are one thing."""
_MOVES = 0.1
"""Share of a thing's regions that move from which all of it is left out, also where it stands."""
_LEAST_VIEWS, _LEAST_ANGLE = 3, np.radians(1.5)
"""Of a point that says anything: who stands at one place of the image is far away for two views."""

Parts = tuple[NDArray[np.int32], NDArray[np.int8]]
"""(h, w) numbered parts of an image, 0 = none, and for each number (P + 1,) 1 where the part stands still or is none,
-1 where it moves, and 0 where too little of it is matched to say."""


def regions_of(named: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Number the regions of a mask (H, W): (h, w) with a long side of `_SIDE` pixels, 0 = none; (1, 1) without any."""
    if not named.any():
        return np.zeros((1, 1), np.int32)
    scale = _SIDE / max(named.shape)
    size = max(1, round(named.shape[1] * scale)), max(1, round(named.shape[0] * scale))
    reduced = (cv2.resize(named.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8)
    _, number = cv2.connectedComponents(cv2.dilate(reduced, np.ones((_NEAR, _NEAR), np.uint8)))
    return np.asarray(number * reduced, np.int32)


def find_static(regions: Sequence[NDArray[np.int32]], structure: Structure) -> list[Parts]:
    """Tell which regions of every keyframe stand still; in parts where one side of a region stands and another moves.

    Args:
        regions: of every keyframe, as of `regions_of`.
        structure: of the same keyframes, made with what the regions show.
    """
    camera = structure.model.cameras[1]
    places = [_place_of(r.shape, f.xy, camera) for r, f in zip(regions, structure.features, strict=True)]
    models = [structure.model, *structure.pieces]
    points = _points_of(models, [len(f) for f in structure.features])
    of = {image - 1: n for n, model in enumerate(models) for image in model.reg_image_ids()}
    together = [p for p in structure.pairs if p.first in of and of[p.first] == of.get(p.second)]
    seen: list[list[NDArray[np.int64]]] = [[np.zeros(0, np.int64)] for _ in regions]
    outside = np.zeros(2)
    for i, j in _asked(together, [bool(r.any()) for r in regions]):
        first, second = match_features(structure.features[i], structure.features[j]).astype(np.int64).T
        agree = (points[i][first] == points[j][second]) & (points[i][first] >= 0)
        at = places[i][first], places[j][second]
        inside = regions[i].ravel()[at[0]] > 0, regions[j].ravel()[at[1]] > 0
        for k, place, is_inside in zip((i, j), at, inside, strict=True):
            seen[k].append((2 * place + agree)[is_inside])
        scene = ~(inside[0] | inside[1])
        outside += (agree & scene).sum(), scene.sum()
    expected = outside[0] / outside[1] if outside[1] >= _FEW_OUTSIDE else 1.0
    parts: list[NDArray[np.int32]] = []
    votes: list[NDArray[np.float64]] = []
    for region, found in zip(regions, seen, strict=True):
        against, agreeing = np.bincount(np.concatenate(found), minlength=2 * region.size).reshape(-1, 2).T
        count = np.stack([agreeing, against + agreeing]).astype(np.float64)
        parts.append(divide_regions(region, count, _STILL * expected))
        votes.append(np.array([np.bincount(parts[-1].ravel(), row) for row in count], np.float64))
    return list(zip(parts, judge_static(votes, things_of(parts), expected), strict=True))


def _place_of(shape: tuple[int, ...], xy: NDArray[np.float64], camera: pycolmap.Camera) -> NDArray[np.int64]:
    """(F,) index into a map of a shape (h, w) of each of the pixels (F, 2) of a camera's image."""
    height, width = shape
    column, row = (xy * [width / camera.width, height / camera.height]).astype(np.int64).T
    return np.asarray(row.clip(0, height - 1) * width + column.clip(0, width - 1))


def divide_regions(regions: NDArray[np.int32], votes: NDArray[np.float64], limit: float) -> NDArray[np.int32]:
    """Divide regions (h, w) of which one side stands and another moves, by votes (2, h * w): where somebody walks past
    a statue, one outline surrounds both. What has few matches around it goes with what is nearest."""
    agreeing, matches = (
        cv2.boxFilter(v, -1, (_WINDOW, _WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for v in votes.reshape(2, *regions.shape)
    )
    known = (matches >= _FEW) & (regions > 0)
    if not known.any():
        return regions
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    moves = (agreeing < limit * matches)[tuple(nearest)]
    moving, size = (np.bincount(regions.ravel(), of) for of in (moves.ravel(), np.ones(regions.size)))
    is_mixed = np.abs(moving - size / 2) < (0.5 - _SIDE_OF_BOTH) * size
    return np.asarray(np.where(moves & is_mixed[regions] & (regions > 0), regions + regions.max(), regions), np.int32)


def _asked(pairs: Sequence[VerifiedPair], shows: Sequence[bool]) -> Iterator[tuple[int, int]]:
    """Pairs of keyframes of which one shows a region, some for each."""
    partners: list[list[tuple[int, int]]] = [[] for _ in shows]
    for pair in pairs:
        for k in (pair.first, pair.second):
            if shows[k]:
                partners[k].append((pair.first, pair.second))
    some = (np.linspace(0, len(p) - 1, min(_PARTNERS, len(p))).round().astype(int) for p in partners)
    yield from sorted({partners[k][n] for k, chosen in enumerate(some) for n in chosen})


def _points_of(models: Sequence[pycolmap.Reconstruction], counts: Sequence[int]) -> list[NDArray[np.int64]]:
    """For every keyframe (F,) the number of the point that each feature shows, -1 for none that says anything."""
    points, start = [np.full(count, -1, np.int64) for count in counts], 0
    for model in models:
        found = ModelArrays.of(model)
        centres = -np.einsum("nij,ni->nj", found.cam_from_world[:, :3, :3], found.cam_from_world[:, :3, 3])
        ray = found.points[found.obs_point] - centres[found.obs_cam]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        middle = np.zeros_like(found.points)
        np.add.at(middle, found.obs_point, ray)
        middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
        angle, views = np.zeros(len(middle)), np.bincount(found.obs_point, minlength=len(middle))
        np.maximum.at(angle, found.obs_point, np.arccos(np.clip((ray * middle[found.obs_point]).sum(1), -1, 1)))
        number = np.where((2 * angle >= _LEAST_ANGLE) & (views >= _LEAST_VIEWS), start + np.arange(len(middle)), -1)
        for image, rows in zip(found.image_ids.tolist(), found.rows(), strict=True):
            points[image - 1][found.obs_feature[rows]] = number[found.obs_point[rows]]
        start += len(middle)
    return points


def things_of(regions: Sequence[NDArray[np.int32]]) -> list[NDArray[np.int32]]:
    """Return the thing of each region, (R + 1,) for every keyframe: regions that overlap in close keyframes are one."""
    starts = np.cumsum([0, *(int(r.max()) + 1 for r in regions)])
    links: list[tuple[int, int]] = []
    for i, j in ((i, i + step) for step in (1, 2) for i in range(len(regions) - step)):
        if regions[i].any() and regions[j].any():
            count = int(regions[j].max()) + 1
            shared = np.bincount((regions[i] * count + regions[j]).ravel(), minlength=(regions[i].max() + 1) * count)
            shared = shared.reshape(-1, count)
            union = shared.sum(1)[:, None] + shared.sum(0) - shared
            links += [(starts[i] + a, starts[j] + b) for a, b in np.argwhere(shared > _SAME * union) if a and b]
    rows, columns = np.array(links, np.int64).reshape(-1, 2).T
    _, thing = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (starts[-1],) * 2), False)
    return np.split(thing, starts[1:-1])


def judge_static(
    votes: Sequence[NDArray[np.float64]], things: Sequence[NDArray[np.int32]], expected: float
) -> list[NDArray[np.int8]]:
    """Tell which regions stand still, numbered as in `Parts`.

    Args:
        votes: of every keyframe (2, R + 1), each region's matches that lie on points, and all of them.
        things: as of `things_of`.
        expected: share of the matches outside of all regions that lie on points.
    """
    agreeing, matches = np.concatenate(votes, axis=1)
    thing, starts = np.concatenate(things), np.cumsum([0, *(v.shape[1] for v in votes)])
    known = matches >= _FEW
    known[starts[:-1]] = False  # 0 is no region
    moves = known & (agreeing < _STILL * expected * matches)
    judged, moving = (np.bincount(thing, rows) for rows in (known, moves))
    goes = (moving > _MOVES * judged) | ((judged > 0) & (expected < _BROKEN))
    found = np.where(moves | goes[thing], -1, judged[thing] > 0).astype(np.int8)
    found[starts[:-1]] = 1
    return np.split(found, starts[1:-1])
