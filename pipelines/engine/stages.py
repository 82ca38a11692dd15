"""Running the stages: what is up to date stays, what is not runs, what was interrupted goes on."""

from __future__ import annotations

import gc
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from ...formats.atomic import is_disk_full, watched_by, write_text
from ...formats.errors import DiskFullError, InputError, RecoverableError
from ..config import Config
from ..run.ending import FINGERPRINT, SNAPSHOT, find_sealed, move_in, results, seal, unseal
from ..run.folder import RunFolder
from ..run.journal import Journal, empty
from ..run.names import STAGES
from ..run.records import (
    Manifest,
    Source,
    StageRecord,
    content_digest,
    load_records,
    plain,
    settings_of,
    write_manifest,
)
from ..run.settings_file import save_settings
from ..system.device import resolve_device
from ..system.limits import available_cpus
from ..system.memory import memory_room, release_free_memory
from ..system.progress import BEGUN, ENDED, REFUSED, STOPPED, UP_TO_DATE, Progress, StageEvent, log
from ..system.stopping import stop_if_asked
from ..system.wording import quoted
from .standing import (
    kept_inputs,
    memory_of,
    next_upstream,
    stage_fingerprint,
    why_again,
)
from .time_left import TimeLeft

T = TypeVar("T")
R = TypeVar("R")
_PROCESS = Path("/proc/self")
SameSource = Callable[[], None]


def _trusted() -> None:
    """A source that nobody asks about."""


class TaskWorkers(Protocol):
    """Workers that take the tasks of a stage."""

    @property
    def at_once(self) -> int:
        """Number of tasks that may run at the same time."""
        ...

    @property
    def threads(self) -> int:
        """Threads that each takes: the same everywhere, or the results would differ."""
        ...

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T], folder: Path) -> list[R]:
        """Do `work` on every task, below `folder`, a stage's unfinished one; returns its results in order."""
        ...


@dataclass(frozen=True)
class StageContext:
    """Everything that a stage is given.

    `folder` is the stage's own unfinished folder: it writes its result there, and may keep snapshots under
    `folder / "snapshot"`, which is removed when the stage ends well. What an interrupted attempt with the same
    settings and inputs has left in `folder` is still there when the stage starts again. `stages` are all of the run;
    `same_source` raises RecoverableError where the source is not, or no longer, what the run was begun from; `workers`
    take the tasks that a stage is divided into, None for this process.
    """

    run: RunFolder
    source: Path
    config: Config
    folder: Path
    progress: Progress
    warnings: list[str] = field(default_factory=list)
    stages: list[Stage] = field(default_factory=list)
    same_source: SameSource = _trusted
    workers: TaskWorkers | None = None

    @property
    def snapshot(self) -> Path:
        """Folder for snapshots; made on first use."""
        path = self.folder / SNAPSHOT
        path.mkdir(exist_ok=True)
        return path

    @property
    def threads(self) -> int:
        """Number of CPU threads to use."""
        return self.config.run.threads or available_cpus()

    @property
    def memory_room(self) -> float:
        """Bytes of memory to plan with."""
        return memory_room(self.config.run.memory_mb)

    @property
    def device(self) -> str:
        """Device of dense work, "cpu" or "cuda"."""
        return resolve_device(self.config.run.device)

    def each(self, work: Callable[[T, Progress], R], tasks: Sequence[T]) -> list[R]:
        """Do `work`, a function of a module's top level, on every task, here, one after the other, or by the workers;
        returns its results in order. A task leaves files below `folder`, and does nothing where they are."""
        if self.workers is None:
            return [self._done(work, task) for task in tasks]
        return self.workers.each(work, tasks, self.folder)

    def _done(self, work: Callable[[T, Progress], R], task: T) -> R:
        result = work(task, self.progress)
        release_free_memory()
        return result

    def warn(self, message: str) -> None:
        """A degraded result: logged now, counted and kept for the report."""
        log.warning(message)
        self.warnings.append(message)


@dataclass(frozen=True)
class Stage:
    """`run` does the work and returns its key figures; what code it is follows from its module (`stage_identity`).

    A stage that reads more than the stages before it says so by `inputs`: plain values that change with what it reads
    (files, models). `check` refuses what it could not use. Both see (source, config) before the first stage runs, so
    that a mistake is told of before anything slow. `auto` names the inputs that the settings leave to what is there
    (networks in the cache): a finished stage keeps what was chosen when it was made. `division`: into which parts the
    work of a finished stage is divided with these settings, where the memory that is given decides that and the result
    with it.
    """

    name: str
    run: Callable[[StageContext], dict[str, Any]]
    inputs: Callable[[Path, Config], Any] | None = None
    check: Callable[[Path, Config], None] | None = None
    auto: Callable[[Config], tuple[str, ...]] = lambda config: ()
    division: Callable[[RunFolder, Config], Any] | None = None

    @property
    def file(self) -> Path:
        """The module of `run`."""
        return Path(self.run.__code__.co_filename)


def run_stages(
    stages: list[Stage],
    run: RunFolder,
    source: Path,
    source_digest: str,
    config: Config,
    progress: Progress,
    until: str = STAGES[-1],
    same_source: SameSource = _trusted,
    workers: TaskWorkers | None = None,
    threads: int = 0,
    redo: str = "",
) -> dict[str, StageRecord]:
    """Bring every stage up to `until` up to date; returns their records.

    `config` is what was asked for, and is saved; the stages work with so many `threads` where it leaves that open. The
    stage `redo` and those after it are made again in any case, and `auto` chooses anew for them.

    A stage is up to date when its fingerprint (code, own settings, seed, own inputs, content of the stages before
    it) and its files are unchanged. Nothing of the run changes before everything that can be checked is; then the
    settings are written, and a stage that has to run again is taken out of the manifest, with those after it, before
    it starts. Raises InputError as the stages do.
    """
    run = RunFolder(run.root.absolute())  # tasks take it to processes with another working folder
    records = load_records(run)
    origin = Source(str(source), source_digest)
    upstream = source_digest
    wanted = stages[: STAGES.index(until) + 1]
    inputs = _check_inputs(wanted, run, source, config, source_digest, same_source, redo)
    if run.manifest() is None:
        write_manifest(run.manifest_file, Manifest(origin, records))
    save_settings(run, config)
    watch = Watch(progress, wanted, records)
    for stage in wanted:
        record = records.get(stage.name)
        why = "" if record is None else why_again(stage, run, record, config, upstream, inputs[stage.name])
        why = why or ("as asked for" if stage.name == redo else "")
        if record is None or why:
            fingerprint = stage_fingerprint(stage, config, upstream, inputs[stage.name])
            if why:
                log.warning("%s and what follows are made again (%s)", stage.name, why)
            if _drop(records, stage.name):
                write_manifest(run.manifest_file, Manifest(origin, records))
            folder = run.partial(stage.name)
            settled = replace(config, run=replace(config.run, threads=config.run.threads or threads))
            context = StageContext(run, source, settled, folder, progress, [], stages, same_source, workers)
            with watch.running(stage.name) as ended:
                sealed = _find_ended(stage, run, config, fingerprint) if record is None else None
                record = sealed or _run_one(stage, context, fingerprint, inputs[stage.name], config)
                move_in(run, stage.name)
                ended(record)
            records[stage.name] = record
            write_manifest(run.manifest_file, Manifest(origin, records))
            unseal(run, stage.name)
            for later in STAGES[STAGES.index(stage.name) + 1 :]:  # made from what is no longer there
                shutil.rmtree(run.stage(later), ignore_errors=True)
        else:
            unseal(run, stage.name)
            watch.tell(stage.name, UP_TO_DATE)
        upstream = next_upstream(upstream, record)
    return records


class Watch:
    """Tells of the stages as they begin and end, and how long the rest will take."""

    def __init__(self, progress: Progress, wanted: Sequence[Stage], records: Mapping[str, StageRecord]) -> None:
        self._progress, self._names = progress, [stage.name for stage in wanted]
        done = {name: records[name].seconds for name in self._names if name in records}
        self._left = TimeLeft(self._names, done)

    def tell(self, name: str, state: str, record: StageRecord | None = None) -> None:
        """Report that a stage has come into a state."""
        index, figures = self._names.index(name) + 1, record.figures if record else {}
        seconds = record.seconds if record else 0.0
        self._progress.stage(StageEvent(name, index, len(self._names), state, seconds, figures, self._left.left))

    @contextmanager
    def running(self, name: str) -> Iterator[Callable[[StageRecord], None]]:
        """The stage runs in this block, which hands its record over at its end."""
        self._left.begin(name)
        self.tell(name, BEGUN)

        def ended(record: StageRecord) -> None:
            self._left.end(name, record.seconds)
            self.tell(name, ENDED, record)

        try:
            yield ended
        except BaseException as error:
            self.tell(name, STOPPED if isinstance(error, KeyboardInterrupt) else REFUSED)
            raise


def _drop(records: dict[str, StageRecord], name: str) -> bool:
    """Take out this stage and those after it; whether there was any."""
    dropped = [records.pop(later, None) for later in STAGES[STAGES.index(name) :]]
    return any(record is not None for record in dropped)


def _check_inputs(
    stages: list[Stage], run: RunFolder, source: Path, config: Config, upstream: str, same_source: SameSource, redo: str
) -> dict[str, Any]:
    """What each stage reads beside the stages before it; raises InputError where one has work to do and cannot.

    A finished stage whose inputs are gone (files deleted, a model removed) stays as it is.
    """
    inputs, records = {}, load_records(run)
    settled = True
    for stage in stages:
        record = records.get(stage.name)
        settled = settled and record is not None and stage.name != redo
        if settled and record is not None:
            settled = not why_again(stage, run, record, config, upstream, record.inputs)
        try:
            inputs[stage.name] = stage.inputs(source, config) if stage.inputs else None
        except InputError as error:
            if record is None or not settled:
                raise
            log.warning("%s: keeps what it was made from (%s)", stage.name, error)
            inputs[stage.name] = record.inputs
        if settled and record is not None:
            settled = kept_inputs(stage, config, record, inputs[stage.name]) == record.inputs
        upstream = next_upstream(upstream, record) if record else upstream
        if stage is stages[0] and not settled:
            same_source()
        if stage.check and not settled:
            stage.check(source, config)
    return inputs


def _find_ended(stage: Stage, run: RunFolder, config: Config, fingerprint: str) -> StageRecord | None:
    """The record of this very work, if it had ended when its process was killed.

    How other memory would divide it cannot be asked: what the division reads may be the stage's own results, which are
    not in the manifest yet.
    """
    record = find_sealed(run, stage.name, fingerprint)
    if record is None or (stage.division is not None and memory_of(stage, record, config) != config.run.memory_mb):
        return None
    log.warning("%s had ended before it was interrupted: its results are taken over", stage.name)
    return record


def _run_one(stage: Stage, context: StageContext, fingerprint: str, inputs: Any, config: Config) -> StageRecord:
    """Run the stage and seal its folder; `config` is what was asked for."""
    stop_if_asked()
    run, folder = context.run, context.folder
    journal = _open_partial(folder, fingerprint)
    started = time.monotonic()
    # What caches of methods keep is a cycle: the stage before would hold its pictures and depths through this one.
    gc.collect()
    release_free_memory()
    forget_peak()
    try:
        with watched_by(journal):
            figures = stage.run(context)
    except InputError as error:
        if stage.name == STAGES[0] and not isinstance(error, RecoverableError):
            context.same_source()  # if it is not, that is what is wrong
        raise
    except OSError as error:
        if is_disk_full(error, run.root):
            raise DiskFullError(
                f"{run.root}: the disk is full. Free some space and run `msgs-slam resume {quoted(run.root)}`"
            ) from error
        raise
    journal.check(files := results(folder))
    seconds, memory = time.monotonic() - started, peak_memory_mb()
    content, settings = content_digest(files), settings_of(config, stage.name)
    record = StageRecord(
        fingerprint, files, seconds, memory, plain(figures), context.warnings, content, inputs, settings
    )  # fmt: skip
    seal(folder, record)
    return record


def _open_partial(folder: Path, fingerprint: str) -> Journal:
    """The unfinished folder: what is whole in it where it belongs to exactly this work, else empty."""
    stamp, journal = folder / FINGERPRINT, Journal(folder)
    if not (stamp.exists() and stamp.read_text(encoding="utf-8", errors="replace") == fingerprint):
        empty(folder)
    elif damaged := journal.discard_damaged(keep=(FINGERPRINT,)):
        log.warning(
            "%s: %d files of the interrupted attempt are damaged and made again, the first is %s",
            folder.name, len(damaged), damaged[0],
        )  # fmt: skip
    write_text(stamp, fingerprint)
    return journal


def forget_peak() -> None:
    """Let `peak_memory_mb` begin anew, where the system can do that (Linux)."""
    with suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float:
    """Largest resident memory of this process since `forget_peak`, in MB; since it began where the system has no such
    thing, 0 where it tells nothing (Windows)."""
    with suppress(OSError, ValueError, StopIteration):
        lines = (_PROCESS / "status").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) / 1024
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
