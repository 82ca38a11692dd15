"""The lines of Python on the README and on its page of the site, run as they stand there."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import FinishedRun

import msgs_slam
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.ply import read_mesh_ply
from msgs_slam.formats.trajectory import read_tum
from msgs_slam.pipelines.types import Intrinsics

ROOT = Path(__file__).resolve().parents[2]


def lines_of(page: str, copied_run: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the first block of a page beside a video.msgs; returns its names."""
    monkeypatch.chdir(copied_run("video.msgs").parent)
    found: dict[str, Any] = {}
    exec(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)[0], found)
    return found


def test_the_lines_of_the_readme(copied_run: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch) -> None:
    found = lines_of("README.md", copied_run, monkeypatch)
    run, export = found["run"], Path("video.msgs", "export")
    seconds, poses = read_tum(export / "trajectory.txt")
    np.testing.assert_allclose(found["seconds"], seconds, atol=1e-6)
    np.testing.assert_allclose(found["poses"], poses, atol=1e-6)
    assert len(found["photos"]) == len(found["cameras"]) == len(run.names) == len(run.timestamps) > 5
    assert all(path.is_file() for path in found["photos"])
    assert (np.diff(run.timestamps) > 0).all()
    assert found["view"].color.shape == (480, 640, 3)
    assert found["names"]
    assert len(found["centres"]) == len(run.gaussians.class_ids) > 500
    whole, floor = read_mesh_ply(export / "mesh.ply"), found["floor"]
    assert set(floor.labels) == {run.classes.index("floor")}
    assert 0 < len(floor.faces) < len(whole.faces)
    assert len(run.mesh().faces) == len(whole.faces)
    assert found["scale"] is None or 0 < found["scale"].sd < found["scale"].value


def test_the_lines_of_the_page(
    copied_run: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = lines_of("docs/python.md", copied_run, monkeypatch)
    assert len(capsys.readouterr().out.splitlines()) == len(found["run"].names)
    assert found["wide"].depth.shape == (480, 1280)


def test_a_view_of_another_size_sees_as_much_from_top_to_bottom(finished_run: FinishedRun) -> None:
    run = msgs_slam.open_run(finished_run.folder)
    pose, camera = run.world_from_cam[0], run.intrinsics
    own, twice = run.draw(pose), run.draw(pose, size=(2 * camera.width, 2 * camera.height))
    smaller = twice.color.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))
    seen = own.coverage > 0.9
    assert 0 < np.abs(smaller - own.color)[seen].mean() < 0.02
    narrow = run.draw(pose, size=(camera.width // 2, camera.height))
    left = camera.width // 4
    np.testing.assert_allclose(narrow.color, own.color[:, left : left + camera.width // 2], atol=1e-4)
    other = Intrinsics(camera.width // 2, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    np.testing.assert_allclose(run.draw(pose, intrinsics=other).color, own.color[:, : camera.width // 2], atol=1e-4)
    np.testing.assert_array_equal(run.depth(0), own.depth)


def test_unknown_classes_are_named(finished_run: FinishedRun) -> None:
    with pytest.raises(InputError, match=r"no class 'unicorn' in .*; there are .*floor"):
        msgs_slam.open_run(finished_run.folder).mesh(classes=["unicorn"])


def test_a_run_shows_its_own_names_alone() -> None:
    shown = {name for name in dir(msgs_slam.Run) if not name.startswith("_")}
    assert shown == {
        "classes", "depth", "draw", "gaussians", "image_paths", "intrinsics", "mesh", "metres_per_unit", "names",
        "things", "timestamps", "trajectory", "world_from_cam",
    }  # fmt: skip
