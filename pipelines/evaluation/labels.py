"""Agreement of label images, from one confusion matrix over the whole sequence, by classes that both sides know.

Where names differ from the truth's, a class map joins ours to theirs:

truth = ["wall", "couch", "shoe"]   # every class of the truth, by which it is recognised; may be omitted
[classes]
wall = "wall"
sofa = "couch"                      # or a list: whichever of them the truth says is right
armchair = "couch"

Names that are joined by an entry are one class then. Compared are the classes that both sides know.
"""

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from ...formats.errors import InputError
from ...formats.textfile import read_toml
from ..system.progress import log
from ..types import require_shape

_SHIPPED = Path(__file__).with_name("class_maps")

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


@dataclass(frozen=True)
class Matching:
    """The classes a run and the truth have in common. names: K common classes; of_ours (C,) and of_truth (T,): the
    common class of each, -1 without; how: in words."""

    names: tuple[str, ...]
    of_ours: NDArray[np.int64]
    of_truth: NDArray[np.int64]
    how: str

    def joined(self, confusion: Counts) -> Counts:
        """(T, C + 1) pixels → (K, K + 1) of the common classes. Pixels whose true class is none of them are left out;
        what was given another class, or none, counts in the last column."""
        count = len(self.names)
        require_shape("confusion", confusion, (len(self.of_truth), len(self.of_ours) + 1))
        columns = np.append(np.where(self.of_ours >= 0, self.of_ours, count), count)
        out = np.zeros((count, count + 1), np.int64)
        kept = np.flatnonzero(self.of_truth >= 0)
        np.add.at(out, (self.of_truth[kept][:, None], columns[None, :]), confusion[kept])
        return out


@dataclass(frozen=True)
class ClassMap:
    """pairs: our name, its names in the truth, all lower case; truth: every class of the truth, () where unknown."""

    name: str
    pairs: tuple[tuple[str, tuple[str, ...]], ...]
    truth: tuple[str, ...] = ()

    def match(self, names: tuple[str, ...], vocabulary: Iterable[str], true_names: tuple[str, ...]) -> Matching:
        """For the classes of a run, `names`, out of the `vocabulary` of what labelled it: a class that it knows and
        did not find counts as well.

        Raises InputError for a map that joins nothing here.
        """
        known, theirs = set(_lower((*names, *vocabulary))), _lower(true_names)
        group: dict[tuple[str, str], int] = {}
        for ours, others in self.pairs:
            there = [("theirs", o) for o in others if o in theirs]
            if ours in known and there:
                members = [("ours", ours), *there]
                met = sorted({group[m] for m in members if m in group})
                number = met[0] if met else len(group)
                group |= {k: number for k, v in group.items() if v in met} | dict.fromkeys(members, number)
        if not group:
            raise InputError(
                f"{self.name}: joins none of the run's classes ({_some(sorted(known))}) with one of the truth's "
                f'({_some(theirs)}). Write lines like: wall = "wall"'
            )
        numbers = list(dict.fromkeys(group["theirs", t] for t in theirs if ("theirs", t) in group))
        titles = tuple(" / ".join(t for t in theirs if group.get(("theirs", t)) == n) for n in numbers)
        of_ours, of_truth = (
            np.array([numbers.index(group[side, n]) if (side, n) in group else -1 for n in listed], np.int64)
            for side, listed in (("ours", _lower(names)), ("theirs", theirs))
        )
        return Matching(titles, of_ours, of_truth, f"by {self.name}")

    def unknown(self, vocabulary: Iterable[str], true_names: tuple[str, ...]) -> list[str]:
        """Which names, each with the nearest known one, are neither classes of the run's, or of the maps that come with
        the program, nor the truth's: entries of them join nothing."""
        shipped = shipped_maps()
        ours = {*_lower(vocabulary), *(o for m in shipped for o, _ in m.pairs)}
        theirs = {*_lower(true_names), *self.truth}
        return [
            *(f"{_named(o, ours)} of the run" for o, _ in self.pairs if o not in ours),
            *dict.fromkeys(
                f"{_named(t, theirs)} of the truth" for _, others in self.pairs for t in others if t not in theirs
            ),
        ]


def read_class_map(path: Path) -> ClassMap:
    """Raises InputError for a file that is no class map."""
    values = read_toml(path)
    classes, truth = values.get("classes"), values.get("truth", [])
    if not isinstance(classes, dict) or not classes or set(values) - {"classes", "truth"}:
        raise InputError(f'{path} is not a class map. Write [classes] and under it lines like: sofa = "couch"')
    pairs = []
    for ours, theirs in classes.items():
        listed = [theirs] if isinstance(theirs, str) else theirs
        if not isinstance(listed, list) or not listed or not all(isinstance(t, str) for t in listed):
            raise InputError(f'{path}: {ours} is given {theirs!r}; a name or a list of names is expected: "wall"')
        pairs.append((ours.strip().lower(), tuple(_lower(listed))))
    if not isinstance(truth, list) or not all(isinstance(t, str) for t in truth):
        raise InputError(f"{path}: truth is a list of names")
    return ClassMap(path.stem, tuple(pairs), tuple(_lower(truth)))


def shipped_maps() -> list[ClassMap]:
    """The maps that come with the program."""
    return [read_class_map(p) for p in sorted(_SHIPPED.glob("*.toml"))]


def open_class_map(text: str) -> ClassMap:
    """A file, or the name of a map that comes with the program. Raises InputError when it is neither."""
    if Path(text).is_file():
        return read_class_map(Path(text))
    maps = {m.name: m for m in shipped_maps()}
    if text not in maps:
        raise InputError(f"{text}: there is no such file, nor a class map of that name; known: {', '.join(maps)}")
    return maps[text]


def match_classes(
    names: tuple[str, ...], vocabulary: tuple[str, ...], true_names: tuple[str, ...], given: ClassMap | None
) -> Matching | None:
    """By the map that is `given`; else by the names themselves where all of the run's are the truth's; else by the one
    map that comes with the program and fits both; else by the names where half of them are shared; else not at all.

    A `vocabulary` of () says that the names are the run's own (regions without names): no map is looked for.
    Raises InputError as `ClassMap.match`.
    """
    if given is not None:
        return given.match(names, vocabulary, true_names)
    same = indices_by_name(names, true_names)
    by_name = None if same is None else Matching(true_names, same, np.arange(len(true_names)), "by name")
    if by_name is not None and (by_name.of_ours >= 0).all():
        return by_name
    fitting = [m for m in shipped_maps() if vocabulary and _fits(m, vocabulary, true_names)]
    if len(fitting) > 1:
        fits = " or ".join(m.name for m in fitting)
        log.warning("more than one class map fits: choose one with --class-map %s", fits)
    return fitting[0].match(names, vocabulary, true_names) if len(fitting) == 1 else by_name


def _fits(map_: ClassMap, vocabulary: tuple[str, ...], true_names: tuple[str, ...]) -> bool:
    """Whether all of the truth's classes are the map's, and half of the vocabulary's or ten of them are."""
    ours, theirs = {o for o, _ in map_.pairs}, set(map_.truth)
    known = sum(n in ours for n in _lower(vocabulary))
    return bool(true_names) and set(_lower(true_names)) <= theirs and known >= min(10, len(vocabulary) / 2)


def _named(name: str, known: set[str]) -> str:
    near = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.5)
    return f"{name!r} (did you mean {near[0]!r}?)" if near else repr(name)


def _lower(names: Iterable[str]) -> list[str]:
    return [n.strip().lower() for n in names]


def _some(names: list[str], limit: int = 12) -> str:
    return ", ".join(names[:limit]) + (" …" if len(names) > limit else "")


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
        return {**of, **_score_cells(score(matching.joined(confusion)), matching.names)}
    every = np.arange(len(true_names))
    kinds = {"one to one": matched_one_to_one(confusion), "majority": matched_by_majority(confusion)}
    found = {name: score(Matching(true_names, match, every, name).joined(confusion)) for name, match in kinds.items()}
    return {
        "input": given,
        "matching": "none",
        "missing": "the run's classes have other names than the truth's",
        "clustering": {name: _score_cells(of_kind, true_names) for name, of_kind in found.items()},
    }


def _score_cells(found: LabelScore | None, names: tuple[str, ...]) -> dict[str, Any]:
    if found is None:
        return {"missing": "no pixel has a true class"}
    of_class = {"class_iou": found.class_iou, "class_recall": found.class_recall}
    return {"mean_iou": found.mean_iou, "pixel_accuracy": found.pixel_accuracy, "unlabelled": found.unlabelled} | {
        key: {n: float(v) for n, v in zip(names, of, strict=True) if np.isfinite(v)} for key, of in of_class.items()
    }
