"""Status of a run, for people and for programs."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ..config import STAGES, Config
from ..system.wording import quoted
from .folder import RunFolder
from .progress import RunProgress, load_run_progress
from .reads import Situation, StageRecord
from .runner import rerun_reason
from .stages import Stage

DONE, RUNNING, DAMAGED, INTERRUPTED = "done", "running", "damaged", "interrupted"
OUTDATED, NOT_YET = "outdated", "not yet"

Program = Callable[[str], Sequence[Stage]]
"""The stages of a method (`run.method`), in order."""


@dataclass(frozen=True)
class StageStatus:
    """state: done; running (a process makes it now); damaged (done, but some of its files are gone or not as it left
    them); interrupted (started and not ended); outdated (its files are there, but were made with other settings or from
    other inputs than the stages before it have by now); not yet. record: of a stage that is done; changed: settings of
    run.toml, as `section.key=value`, with which `resume` would make it again; damaged: names of those files; again: why
    `resume` would make it again, where nothing above says so; running: how far the process is that makes it now."""

    name: str
    state: str
    record: StageRecord | None
    changed: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()
    again: str = ""
    running: RunProgress | None = None

    @property
    def state_text(self) -> str:
        """The state, and of a stage that is being made how far it is."""
        return self.running.text if self.running else self.state


@dataclass(frozen=True)
class RunStatus:
    """source: the path that the run was made from; stages: all of them, in order."""

    run: RunFolder
    source: str
    stages: tuple[StageStatus, ...]

    @property
    def warnings(self) -> list[str]:
        """Faults of the run itself, each with the command that repairs it."""
        again = f"`msgs-slam resume {quoted(self.run.root)}` runs it and all later stages again"
        changed = [
            f"{s.name} was made with other settings than run.toml now has ({', '.join(s.changed)}): {again}"
            for s in self.stages
            if s.changed
        ]
        damaged = [
            f"{s.name}: its folder is gone: {again}"
            if not self.run.stage(s.name).exists()
            else f"{s.name}: {len(s.damaged)} of its {len(s.record.files)} files are missing or damaged "
            f"({', '.join(s.damaged[:5])}{', ...' if len(s.damaged) > 5 else ''}): {again}"
            for s in self.stages
            if s.damaged and s.record
        ]
        file = self.run.settings_file
        gone = [] if file.exists() else [f"{file} is gone: stages that are not done get default settings"]
        other = [f"{s.name} is out of date ({s.again}): {again}" for s in self.stages if s.again]
        return gone + changed + damaged + other

    @property
    def notes(self) -> list[str]:
        """Remarks on the run that are no fault."""
        older = [f"older results are kept: {self.run.why_not_done(name)}" for name in list(self.run.stale)[:1]]
        gone = [f"{path} (read by {s.name})" for s in self.stages if s.record for path in s.record.reads.gone()]
        return older + ([f"files that were read are gone, the results are kept: {', '.join(gone)}"] if gone else [])

    def to_json(self) -> dict[str, Any]:
        """Plain values; the records without their lists of files."""
        stages = []
        for s in self.stages:
            record = {k: v for k, v in asdict(s.record).items() if k not in ("files", "reads")} if s.record else None
            stages.append(
                {"name": s.name, "state": s.state, "changed": s.changed, "damaged": s.damaged, "record": record,
                 "again": s.again, "progress": asdict(s.running) if s.running else None}
            )  # fmt: skip
        return {
            "run": str(self.run.root),
            "source": self.source,
            "stages": stages,
            "warnings": self.warnings,
            "notes": self.notes,
        }


def run_status(run: RunFolder, program: Program = lambda method: ()) -> RunStatus:
    """Reads every file of the run once, to find damaged ones; with the stages of the `program`, reports too what it
    would make again, and why.

    Raises InputError where the manifest or the settings are damaged.
    """
    records, config = run.records, run.settings()
    again, running = _made_again(run, program(config.run.method), records, config), load_run_progress(run)
    stages = []
    for name in STAGES:
        record = records.get(name)
        changed = tuple(record.reads.changed_settings(config)) if record else ()
        damaged = tuple(run.damaged(name)) if record else ()
        why = "" if changed or damaged else again.get(name, "")
        now = running if running and running.stage == name and record is None else None
        state = RUNNING if now else _state(run, name, record, damaged)
        stages.append(StageStatus(name, state, record, changed, damaged, why, now))
    return RunStatus(run, run.source.path, tuple(stages))


def _made_again(
    run: RunFolder, program: Sequence[Stage], records: dict[str, StageRecord], config: Config
) -> dict[str, str]:
    """The first stage that would be made again, and why."""
    source = run.source.digest
    for stage in program:
        if (record := records.get(stage.name)) is None:
            break
        if why := rerun_reason(stage, run, record, Situation(stage.program, source, config, records)):
            return {stage.name: why}
    return {}


def _state(run: RunFolder, name: str, record: StageRecord | None, damaged: tuple[str, ...]) -> str:
    if record is not None:
        return DAMAGED if damaged else DONE
    if run.partial(name).exists():
        return INTERRUPTED
    return OUTDATED if run.stage(name).exists() else NOT_YET
