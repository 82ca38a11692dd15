"""Notes of what a stage reads, taken as it reads: they and the program are the identity of its result.

A stage is made again where a setting or a file that it has read is another by now. Settings are noted by the view of
them that a stage is given (`watched`), files of earlier stages by the run folder, files of the user and networks by
`formats.reading.opened`; the package's own code and data are in the digest of the program, the source's files in that
of the source. Not noted are settings of the machine (of the memory the stage's `division` says whether it matters) and
results of networks that are kept over runs, whose names are digests of what made them.

Notes are on disk before what was read can leave anything there. So unfinished work is judged by what it has read so
far, and goes on where all of that is as it was; `LOGS` in its folder holds a file for each process that works on it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from threading import Lock
from typing import IO, Any, TypeVar

from ...formats.atomic import process_token
from ...formats.errors import InputError
from ...formats.reading import known_sha256, noting_files, on_each_read
from ..config import EXTENSION, Config
from ..system.identity import ROOMS, ROOT
from ..system.progress import Progress

T = TypeVar("T")
R = TypeVar("R")
LOGS = ".reads"
_FIGURES = ""
"""In the place of a file's name: the figures that a stage's record holds."""
_OF_MACHINE = {"threads", "device", "memory_mb"}
_active: ContextVar[ReadLog | None] = ContextVar("_active", default=None)


@dataclass(frozen=True)
class Reads:
    """Everything that a stage has read. program: digest of what computed it; source: the source's digest; settings:
    section.key → value; results: earlier stage → digest and names of its files ("" for its figures); files: path →
    sha256, of a folder of its names, "" where there was nothing."""

    program: str = ""
    source: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    results: dict[str, tuple[str, list[str]]] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)

    def changed_settings(self, config: Config) -> list[str]:
        """Return `section.key=value` of each setting that `config` has otherwise."""
        return [f"{key}={now}" for key, value in self.settings.items() if (now := _setting(config, key)) != value]

    def difference(self, now: Situation) -> str:
        """Say what of it is another by now, "" where nothing is. A file that is gone is no other one."""
        if changed := self.changed_settings(now.config):
            return f"other settings: {', '.join(changed)}"
        if self.program != now.program:
            return "another version of the program made it"
        if self.source != now.source:
            return "it is of another source"
        for stage, (digest, names) in self.results.items():
            record = now.records.get(stage)
            if record is None or _digest_of_pairs((n, digest_of_result(record, n)) for n in names) != digest:
                return f"{stage} has other results by now"
        other = [path for path, digest in self.files.items() if _digest_of_path(Path(path)) not in (digest, "")]
        return f"{other[0]} is another file by now" if other else ""

    def gone(self) -> list[str]:
        """Return the files that were there and are no longer."""
        return [path for path, digest in self.files.items() if digest and not os.path.exists(path)]


@dataclass(frozen=True)
class StageRecord:
    """One finished stage. reads: what it was made from; files: relative path → [bytes, sha256]; settings: {"run": ...,
    its own section: ...}, those that it was made with, whatever run.toml says by now; of a stale one the sections of
    the other stages, too."""

    reads: Reads
    files: dict[str, tuple[int, str]]
    seconds: float
    peak_memory_mb: float
    figures: dict[str, Any]
    warnings: list[str]
    content: str
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Situation:
    """Everything that a stage would read by now: its program, the source, the settings, the earlier stages' results."""

    program: str
    source: str
    config: Config
    records: Mapping[str, StageRecord]


def _setting(config: Config, key: str) -> Any:
    section, _, name = key.partition(".")
    return getattr(getattr(config, section, None), name, None)


def _digest_of_path(path: Path) -> str:
    """Digest a file's bytes or a folder's names; "" for nothing that can be read."""
    with noting_files(), suppress(InputError, OSError, ValueError):
        if path.is_dir():
            return hashlib.sha256("\0".join(sorted(os.listdir(path))).encode("utf-8", "surrogateescape")).hexdigest()
        return known_sha256(path)
    return ""


def digest_of_result(record: StageRecord, name: str) -> str:
    """Return the digest of a file that a finished stage has left, "" where it has left none of that name."""
    if name == _FIGURES:
        return hashlib.sha256(json.dumps(record.figures, sort_keys=True).encode()).hexdigest()
    return record.files[name][1] if name in record.files else ""


def _digest_of_pairs(pairs: Iterable[tuple[str, str]]) -> str:
    return hashlib.sha256(json.dumps([*pairs]).encode()).hexdigest()


class ReadLog:
    """Notes what is read in its block, in this thread and those that `system.parallel` starts, for the stage that works
    in `folder`. Settings are noted with the values of `config`, whatever a task makes of them."""

    def __init__(self, root: Path, folder: Path, config: Config) -> None:
        self._root, self._folder = root.absolute(), folder
        self.config = replace(config, **{f.name: _plain(getattr(config, f.name)) for f in fields(config)})
        self._seen = set(_entries(folder)) if (folder / LOGS).is_dir() else set()
        self.covered: set[str] = set()
        self._lock = Lock()
        self._stream: IO[str] | None = None

    def __enter__(self) -> ReadLog:
        (self._folder / LOGS).mkdir(parents=True, exist_ok=True)
        self._stream = (self._folder / LOGS / f"{process_token()}.jsonl").open("a", encoding="utf-8")
        self._stream.write("\n")  # ends a line that a killed process has left in the middle
        self._token, self._reading = _active.set(self), on_each_read(self.note_file)
        self._reading.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._reading.__exit__(None, None, None)
        _active.reset(self._token)
        if self._stream is not None:
            self._stream.close()

    def note(self, kind: str, key: str, find: Callable[[], Any]) -> None:
        """Write down what a thing is that is read for the first time, before it is used."""
        if (kind, key) in self._seen or self._stream is None:
            return
        value = find()
        with self._lock:
            if (kind, key) not in self._seen:
                self._stream.write(json.dumps([kind, key, value]) + "\n")
                self._stream.flush()
                self._seen.add((kind, key))

    def note_file(self, path: Path) -> None:
        """Note a file or folder of the user or a network; the package's own, the source's and the run's are known."""
        text = os.path.abspath(path)
        if ("files", text) in self._seen or text in self.covered:
            return
        if any(Path(text).resolve().is_relative_to(ROOT / room) for room in ROOMS):
            return
        inside = Path(text).relative_to(self._root).parts if Path(text).is_relative_to(self._root) else ()
        if not inside or inside[0].startswith(EXTENSION):
            self.note("files", text, lambda: _digest_of_path(Path(text)))

    def for_task(self, work: Callable[[T, Progress], R]) -> Callable[[T, Progress], R]:
        """Return the work so that it notes what it reads in the process that does it."""
        noted = functools.partial(_work_noted, work, self._root, self._folder, self.config)
        return functools.update_wrapper(noted, work)


def _work_noted(
    work: Callable[[T, Progress], R], root: Path, folder: Path, config: Config, task: T, progress: Progress
) -> R:
    with ReadLog(root, folder, config):
        return work(task, progress)


def active_log() -> ReadLog | None:
    """Return the log of the stage that this thread works for."""
    return _active.get()


def note_result(root: Path, stage: str, name: str, find: Callable[[], str]) -> None:
    """Note a result of a stage of the run in `root`, with its digest."""
    if (log := _active.get()) is not None and log._root == root.absolute():
        log.note("results", f"{stage}/{name}", find)


def note_figures(root: Path, records: Mapping[str, StageRecord]) -> None:
    """Note the figures in these records of the run in `root`."""
    for stage, record in records.items():
        note_result(root, stage, _FIGURES, functools.partial(digest_of_result, record, _FIGURES))


def cover_files(files: Iterable[Path]) -> None:
    """Tell the stage that this thread works for that its source's digest covers these files."""
    if (log := _active.get()) is not None:
        log.covered.update(os.path.abspath(file) for file in files)


def _entries(folder: Path) -> dict[tuple[str, str], Any]:
    found: dict[tuple[str, str], Any] = {}
    for log in sorted((folder / LOGS).glob("*.jsonl")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError):  # a line that was cut short: what it says had not been read
                kind, key, value = json.loads(line)
                found[kind, key] = value
    return found


def begin_log(folder: Path, now: Situation) -> None:
    """Note in an empty folder of a stage what its work is begun by."""
    log = ReadLog(folder, folder, now.config)
    with log:
        log.note("program", "", lambda: now.program)
        log.note("source", "", lambda: now.source)


def reads_in(folder: Path) -> Reads:
    """Return what the processes that have worked in a folder have read."""
    of: defaultdict[str, dict[str, Any]] = defaultdict(dict)
    for (kind, key), value in sorted(_entries(folder).items(), key=lambda entry: entry[0]):
        of[kind][key] = value
    read_of: defaultdict[str, dict[str, str]] = defaultdict(dict)
    for place, digest in of["results"].items():
        stage, _, name = place.partition("/")
        read_of[stage][name] = digest
    results = {stage: (_digest_of_pairs(found.items()), list(found)) for stage, found in read_of.items()}
    return Reads(of["program"].get("", ""), of["source"].get("", ""), of["settings"], results, of["files"])


def watched(config: Config) -> Config:
    """Return the settings so that a stage which reads one of them notes it."""
    return replace(config, **{f.name: _view(f.name, getattr(config, f.name)) for f in fields(config)})


def _plain(values: T) -> T:
    """Return a section whose reads are not noted, of one or of a view of one: a stage that runs stages has views."""
    cls: type[T] = getattr(type(values), "plain_class", type(values))
    return cls(**vars(values))


def _view(section: str, values: T) -> T:
    values = _plain(values)
    cls = _view_class(section, type(values))  # type: ignore[arg-type]
    view: T = object.__new__(cls)
    vars(view).update(vars(values))
    return view


@functools.cache
def _view_class(section: str, cls: type[T]) -> type[T]:
    names = frozenset(f.name for f in fields(cls)) - (_OF_MACHINE if section == "run" else set())  # type: ignore[arg-type]

    def get(view: T, name: str) -> Any:
        if name in names and (log := _active.get()) is not None:
            log.note("settings", f"{section}.{name}", lambda: _setting(log.config, f"{section}.{name}"))
        return object.__getattribute__(view, name)

    changed = {
        "plain_class": cls,
        "__getattribute__": get,
        "__reduce__": lambda view: (_view, (section, _plain(view))),
        "__eq__": lambda view, other: isinstance(other, cls) and vars(view) == vars(other),
        "__hash__": lambda view: hash(_plain(view)),
        "__module__": cls.__module__,
    }
    return type(cls.__name__, (cls,), changed)
