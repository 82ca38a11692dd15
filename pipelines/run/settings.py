"""Reading settings: defaults < a TOML file < `section.key=value` overrides, and writing them as TOML.

Unknown keys and wrong types are refused with the nearest name; what was a setting once, with what became of it.
"""

import difflib
import json
import math
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import Field, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from ...formats.errors import SettingError
from ...formats.reading import home_expanded, is_unicode
from ...formats.textfile import read_toml
from ..config import Config, allowed_values, meaning_of, range_text, value_of

_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


class UnknownSettingError(SettingError):
    """There is no setting of that name."""


def load_config(
    file: Path | None = None, overrides: Iterable[str] = (), base: Config | None = None, quality: str | None = None
) -> Config:
    """The settings of `base` (or the defaults), changed by a TOML file and then by `section.key=value` texts.

    A `quality` (of --quality; else run.quality of a text, else of the file) first sets all settings that were not set
    explicitly; what else is in the file and the texts is laid over that. A file that says its quality,
    as one that `msgs-slam config` prints, is taken as a whole for what --quality or a text then changes.
    Raises InputError for an unreadable file, an unknown key (with the nearest known one) or a value of a wrong type.
    """
    config, texts = base or Config(), [_override(text) for text in overrides]
    values = {} if file is None else read_toml(file)
    asked = [(change["run"]["quality"], source) for change, source in texts if "quality" in change.get("run", {})]
    asked += [(quality, "--quality")] if quality is not None else []
    of_file = run.get("quality") if isinstance(run := values.get("run"), Mapping) else None
    if of_file is not None:
        config = merge_with_quality(config, values, str(file))
    for wanted, source in asked:
        config = with_quality(config, wanted, source)
    if of_file is None:
        config = merge_settings(config, values, str(file))
    for change, source in texts:
        config = config if "quality" in change.get("run", {}) else merge_settings(config, change, source)
    return config


def _override(text: str) -> tuple[dict[str, dict[str, Any]], str]:
    """What `section.key=value` changes, and how an error names it."""
    key, separator, value = text.partition("=")
    section, dot, name = key.strip().partition(".")
    if not separator or not dot:
        raise SettingError(f"--set {text}: expected section.key=value, for example --set frames.rate=5")
    parsed, wanted = _parse_value(value.strip()), get_type_hints(type(getattr(Config(), section, None))).get(name)
    if wanted is str and not isinstance(parsed, str):
        parsed = value.strip()  # a folder may be called 2024_01 or 2024-01-31
    return {section: {name: parsed}}, f"--set {text}"


def merge_with_quality(config: Config, changes: Mapping[str, Any], source: str) -> Config:
    """Merge as `merge_settings`, after the values of a run.quality that is among the changes."""
    of_run = changes.get("run")
    if isinstance(of_run, Mapping) and "quality" in of_run:
        config = with_quality(config, of_run["quality"], source)
    return merge_settings(config, changes, source)


def with_quality(config: Config, quality: Any, source: str) -> Config:
    """Give every setting its value of a quality; one that differs from its value of the present quality is somebody's
    choice and stays. Raises SettingError, which names the `source`, for no quality."""
    before = config.run.quality
    config = merge_settings(config, {"run": {"quality": quality}}, source)
    sections = {f.name: getattr(config, f.name) for f in fields(config)}
    for name, values in sections.items():
        changed = {
            f.name: value_of(f, quality) for f in fields(values) if getattr(values, f.name) == value_of(f, before)
        }
        sections[name] = replace(values, **changed | ({"quality": quality} if name == "run" else {}))
    return Config(**sections)


def merge_settings(config: Config, changes: Mapping[str, Any], source: str) -> Config:
    """Lay section → key → value over `config`. Raises SettingError, which names the `source`: a file, `--set ...`; of
    an option of the setting's own, such as `--depth`, that is all."""
    sections = {f.name: getattr(config, f.name) for f in fields(config)}
    for section, values in changes.items():
        if not isinstance(values, Mapping):
            raise SettingError(f"{source}: {section} is a section of settings, got {values!r:.80}")
        if section not in sections:
            raise UnknownSettingError(f"{source}: there is no section {section!r}{nearest(section, sections)}")
        known = {f.name: f for f in fields(sections[section])}
        for key, value in values.items():
            if key not in known:
                hint = nearest(key, known, section + ".")
                raise UnknownSettingError(f"{source}: there is no setting {section}.{key}{hint}")
            option = known[key].metadata["option"]
            subject = source if option and source == f"--{option.name}" else f"{source}: {section}.{key}"
            types = get_type_hints(type(sections[section]))
            checked = _checked(value, types[key], known[key].metadata["choices"], subject)
            _require_within(checked, known[key], subject)
            sections[section] = replace(sections[section], **{key: checked})
    return Config(**sections)


def merge_known_settings(config: Config, changes: Mapping[str, Any], source: str) -> tuple[Config, list[SettingError]]:
    """Merge as `merge_settings`, but leave out what cannot be, of another version for example; returns the error of
    each such setting too."""
    dropped = []
    for section, values in changes.items():
        for key, value in values.items() if isinstance(values, Mapping) else [("", values)]:
            try:
                config = merge_settings(config, {section: {key: value} if key else value}, source)
            except SettingError as error:
                dropped.append(error)
    return config, dropped


def _require_within(value: Any, known: Field[Any], where: str) -> None:
    if (within := known.metadata["within"]) is None or (known.metadata["or_zero"] and value == 0):
        return
    if not within[0] <= value <= within[1]:  # not so of NaN either
        raise SettingError(f"{where} is {range_text(known)}; got {value!r:.40}")


def _checked(value: Any, wanted: Any, choices: tuple[str, ...], where: str) -> Any:
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value) if abs(value) < 2**53 else math.inf
    if wanted is str and not choices and isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)  # strings need no quotes, and a file's name may be a number
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise SettingError(f"{where} expects {_WORDS[wanted]}, got {value!r:.80}")
    if isinstance(value, str) and not is_unicode(value):
        raise SettingError(f"{where} is no valid UTF-8, got {value!r:.80}: rename the file or folder")
    if choices and value not in choices:
        raise SettingError(f"{where} is one of {', '.join(choices)}; got {value!r}{nearest(value, choices)}")
    return value


def _parse_value(text: str) -> Any:
    """A TOML value, or the bare text itself where it is no TOML (so that strings need no quotes)."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def config_to_toml(config: Config) -> str:
    """The settings as TOML that `load_config` reads back, each with its help text above it."""
    lines = []
    for section in fields(config):
        values = getattr(config, section.name)
        lines.append(f"# {(type(values).__doc__ or '').strip()}")
        lines.append(f"[{section.name}]")
        for f in fields(values):
            allowed = allowed_values(f)
            lines.append(f"# {meaning_of(f)}" + (f" ({allowed})" if allowed else ""))
            lines.append(f"{f.name} = {toml_value(getattr(values, f.name))}")
        lines.append("")
    return "\n".join(lines)


def with_absolute_paths(config: Config) -> Config:
    """Make the paths of files and folders that are there absolute: a run goes on from any working folder."""
    for section in fields(config):
        for f in fields(values := getattr(config, section.name)):
            text = getattr(values, f.name)
            prefix = next((p for p in f.metadata["paths"] if text.startswith(p)), None)
            if prefix is None or text in ("", prefix, "auto", "off"):
                continue
            path = os.path.abspath(home_expanded(text.removeprefix(prefix)))
            if os.path.exists(path) or os.path.exists(path.rpartition("#")[0]):  # a file, or FILE#CAMERA
                config = merge_settings(config, {section.name: {f.name: prefix + path}}, f.name)
    return config


def toml_value(value: bool | int | float | str) -> str:
    """The value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    # A JSON string is a TOML basic string, but for pairs of surrogates, which TOML refuses, and a bare DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f") if isinstance(value, str) else repr(value)


_SAME_AS = {"gpu": "cuda", "nvidia": "cuda", "cuda:0": "cuda", "video": "images", "mp4": "images",
            "high": "best", "fast": "draft", "low": "draft", "preview": "draft"}  # fmt: skip
"""What people type for a choice that has another name."""


def nearest(word: str, known: Iterable[str], prefix: str = "") -> str:
    """; did you mean ...?, or what is known where nothing is near."""
    known = list(known)
    if (meant := _SAME_AS.get(str(word).lower())) in known:
        return f"; did you mean {meant}?"
    matches = difflib.get_close_matches(str(word), known, n=1, cutoff=0.4)
    return f"; did you mean {prefix}{matches[0]}?" if matches else f"; known: {', '.join(known)}"
