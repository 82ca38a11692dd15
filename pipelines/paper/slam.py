"""Figure 1 of the paper: for each frame predict, track, adjust, grow, select, optimise; the rest is in `stages`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..depth.fields import FINE, field_scales
from ..geometry import se3
from ..geometry.camera import unproject_depth
from ..mapping.move_map import follow_keyframes
from ..mapping.views import View
from ..render.api import Rendering
from ..types import Array, Intrinsics
from .adjustment import adjust_frame, carry, local_adjustment
from .mapping import grow, optimise, prune
from .rendering import Gaussians, scaled_depth, show
from .tracking import overlap, predict, select_keyframes, semantic_keyframes, time_weights, track_pose
from .uncertainty import PAPER, Constants, semantic_agreement, semantic_factor, with_agreement

STEPS, FIRST_STEPS = 15, 60
"""Of mapping, after each keyframe and after the first."""
PRUNE_EVERY = 10
WINDOW = 8
"""Keyframes that are adjusted together with each new one."""
_GRID = (40, 30)
_STRIDE = 8
_COVERED = 0.1
"""A frame of which the map covers less is lost."""
_KEPT = ("unit", "poses", "fields", "summaries", "lost")


@dataclass
class Slam:
    """All that is known after a frame; tables by frame id. fields: log scales (rows, columns) that bring a keyframe's
    proxy depth into the map; summaries: its labels (30, 40) and mean U."""

    classes: int
    seed: int
    unit: float = 1.0
    gaussians: Gaussians | None = None
    poses: dict[int, Array] = field(default_factory=dict)
    fields: dict[int, Array] = field(default_factory=dict)
    summaries: dict[int, tuple[NDArray[np.uint8], float]] = field(default_factory=dict)
    lost: dict[int, str] = field(default_factory=dict)

    @property
    def keyframes(self) -> list[int]:
        """Frame ids in order."""
        return list(self.fields)

    def step(self, view: View, view_of: Callable[[int], View], may_map: bool, constants: Constants = PAPER) -> None:
        """One frame of figure 1; `view_of` a keyframe, by its id, `may_map`: not for a frame that only measures."""
        if self.gaussians is None:
            if may_map and bool((view.depth > 0).any()):
                self._begin(view, constants)
                self._optimise(view_of, FIRST_STEPS, [view.frame_id], constants)
            return
        starts = [torch.from_numpy(pose) for pose in self._starts()]
        found = track_pose(self.gaussians, self._scaled(view), starts, self.classes, self.unit, constants)
        if found.covered < _COVERED:
            self.lost[view.frame_id] = "the map covers too little of it"
            return
        pose = self.poses[view.frame_id] = _rotated(found.cam_from_world.numpy())
        if not (may_map and self._is_new(view, pose, constants)):
            self.poses[view.frame_id] = self._adjusted_frame(view, pose, view_of, constants)
            return
        with torch.no_grad():
            at = torch.from_numpy(pose)
            shown = show(vars(self.gaussians.map.only(self.gaussians.in_view(at, view.intrinsics))), at, view)
        view = self._agreeing(view, shown, constants)
        self.fields[view.frame_id] = fitted_field(view, shown.depth.numpy(), shown.silhouette.numpy() > constants.t_sil)
        self.summaries[view.frame_id] = _summary(view)
        self._adjust(view_of, view.intrinsics, constants)
        pose = self.poses[view.frame_id]
        grow(self.gaussians, self._scaled(view), torch.from_numpy(pose), self.classes, constants)
        chosen = self._select(view, pose, constants)
        self._optimise(view_of, STEPS, chosen, constants)
        if len(self.fields) % PRUNE_EVERY == 0:
            prune(self.gaussians, self.unit)

    def _adjusted_frame(self, view: View, pose: Array, view_of: Callable[[int], View], constants: Constants) -> Array:
        """(25) for a frame that is no keyframe and the last two that are, of which only the frame moves: a keyframe is
        adjusted in its window, and two others alone can lead it astray where they show little."""
        near = self.keyframes[-2:]
        poses = np.stack([*(self.poses[i] for i in near), pose])
        fields = np.stack([self.fields[i] for i in [*near, near[-1]]])
        return _rotated(
            adjust_frame(view_of, [*near, view.frame_id], poses, fields, self.classes, self.unit, constants)
        )

    def _begin(self, view: View, constants: Constants) -> None:
        """First pose = identity; the scale is that of the proxy depth."""
        self.unit = float(view.depth[view.depth > 0].median())
        self.poses[view.frame_id] = np.eye(4)
        self.fields[view.frame_id], self.summaries[view.frame_id] = np.zeros((FINE.rows, FINE.columns)), _summary(view)
        self.gaussians = grow(None, view, torch.eye(4, dtype=torch.float64), self.classes, constants)

    def _starts(self) -> list[Array]:
        """By (15), and where the last frame was: of sudden turns that is nearer."""
        *before, last = list(self.poses.values())[-2:]
        return [predict(before[0], last), last] if before else [last]

    def _scaled(self, view: View) -> View:
        """With its proxy depth in the scale of the map, as its own or the last keyframe's field says."""
        nodes = self.fields.get(view.frame_id, self.fields[self.keyframes[-1]])
        return scaled_depth(view, torch.from_numpy(field_scales(nodes, *view.depth.shape)))

    def _is_new(self, view: View, pose: Array, constants: Constants) -> bool:
        last, has_depth = self.poses[self.keyframes[-1]], bool((view.depth > 0).any())
        return has_depth and overlap(self._points(view, pose), last, view.intrinsics) < constants.new_keyframe

    def _points(self, view: View, pose: Array) -> Array:
        """(P, 3) some of a frame's back-projected pixels."""
        points = unproject_depth(self._scaled(view).depth.numpy(), view.intrinsics)[::_STRIDE, ::_STRIDE].reshape(-1, 3)
        return se3.transform(se3.inverse(pose), points[points[:, 2] > 0])

    def _agreeing(self, view: View, shown: Rendering, constants: Constants) -> View:
        """U with θ^γ of (3), by how well the map shows the classes of the frame."""
        if self.classes == 0:
            return view
        channels = shown.features[..., 3:].argmax(-1).to(torch.uint8)
        channels = torch.where(shown.silhouette > constants.t_sil, channels, view.channels)
        theta = semantic_factor(semantic_agreement(view.channels.numpy(), channels.numpy()), constants)
        weighed = with_agreement(view.reliability.numpy().astype(np.float64), theta, constants)
        return replace(view, reliability=torch.from_numpy(np.round(weighed).astype(np.uint8)))

    def _select(self, view: View, pose: Array, constants: Constants) -> list[int]:
        """The frame itself, and at most 20 keyframes by (10) to (14)."""
        others = [k for k in self.keyframes if k != view.frame_id]
        points = self._points(view, pose)
        overlaps = [overlap(points, self.poses[k], view.intrinsics) for k in others]
        differs = semantic_keyframes(self.summaries[view.frame_id][0], np.stack([self.summaries[k][0] for k in others]))
        ages = np.arange(len(others), 0, -1)
        weights = time_weights(ages, np.array([self.summaries[k][1] for k in others]), constants)
        rng = np.random.default_rng([self.seed, view.frame_id])
        return [view.frame_id, *(others[i] for i in select_keyframes(overlaps, differs, weights, rng, constants))]

    def _adjust(self, view_of: Callable[[int], View], camera: Intrinsics, constants: Constants) -> None:
        """(25) over the last keyframes; the Gaussians and the frames between move with them."""
        assert self.gaussians is not None
        ids = self.keyframes[-WINDOW:]
        poses, fields = np.stack([self.poses[i] for i in ids]), np.stack([self.fields[i] for i in ids])
        moves = np.arange(len(ids)) > 0
        bends = moves | (ids[0] == self.keyframes[0])  # the scale of a later one is that of the map before
        new, bent = local_adjustment(view_of, ids, poses, fields, moves, bends, self.classes, self.unit, constants)
        carry(self.gaussians, ids, poses, new, bent - fields, camera)
        frames = np.array([i for i in self.poses if i > ids[0] and i not in self.fields])
        if len(frames):
            was = np.stack([self.poses[i] for i in frames.tolist()])
            followed = follow_keyframes(frames, was, np.array(ids), poses, new, np.ones(len(ids)))
            self.poses.update(zip(frames.tolist(), followed, strict=True))
        self.poses.update(zip(ids, new, strict=True))
        self.fields.update(zip(ids, bent, strict=True))

    def _optimise(self, view_of: Callable[[int], View], steps: int, chosen: list[int], constants: Constants) -> None:
        """Steps on (18), every other by the frame itself, the first of the chosen."""
        assert self.gaussians is not None
        rng = np.random.default_rng([self.seed, chosen[0], 1])
        for number in range(steps):
            k = chosen[0] if number % 2 == 0 else chosen[int(rng.integers(len(chosen)))]
            view, pose = self._scaled(view_of(k)), torch.from_numpy(self.poses[k])
            optimise(self.gaussians, view, pose, self.classes, self.unit, 1.0, constants)

    def to_value(self) -> dict[str, Any]:
        """All of it for a snapshot; `restore` is the inverse."""
        held = {} if self.gaussians is None else self.gaussians.to_tensors()
        return {"gaussians": {k: v.numpy() for k, v in held.items()}, **{name: getattr(self, name) for name in _KEPT}}

    def restore(self, value: dict[str, Any]) -> None:
        """Take what `to_value` returned."""
        self.gaussians = Gaussians.from_tensors({k: torch.from_numpy(v.copy()) for k, v in value["gaussians"].items()})
        for name in _KEPT:
            setattr(self, name, value[name])


def _rotated(pose: Array) -> Array:
    """The pose with a rotation again: by (15) each frame more than doubles what it is off."""
    return np.asarray(se3.exp(se3.log(pose)))


def _summary(view: View) -> tuple[NDArray[np.uint8], float]:
    height, width = view.depth.shape
    size = _GRID if width >= height else _GRID[::-1]
    labels = np.asarray(cv2.resize(view.channels.numpy(), size, interpolation=cv2.INTER_NEAREST), np.uint8)
    return labels, float(view.trust.mean())


def fitted_field(view: View, shown: NDArray[np.float32], solid: NDArray[np.bool_]) -> Array:
    """(rows, columns) the log scale field from a view's proxy depth to a shown one (H, W) where that is solid.

    Smooth, and as it is on the whole where the map shows nothing."""
    proxy, trust = view.depth.numpy(), view.trust.numpy()
    weight = np.where(solid & (proxy > 0) & (shown > 0), trust, 0).astype(np.float32)
    logs = np.log(np.where(weight > 0, shown / np.where(proxy > 0, proxy, 1), 1)).astype(np.float32)
    if not (weight > 0).any():
        return np.zeros((FINE.rows, FINE.columns))
    middle = float(np.median(logs[weight > 0]))
    weight *= np.abs(logs - middle) < 0.3  # across the edge of something
    size = (FINE.columns, FINE.rows)
    kept = (weight * (logs - middle), weight)
    along = kept if proxy.shape[1] >= proxy.shape[0] else [np.ascontiguousarray(a.T) for a in kept]
    blurred = [cv2.GaussianBlur(a, (0, 0), max(proxy.shape) / FINE.columns / 2) for a in along]
    total, share = (cv2.resize(a, size, interpolation=cv2.INTER_AREA).astype(np.float64) for a in blurred)
    return middle + total / (share + 0.05)
