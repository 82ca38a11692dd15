"""What a notebook imports, and that an installation brings one name only."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import msgs_slam
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.trajectory import read_tum
from msgs_slam.pipelines.config import ExportConfig
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.run.files import FRAMES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.identity import package_digest
from msgs_slam.pipelines.system.progress import SilentProgress, StageEvent
from tests.pipelines.frames.conftest import QUICK, render, sideways

ROOT = Path(__file__).resolve().parents[2]
OracleRun = Callable[..., RunFolder]


def test_a_run_is_opened_and_drawn(oracle_run: OracleRun, tmp_path: Path) -> None:
    folder = oracle_run(pixel_stride=6)
    run = msgs_slam.open_run(str(folder.root))
    assert len(run.names) == len(run.world_from_cam) == 32
    assert run.classes
    view = run.draw(run.world_from_cam[0])
    assert view.color.shape == (run.intrinsics.height, run.intrinsics.width, 3)
    photo = folder.image(folder.load(FRAMES)[0]) / 255
    assert 0 < np.abs(view.color - photo)[view.coverage > 0.9].mean() < 0.1
    with pytest.raises(ValueError, match=r"\(4, 4\)"):
        run.draw(np.eye(3))


def test_its_world_is_that_of_the_files(oracle_run: OracleRun, tmp_path: Path) -> None:
    from finished import note_finished

    folder = oracle_run(pixel_stride=6)
    export_run(folder, tmp_path, "tum")
    shutil.copytree(tmp_path, folder.stage("export"), dirs_exist_ok=True)
    note_finished(folder, ("frames", "proxy", "tracking", "mapping", "export"))
    run = msgs_slam.open_run(folder.root)
    _, poses = read_tum(folder.stage("export") / "trajectory.txt")
    np.testing.assert_allclose(run.world_from_cam, poses, atol=1e-6)


def test_the_readers_on_the_page_read_an_export(
    oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run(pixel_stride=6)
    for kind in ("mesh", "tum"):
        export_run(run, tmp_path / "video.msgs" / "export", kind, settings=ExportConfig(voxel=0.05, texture=False))
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    code = next(b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "read_tum" in b)
    found: dict[str, Any] = {}
    exec(code, found)
    mesh = found["mesh"]
    assert len(mesh.vertices) == len(mesh.colors) == len(mesh.labels) > 1000
    assert 1000 < mesh.faces.max() < len(mesh.vertices)
    assert len(np.unique(mesh.labels)) > 2
    assert found["world_from_cam"].shape == (len(found["seconds"]), 4, 4)


def test_errors_say_what_to_do(tmp_path: Path) -> None:
    assert msgs_slam.InputError is InputError
    with pytest.raises(InputError, match=r"no\.msgs does not exist\. `msgs-slam reconstruct VIDEO` creates a run"):
        msgs_slam.open_run(tmp_path / "no.msgs")
    with pytest.raises(InputError, match="no such file"):
        msgs_slam.reconstruct(tmp_path / "none.mp4", tmp_path / "out.msgs")
    with pytest.raises(InputError, match=r"did you mean mapping\.passes"):
        msgs_slam.reconstruct(tmp_path / "none.mp4", tmp_path / "out.msgs", ["mapping.pases=3"])
    for wrong in ({"mapping.pases": 3}, {"mapping": {"pases": 3}}):
        with pytest.raises(InputError, match=r"did you mean mapping\.passes"):
            msgs_slam.reconstruct(tmp_path / "none.mp4", tmp_path / "out.msgs", wrong)
    with pytest.raises(InputError, match=r"expected section\.key"):
        msgs_slam.reconstruct(tmp_path / "none.mp4", tmp_path / "out.msgs", {"passes": 3})


def test_the_version_is_the_installed_one() -> None:
    assert msgs_slam.__version__ == importlib.metadata.version("msgs-slam")


def test_settings_are_a_dict_and_progress_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i, pose in enumerate(sideways(12)):
        write_rgb(tmp_path / "walk" / f"{i:02d}.jpg", render(*pose))
    changes = dict(text.split("=") for text in QUICK)
    nested = {"frames": {"max_features": 300}, "run.threads": 1}
    with pytest.raises(InputError, match="mapping"):  # a stop, long before the map
        msgs_slam.reconstruct(tmp_path / "walk", tmp_path / "a.msgs", {**numbers(changes), **nested}, StopAfterFrames())
    settings = RunFolder(tmp_path / "a.msgs").settings()
    assert (settings.frames.max_features, settings.run.threads) == (300, 1)
    assert "frames" in RunFolder(tmp_path / "a.msgs").records
    with pytest.raises(InputError, match="nowhere"):
        msgs_slam.reconstruct(tmp_path / "walk", tmp_path / "a.msgs", {"proxy.depth": "files:nowhere"}, progress=True)
    assert "\r" not in capsys.readouterr().err


def numbers(texts: dict[str, str]) -> dict[str, object]:
    return {key: tomllib.loads(f"v = {value}")["v"] if value[0].isdigit() else value for key, value in texts.items()}


class StopAfterFrames(SilentProgress):
    """Hears of the stages, and has enough of them after the first."""

    def stage(self, event: StageEvent) -> None:
        if event.name != "frames":
            raise InputError("enough, no mapping")


def test_an_installation_brings_one_name_only(tmp_path: Path) -> None:
    if find_spec("setuptools") is None:  # its import fails in a process that has imported distutils
        pytest.skip("setuptools is not installed")
    command = [
        sys.executable,
        "setup.py",
        "-q",
        "egg_info",
        "--egg-base",
        str(tmp_path),
    ]
    command += ["build_py", "--build-lib", str(tmp_path / "built")]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, env=environment)
    assert [p.name for p in (tmp_path / "built").iterdir()] == ["msgs_slam"]
    package = tmp_path / "built" / "msgs_slam"
    for room in ("pipelines", "formats", "msgs_cli"):
        sources = {p.relative_to(ROOT / room) for p in (ROOT / room).rglob("*.py") if p.parent.name != "msgs_slam"}
        built = {p.relative_to(package / room) for p in (package / room).rglob("*") if p.is_file()}
        assert {p for p in built if p.suffix == ".py"} == sources
        assert {p for p in built if p.suffix == ".toml"} == {
            p.relative_to(ROOT / room) for p in (ROOT / room).rglob("*.toml")
        }
        for path in sources:
            assert (package / room / path).read_bytes() == (ROOT / room / path).read_bytes(), "changed by the build"
    # A run made by the sources is not out of date for the installed program.
    assert package_digest(package) == package_digest(ROOT)
