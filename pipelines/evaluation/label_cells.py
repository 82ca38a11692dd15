"""The label figures of a run: by name where the classes are the truth's, as a clustering where they are not."""

from __future__ import annotations

from typing import Any

import numpy as np

from .class_map import Matching
from .label_score import (
    Counts,
    LabelScore,
    matched_by_majority,
    matched_one_to_one,
    renamed,
    score,
)


def label_cells(
    confusion: Counts, matching: Matching | None, semantics: str, true_names: tuple[str, ...]
) -> dict[str, Any]:
    """confusion as `count_labels` gives it; matching: what the classes of run and truth have in common, None where
    their names are not the truth's. A clustering's classes are named *by the truth*: its figures flatter and stand
    apart."""
    if confusion.size == 0 or confusion.sum() == 0:
        return {"missing": "no rendered view has true labels"}
    given = "labels from files" if semantics.startswith("files") else "predicted labels"
    if matching is not None:
        of = {"input": given, "matching": matching.how}
        return {**of, **_cells(score(matching.joined(confusion)), matching.names)}
    return {
        "input": given,
        "matching": "none",
        "missing": "the run's classes have other names than the truth's",
        "clustering": {
            "one to one": _cells(score(renamed(confusion, matched_one_to_one(confusion))), true_names),
            "majority": _cells(score(renamed(confusion, matched_by_majority(confusion))), true_names),
        },
    }


def _cells(found: LabelScore | None, names: tuple[str, ...]) -> dict[str, Any]:
    if found is None:
        return {"missing": "no pixel has a true class"}
    return {
        "mean_iou": found.mean_iou,
        "pixel_accuracy": found.pixel_accuracy,
        "unlabelled": found.unlabelled,
        "class_iou": {n: float(v) for n, v in zip(names, found.class_iou, strict=True) if np.isfinite(v)},
        "class_recall": {n: float(v) for n, v in zip(names, found.class_recall, strict=True) if np.isfinite(v)},
    }
