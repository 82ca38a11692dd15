"""A finished run stays finished, whatever has come to the machine since; what would run again is said before."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runs import files_below, invoke

from msgs_slam.pipelines.engine import standing
from msgs_slam.pipelines.networks.registry import ModelStore
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.records import Manifest, load_records, load_source, write_manifest
from tests.cli.test_models_commands import write_network


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def contents(run: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in run.rglob("*") if p.is_file()}


def require_unchanged_by_resume(run: Path) -> None:
    before, times = contents(run), files_below(run)
    resumed = invoke("resume", run, "-v")
    assert resumed.exit_code == 0
    assert resumed.stderr.count("] up to date") == 6
    assert contents(run) == before
    assert files_below(run) == times


def test_networks_that_are_pulled_later_make_nothing_again(
    copied_run: Callable[[str], Path], cache: Path, shared_data: Path
) -> None:
    run = copied_run("run.msgs")
    assert "keeps what auto chose" not in invoke("status", run).stdout
    assert invoke("models", "pull", "--from", shared_data / "models").exit_code == 0
    require_unchanged_by_resume(run)
    said = invoke("status", run).stdout
    assert "proxy keeps what auto chose when it was made (labels)" in said
    assert "frames keeps what auto chose when it was made (people)" in said
    assert "export keeps what auto chose when it was made (metres)" in said
    assert "again" not in {row["again"] for row in json.loads(invoke("status", run, "--json").stdout)["stages"]}


def test_a_network_that_is_added_later_makes_nothing_again(
    copied_run: Callable[[str], Path], cache: Path, tmp_path: Path
) -> None:
    run = copied_run("run.msgs")
    ModelStore.open().add(write_network(tmp_path / "net.onnx", "predicted_depth"), "metric3d-community")
    require_unchanged_by_resume(run)
    assert "proxy keeps what auto chose when it was made (depth)" in invoke("status", run).stdout


def test_status_says_what_another_version_would_make_again(
    copied_run: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, right = copied_run("run.msgs"), standing.stage_identity
    assert json.loads(invoke("status", run, "--json").stdout)["warnings"] == []
    monkeypatch.setattr(standing, "stage_identity", lambda n, f: "new" if n == "global_ba" else right(n, f))
    before = contents(run)
    said = " ".join(invoke("status", run).stdout.split())
    assert "global_ba was made otherwise (another version of the program made it" in said
    assert f"`msgs-slam resume {run}` makes it and what follows again" in said
    assert contents(run) == before
    resumed = invoke("resume", run, "--until", "global_ba", "-v")
    assert "global_ba and what follows are made again (another version of the program" in resumed.stderr
    assert resumed.stderr.count("] up to date") == 4


def test_a_source_that_has_moved_is_asked_for(copied_run: Callable[[str], Path], tmp_path: Path) -> None:
    run = RunFolder(copied_run("run.msgs"))
    source = replace(load_source(run), path=str(tmp_path / "gone" / "room.avi"))
    write_manifest(run.manifest_file, Manifest(source, load_records(run)))
    assert invoke("resume", run.root, "--until", "frames").exit_code == 0
    refused = invoke("resume", run.root, "--set", "frames.rate=1")
    assert refused.exit_code == 1
    assert f"msgs-slam reconstruct SOURCE --out {run.root}" in refused.stderr
