"""Runs that version 0.1.0 has made, as this version writes them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from formats.errors import InputError
from pipelines.run_folder_names import STAGES

_VERSIONS = {"frames": 4, "proxy": 6, "tracking": 3, "mapping": 4, "global_ba": 1, "export": 1}
"""Of the stages of 0.1.0, as they went into its fingerprints."""


def migrated_stages(manifest: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """The stages of a manifest of format 1 with the settings they were made with; `settings` are its run.toml's.

    Format 1 did not keep those, and run.toml may be newer than the results: a stage counts as finished only as far as
    its fingerprint, made again from run.toml, is the one in its record. Raises what comes of missing keys.
    """
    if missing := {"run", *STAGES} - settings.keys():
        raise InputError(f"run.toml lacks {', '.join(sorted(missing))}: it was emptied or cut short")
    stages: dict[str, Any] = {}
    upstream = manifest["source"]["digest"]
    for name in STAGES:
        record = manifest["stages"].get(name)
        if record is None or record["fingerprint"] != _fingerprint(name, settings, upstream, record.get("inputs")):
            break
        stages[name] = {**record, "settings": {"run": settings["run"], name: settings[name]}}
        upstream = hashlib.sha256((upstream + record["content"]).encode()).hexdigest()
    return stages


def _fingerprint(name: str, settings: Mapping[str, Any], upstream: str, inputs: Any) -> str:
    beside = [] if inputs is None else [inputs]
    own, seed = settings[name], settings["run"]["seed"]
    text = json.dumps([name, _VERSIONS[name], own, seed, upstream, *beside], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
