"""A run that begins with the finished stages of another one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.engine.stages import Stage
from msgs_slam.pipelines.engine.standing import next_upstream, stage_fingerprint
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.records import Manifest, StageRecord, load_records, load_source, write_manifest
from msgs_slam.pipelines.run.settings_file import load_settings, save_settings


def branch(
    origin: RunFolder, target: RunFolder, names: Iterable[str], accept: tuple[list[Stage], Config] | None = None
) -> None:
    """Make `target` with these stages of `origin`, as hard links where the disk allows it, and its settings.

    With accept = (all stages, settings) the taken stages count as made with those settings and that seed, which they
    may not have had: for comparisons that vary what comes after them, such as over seeds from one set of proxies. The
    target is there whole or not at all; where it is there already, nothing happens. Raises InputError for a damaged
    manifest of `origin`.
    """
    if target.manifest_file.exists():
        return
    unfinished = RunFolder(target.root.with_name(target.root.name + ".partial"))
    shutil.rmtree(unfinished.root, ignore_errors=True)
    unfinished.root.mkdir(parents=True)
    source, records = load_source(origin), load_records(origin)
    taken = {name: records[name] for name in names if name in records}
    for name in taken:
        shutil.copytree(origin.stage(name), unfinished.stage(name), copy_function=_link)
    config = load_settings(origin)
    if accept is not None:
        taken, config = _accepted(taken, *accept, source.digest), accept[1]
    write_manifest(unfinished.manifest_file, Manifest(source, taken))
    save_settings(unfinished, config)
    os.replace(unfinished.root, target.root)


def _accepted(
    records: dict[str, StageRecord], stages: list[Stage], config: Config, upstream: str
) -> dict[str, StageRecord]:
    accepted = {}
    for stage in stages:
        if (record := records.get(stage.name)) is None:
            break
        accepted[stage.name] = replace(record, fingerprint=stage_fingerprint(stage, config, upstream, record.inputs))
        upstream = next_upstream(upstream, record)
    return accepted


def _link(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
    return str(Path(target))
