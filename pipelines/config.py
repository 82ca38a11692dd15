"""Every setting, its default and its meaning, once.

Defaults < a TOML file < `section.key=value` overrides. Unknown keys and wrong types are refused with the nearest name.
"""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from formats.errors import InputError


def setting(default: Any, help: str, choices: tuple[str, ...] = ()) -> Any:
    """A dataclass field that carries its own help text."""
    return field(default=default, metadata={"help": help, "choices": choices})


@dataclass(frozen=True)
class RunConfig:
    """The whole run."""

    seed: int = setting(0, "seed of every random choice")
    threads: int = setting(0, "CPU threads, 0 = all cores; the same count gives the same bytes")
    device: str = setting("auto", "where dense work runs; auto takes a GPU if there is one", ("auto", "cpu", "cuda"))


@dataclass(frozen=True)
class FramesConfig:
    """Picking frames and finding the camera's intrinsics."""

    rate: float = setting(10.0, "frames per second to keep of a video; the sharpest of each window. 0 = all")
    max_side: int = setting(960, "longer images are reduced to this many pixels on the long side")
    max_frames: int = setting(5000, "more picked frames than this are refused")
    intrinsics: str = setting("", "fx,fy,cx,cy[,k1,k2,p1,p2] in pixels of the source, or a file; empty = find them")


@dataclass(frozen=True)
class ProxyConfig:
    """Proxy depth and semantics of every keyframe."""

    depth: str = setting("auto", "depth provider: auto, multiview, files:FOLDER, files, onnx:CARD")
    semantics: str = setting("auto", "semantics provider: auto, segments, files:FOLDER, files, onnx:CARD")


@dataclass(frozen=True)
class TrackingConfig:
    """Camera poses."""


@dataclass(frozen=True)
class MappingConfig:
    """The Gaussian map."""


@dataclass(frozen=True)
class GlobalBaConfig:
    """Loops and the global adjustment."""


@dataclass(frozen=True)
class ExportConfig:
    """Files for other programs."""


@dataclass(frozen=True)
class Config:
    """The complete settings of a run; one section a stage."""

    run: RunConfig = field(default_factory=RunConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    proxy: ProxyConfig = field(default_factory=ProxyConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    global_ba: GlobalBaConfig = field(default_factory=GlobalBaConfig)
    export: ExportConfig = field(default_factory=ExportConfig)


def load_config(file: Path | None = None, overrides: Iterable[str] = (), base: Config | None = None) -> Config:
    """The settings of `base` (or the defaults), changed by a TOML file and then by `section.key=value` texts.

    Raises InputError for an unreadable file, an unknown key (with the nearest known one) or a value of a wrong type.
    """
    config = base or Config()
    if file is not None:
        config = merge_settings(config, _read_toml(file), where=str(file))
    for text in overrides:
        key, separator, value = text.partition("=")
        section, dot, name = key.strip().partition(".")
        if not separator or not dot:
            raise InputError(f"--set {text}: expected section.key=value, for example --set frames.rate=5")
        config = merge_settings(config, {section: {name: _parse_value(value.strip())}}, where=f"--set {text}")
    return config


def merge_settings(config: Config, changes: Mapping[str, Any], where: str) -> Config:
    """`config` with a mapping section → key → value laid over it; `where` names its source in errors."""
    sections = {f.name: getattr(config, f.name) for f in fields(config)}
    for section, values in changes.items():
        if section not in sections:
            raise InputError(f"{where}: there is no section {section!r}{_nearest(section, sections)}")
        if not isinstance(values, Mapping):
            raise InputError(f"{where}: {section} is a section of settings, got {values!r}")
        sections[section] = _merge_section(sections[section], section, values, where)
    return Config(**sections)


def _merge_section(section: Any, name: str, values: Mapping[str, Any], where: str) -> Any:
    types = get_type_hints(type(section))
    known = {f.name: f for f in fields(section)}
    checked = {}
    for key, value in values.items():
        if key not in known:
            raise InputError(f"{where}: there is no setting {name}.{key}{_nearest(key, known, name + '.')}")
        checked[key] = _checked(value, types[key], known[key].metadata.get("choices", ()), f"{where}: {name}.{key}")
    return replace(section, **checked)


def _checked(value: Any, wanted: Any, choices: tuple[str, ...], where: str) -> Any:
    if get_origin(wanted) is tuple:
        element = get_args(wanted)[0]
        if not isinstance(value, list | tuple):
            raise InputError(f"{where} expects a list, got {value!r}")
        return tuple(_checked(v, element, (), where) for v in value)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise InputError(f"{where} expects {wanted.__name__}, got {value!r}")
    if choices and value not in choices:
        raise InputError(f"{where} is one of {', '.join(choices)}; got {value!r}{_nearest(value, choices)}")
    if wanted is float and value != value:
        raise InputError(f"{where} must be a number, got nan")
    return value


def _parse_value(text: str) -> Any:
    """A TOML value, or the bare text itself where it is no TOML (so that strings need no quotes)."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _nearest(word: str, known: Iterable[str], prefix: str = "") -> str:
    matches = difflib.get_close_matches(word, list(known), n=1, cutoff=0.4)
    return f"; did you mean {prefix}{matches[0]}?" if matches else f"; known: {', '.join(known)}"


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{file}: cannot read the settings: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a TOML file: {error}") from error


def config_to_dict(config: Any) -> dict[str, Any]:
    """Nested plain values, for fingerprints and JSON."""
    return {
        f.name: config_to_dict(value) if is_dataclass(value := getattr(config, f.name)) else value
        for f in fields(config)
    }


def config_to_toml(config: Config, comments: bool = True) -> str:
    """The settings as TOML that `load_config` reads back, each with its help text above it."""
    lines = []
    for section in fields(config):
        values = getattr(config, section.name)
        if comments:
            lines.append(f"# {(type(values).__doc__ or '').strip()}")
        lines.append(f"[{section.name}]")
        for f in fields(values):
            if comments:
                choices = f.metadata.get("choices")
                lines.append(f"# {f.metadata['help']}" + (f" ({' | '.join(choices)})" if choices else ""))
            lines.append(f"{f.name} = {_toml_value(getattr(values, f.name))}")
        lines.append("")
    return "\n".join(lines)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    # JSON strings are valid TOML basic strings.
    return json.dumps(value) if isinstance(value, str) else repr(value)
