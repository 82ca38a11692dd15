"""Semantic loops (section 3.5): which keyframes show the same place again, and what motion that means."""

from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry import se3
from ..global_ba.candidates import LabelSummary, structure_similarity
from ..global_ba.candidates import richness as quantile_richness
from ..mapping.views import View
from ..proxy.maps import mean_iou
from ..types import LoopEdge
from .constants import PAPER, Constants
from .gaussians import Gaussians
from .tracking import track

Array = NDArray[np.float64]
GAP = 8
"""A loop joins keyframes at least this many apart."""
_MIN_COVERED, _MAX_LOSS = 0.5, 1.5
"""A loop's place must be covered so far by the map around the other end, and (16) be at most so many times that of a
neighbour."""


def semantic_keyframes(summaries: Sequence[LabelSummary], constants: Constants = PAPER) -> list[int]:
    """Eq. (21): the keyframes with S(KF) > 0.9: the tenth that shows most."""
    return np.flatnonzero(richness(summaries, constants) > constants.rich).tolist()


def richness(summaries: Sequence[LabelSummary], constants: Constants = PAPER) -> Array:
    """Eq. (22): S = θ H + (1 - θ) E of entropy and density of boundaries (N,), as quantiles over the run."""
    return quantile_richness(summaries, constants.theta)


def candidates(summaries: Sequence[LabelSummary], looks: Array, constants: Constants = PAPER) -> list[tuple[int, int]]:
    """Eq. (23): pairs (i, j) of a semantic keyframe j with an earlier one far apart, where the largest likeness passes
    T_loop; the paper takes the mIoU, and (24) for what it is. looks (N, F): unit descriptors."""
    out = []
    for j in semantic_keyframes(summaries, constants):
        before = range(0, j - GAP)
        if not before:
            continue
        alike = similarity(summaries[j], [summaries[i] for i in before], looks[: len(before)] @ looks[j], constants)
        best = int(np.argmax(alike))
        if alike[best] > constants.t_loop:
            out.append((best, j))
    return out


def similarity(first: LabelSummary, others: Sequence[LabelSummary], dino: Array, constants: Constants = PAPER) -> Array:
    """Eq. (24): Sim = α₁ mIoU + α₂ DINOSim + α₃ StructSim (K,) of one keyframe with others; dino (K,) cosines."""
    labels, graphs = np.stack([o.labels for o in others]), np.stack([o.graph for o in others])
    structure = structure_similarity(first.graph, graphs)
    miou = mean_iou(first.labels, labels)
    return constants.alpha1 * miou + constants.alpha2 * np.asarray(dino) + constants.alpha3 * structure


def small_looks(views: Sequence[View]) -> Array:
    """(N, F) unit vectors of the images made small, for DINOSim of (24) where no network has given descriptors."""
    rows = [cv2.resize(v.image.numpy(), (16, 12), interpolation=cv2.INTER_AREA).reshape(-1) for v in views]
    looks = np.stack(rows).astype(np.float64)
    looks -= looks.mean(1, keepdims=True)
    looks -= looks.mean(0)
    return looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-9)


def close(
    pairs: Iterable[tuple[int, int]], ids: Sequence[int], poses: Array, view_of: Callable[[int], View],
    gaussians: Gaussians, classes: int, unit: float,
) -> list[LoopEdge]:  # fmt: skip
    """Find the loops: the second frame of a pair is tracked by (16) by what was mapped around the first, from its pose.

    It counts where that map covers it, and explains it about as well as the first frame itself."""
    loops = []
    for i, j in pairs:
        around = np.abs(np.searchsorted(ids, gaussians.anchors.numpy()) - i) <= GAP // 2
        near = Gaussians.of(gaussians.map.only(torch.from_numpy(around)))
        start = torch.from_numpy(poses[i])
        own = track(near, view_of(i), [start], classes, unit)
        found = track(near, view_of(j), [start, torch.from_numpy(poses[j])], classes, unit)
        if found.covered > _MIN_COVERED and found.loss < _MAX_LOSS * own.loss:
            motion = found.cam_from_world.numpy() @ se3.inverse(poses[i])
            loops.append(LoopEdge(int(ids[i]), int(ids[j]), motion, 1.0, int(found.covered * 1000)))
    return loops
