"""Colours and labels of mesh vertices, from what the map shows in the views that see them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project
from ..geometry.posed_depth import PosedDepth
from ..mapping.measure import DrawnView
from ..types import VOID


def paint(
    vertices: NDArray[np.float32], views: Iterable[DrawnView], class_ids: tuple[int, ...], tolerance: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """colors (V, 3) uint8 and labels (V,) uint8: weighted mean and vote of the views that see a vertex.

    A view sees a vertex where its depth there agrees within `tolerance`. Unseen ones are grey and VOID.
    """
    total = np.zeros((len(vertices), 3), np.float32)
    weight = np.zeros(len(vertices), np.float32)
    votes = np.zeros((len(vertices), max(len(class_ids), 1)), np.float32)
    for view in views:
        rows, place = _seen(vertices, view.shown, tolerance)
        share = view.shown.trust[place]
        total[rows] += view.colors[place] * share[:, None]
        weight[rows] += share
        if view.channels is not None and class_ids:
            channel = view.channels[place]
            votes[rows[channel >= 0], channel[channel >= 0]] += share[channel >= 0]
    colors = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-9)[:, None], 127.5)
    table = np.array([*class_ids, VOID] if class_ids else [VOID, VOID], np.uint8)
    labels = np.where(votes.max(1) > 0, votes.argmax(1), len(table) - 1)
    return np.round(colors).astype(np.uint8), table[labels]


def _seen(
    vertices: NDArray[np.float32], view: PosedDepth, tolerance: float
) -> tuple[NDArray[np.int64], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Which vertices the view sees, and the (row, column) of each."""
    pose = view.cam_from_world
    xy, z = project(vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3], view.intrinsics)
    inside = np.flatnonzero(((xy >= 0) & (xy < (view.intrinsics.width, view.intrinsics.height))).all(1))
    place = xy[inside].astype(int)
    close = np.abs(view.depth[place[:, 1], place[:, 0]] - z[inside]) < tolerance
    close &= view.trust[place[:, 1], place[:, 0]] > 0
    return inside[close], (place[close, 1], place[close, 0])
