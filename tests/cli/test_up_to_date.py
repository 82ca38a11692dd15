"""A finished run stays finished, whatever has come to the machine since; what would run again is said before."""

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from cli_runs import QUICK, FinishedRun, files_below, invoke

from msgs_slam.pipelines.evaluation.serve import page_of_run
from msgs_slam.pipelines.run import stages
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.source.recording import open_recording
from tests.pipelines.finished import note_finished


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def contents(run: Path) -> dict[str, bytes]:
    """Of every file but the lock, which names the last process."""
    return {str(p): p.read_bytes() for p in run.rglob("*") if p.is_file() and p.name != ".lock"}


def require_unchanged_by_resume(run: Path) -> None:
    before, times = contents(run), files_below(run)
    resumed = invoke("resume", run, "-v")
    assert resumed.exit_code == 0
    assert resumed.stderr.count("] up to date") == 6
    assert contents(run) == before
    assert {path: when for path, when in files_below(run).items() if path in before} == {p: times[p] for p in before}


def test_networks_that_are_pulled_later_make_nothing_again(
    copied_run: Callable[[str], Path], cache: Path, shared_data: Path
) -> None:
    run = copied_run("run.msgs")
    assert invoke("models", "pull", "--from", shared_data / "models").exit_code == 0
    require_unchanged_by_resume(run)
    told = json.loads(invoke("status", run, "--json").stdout)
    assert (told["notes"], {row["again"] for row in told["stages"]}) == ([], {""})


def test_a_stage_is_made_again_on_demand_with_the_networks_of_now(
    copied_run: Callable[[str], Path], cache: Path, shared_data: Path
) -> None:
    run = copied_run("run.msgs")
    before, times = contents(run), files_below(run / "frames", run / "tracking")
    assert invoke("resume", run, "--redo", "export", "--until", "frames").exit_code == 2
    same = invoke("resume", run, "--redo", "export")
    assert "export and what follows are made again (as asked for)" in same.stderr
    assert same.stderr.count("] up to date") == 5
    assert {k for k, v in contents(run).items() if before.get(k) != v} == {str(run / "manifest.json")}
    assert invoke("models", "pull", "--from", shared_data / "models").exit_code == 0
    made = invoke("resume", run, "--redo", "proxy", "--until", "proxy")
    assert made.exit_code == 0, made.output
    assert "proxy and what follows are made again (as asked for)" in made.stderr
    assert made.stderr.count("] up to date") == 1
    assert RunFolder(run).records["proxy"].figures["semantics"] != "segments"
    assert files_below(run / "frames", run / "tracking") == times, (
        "later results stay until their own new ones are ready"
    )
    shutil.rmtree(cache)
    said = " ".join(invoke("status", run).stdout.split())
    assert f"files that were read are gone, the results are kept: {cache}" in said
    assert "(read by proxy)" in said


def test_a_folder_that_is_gone_is_called_so(copied_run: Callable[[str], Path]) -> None:
    run = copied_run("my room's.msgs")
    shutil.rmtree(run / "export")
    said = " ".join(invoke("status", run).stdout.split())
    again = said.split("export: its folder is gone: `")[1].split("`")[0]
    assert shlex.split(again) == ["msgs-slam", "resume", str(run)], "can be pasted"
    resumed = invoke(*shlex.split(again)[1:])
    assert "export and what follows are made again (its folder is gone)" in resumed.stderr
    assert "damaged" not in resumed.stderr


def test_files_of_options_are_found_from_another_folder_and_may_be_gone_when_their_stage_is_done(
    finished_run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(finished_run.folder / "export" / "trajectory.txt", "poses.txt")
    settings = [x for s in QUICK for x in ("--set", s)]
    wanted = ("--poses", "poses.txt", "--until", "frames", *settings)
    made = invoke("reconstruct", finished_run.video, "--out", "run.msgs", *wanted)
    assert made.exit_code == 0, made.output
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    found = invoke("resume", "../run.msgs", "--until", "frames")
    assert (found.exit_code, "up to date" in found.stderr, "keeps" in found.stderr) == (0, True, False)
    (tmp_path / "poses.txt").unlink()
    kept = invoke("resume", "../run.msgs", "--until", "frames")
    assert kept.exit_code == 0, kept.stderr
    assert f"frames: keeps what it was made from ({tmp_path / 'poses.txt'} is gone)" in " ".join(kept.stderr.split())
    assert "up to date" in kept.stderr
    other = invoke("resume", "../run.msgs", "--until", "frames", "--set", "frames.parallax=0.05")
    assert other.exit_code == 1
    assert "poses.txt: there is no such file" in other.stderr


def test_status_says_what_another_version_would_make_again(
    copied_run: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = copied_run("run.msgs")
    assert json.loads(invoke("status", run, "--json").stdout)["warnings"] == []
    monkeypatch.setattr(stages, "package_digest", lambda: "new")
    before = contents(run)
    said = " ".join(invoke("status", run).stdout.split())
    assert "frames is out of date (another version of the program made it" in said
    assert f"`msgs-slam resume {run}` runs it and all later stages again" in said
    assert contents(run) == before
    resumed = invoke("resume", run, "--until", "frames", "-v")
    assert "frames and what follows are made again (another version of the program" in resumed.stderr


def test_what_was_made_before_a_change_stays_and_counts_again(
    copied_run: Callable[[str], Path], tmp_path: Path
) -> None:
    run = copied_run("run.msgs")
    before = contents(run)
    other = ("--set", "mapping.hold_out=4", "--set", "mapping.min_iterations=21", "--until", "mapping")
    assert invoke("resume", run, *other, "-q").exit_code == 0
    assert {k for k, v in before.items() if contents(run).get(k) != v and "/mapping/" not in k} == {
        str(run / "manifest.json"), str(run / "run.toml")
    }  # fmt: skip
    rows = json.loads(invoke("status", run, "--json").stdout)["stages"]
    assert [row["state"] for row in rows] == ["done"] * 4 + ["outdated"] * 2
    assert f"what is in {run / 'global_ba'} was made before" in " ".join(invoke("status", run).stdout.split())
    assert load_outcome(RunFolder(run)).map_stage == "mapping"
    assert page_of_run(RunFolder(run)) != (run / "export" / "map.html").read_text()  # that is of the old map
    assert invoke("report", run, "-q").exit_code == 0
    assert "map.html" not in (run / "report.html").read_text()
    (run / "report.html").unlink()
    # The new map's files beside the old map's would not be told apart.
    refused = " ".join(invoke("export", run, "--only", "ply", "--to", run / "export").stderr.split())
    assert "belongs to the run" in refused
    assert invoke("export", run, "--only", "tum", "-q").exit_code == 0
    assert (run / "exports" / "tum" / "trajectory.txt").is_file()
    said = " ".join(invoke("status", run).stdout.split())
    back = said.split("go back with `")[1].split("`")[0]
    gone_back = invoke(*shlex.split(back)[1:], "-v")
    assert gone_back.exit_code == 0, gone_back.output
    assert gone_back.stderr.count("] up to date") == 5
    assert {k for k, v in before.items() if contents(run).get(k) != v} == {str(run / "manifest.json")}


def test_another_format_is_not_called_another_source(finished_run: FinishedRun, tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "run.msgs")
    run.stage("frames").mkdir(parents=True)
    note_finished(run, ["frames"])
    source = Source(str(finished_run.truth), open_recording(finished_run.truth, "auto").digest)
    write_manifest(run.manifest_file, Manifest(source, run.records))
    before = contents(run.root)
    refused = " ".join(invoke("resume", run.root, "--set", "run.format=images").stderr.split())
    assert "run.format=images reads other images, times or cameras" in refused
    assert "continue with --set run.format=auto" in refused
    assert contents(run.root) == before


def test_a_source_that_has_moved_is_asked_for(copied_run: Callable[[str], Path], tmp_path: Path) -> None:
    run = RunFolder(copied_run("run.msgs"))
    source = replace(run.source, path=str(tmp_path / "gone" / "room.avi"))
    write_manifest(run.manifest_file, Manifest(source, run.records))
    assert invoke("resume", run.root, "--until", "frames").exit_code == 0
    refused = invoke("resume", run.root, "--set", "frames.rate=1")
    assert refused.exit_code == 1
    assert f"msgs-slam reconstruct SOURCE --out {run.root}" in refused.stderr
