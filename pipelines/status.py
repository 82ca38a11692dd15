"""Where a run stands, for people and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pipelines.records import StageRecord, differing_settings, load_records, load_source
from pipelines.run_folder import RunFolder
from pipelines.run_folder_names import STAGES
from pipelines.settings_file import load_settings

DONE, INTERRUPTED, OUTDATED, NOT_YET = "done", "interrupted", "outdated", "not yet"


@dataclass(frozen=True)
class StageStatus:
    """state: done; interrupted (begun and not ended); outdated (its files are there, but were made with other
    settings or from other inputs than the stages before it have by now); not yet. record of a stage that is done;
    changed: settings of run.toml, as `section.key=value`, with which `resume` would make it again."""

    name: str
    state: str
    record: StageRecord | None
    changed: tuple[str, ...] = ()


@dataclass(frozen=True)
class RunStatus:
    """source: the path that the run was made from; stages: all of them, in order."""

    source: str
    stages: tuple[StageStatus, ...]

    @property
    def warnings(self) -> list[str]:
        """What is wrong with the run itself, and what to type."""
        return [
            f"{s.name} was made with other settings than run.toml asks for by now ({', '.join(s.changed)}): "
            "`msgs-slam resume` makes it again"
            for s in self.stages
            if s.changed
        ]


def run_status(run: RunFolder) -> RunStatus:
    """Raises InputError where the manifest or the settings are damaged."""
    records, config = load_records(run), load_settings(run)
    stages = []
    for name in STAGES:
        record = records.get(name)
        changed = tuple(differing_settings(record, config)) if record else ()
        stages.append(StageStatus(name, _state(run, name, record), record, changed))
    return RunStatus(load_source(run).path, tuple(stages))


def _state(run: RunFolder, name: str, record: Any) -> str:
    if record is not None:
        return DONE
    if run.partial(name).exists():
        return INTERRUPTED
    return OUTDATED if run.stage(name).exists() else NOT_YET
