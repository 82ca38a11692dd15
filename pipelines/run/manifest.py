"""The manifest of a run, manifest.json: one record for each finished stage."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ...formats.errors import InputError
from ...formats.reading import is_plain_path, parsing
from ...formats.textfile import MAX_OWN_JSON_BYTES, read_json_object, write_json
from ..config import STAGES, Config, config_to_dict
from ..system.values import dataclass_from_json
from ..system.wording import quoted
from .reads import StageRecord
from .settings import merge_known_settings

FORMAT = 3
"""Of manifest.json."""


@dataclass(frozen=True)
class Source:
    """Source of a run: its path, and the identity of its content (`Recording.digest`)."""

    path: str
    digest: str


@dataclass(frozen=True)
class Manifest:
    """Source of a run, and its finished stages by name, in their order. stale: those whose results are still in their
    folders, but a stage before them is being made again, or has been: they count again where it comes out the same."""

    source: Source
    records: dict[str, StageRecord]
    stale: dict[str, StageRecord] = field(default_factory=dict)


def read_manifest(path: Path) -> Manifest:
    """Raises InputError when it is missing, damaged, or of a newer version."""
    try:
        value = read_json_object(path, MAX_OWN_JSON_BYTES)
        with parsing(path, "manifest of a run", "it was damaged or edited"):
            return _manifest(path, value)
    except InputError as error:
        raise InputError(
            f"{error}\nWithout it nothing in the run can be trusted. Its settings are kept beside it: "
            f"msgs-slam reconstruct SOURCE --out NEW --config {quoted(path.with_name('run.toml'))}"
        ) from error


def _manifest(path: Path, value: dict[str, Any]) -> Manifest:
    if (found := value.get("format", 1)) != FORMAT:
        raise InputError(f"{path}: its format is {str(found)[:20]}, this version of the program knows {FORMAT}")
    if value.pop("check", None) != _check(value):
        raise ValueError("its checksum differs")
    records, stale = _records(value["stages"]), _records(value.get("stale", {}))
    return Manifest(dataclass_from_json(Source, value["source"]), records, stale)


def _records(values: dict[str, Any]) -> dict[str, StageRecord]:
    records = {name: dataclass_from_json(StageRecord, values[name]) for name in STAGES if name in values}
    for record in records.values():
        if bad := next((name for name in record.files if not is_plain_path(name)), None):
            raise ValueError(f"it names the file {bad[:100]!r}, which may lie outside of the run")
    return records


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Atomically, with a checksum over itself. Raises InputError when the disk refuses."""
    value = {"format": FORMAT, "source": asdict(manifest.source), "stages": _in_order(manifest.records)}
    if manifest.stale:
        value["stale"] = _in_order(manifest.stale)
    value = json.loads(json.dumps(value, allow_nan=False))  # tuples are lists when it is read again
    write_json(path, {**value, "check": _check(value)})


def _in_order(records: Mapping[str, StageRecord]) -> dict[str, Any]:
    return {name: asdict(records[name]) for name in STAGES if name in records}


def _check(value: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def recorded_config(records: Mapping[str, StageRecord], config: Config) -> Config:
    """The settings that each finished stage was made with; of the stages that are not, those of `config`."""
    for name in STAGES:
        if name in records:
            config, _ = merge_known_settings(config, records[name].settings, "manifest.json")
    return config


def settings_of(config: Config, stage: str) -> dict[str, dict[str, Any]]:
    """Return the settings that a stage's record keeps."""
    return {section: config_to_dict(getattr(config, section)) for section in ("run", stage) if hasattr(config, section)}


def previous_settings(record: StageRecord, config: Config) -> list[str]:
    """`section.key=value` of each setting of which `config` has another value than the record, with that of the
    record."""
    now = config_to_dict(config)  # without a section or a key of an earlier version
    return [
        f"{section}.{key}={str(value).lower() if isinstance(value, bool) else value}"
        for section, values in record.settings.items()
        for key, value in values.items()
        if section != "run" and now.get(section, {}).get(key, value) != value
    ]


def piece_digest(records: Mapping[str, StageRecord], name: str) -> str:
    """Digest of what the piece `name` of a run with these records is made from."""
    text = f"{name} {records['frames'].content} {records['tracking'].content}"
    return hashlib.sha256(text.encode()).hexdigest()


def content_digest(files: Mapping[str, tuple[int, str]]) -> str:
    """One digest of what a stage has left."""
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()


def finite_or_none(figures: Any) -> Any:
    """Replace numbers that JSON lacks (infinite, NaN) by None, at any depth."""
    if isinstance(figures, dict):
        return {k: finite_or_none(v) for k, v in figures.items()}
    if isinstance(figures, list | tuple):
        return [finite_or_none(v) for v in figures]
    return None if isinstance(figures, float) and not math.isfinite(figures) else figures


def keyframe_psnr(records: Mapping[str, StageRecord]) -> float | None:
    """The PSNR of a run, dB: mean over up to 16 keyframes of each submap, drawn with their exposures at the size that
    the map was made at, against what it shows of the scene; as the last stage that changed the map measured it. None
    before mapping is done."""
    figures = (records[name].figures for name in ("global_ba", "mapping") if name in records)
    return next((found for f in figures if (found := f.get("keyframe_psnr")) is not None), None)
