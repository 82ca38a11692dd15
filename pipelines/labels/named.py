"""Names in the world: what a network says of a place in all frames, agreed on by patches of like surface.

A network is sure of what and vague about where: its samples are 16 and more pixels apart, and its mistakes change from
view to view. Depth and poses bring all that it said of a place together; patches of one colour and slope give the names
their outlines; slope and height speak against names that do not fit, and a thing has one name where most of its
parts agree. What remains without a name ("other" to the network) stays apart as numbered objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ..geometry.camera import resample_nearest, unproject_depth
from ..geometry.sequence import Sequence, resample_linear
from ..geometry.voxels import FLOOR, Gravity, Voxels, find, find_near, select_voxels, touching, voxel_keys
from ..providers import DepthEstimate, LabelEstimate, SemanticsProvider, class_colors
from ..system.progress import Progress
from ..types import VOID, ClassTable, Frame
from .segments import Segments, cut_parts, cut_patches, label_pixels
from .shape import NAMES as SHAPE_NAMES
from .shape import RoomShape

_LYING = frozenset({"floor", "rug", "carpet", "floor mat", "earth", "road", "sidewalk", "grass", "field", "path"})
_OVERHEAD = frozenset({"ceiling"})
_STANDING = frozenset(
    {"wall", "building", "house", "door", "window", "windowpane", "picture", "painting", "poster", "mirror", "curtain"}
    | {"blind", "blinds", "whiteboard"}
)
_LIES, _STANDS = np.cos(np.radians(45)), np.cos(np.radians(35))
_ON_FLOOR = 0.25
"""Up to this share of the cameras' height over the floor a thing may be above it and still count as lying on it."""
_AGAINST = float(np.exp(-2.0))
"""Probability left to a name that the geometry contradicts: normals of stereo depth err too. Factors e^-2 and e^-4 did
equally well on two recordings."""

_UNKNOWN_AS = ("wall", "floor")
_BY_SHAPE = ("wall", "floor", "ceiling", "door", "seating", "table", "storage")
"""Names that shape tells apart; windows, pictures and curtains are flat to it."""

_ALIKE = (
    frozenset({"bed", "seating", "sofa", "armchair", "chair", "seat", "swivel chair", "bench", "ottoman", "stool"}),
    frozenset({"cabinet", "shelf", "wardrobe", "bookcase", "chest of drawers", "buffet"}),
    frozenset({"table", "desk", "coffee table", "counter", "countertop", "kitchen island"}),
)
"""Names that one thing may bear from different sides, but not at once."""
_MIN_AGREEMENT = 2 / 3
"""Share of a thing that bears one name already, without which it may as well be two things that touch. A table and a
chair that became one bed have 0.53; sofas of two recordings are at 0.7 and above 0.9."""

_MIN_CONFIDENCE = 0.3
_ALONE = 0.3
"""Weight of what one frame says of a pixel whose place is not known."""
_MIN_SHARE = 0.0005
"""A class on a smaller share of what was seen is noise of the network."""


@dataclass(frozen=True)
class NetworkClasses:
    """The network's names; `void`: those that say nothing; `limit`: numbered objects fill up to this many classes."""

    names: tuple[str, ...]
    void: tuple[int, ...]
    limit: int


SHAPE_CLASSES = tuple(n for n in SHAPE_NAMES if n != "other")


@dataclass(frozen=True)
class NamedScene:
    """keys (V,) of voxels of `size`; share (V, K) probability of each of `names`; kept (K,) the network's class that
    each name is, -1 for a numbered object; the room's shape."""

    size: float
    keys: NDArray[np.int64]
    share: NDArray[np.float32]
    names: tuple[str, ...]
    kept: NDArray[np.int64]
    room: RoomShape

    @staticmethod
    def gather(
        segments: Segments,
        frames: list[Frame],
        depth_of: Callable[[Frame], DepthEstimate],
        probabilities_of: Callable[[Frame], NDArray[np.float32]] | None,
        vocabulary: NetworkClasses,
    ) -> NamedScene:
        """All frames vote; `probabilities_of` gives (rows, columns, C) over the frame's image, 0 for nothing said.
        Without it shape alone says what things are, and `vocabulary` has its names."""
        sequence = segments.sequence
        voxels, gravity, kind = segments.structure(frames, depth_of)
        posed = [f for f in frames if f.id in sequence.cam_from_world]
        centres = np.array([np.linalg.inv(sequence.cam_from_world[f.id])[:3, 3] for f in posed])
        room, patch = RoomShape.of(voxels, gravity, kind, centres), cut_patches(voxels)
        votes, by_shape = (
            np.zeros((len(voxels), len(names) + 1), np.float32) for names in (vocabulary.names, SHAPE_NAMES)
        )
        elsewhere = np.zeros(len(vocabulary.names))
        for frame in posed:
            depth = depth_of(frame)
            shape = room.probabilities(sequence, frame, depth)
            outside = _vote(by_shape, sequence, voxels, frame, depth, shape)
            if probabilities_of is not None:
                outside = _vote(votes, sequence, voxels, frame, depth, probabilities_of(frame))
            elsewhere += outside / len(frames)
        share = _agreed(by_shape, patch)
        if probabilities_of is not None:
            shape, share = share, _agreed(votes, patch)
            share *= name_likelihood(vocabulary.names, voxels, gravity, kind, float(np.median(centres @ gravity.up)))
            share /= np.maximum(share.sum(1, keepdims=True), 1e-9)
            recognise(share, vocabulary.names, shape)
        one_name_each(share, vocabulary.names, voxels)
        columns, names, kept = _settle(share, voxels, vocabulary, elsewhere)
        return NamedScene(voxels.size, voxels.keys, columns, names, kept, room)

    def estimate(
        self, sequence: Sequence, frame: Frame, depth: DepthEstimate, own: NDArray[np.float32]
    ) -> LabelEstimate:
        """Names of the places that the pixels (h, w) show, spread along like colours to where the depth is unsure.

        own (rows, columns, C): what the network says of this frame, for pixels that show no place that is known.
        """
        at = self._places(sequence, frame, depth)
        known = self.kept >= 0
        votes = np.zeros((*at.shape, len(self.names)), np.float32)
        votes[..., known] = resample_linear(own[..., self.kept[known]], *at.shape)
        seen = at >= 0
        votes[seen] = self.share[at[seen]]
        trust = np.where(seen, depth.confidence, _ALONE).astype(np.float32)
        return label_pixels(votes, trust, sequence.image(frame))

    def _places(self, sequence: Sequence, frame: Frame, depth: DepthEstimate) -> NDArray[np.int64]:
        """(h, w) index of the voxel that every pixel shows, or of one beside it; -1 for none."""
        if frame.id not in sequence.cam_from_world:
            return np.full(depth.depth.shape, -1, np.int64)
        return find_near(self.keys, _keys(sequence, frame, depth.depth, self.size))


def _vote(
    votes: NDArray[np.float32],
    sequence: Sequence,
    voxels: Voxels,
    frame: Frame,
    depth: DepthEstimate,
    probabilities: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Add one frame's vote: to every voxel the mean of what it says of it, times at most one; last column: how much."""
    rows, columns, classes = probabilities.shape
    at = find(voxels.keys, _keys(sequence, frame, resample_nearest(depth.depth, rows, columns), voxels.size))
    confidence = resample_nearest(depth.confidence, rows, columns)
    use = (at >= 0) & (confidence >= _MIN_CONFIDENCE) & (probabilities.sum(-1) > 0)
    seen, place = np.unique(at[use], return_inverse=True)
    weight = confidence[use]
    heard = np.bincount(place, weight, len(seen)).astype(np.float32)
    said = csr_matrix((weight, (place, np.arange(len(place)))), (len(seen), len(place))) @ probabilities[use]
    loudness = np.minimum(heard, 1.0)
    votes[seen, :classes] += said * (loudness / heard)[:, None]
    votes[seen, classes] += loudness
    return np.bincount(probabilities[at < 0].argmax(-1), None, classes) / at.size


def _agreed(votes: NDArray[np.float32], patch: NDArray[np.int64]) -> NDArray[np.float32]:
    """(V, C) mean of the votes over each voxel's patch; 0 where nobody voted. votes (V, C + 1)."""
    count = int(patch.max(initial=-1)) + 1
    total = csr_matrix((np.ones(len(patch), np.float32), (patch, np.arange(len(patch)))), (count, len(patch))) @ votes
    return np.asarray((total[:, :-1] / np.maximum(total[:, -1:], 1e-9))[patch], np.float32)


def _settle(
    share: NDArray[np.float32], voxels: Voxels, vocabulary: NetworkClasses, elsewhere: NDArray[np.float64]
) -> tuple[NDArray[np.float32], tuple[str, ...], NDArray[np.int64]]:
    """(V, K) shares of the names that occur, and of the objects into which what has none is cut; names; kept (K,)."""
    best, said = share.argmax(1), share.sum(1) > 0
    void = np.isin(best, vocabulary.void) & said
    weight = voxels.weight / voxels.weight.sum()
    mass = np.bincount(best[said], weight[said], len(vocabulary.names)) * (1 - elsewhere.sum()) + elsewhere
    named = np.setdiff1d(np.flatnonzero(mass >= _MIN_SHARE), vocabulary.void)
    columns, names = share[:, named], [vocabulary.names[i] for i in named]
    objects = np.full(len(voxels), -1, np.int64)
    if weight[void].sum() >= _MIN_SHARE:
        objects[void] = cut_parts(select_voxels(voxels, void), max(vocabulary.limit - len(named), 1))
    count = int(objects.max(initial=-1)) + 1
    own = np.zeros((len(voxels), count), np.float32)
    inside = np.flatnonzero(objects >= 0)
    own[inside, objects[inside]] = share[inside][:, list(vocabulary.void)].sum(1)
    names += [f"object {i + 1}" for i in range(count)]
    return np.concatenate([columns, own], 1), tuple(names), np.concatenate([named, np.full(count, -1)])


def _keys(sequence: Sequence, frame: Frame, depth: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """(h, w) keys of the voxels that a depth map hits, -1 without depth."""
    camera = sequence.intrinsics.resized(depth.shape[1], depth.shape[0])
    world_from_cam = np.linalg.inv(sequence.cam_from_world[frame.id])
    points = unproject_depth(depth, camera) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    return np.where(depth > 0, voxel_keys(points, size), -1)


def one_name_each(share: NDArray[np.float32], names: tuple[str, ...], voxels: Voxels) -> None:
    """Connected voxels whose likeliest names may be one thing's are one thing where most of it has one of them, which
    gets what the others had. share (V, C) is changed in place."""
    for members, inside, winner in _things(share.argmax(1), names, voxels):
        agreed, name = inside[winner >= 0], members[winner[winner >= 0]]
        said = share[np.ix_(agreed, members)].sum(1)
        share[np.ix_(agreed, members)] = 0
        share[agreed, name] = said


def disputed(label: NDArray, names: tuple[str, ...], voxels: Voxels) -> NDArray[np.bool_]:
    """(V,) whether a voxel is part of a thing whose parts do not agree on its name; label (V,) indices into names, or
    any other number for none."""
    out = np.zeros(len(voxels), bool)
    for _, inside, winner in _things(label, names, voxels):
        out[inside[winner < 0]] = True
    return out


def _things(
    label: NDArray, names: tuple[str, ...], voxels: Voxels
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]]:
    """Each set of alike names: indices (M,), voxels (I,) that bear one, the name that wins there or -1."""
    for alike in _ALIKE:
        members = np.flatnonzero([n.lower() in alike for n in names])
        inside = np.flatnonzero(np.isin(label, members))
        if len(members) < 2 or len(inside) == 0:
            continue
        own = np.searchsorted(members, label[inside])
        thing = _touching(voxels.keys[inside])
        votes = csr_matrix((voxels.weight[inside], (thing, own)), (thing.max() + 1, len(members))).toarray()
        agrees = votes.max(1) >= _MIN_AGREEMENT * votes.sum(1)
        yield members, inside, np.where(agrees, votes.argmax(1), -1)[thing]


def recognise(share: NDArray[np.float32], names: tuple[str, ...], by_shape: NDArray[np.float32]) -> None:
    """Give of what a network calls wall or floor, as it does with what it does not know, to each of the names that
    shape tells apart the part that it gets by shape (V, SHAPE_NAMES). share (V, C) is changed in place; a network that
    has not all of these names, but finer ones, is left alone."""
    if not {*_BY_SHAPE} <= {*names}:
        return
    before = {name: share[:, names.index(name)].copy() for name in _UNKNOWN_AS}
    for called, said in before.items():
        for name in _BY_SHAPE:
            part = said * by_shape[:, SHAPE_NAMES.index(name)]
            share[:, names.index(called)] -= part
            share[:, names.index(name)] += part


def _touching(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(V,) number of the connected piece of each of the sorted keys."""
    a, b = touching(keys)
    links = csr_matrix((np.ones(len(a), bool), (a, b)), (len(keys), len(keys)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def name_likelihood(
    names: tuple[str, ...], voxels: Voxels, gravity: Gravity, kind: NDArray[np.int64], eye: float
) -> NDArray[np.float32]:
    """(V, C) factor of every name's probability: 1, or less where slope or height of the surface speak against it.

    kind (V,) is the structure of `name_structure`, `eye` the cameras' height along `gravity.up`. All 1 where no
    direction is surely up; names that mean nothing here are left alone.
    """
    factor = np.ones((len(voxels), len(names)), np.float32)
    if not gravity.is_sure:
        return factor
    upward, height = voxels.normal @ gravity.up, voxels.position @ gravity.up
    is_floor = kind == FLOOR
    floor = float(np.median(height[is_floor])) if is_floor.any() else -np.inf
    lifted = height > floor + _ON_FLOOR * (eye - floor) if is_floor.any() else np.zeros(len(voxels), bool)
    lying = np.array([n.lower() in _LYING for n in names])
    against = {
        "lying": (upward < _LIES) | lifted,
        "overhead": (upward > -_LIES) | (height < eye),
        "standing": np.abs(upward) > _STANDS,
    }
    for kinds, members in (("lying", _LYING), ("overhead", _OVERHEAD), ("standing", _STANDING)):
        named = np.array([n.lower() in members for n in names])
        factor[np.ix_(against[kinds], named)] *= _AGAINST
    factor[np.ix_(is_floor, ~lying)] *= _AGAINST
    return factor


class ShapeLabels(SemanticsProvider):
    """Classes without a download, by shape; what has none becomes numbered objects. Needs poses (a backbone)."""

    name = "segments"
    shared_state = ("_scene",)

    def __init__(self, sequence: Sequence, limit: int, progress: Progress) -> None:
        """`limit` classes at the most. Raises InputError without a backbone."""
        self._segments, self._limit = Segments(sequence, progress), limit
        self._scene: NamedScene | None = None

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames without a pose."""
        return [f for f in frames if f.id not in self._segments.sequence.cam_from_world]

    def fit(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Let all frames vote on the names of the places they see."""
        vocabulary = NetworkClasses(SHAPE_NAMES, (SHAPE_NAMES.index("other"),), self._limit)
        self._scene = NamedScene.gather(self._segments, frames, depth_of, None, vocabulary)

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """Votes of the voxels under the pixels, spread along like colours to where the depth is unsure."""
        assert self._scene is not None
        sequence = self._segments.sequence
        if frame.id not in sequence.cam_from_world or not self._scene.names:
            return LabelEstimate(np.full(depth.depth.shape, VOID, np.uint8), np.zeros(depth.depth.shape, np.float32))
        own = self._scene.room.probabilities(sequence, frame, depth)
        return self._scene.estimate(sequence, frame, depth, own)

    def classes(self) -> ClassTable:
        """The names that occur, then the objects by size."""
        assert self._scene is not None
        return ClassTable(self._scene.names, class_colors(self._scene.names))

    def figures(self) -> dict[str, Any]:
        """The names that it knows, whether or not they occur."""
        return {"vocabulary": [*SHAPE_CLASSES]}
