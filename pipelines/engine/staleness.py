"""Whether a finished stage is what its settings, its inputs and this program would make, and if not, why."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from ..config import Config, config_to_dict
from ..run.folder import RunFolder
from ..run.manifest import StageRecord, differing_settings, recorded_config
from ..system.identity import package_digest
from .stages import Stage


def stage_fingerprint(stage: Stage, config: Config, upstream: str, inputs: Any) -> str:
    """Digest of what a stage's result depends on: its code, its settings, the seed, its inputs, what is before."""
    own = config_to_dict(getattr(config, stage.name))
    beside = [] if inputs is None else [inputs]
    text = json.dumps([stage.name, package_digest(), own, config.run.seed, upstream, *beside], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def next_upstream(upstream: str, record: StageRecord) -> str:
    """Digest of everything that the stages after `record` are made from."""
    return hashlib.sha256((upstream + record.content).encode()).hexdigest()


def effective_inputs(stage: Stage, config: Config, record: StageRecord | None, inputs: Any) -> Any:
    """The inputs of now with what `auto` has chosen as it was when the stage was made: that belongs to the run, and a
    network that has appeared since makes nothing out of date."""
    was = record.inputs if record is not None else None
    if not isinstance(inputs, Mapping | None) or not isinstance(was, Mapping | None) or record is None:
        return inputs
    chosen = stage.auto(config)
    kept = {k: v for k, v in (inputs or {}).items() if k not in chosen}
    return kept | {k: v for k, v in (was or {}).items() if k in chosen} or None


def rerun_reason(
    stage: Stage, run: RunFolder, record: StageRecord, config: Config, upstream: str, inputs: Any
) -> str:  # fmt: skip
    """Why a finished stage has to be made again, "" where it has not; `inputs` are those of now."""
    if not run.stage(stage.name).exists():
        return "its folder is gone"
    kept = effective_inputs(stage, config, record, inputs)
    if record.fingerprint != stage_fingerprint(stage, config, upstream, kept):
        return _what_differs(stage, record, config, upstream)
    if damaged := run.damaged(stage.name):  # last, for it reads all of them
        return f"{len(damaged)} of its files are missing or damaged"
    return divided_otherwise(stage, run, record, config)


def divided_otherwise(stage: Stage, run: RunFolder, record: StageRecord, config: Config) -> str:
    """Say that a stage was made in other parts than the memory that is given now would divide it into, "" if not."""
    if stage.division is not None and (memory := memory_of(stage, record, config)) != config.run.memory_mb:
        was = recorded_config({stage.name: record}, config)
        if stage.division(run, config) != stage.division(run, was):
            return f"run.memory_mb={config.run.memory_mb} divides it otherwise than {memory} has"
    return ""


def memory_of(stage: Stage, record: StageRecord, config: Config) -> int:
    """Return the run.memory_mb that a stage was made with."""
    return recorded_config({stage.name: record}, config).run.memory_mb


def _what_differs(stage: Stage, record: StageRecord, config: Config, upstream: str) -> str:
    differing = differing_settings(record, config)
    if (seed := record.settings.get("run", {}).get("seed", config.run.seed)) != config.run.seed:
        differing.append(f"run.seed={config.run.seed}, not {seed}")
    if differing:
        return f"other settings: {', '.join(differing)}"
    if stage_fingerprint(stage, config, upstream, record.inputs) == record.fingerprint:
        return "what it reads beside the stages before it has changed"
    return "another version of the program made it, or other stages before it"
