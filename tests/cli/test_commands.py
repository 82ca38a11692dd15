"""The command line through click's runner: exit codes, messages, help."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
from cli_runs import FinishedRun
from click.testing import CliRunner, Result
from PIL import Image

from msgs_slam.formats.atomic import temporary_of
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.video_streams import write_video
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.export.kinds import export_of
from msgs_slam.pipelines.reconstruct import existing_config
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.mark.parametrize("name", sorted(main.commands))
def test_every_command_and_option_has_help(name: str) -> None:
    command = main.commands[name]
    assert command.help
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            assert parameter.help, f"{name} {parameter.opts}"
    assert invoke(name, "--help").exit_code == 0


def test_config_prints_settings_and_refuses_unknown_ones() -> None:
    assert "[mapping]" in invoke("config").stdout
    wrong = invoke("config", "--set", "frames.rat=3")
    assert wrong.exit_code == 2, "as an option that does not exist"
    assert "did you mean frames.rate?" in wrong.stderr


def test_wrong_usage_exits_2(tmp_path: Path) -> None:
    assert invoke("reconstruct").exit_code == 2
    assert invoke("reconstruct", tmp_path, "--until", "nowhere").exit_code == 2
    assert invoke("reconstruct", tmp_path, "-q", "-v").exit_code == 2


@pytest.mark.parametrize("command", ["resume", "status", "export"])
def test_a_folder_that_is_no_run_is_refused(command: str, tmp_path: Path) -> None:
    result = invoke(command, tmp_path)
    assert result.exit_code == 1
    assert "is not a run folder" in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["resume", "status", "export", "view", "report"])
@pytest.mark.parametrize("named", [".", "..", "/"])
def test_the_working_folder_that_is_no_run_is_refused(
    command: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    result = invoke(command, named)
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert "no run" in result.stderr or "not a run" in result.stderr


def refused(source: Path, out: Path, *options: object) -> str:
    """The message with which `reconstruct` ends; nothing must be left behind."""
    existed = out.exists()
    result = invoke("reconstruct", source, "--out", out, *options)
    assert result.exit_code == 1, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert out.exists() == existed, "a refused source must leave no run folder"
    return result.stderr


@pytest.mark.parametrize(
    ("word", "meant"),
    [("room.mp4", "reconstruct room.mp4"), ("my room.MOV", "reconstruct 'my room.MOV'"), ("a.msgs", "resume a.msgs")],
)
def test_a_video_or_a_run_without_a_command(word: str, meant: str) -> None:
    result = invoke(word)
    assert result.exit_code == 2
    assert f"did you mean `msgs-slam {meant}`?" in result.stderr


def test_a_folder_without_a_command(tmp_path: Path) -> None:
    assert f"`msgs-slam reconstruct {tmp_path}`" in invoke(tmp_path, "--out", "x").stderr
    (tmp_path / "manifest.json").touch()
    assert f"`msgs-slam resume {tmp_path}`" in invoke(tmp_path).stderr
    assert "Did you mean" in invoke("reconstrct", "x").stderr


def test_a_folder_of_videos_is_for_batch(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.MOV", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    said = " ".join(refused(tmp_path, tmp_path / "run").split())
    assert "but 2 videos, such as a.mp4: give one of them, or the folder to `msgs-slam batch`" in said


@pytest.mark.parametrize(("word", "kind"), [("texture", "mesh"), ("GLTF", "glb"), ("poses", "tum"), ("ply", "ply")])
def test_kinds_of_files_by_the_names_of_their_formats(word: str, kind: str) -> None:
    assert export_of(word).kind == kind
    assert invoke("export", "no_such_run", "--only", word).exit_code == 1, "no wrong usage"


def test_sources_that_are_missing_empty_or_no_video(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("this is not a video")
    for name, said in (
        ("none.mp4", "no such file"),
        ("empty.mp4", "is empty"),
        ("text.mp4", "text.mp4"),
        ("images", "image"),
    ):
        assert said in refused(tmp_path / name, tmp_path / "run")


def test_a_user_who_does_not_exist(tmp_path: Path) -> None:
    source = tmp_path / "room.avi"
    write_video(source, np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3), np.uint8), 10.0)
    for option, value in (
        ("--poses", "~nosuch/p.txt"), ("--intrinsics", "~nosuch/c.json"), ("--masks", "~nosuch/m"),
        ("--gps", "~nosuch/g.gpx"), ("--depth", "onnx:~nosuch/card.toml"),
    ):  # fmt: skip
        assert "~nosuch/" in refused(source, tmp_path / "run", option, value)


def test_a_calibration_of_several_cameras(tmp_path: Path) -> None:
    source, cameras = tmp_path / "room.avi", tmp_path / "cameras.txt"
    write_video(source, np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3), np.uint8), 10.0)
    cameras.write_text("1 PINHOLE 64 48 60 60 32 24\n2 PINHOLE 64 48 90 90 32 24\n")
    said = refused(source, tmp_path / "run", "--intrinsics", str(cameras))
    assert "2 cameras that differ: 1 (64x48, fx 60), 2 (64x48, fx 90)" in " ".join(said.split())
    assert "cameras.txt#1'" in said


def test_names_that_are_no_utf_8(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/K\xfcche 2019"))
    folder.mkdir()
    write_video(tmp_path / "good.avi", [np.full((48, 64, 3), 9 * i, np.uint8) for i in range(5)], 10.0)
    video = Path(shutil.copy(tmp_path / "good.avi", folder / "room.avi"))
    for source, out in ((video, tmp_path / "run"), (folder, tmp_path / "run"), (tmp_path / "good.avi", folder / "run")):
        assert "K\\udcfcche 2019" in (said := refused(source, out))
        assert "no valid UTF-8" in said
    monkeypatch.chdir(folder)
    assert "no valid UTF-8" in refused(Path("room.avi"), Path("room.msgs"))
    monkeypatch.undo()
    assert "no valid UTF-8" in invoke("reconstruct", tmp_path / "good.avi", video, "-o", tmp_path / "run").stderr
    assert not (tmp_path / "run").exists()
    assert invoke("batch", folder, "--out", tmp_path / "runs").exit_code == 1
    assert "no valid UTF-8" in (tmp_path / "runs" / "batch.md").read_text()


def test_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "diary.txt").write_text("mine")
    source = tmp_path / "video.mp4"
    source.write_text("x")
    assert "not a run folder" in refused(source, out)
    assert [p.name for p in out.iterdir()] == ["diary.txt"]


def run_of(out: Path, digest: str = "0") -> RunFolder:
    """A run of another source, of which no stage is done."""
    run = RunFolder(out)
    write_manifest(run.manifest_file, Manifest(Source("other.mp4", digest), {}))
    run.save_settings(Config())
    return run


def test_run_of_another_source_is_not_touched(tmp_path: Path) -> None:
    out = tmp_path / "run"
    manifest = run_of(out).manifest_file.read_bytes()
    source = tmp_path / "video.avi"
    write_video(source, list(np.random.default_rng(0).integers(0, 255, (5, 48, 64, 3), np.uint8)), 10.0)
    message = refused(source, out)
    assert "another source" in message
    assert "--out" in message
    assert (out / "manifest.json").read_bytes() == manifest


def test_what_was_stopped_in_its_first_moments_is_begun_again(tmp_path: Path) -> None:
    """Between the lock, the manifest and run.toml: with default settings nobody would have asked for."""
    run = run_of(tmp_path / "run")
    run.settings_file.unlink()
    for command in ("resume", "status"):
        result = invoke(command, run.root)
        assert result.exit_code == 1
        assert f"msgs-slam reconstruct other.mp4 --out {run.root}" in result.stderr
    assert existing_config(run) is None
    half = temporary_of(run.manifest_file)
    run.manifest_file.rename(half)
    source = tmp_path / "video.mp4"
    source.write_text("x")
    assert "video.mp4" in refused(source, run.root)  # as a video, not because of the folder
    assert half.exists()
    (run.root / "diary.txt").write_text("mine")
    assert "not a run folder" in refused(source, run.root)


def emptied(run: RunFolder) -> None:
    run.settings_file.write_text("")


def cut_short(run: RunFolder) -> None:
    text = run.settings_file.read_text()
    run.settings_file.write_text(text[: text.index("[export]")])


def no_toml(run: RunFolder) -> None:
    run.settings_file.write_text(run.settings_file.read_text().replace("voxel = 0.008", "voxel = "))


def out_of_range(run: RunFolder) -> None:
    run.settings_file.write_text(run.settings_file.read_text().replace("rate = 10.0", "rate = -5.0"))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [(emptied, "run.toml is empty"), (cut_short, "cut short"), (no_toml, "run.toml"),
     (out_of_range, "frames.rate is 0.1 to 1000")],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused(spoil: Callable[[RunFolder], None], reason: str, tmp_path: Path) -> None:
    run = run_of(tmp_path / "run")
    spoil(run)
    for command in ("resume", "status", "report", "render", "export"):
        result = invoke(command, run.root, *([tmp_path / "out.mp4"] if command == "render" else []))
        assert result.exit_code == 1, (command, result.output)
        assert isinstance(result.exception, SystemExit)
        assert reason in " ".join(result.stderr.split())
        assert "Correct it, or delete it and run" in result.stderr
        assert f"msgs-slam resume {run.root}" in result.stderr


def test_damaged_manifest_is_refused(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run")
    whole = run.manifest_file.read_text()
    for damaged in ("", whole[:-9], whole.replace("other", "othor"), "[" * 100_000, '{"stages": 5}', '{"stages": {}}'):
        run.manifest_file.write_text(damaged)
        for command in ("status", "resume", "report"):
            result = invoke(command, run.root)
            assert result.exit_code == 1
            assert isinstance(result.exception, SystemExit)
            assert "manifest.json" in result.stderr
            assert "msgs-slam reconstruct" in result.stderr


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("export", "--to", "x", "--set", "mapping.passes=3"), "msgs-slam resume no.msgs --set mapping.passes=3"),
        (("export", "--to", ""), "the name is empty; the working folder is ."),
        (("reconstruct", "--out", ""), "the name is empty; the working folder is ."),
        (("report", "--to", "report.pdf"), "report.html; print it in a browser"),
    ],
)
def test_options_that_would_do_nothing_or_something_else_are_refused(words: tuple[str, ...], reason: str) -> None:
    result = invoke(words[0], "no.msgs", *words[1:])
    assert result.exit_code == 2
    assert reason in " ".join(result.stderr.split())


@pytest.mark.parametrize("words", [("reconstruct", "loop"), ("resume", "loop"), ("reconstruct", ".", "--out", "loop")])
def test_a_link_that_leads_to_itself(words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    for name in "ab":
        Image.new("RGB", (8, 8)).save(f"{name}.png")
    refused = invoke(*words)
    assert refused.exit_code == 1
    assert "loop" in refused.stderr


def test_a_run_is_no_source(tmp_path: Path) -> None:
    run = run_of(tmp_path / "room.msgs")
    refused = invoke("reconstruct", run.root)
    assert refused.exit_code == 1
    assert f"is a run, not a source: `msgs-slam resume {run.root}` continues it" in refused.stderr


def test_a_class_map_that_is_none_is_refused_before_the_run_is_looked_at(tmp_path: Path) -> None:
    result = invoke("evaluate", tmp_path / "no.msgs", "--truth", tmp_path, "--class-map", "mine.toml")
    assert result.exit_code == 1
    assert "mine.toml: there is no such file, nor a class map of that name; known: ade20k-replica" in result.stderr


LOADED_BY_EACH = """
import sys
from click.testing import CliRunner
from msgs_slam.msgs_cli.main import main

heavy = ("torch", "numba", "scipy", "skimage", "onnxruntime")
for line in sys.stdin.read().splitlines():
    result = CliRunner().invoke(main, line.split("\t"))
    loaded = ",".join(name for name in heavy if name in sys.modules)
    print(result.exit_code, loaded or "nothing", line, sep="|")
"""


def test_what_computes_nothing_loads_nothing_that_computes(finished_run: FinishedRun, tmp_path: Path) -> None:
    """Importing torch, numba and scipy takes seconds: who looks at a run, or has mistyped, does not wait for them."""
    run, no_run, none = finished_run.folder, tmp_path, tmp_path / "none.mp4"
    (torn := tmp_path / "torn.mp4").write_bytes(bytes(range(256)) * 8)
    fine = (
        ("status", run), ("status", run, "--json"), ("resume", run, "-q"), ("config",), ("models", "list"),
        ("reconstruct", finished_run.video, "--out", run, "-q"),
    )  # fmt: skip
    refused = (
        ("status", no_run), ("resume", no_run), ("export", no_run), ("report", no_run), ("view", no_run),
        ("render", no_run, "x.mp4"), ("evaluate", no_run, "--truth", no_run), ("extend", no_run, torn),
        ("batch", no_run / "nowhere", "--out", no_run), ("reconstruct", none), ("reconstruct", torn),
        ("reconstruct", no_run), ("reconstruct", finished_run.video, "--semantics", "tags", "--out", no_run / "a"),
        ("reconstruct", finished_run.video, "--set", "frames.rate=-1"), ("demo", "--set", "frames.rate=-1"),
        ("models", "path", "nothing"),
    )  # fmt: skip
    lines = ["\t".join(map(str, words)) for words in (*fine, *refused)]
    done = subprocess.run(
        [sys.executable, "-c", LOADED_BY_EACH], input="\n".join(lines), capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    codes, loaded, _ = zip(*(row.split("|", 2) for row in done.stdout.splitlines()), strict=True)
    assert len(codes) == len(lines)
    assert set(codes[: len(fine)]) == {"0"}
    assert set(codes[len(fine) :]) <= {"1", "2"}
    assert set(loaded) == {"nothing"}, done.stdout


def test_commands_that_look_at_a_run_keep_to_its_threads(
    finished_run: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(threads: int) -> None:
        raise InputError(f"{threads} threads")

    monkeypatch.setattr("msgs_slam.pipelines.system.threads.limit_threads", asked)
    run = finished_run.folder
    for words in (
        ("export", run, "--to", tmp_path / "out"), ("render", run, tmp_path / "film.avi"), ("report", run),
        ("evaluate", run, "--truth", finished_run.truth), ("view", run),
    ):  # fmt: skip
        assert "1 threads" in invoke(*words).stderr, words
