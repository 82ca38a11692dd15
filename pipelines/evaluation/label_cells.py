"""The label figures of a run: by name where the classes are the truth's, as a clustering where they are not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.evaluation.label_score import Counts, LabelScore, matched_by_majority, matched_one_to_one, renamed, score


def label_cells(
    confusion: Counts, match: NDArray[np.int64] | None, semantics: str, true_names: tuple[str, ...]
) -> dict[str, Any]:
    """confusion as `count_labels` gives it; match (C,) the true class of every class of the run, None where their
    names are not the truth's. A clustering's classes are named *by the truth*: its figures flatter and stand apart."""
    if confusion.size == 0 or confusion.sum() == 0:
        return {"missing": "no rendered view has true labels"}
    given = "labels from files" if semantics.startswith("files") else "predicted labels"
    if match is not None:
        return {"input": given, "matching": "by name", **_cells(score(renamed(confusion, match)), true_names)}
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
    }
