"""Agreement of label images, from one confusion matrix over the whole sequence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ..types import require_shape

Counts = NDArray[np.int64]


def count_labels(labels: NDArray, truth: NDArray, classes: int, true_classes: int) -> Counts:
    """(true_classes, classes + 1) pixels by true class (row) and given label (column).

    A pixel whose truth is no class is left out. The last column counts pixels with truth that were given no class:
    void must not be a way round a mistake.
    """
    require_shape("labels", labels, truth.shape)
    known = truth < true_classes
    given = np.where(labels[known] < classes, labels[known], classes).astype(np.int64)
    cells = truth[known].astype(np.int64) * (classes + 1) + given
    return np.bincount(cells, minlength=true_classes * (classes + 1)).reshape(true_classes, classes + 1)


@dataclass(frozen=True)
class LabelScore:
    """mean_iou over the classes that occur in the truth; class_iou, class_recall (C,) NaN where a class does not;
    pixel_accuracy;
    unlabelled: share of the pixels with truth that were given no class."""

    mean_iou: float
    class_iou: NDArray[np.float64]
    class_recall: NDArray[np.float64]
    pixel_accuracy: float
    unlabelled: float


def score(confusion: Counts) -> LabelScore | None:
    """Score a square confusion with one more column (from `count_labels`); None without any pixel of truth."""
    classes = len(confusion)
    require_shape("confusion", confusion, (classes, classes + 1))
    total = int(confusion.sum())
    if total == 0:
        return None
    hit = np.diag(confusion[:, :classes]).astype(np.float64)
    in_truth, given = confusion.sum(axis=1), confusion[:, :classes].sum(axis=0)
    occurs = in_truth > 0
    union = in_truth + given - hit
    iou = np.where(occurs, hit / np.maximum(union, 1), np.nan)
    recall = np.where(occurs, hit / np.maximum(in_truth, 1), np.nan)
    return LabelScore(
        float(iou[occurs].mean()), iou, recall, float(hit.sum() / total), float(confusion[:, classes].sum() / total)
    )


def indices_by_name(names: tuple[str, ...], true_names: tuple[str, ...]) -> NDArray[np.int64] | None:
    """(C,) for every class the true class of the same name (any case), -1 without.

    None where fewer than half of the names are shared: then the two lists mean different things, and a "floor" in
    both is a coincidence.
    """
    known = {name.strip().lower(): i for i, name in enumerate(true_names)}
    found = np.array([known.get(name.strip().lower(), -1) for name in names], np.int64)
    return found if len(found) and (found >= 0).mean() >= 0.5 else None


def matched_one_to_one(confusion: Counts) -> NDArray[np.int64]:
    """(C,) for every given label the true class, such that the summed IoU is largest (Hungarian); -1 = left over."""
    given_pixels = confusion[:, :-1].sum(axis=0)
    union = confusion.sum(axis=1)[:, None] + given_pixels[None, :] - confusion[:, :-1]
    iou = confusion[:, :-1] / np.maximum(union, 1)
    rows, columns = linear_sum_assignment(-iou)
    match = np.full(confusion.shape[1] - 1, -1, np.int64)
    match[columns] = rows
    return match


def matched_by_majority(confusion: Counts) -> NDArray[np.int64]:
    """(C,) for every given label the true class that most of its pixels have; several may share one."""
    match = confusion[:, :-1].argmax(axis=0).astype(np.int64)
    match[confusion[:, :-1].sum(axis=0) == 0] = -1
    return match


def renamed(confusion: Counts, match: NDArray[np.int64]) -> Counts:
    """The square confusion after label k is called true class match[k]; -1 becomes unlabelled."""
    true_classes = len(confusion)
    require_shape("match", match, (confusion.shape[1] - 1,))
    square = np.zeros((true_classes, true_classes + 1), np.int64)
    square[:, -1] = confusion[:, -1]
    for label, true_class in enumerate(match):
        square[:, true_class if true_class >= 0 else true_classes] += confusion[:, label]
    return square
