"""The examination of a machine: what is well, and what it says of what is not."""

import importlib.util
import shlex
import shutil
import sys
from collections import namedtuple
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

from msgs_slam.formats.errors import install_command, install_extra
from msgs_slam.msgs_cli.doctor import BAD, GOOD, NOTE, Finding, examine
from msgs_slam.msgs_cli.main import main
from msgs_slam.pipelines.system import machine


def found(name: str, folder: Path) -> Finding:
    return next(f for f in examine(folder) if f.name == name)


def test_this_machine_can_run_the_program() -> None:
    result = CliRunner().invoke(main, ["doctor"])
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    for name in ("program", "requirements", "libraries", "video", "threads", "memory", "gpu", "models", "disk"):
        assert any(line[6:].startswith(name) for line in lines), name
    # Every note says what to do.
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        assert not line.startswith(NOTE) or "fix: " in after, line


def test_what_is_missing_is_said_with_its_fix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "none"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr("msgs_slam.msgs_cli.doctor._MODULES", ("math", "no_such_module_at_all"))
    monkeypatch.setattr("msgs_slam.pipelines.system.machine.available_cpus", lambda: 3)
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**8))
    findings = {f.name: f for f in examine(tmp_path)}
    assert findings["libraries"].state == BAD
    assert "no_such_module_at_all" in findings["libraries"].text
    assert findings["models"].fix == "msgs-slam models pull"
    assert findings["threads"].state == NOTE
    assert findings["disk"].state == BAD
    assert "0.1 GB" in findings["disk"].text


def test_memory_is_that_of_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "memory_limits", lambda: [2e9])
    assert found("memory", tmp_path).state == NOTE
    assert found("memory", tmp_path).text.startswith("2.0 GB")


@pytest.mark.parametrize(("has_pip", "words"), [(True, "-m pip install"), (False, "uv pip install --python")])
def test_commands_install_beside_this_program(has_pip: bool, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever environment the shell is in; `uv tool` makes some without pip."""
    monkeypatch.setattr(sys, "executable", "/opt/my tools/bin/python")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if has_pip else None)
    command = install_command(".[hdr]", "torch<3")
    assert words in command
    split = shlex.split(command)
    assert "/opt/my tools/bin/python" in split
    assert split[-2:] == [".[hdr]", "torch<3"]
    assert shlex.split(install_extra("hdr"))[-1] == "av>=14"
    assert "msgs-slam" not in install_extra("cluster")


def test_a_check_that_breaks_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> Finding:
        raise RuntimeError("no such bus")

    monkeypatch.setattr("msgs_slam.msgs_cli.doctor._video", broken)
    finding = found("video", tmp_path)
    assert finding.state == BAD
    assert "no such bus" in finding.text
    assert found("threads", tmp_path).state in (GOOD, NOTE)


@pytest.mark.parametrize(("built", "fix"), [(None, "install a CUDA build of torch"), ("12.6", "update the driver")])
def test_a_card_that_torch_cannot_use_is_a_note(
    built: str | None, fix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(machine.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", built)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    seen = found("gpu", tmp_path)
    assert (seen.state, fix in seen.fix) == (NOTE, True)
    machine._log_once.cache_clear()
    assert machine.resolve_device("auto") == "cpu"
    assert fix in caplog.text
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert found("gpu", tmp_path).state == GOOD
    machine._log_once.cache_clear()
