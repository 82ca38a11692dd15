"""What a run says of itself: manifest.json, one record a finished stage."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from formats.digest import file_sha256
from formats.jsonfile import write_json
from pipelines.config import Config, config_to_dict, merge_settings
from pipelines.run_folder import RunFolder, read_json
from pipelines.run_folder_names import STAGES


@dataclass(frozen=True)
class StageRecord:
    """One finished stage. files: relative path → [bytes, sha256]; settings: {"run": ..., its own section: ...}, those
    that it was made with, whatever run.toml says by now."""

    fingerprint: str
    files: dict[str, tuple[int, str]]
    seconds: float
    peak_memory_mb: float
    figures: dict[str, Any]
    warnings: list[str]
    content: str
    inputs: Any = None
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)

    @staticmethod
    def from_json(value: dict[str, Any]) -> StageRecord:
        """Inverse of `asdict` after JSON."""
        return StageRecord(**{**value, "files": {k: (v[0], v[1]) for k, v in value["files"].items()}})


def load_records(run: RunFolder) -> dict[str, StageRecord]:
    """The finished stages by name."""
    if not run.manifest_file.exists():
        return {}
    return {k: StageRecord.from_json(v) for k, v in read_json(run.manifest_file)["stages"].items()}


def load_source(run: RunFolder) -> dict[str, Any]:
    """What the run was made from: {"path", "digest"}."""
    return read_json(run.manifest_file)["source"]


def save_manifest(run: RunFolder, source: Mapping[str, Any], records: Mapping[str, StageRecord]) -> None:
    """source: {"path", "digest"}. Raises InputError when the disk refuses."""
    stages = {name: asdict(records[name]) for name in STAGES if name in records}
    write_json(run.manifest_file, {"source": dict(source), "stages": stages})


def recorded_config(records: Mapping[str, StageRecord], config: Config) -> Config:
    """The settings that each finished stage was made with; of the stages that are not, those of `config`."""
    for name in STAGES:
        if name in records:
            config = merge_settings(config, records[name].settings, where=f"the record of {name} in manifest.json")
    return config


def settings_of(config: Config, stage: str) -> dict[str, dict[str, Any]]:
    """What a record keeps of the settings."""
    return {"run": config_to_dict(config.run), stage: config_to_dict(getattr(config, stage))}


def differing_settings(record: StageRecord, config: Config) -> list[str]:
    """`section.key=value` of each setting of its own section that `config` has otherwise than the record."""
    return [
        f"{section}.{key}={value}"
        for section, values in record.settings.items()
        if section != "run"
        for key, value in config_to_dict(getattr(config, section)).items()
        if values.get(key, value) != value
    ]


def checksums(folder: Path) -> dict[str, tuple[int, str]]:
    """Relative path, with slashes, → (bytes, sha256) of every file below."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    return {p.relative_to(folder).as_posix(): (p.stat().st_size, file_sha256(p)) for p in paths}


def content_digest(files: Mapping[str, tuple[int, str]]) -> str:
    """One digest of what a stage has left."""
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


def plain(figures: Any) -> Any:
    """The same with None for what JSON has no number for (infinite, NaN)."""
    if isinstance(figures, dict):
        return {k: plain(v) for k, v in figures.items()}
    if isinstance(figures, list | tuple):
        return [plain(v) for v in figures]
    return None if isinstance(figures, float) and not math.isfinite(figures) else figures
