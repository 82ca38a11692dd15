"""Depth that stands in front of what other views see there is wrong, and would become a floater."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.geometry.camera import project, unproject
from pipelines.mapping.depth_fields import neighbours
from pipelines.mapping.views import View

STRIDE = 2
AGREES = 0.03
"""Relative difference up to which another view confirms a depth."""
SEES_THROUGH = 0.08
"""Relative difference from which the other view's surface is plainly behind it."""
_TRUSTED = 0.5


def without_contradicted_depth(views: Sequence[View]) -> list[View]:
    """The views, their depth unknown where more of the others (two at least) see through it than confirm it."""
    depths = [v.depth.cpu().numpy() for v in views]
    trusts = [v.trust.cpu().numpy() for v in views]
    seeing: dict[int, list[int]] = {}
    for i, j in neighbours(views):
        seeing.setdefault(i, []).append(j)
    out = []
    for i, view in enumerate(views):
        votes = np.zeros(depths[i][::STRIDE, ::STRIDE].shape, np.int16)
        through = np.zeros_like(votes)
        for j in seeing.get(i, []):
            confirmed, seen_through = _votes(view, depths[i], views[j], depths[j], trusts[j])
            votes += confirmed
            through += seen_through
        bad = (through >= 2) & (through > votes)
        whole = np.repeat(np.repeat(bad, STRIDE, axis=0), STRIDE, axis=1)[: depths[i].shape[0], : depths[i].shape[1]]
        kept = torch.where(torch.from_numpy(whole).to(view.depth.device), 0.0, view.depth)
        out.append(view.with_depth(kept, view.reliability))
    return out


def _votes(
    view: View, depth: NDArray[np.float32], other: View, other_depth: NDArray[np.float32], trust: NDArray[np.float32]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(h, w) bool each: the other view confirms the depth of the strided pixels; it sees through it."""
    strided = depth[::STRIDE, ::STRIDE]
    rows, columns = np.nonzero(strided)
    xy = np.stack([columns, rows], 1).astype(np.float64) * STRIDE + 0.5
    other_from_view = (other.cam_from_world @ torch.linalg.inv(view.cam_from_world)).cpu().numpy()
    points = unproject(xy, strided[rows, columns].astype(np.float64), view.intrinsics)
    there, z = project(points @ other_from_view[:3, :3].T + other_from_view[:3, 3], other.intrinsics)
    inside = np.all((there >= 0) & (there < (other.intrinsics.width, other.intrinsics.height)), axis=1)
    place = np.where(inside[:, None], there, 0).astype(int)
    seen = other_depth[place[:, 1], place[:, 0]]
    usable = inside & (seen > 0) & (trust[place[:, 1], place[:, 0]] > _TRUSTED)
    confirmed, through = np.zeros(strided.shape, bool), np.zeros(strided.shape, bool)
    confirmed[rows, columns] = usable & (np.abs(z - seen) < AGREES * seen)
    through[rows, columns] = usable & (z < (1 - SEES_THROUGH) * seen)
    return confirmed, through
