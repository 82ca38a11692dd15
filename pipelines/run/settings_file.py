"""run.toml: the settings with which a run goes on, and a first line by which damage shows."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...formats.atomic import write_text
from ...formats.errors import InputError
from ...formats.reading import opened
from ...formats.textfile import MAX_TOML_BYTES, read_toml
from ..config import Config
from ..read_config import config_to_toml, merge_known_settings
from ..system.progress import log
from ..system.wording import quoted
from .before import before_of
from .records import load_records, load_source, recorded_config

if TYPE_CHECKING:
    from .folder import RunFolder

_MARK = re.compile(r"# Written by msgs-slam\. Change settings with --set or --config\. Check: ([0-9a-f]{64})\n")


def save_settings(run: RunFolder, config: Config) -> None:
    """Atomically, where they are others than before. The checksum in the first line is over the rest and the run's
    source, so that neither an emptied file nor that of another run is taken for this one's. Raises InputError when the
    disk refuses."""
    text = config_to_toml(config)
    check = _check(load_source(run).digest, text)
    mark = f"# Written by msgs-slam. Change settings with --set or --config. Check: {check}\n"
    if not run.settings_file.exists() or run.settings_file.read_bytes() != (mark + text).encode():
        write_text(run.settings_file, mark + text)


def load_settings(run: RunFolder) -> Config:
    """The settings with which the run goes on. Raises InputError for a file that is not as the program left it.

    Where it is gone, what the finished stages were made with is taken, and defaults for the others; InputError where
    none is finished.
    """
    if not run.settings_file.exists():
        if not (records := load_records(run)):
            raise InputError(
                f"{run.root} was stopped before its settings were written, or {run.settings_file.name} is gone, and "
                f"nothing is finished: run `msgs-slam reconstruct {quoted(load_source(run).path)} "
                f"--out {quoted(run.root)}` with the options it had"
            )
        log.warning("%s is gone: stages that are not done get default settings", run.settings_file)
        return recorded_config(records, Config())
    with opened(run.settings_file, MAX_TOML_BYTES, any_content=True) as file:
        text = file.read().decode("utf-8", errors="replace")
    mark = _MARK.match(text)
    as_written = mark is not None and mark[1] in [_check(s, text[mark.end() :]) for s in _sources(run)]
    if not as_written:
        raise InputError(
            f"{run.settings_file} is not as the program left it: damaged, or edited by hand. Delete it and run "
            f"`msgs-slam resume {quoted(run.root)}`: what the finished stages were made with is kept in manifest.json. "
            "(Settings are changed with --set SECTION.KEY=VALUE, or with --config FILE, which may be a copy of it)"
        )
    return _known(read_toml(run.settings_file), run)


def _check(source_digest: str, text: str) -> str:
    return hashlib.sha256(f"{source_digest}\n{text}".encode()).hexdigest()


def _sources(run: RunFolder) -> list[str]:
    """Digests of the run's source and, of a run that was extended, of the one before: the manifest alone says when a
    run is the extended one, and this file is written after it."""
    source = load_source(run)
    before = before_of(Path(source.path))
    return [source.digest] if before is None else [source.digest, before.source_digest]


def _known(values: dict[str, Any], run: RunFolder) -> Config:
    """Settings of an earlier version that are no more, or whose value is none any longer, are reported and left out."""
    config, dropped = merge_known_settings(Config(), values)
    if dropped:
        log.warning(
            "%s is of an earlier version: %d settings in it are none any more (%s%s)",
            run.settings_file, len(dropped), ", ".join(dropped[:3]), ", ..." if len(dropped) > 3 else "",
        )  # fmt: skip
    return config
