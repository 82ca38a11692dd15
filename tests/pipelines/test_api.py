"""What a notebook imports, and that an installation brings one name only."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import msgs_slam
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.trajectory import read_tum
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.identity import source_digest

ROOT = Path(__file__).resolve().parents[2]
OracleRun = Callable[..., RunFolder]


def test_a_run_is_opened_and_drawn(oracle_run: OracleRun, tmp_path: Path) -> None:
    folder = oracle_run(pixel_stride=6)
    run = msgs_slam.open_run(str(folder.root))
    assert len(run.names) == len(run.world_from_cam) == 32
    assert run.classes
    view = run.draw(run.world_from_cam[0])
    assert view.color.shape == (run.intrinsics.height, run.intrinsics.width, 3)
    photo = folder.image(folder.load_frames()[0]) / 255
    assert 0 < np.abs(view.color - photo)[view.coverage > 0.9].mean() < 0.1
    with pytest.raises(ValueError, match=r"\(4, 4\)"):
        run.draw(np.eye(3))


def test_its_world_is_that_of_the_files(oracle_run: OracleRun) -> None:
    from finished import note_finished

    folder = oracle_run(pixel_stride=6)
    export_run(folder, folder.stage("export"), "tum")
    note_finished(folder, ("frames", "proxy", "tracking", "mapping", "export"))
    run = msgs_slam.open_run(folder.root)
    _, poses = read_tum(folder.stage("export") / "trajectory.txt")
    np.testing.assert_allclose(run.world_from_cam, poses, atol=1e-6)


def test_errors_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no\.msgs"):
        msgs_slam.open_run(tmp_path / "no.msgs")
    with pytest.raises(InputError, match="no such file"):
        msgs_slam.reconstruct(tmp_path / "none.mp4", tmp_path / "out.msgs")
    with pytest.raises(InputError, match=r"did you mean mapping\.passes"):
        msgs_slam.reconstruct(tmp_path / "none.mp4", tmp_path / "out.msgs", ["mapping.pases=3"])


def test_an_installation_brings_one_name_only(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path)]
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
    stage = Path("pipelines/export/stage.py")
    assert source_digest(package / stage, package) == source_digest(ROOT / stage, ROOT)
