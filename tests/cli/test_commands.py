"""The command line through click's runner: exit codes, messages, help."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from msgs_cli.main import main


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
    assert wrong.exit_code == 1
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


def refused(source: Path, out: Path, *options: object) -> str:
    """The message with which `reconstruct` ends; nothing must be left behind."""
    existed = out.exists()
    result = invoke("reconstruct", source, "--out", out, *options)
    assert result.exit_code == 1, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert out.exists() == existed, "a refused source must leave no run folder"
    return result.stderr


def test_missing_source(tmp_path: Path) -> None:
    assert "no such file" in refused(tmp_path / "missing.mp4", tmp_path / "run")


def test_empty_file_and_text_file(tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"")
    assert "is empty" in refused(video, tmp_path / "run")
    video.write_text("this is not a video")
    assert "video.mp4" in refused(video, tmp_path / "run")


def test_empty_folder(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    assert "image" in refused(folder, tmp_path / "run")


def test_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "diary.txt").write_text("mine")
    source = tmp_path / "video.mp4"
    source.write_text("x")
    assert "not a run folder" in refused(source, out)
    assert [p.name for p in out.iterdir()] == ["diary.txt"]


def test_no_gpu_is_said(tmp_path: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    source = tmp_path / "video.mp4"
    source.write_text("x")
    assert "no CUDA device" in refused(source, tmp_path / "run", "--device", "cuda")


def test_run_of_another_source_is_not_touched(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    manifest = '{"source": {"path": "other.mp4", "digest": "0"}, "stages": {}}'
    (out / "manifest.json").write_text(manifest)
    (out / "run.toml").write_text("")
    source = tmp_path / "video.mp4"
    source.write_text("x")
    message = refused(source, out)
    assert "another source" in message
    assert "--out" in message
    assert (out / "manifest.json").read_text() == manifest


def test_settings_of_an_older_version_are_explained(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "manifest.json").write_text('{"source": {"path": "other.mp4", "digest": "0"}, "stages": {}}')
    (out / "run.toml").write_text("[mapping]\npasses = 3.0\ndepht_weight = 0.5\n")
    for command in ("resume", "report", "render", "export"):
        more = [tmp_path / "out.mp4"] if command == "render" else []
        result = invoke(command, out, *more)
        assert result.exit_code == 1, (command, result.output)
        assert isinstance(result.exception, SystemExit)
        assert "there is no setting mapping.depht_weight; did you mean mapping.depth_weight?" in result.stderr
        assert "remove that line" in result.stderr


def test_export_with_other_settings_must_say_where_to(tmp_path: Path) -> None:
    result = invoke("export", tmp_path, "--set", "export.voxel=0.02")
    assert result.exit_code == 2
    assert "--to" in result.stderr
