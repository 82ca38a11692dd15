"""Pictures for people: depth and labels in colour, and sheets of views side by side."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import VOID, ClassTable

Picture = NDArray[np.uint8]


def _color_table(name: int) -> Picture:
    """(256, 3) RGB."""
    return np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], name), np.uint8).reshape(256, 3)[
        :, ::-1
    ]


_TURBO = _color_table(cv2.COLORMAP_TURBO)
_MAGMA = _color_table(cv2.COLORMAP_MAGMA)
_VOID_COLOR = (40, 40, 40)


def depth_picture(depth: NDArray, nearest: float, farthest: float) -> Picture:
    """(H, W, 3): near is red, far blue, by inverse depth; unknown is dark grey."""
    known = depth > 0
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    share = (inverse - 1 / farthest) / max(1 / nearest - 1 / farthest, 1e-12)
    picture = _TURBO[np.clip(share * 255, 0, 255).astype(np.uint8)]
    return np.where(known[..., None], picture, np.uint8(40)).astype(np.uint8)


def depth_range(depth: NDArray) -> tuple[float, float]:
    """(nearest, farthest) of most pixels; (1, 2) where nothing is known."""
    known = depth[depth > 0]
    if known.size == 0:
        return 1.0, 2.0
    low, high = np.quantile(known, (0.02, 0.98))
    return float(low), float(max(high, 1.01 * low))


def error_picture(error: NDArray, known: NDArray[np.bool_], largest: float) -> Picture:
    """(H, W, 3): no error is black, `largest` and more pale yellow; unknown is dark blue-grey."""
    picture = _MAGMA[np.clip(error / largest * 255, 0, 255).astype(np.uint8)]
    return np.where(known[..., None], picture, np.array([30, 40, 60], np.uint8)).astype(np.uint8)


def label_picture(labels: NDArray[np.uint8], colors: Sequence[tuple[int, int, int]]) -> Picture:
    """(H, W, 3) in the classes' colours; void and unknown classes are dark grey."""
    table = np.full((256, 3), _VOID_COLOR, np.uint8)
    table[: len(colors)] = np.array(colors, np.uint8).reshape(-1, 3)
    table[VOID] = _VOID_COLOR
    return table[labels]


def labels_on_photo(
    photo: Picture, labels: NDArray[np.uint8], colors: Sequence[tuple[int, int, int]], share: float = 0.55
) -> Picture:
    """(H, W, 3) the photo under its labels, with class borders drawn."""
    mixed = (1 - share) * photo + share * label_picture(labels, colors)
    edge = np.zeros(labels.shape, bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    mixed[edge] = 255
    return mixed.astype(np.uint8)


def sheet(rows: Sequence[Sequence[Picture]], titles: Sequence[str], width: int = 320) -> Picture:
    """Rows of pictures of one shape under their titles, each reduced to `width` pixels."""
    height = round(width * rows[0][0].shape[0] / rows[0][0].shape[1])
    lines = [_titles(titles, width)]
    for row in rows:
        resized = [np.asarray(cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA), np.uint8) for p in row]
        lines.append(np.concatenate([_bordered(p) for p in resized], axis=1))
    return np.concatenate(lines, axis=0)


def _bordered(picture: Picture) -> Picture:
    return np.pad(picture, ((0, 4), (0, 4), (0, 0)), constant_values=255)


def _titles(titles: Sequence[str], width: int) -> Picture:
    line = np.full((26, (width + 4) * len(titles), 3), 255, np.uint8)
    for i, title in enumerate(titles):
        at = (i * (width + 4) + 4, 18)
        cv2.putText(line, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
    return line


def class_colors_by_name(
    names: Sequence[str], colors: Sequence[tuple[int, int, int] | None], table: ClassTable
) -> list[tuple[int, int, int]]:
    """Display colours of the truth's classes: the run's for the same name, else the truth's own, else a grey."""
    known = {n.lower(): c for n, c in zip(table.names, table.colors, strict=True)}
    greys = [(60 + 37 * i % 160,) * 3 for i in range(len(names))]
    return [known.get(n.lower(), c or (g[0], g[1], g[2])) for n, c, g in zip(names, colors, greys, strict=True)]
