"""Classes whose names differ from the truth's: a table of ours to theirs.

truth = ["wall", "couch", "shoe"]   # every class of the truth, by which it is recognised; may be left out
[classes]
wall = "wall"
sofa = "couch"                      # or a list: whichever of them the truth says is right
armchair = "couch"

Names that are joined by an entry are one class then. Compared are the classes that both sides know.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.jsonfile import read_toml
from ..system.progress import log
from ..types import require_shape
from .label_score import Counts, indices_by_name

_SHIPPED = Path(__file__).with_name("class_maps")


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

    def require_known(self, vocabulary: Iterable[str], true_names: tuple[str, ...]) -> None:
        """Raise InputError for a name that is neither a class of the run's, or of the maps that come with the
        program, nor one of the truth's."""
        shipped = shipped_maps()
        ours = {*_lower(vocabulary), *(o for m in shipped for o, _ in m.pairs)}
        theirs = {*_lower(true_names), *self.truth}
        for name, others in self.pairs:
            _require(name, ours, f"{self.name}: the run knows no class")
            for other in others:
                _require(other, theirs, f"{self.name}: the truth has no class")


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


def _require(name: str, known: set[str], problem: str) -> None:
    if name in known:
        return
    near = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {_some(sorted(known))}"
    raise InputError(f"{problem} {name!r}; {hint} Correct that line, or take it out")


def _lower(names: Iterable[str]) -> list[str]:
    return [n.strip().lower() for n in names]


def _some(names: list[str], most: int = 12) -> str:
    return ", ".join(names[:most]) + (" …" if len(names) > most else "")
