"""Running the stages: what is up to date stays, what is not runs, what was interrupted goes on."""

import gc
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import psutil

from ...formats.atomic import is_disk_full, remove_temporaries
from ...formats.errors import DiskFullError, InputError, RecoverableError
from ...formats.reading import links_in
from ..config import STAGES
from ..system.machine import release_free_memory
from ..system.progress import BEGUN, ENDED, REFUSED, STOPPED, UP_TO_DATE, StageEvent, log, stop_if_asked
from ..system.wording import quoted
from .ending import empty, find_sealed, move_in, results, seal, unseal
from .folder import RunFolder
from .manifest import Manifest, Source, content_digest, finite_or_none, recorded_config, settings_of, write_manifest
from .progress import TimeLeft, in_pieces
from .reads import ReadLog, Situation, StageRecord, begin_log, reads_in, watched
from .stages import Stage, StageContext, stopping_after_writes

_PROCESS = Path("/proc/self")


def run_stages(
    work: StageContext, digest: str, until: str = STAGES[-1], threads: int = 0, redo: str = ""
) -> dict[str, StageRecord]:
    """Bring every stage of `work` up to `until` up to date; returns their records.

    Its settings are what was asked for, and are saved; the stages work with so many `threads` where these leave that
    open. `digest` is that of its source. The stage `redo` and those after it are made again in any case, and `auto`
    chooses anew for them.

    A stage is up to date when its files are unchanged and all that it has read is (`run/reads.py`). Nothing of the run
    changes before everything that can be checked is; then the settings are written, and the manifest calls a stage that
    has to run again stale, with those after it, before it starts. Their folders stay until their own new results are
    ready; what still fits then counts again. Raises InputError as the stages do.
    """
    work = replace(work, run=RunFolder(work.run.root.absolute()))  # processes with another working folder get it
    run, config, wanted = work.run, work.config, work.stages[: STAGES.index(until) + 1]
    book = _Records(run, Source(str(work.source), digest))
    records = book.current
    _check(work, wanted, digest, redo)
    if run.manifest() is None:
        book.save()
    run.save_settings(config)
    settled = replace(config, run=replace(config.run, threads=config.run.threads or threads))
    reporter = StageReporter(work, wanted, records, settled.run.threads)
    for stage in wanted:
        record, now = book.find(stage.name), Situation(stage.program, digest, config, records)
        why = "" if record is None else rerun_reason(stage, run, record, now)
        why = why or ("as asked for" if stage.name == redo else "")
        if record is None or why:
            if why and stage.name in records:
                log.warning("%s and what follows are made again (%s)", stage.name, why)
            begun = stage.name not in records
            book.set_aside(stage.name, keep=stage.name != redo)
            context = replace(work, config=watched(settled), folder=run.partial(stage.name), warnings=[])
            with reporter.running(stage.name) as ended:
                sealed = _find_ended(stage, run, now) if begun else None
                record = sealed or _run_one(stage, context, now)
                move_in(run, stage.name)
                ended(record)
            book.enter(stage.name, record)
        else:
            if stage.name not in records:
                book.enter(stage.name, record)
            reporter.report(stage.name, UP_TO_DATE)
        unseal(run, stage.name)
    return records


def rerun_reason(stage: Stage, run: RunFolder, record: StageRecord, now: Situation) -> str:
    """Why a finished stage has to be made again, "" where it has not."""
    if not run.stage(stage.name).exists():
        return "its folder is gone"
    if why := record.reads.difference(now):
        return why
    if damaged := run.damaged(stage.name):  # last, for it reads all of them
        return f"{len(damaged)} of its files are missing or damaged"
    config, was = now.config, recorded_config({stage.name: record}, now.config)
    memory = was.run.memory_mb
    if stage.division and memory != config.run.memory_mb and stage.division(run, config) != stage.division(run, was):
        return f"run.memory_mb={config.run.memory_mb} divides it otherwise than {memory} has"
    return ""


class _Records:
    """The records of a run while its stages are brought up to date: the `current` ones, and the stale ones, each of
    which holds the settings of all stages, with which it would count again."""

    def __init__(self, run: RunFolder, origin: Source) -> None:
        self._run, self._origin = run, origin
        self.current, self._stale = run.records, run.stale

    def save(self) -> None:
        """Write the manifest."""
        write_manifest(self._run.manifest_file, Manifest(self._origin, self.current, self._stale))

    def find(self, name: str) -> StageRecord | None:
        """Return the record of the results in a stage's folder."""
        return self.current.get(name) or self._stale.get(name)

    def set_aside(self, name: str, keep: bool) -> None:
        """Call a stage and those after it stale, or with `keep` False forget them, and save that."""
        later = STAGES[STAGES.index(name) :]
        settings = {stage: r.settings[stage] for stage, r in self.current.items() if stage in r.settings}
        aside = {stage: self.current.pop(stage) for stage in later if stage in self.current}
        if keep:
            self._stale |= {stage: replace(r, settings=settings | r.settings) for stage, r in aside.items()}
        else:
            self._stale = {stage: r for stage, r in self._stale.items() if stage not in later}
        if aside or not keep:
            self.save()

    def enter(self, name: str, record: StageRecord) -> None:
        """Note that a stage is done, and save that."""
        own = {section: values for section, values in record.settings.items() if section in ("run", name)}
        self.current[name] = replace(record, settings=own)
        self._stale.pop(name, None)
        self.save()


class StageReporter:
    """Reports the stages as they begin and end, and how long the rest will take."""

    def __init__(
        self, work: StageContext, wanted: Sequence[Stage], records: Mapping[str, StageRecord], threads: int
    ) -> None:
        self._progress, self._names, self._threads = work.progress, [stage.name for stage in wanted], threads
        taken = {name: records[name].seconds for name in self._names if name in records}
        pieces = in_pieces(records["tracking"].figures) if "tracking" in records else 0.0
        self._left = TimeLeft(taken, self._names, work.config.run.quality == "draft", pieces)

    def report(self, name: str, state: str, record: StageRecord | None = None) -> None:
        """Report that a stage has come into a state."""
        index, figures = self._names.index(name) + 1, record.figures if record else {}
        seconds, left = record.seconds if record else 0.0, self._left.left
        self._progress.stage(StageEvent(name, index, len(self._names), state, seconds, figures, left))

    @contextmanager
    def running(self, name: str) -> Iterator[Callable[[StageRecord], None]]:
        """The stage runs in this block, which hands its record over at its end."""
        from ..system.threads import limit_threads  # imports torch

        limit_threads(self._threads)
        self._left.begin(name)
        self.report(name, BEGUN)

        def ended(record: StageRecord) -> None:
            self._left.end(name, record.seconds, record.figures)
            self.report(name, ENDED, record)

        try:
            yield ended
        except BaseException as error:
            self.report(name, STOPPED if isinstance(error, KeyboardInterrupt) else REFUSED)
            raise


def _check(work: StageContext, wanted: Sequence[Stage], digest: str, redo: str) -> None:
    """Raise InputError where a stage has work to do and could not. A finished one whose inputs are gone (files deleted,
    a network removed) stays as it is."""
    run, config = work.run, work.config
    for stage in wanted:
        run.partial(stage.name)  # refuses a link
    checks, records, settled = [], {**run.stale, **run.records}, True
    for stage in wanted:
        record = records.get(stage.name)
        now = Situation(stage.program, digest, config, records)
        if settled and record and stage.name != redo and not rerun_reason(stage, run, record, now):
            for path in record.reads.gone():
                log.warning("%s: keeps what it was made from (%s is gone)", stage.name, path)
            continue
        settled = False
        if stage is wanted[0]:
            work.same_source()
        if stage.check_settings:
            stage.check_settings(config)
        if stage.check:
            checks.append(stage.check)
    for check in checks:  # these open networks and read files, which takes longer than what is refused above
        check(work.source, config)


def _find_ended(stage: Stage, run: RunFolder, now: Situation) -> StageRecord | None:
    """The record of this very work, if it had ended when its process was killed.

    How other memory would divide it cannot be asked: what the division reads may be the stage's own results, which are
    not in the manifest yet.
    """
    record, memory = find_sealed(run, stage.name, now), now.config.run.memory_mb
    if record is None or (stage.division and record.settings["run"]["memory_mb"] != memory):
        return None
    log.warning("%s had ended before it was interrupted: its results are taken over", stage.name)
    return record


def _run_one(stage: Stage, context: StageContext, now: Situation) -> StageRecord:
    """Run the stage and seal its folder."""
    stop_if_asked()
    run, folder = context.run, context.folder
    _open_partial(folder, now)
    started = time.monotonic()
    # What caches of methods keep is a cycle: the stage before would hold its pictures and depths through this one.
    gc.collect()
    release_free_memory()
    forget_peak()
    try:
        with stopping_after_writes(folder), ReadLog(run.root, folder, now.config):
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
    remove_temporaries(folder)  # of tasks whose process was killed
    files = results(folder)
    seconds, memory = time.monotonic() - started, peak_memory_mb()
    content, settings = content_digest(files), settings_of(now.config, stage.name)
    finite, reads = finite_or_none(figures), reads_in(folder)
    record = StageRecord(reads, files, seconds, memory, finite, context.warnings, content, settings)
    seal(folder, record)
    return record


def _open_partial(folder: Path, now: Situation) -> None:
    """Keep what an interrupted attempt at this work has left in the unfinished folder where all that it has read is as
    it was, else empty it. Every file there is whole, for it has been flushed to the disk before it took its name."""
    # The program makes no links, and would write through those of somebody else.
    if any(links_in(folder)) or reads_in(folder).difference(now):
        empty(folder)
        begin_log(folder, now)
    remove_temporaries(folder)


def forget_peak() -> None:
    """Let `peak_memory_mb` begin anew, where the system can do that (Linux)."""
    with suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5", encoding="ascii")


def peak_memory_mb() -> float:
    """Largest resident memory of this process since `forget_peak`, in MB; since it began where the system has no such
    thing."""
    with suppress(OSError, ValueError, StopIteration):
        lines = (_PROCESS / "status").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) / 1024
    if sys.platform == "win32":
        return float(psutil.Process().memory_info().peak_wset) / (1024 * 1024)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
