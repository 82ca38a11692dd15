"""The command `msgs-slam` as a user has it: a process of its own, in an empty folder, without the checkout on its path.

`make test` runs this against the built wheel and says so by MSGS_SLAM_CHECKOUT; in an editable install it is the same.
"""

import importlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest
import trimesh

import msgs_slam
from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.export.kinds import EXPORTS

PROGRAM = Path(sys.executable).with_name("msgs-slam")
PACKAGE = Path(importlib.import_module("msgs_slam.pipelines").__file__ or "").parents[1]
SMALL = (
    "run.device=cpu", "frames.max_features=600", "frames.rate=5", "proxy.stereo_side=96",
    "mapping.passes=1", "mapping.min_iterations=20", "mapping.max_gaussians=8000", "export.voxel=0.05",
)  # fmt: skip
FILES = {
    "colmap": "sparse/0/images.bin", "ply": "point_cloud.ply", "spz": "point_cloud.spz", "sog": "point_cloud.sog",
    "glb": "point_cloud.glb", "mesh": "mesh.ply", "tum": "trajectory.txt", "depth": "transforms.json",
    "html": "map.html", "tiles": "tiles/tileset.json", "floorplan": "floorplan.svg", "collision": "collision.glb",
    "usd": "mesh.usdz",
}  # fmt: skip


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("somewhere")


def environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}


def run(here: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    words = [str(PROGRAM), *map(str, arguments)]
    return subprocess.run(words, cwd=here, env=environment(), capture_output=True, text=True, timeout=900)


def succeeds(here: Path, *arguments: object) -> str:
    done = run(here, *arguments)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def demo(here: Path) -> Path:
    """A finished run of the built-in clip, by the command for it."""
    said = succeeds(here, "demo", *(word for setting in SMALL for word in ("--set", setting)), "-q")
    (here / "said.txt").write_text(said)
    return here / "msgs-demo" / "room.msgs"


def test_it_is_the_wheel_where_that_is_what_is_tested() -> None:
    checkout = os.environ.get("MSGS_SLAM_CHECKOUT")
    if checkout is None:
        pytest.skip("the program is not said to be installed from a wheel: `make test` does")
    assert not PACKAGE.is_relative_to(Path(checkout))
    assert Path(msgs_slam.__file__).parent == PACKAGE


def test_every_file_of_the_package_is_imported_by_one_name() -> None:
    """A name in a string or an import that an installed copy does not have breaks here, not at a user's."""
    code = "import importlib, sys; [importlib.import_module(n) for n in sys.argv[1:]]; "
    code += "print(sorted(n for n in sys.modules if n.split('.')[0] in ('pipelines', 'formats', 'msgs_cli')))"
    names = [module_of(path) for path in sources() if path.name not in ("__main__.py", "cuda_kernels.py")]
    assert len(names) > 200
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, env=environment())
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip() == "[]"


def sources() -> list[Path]:
    return [p for n in ("msgs_cli", "pipelines", "formats") for p in sorted((PACKAGE / n).rglob("*.py"))]


def module_of(path: Path) -> str:
    """Import name of a file of the package."""
    inside = path.relative_to(PACKAGE).with_suffix("").parts
    parts = inside[:-1] if inside[-1] == "__init__" else inside
    return ".".join(("msgs_slam", *parts))


def test_names_of_modules_in_strings_are_modules() -> None:
    texts = [path.read_text(encoding="utf-8") for path in sources()]
    named = {m for text in texts for m in re.findall(r'"(msgs_slam(?:\.\w+)+)"', text)}
    later = {f"msgs_slam.pipelines.{m}" for text in texts for m in re.findall(r'\bLazyFunction\("([\w.]+)"', text)}
    assert later
    assert named | later <= {module_of(path) for path in sources()} | {"msgs_slam.msgs_cli.log_format"}


def test_the_demo_ends_with_every_file(demo: Path) -> None:
    written = {str(p.relative_to(demo / "export")) for p in (demo / "export").rglob("*")}
    assert {FILES[n] for n in ("colmap", "ply", "mesh", "tum")} <= written
    mesh = trimesh.load(demo / "export" / "mesh.ply", process=False)
    assert len(mesh.faces) > 1000


def test_the_demo_ends_with_three_next_commands_that_can_be_pasted(demo: Path) -> None:
    said = (demo.parents[1] / "said.txt").read_text()
    lines = [line.split("#")[0].split() for line in said.split("Next:\n")[1].splitlines()]
    assert [words[1] for words in lines] == ["view", "report", "reconstruct"]
    assert lines[0][2] == "msgs-demo/room.msgs"
    for words in lines:
        assert shutil.which(words[0]), "by its path where it is not on the PATH"


def test_a_finished_run_is_up_to_date(demo: Path) -> None:
    before = {p: p.stat().st_mtime_ns for n in STAGES for p in (demo / n).rglob("*")}
    succeeds(demo.parent, "resume", demo.name, "-q")
    assert {p: p.stat().st_mtime_ns for n in STAGES for p in (demo / n).rglob("*")} == before


def test_ray_is_a_place_to_work(demo: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    other = tmp_path / "ray.msgs"
    shutil.copytree(demo, other)
    shutil.rmtree(other / "export")
    succeeds(tmp_path, "resume", other.name, "--engine", "ray", "-q")
    assert (other / "export" / "mesh.ply").read_bytes() == (demo / "export" / "mesh.ply").read_bytes()


@pytest.mark.parametrize("kind", [row.kind for row in EXPORTS])
def test_each_export_alone(demo: Path, kind: str, tmp_path: Path) -> None:
    if kind == "usd":
        pytest.importorskip("pxr")
    succeeds(tmp_path, "export", demo, "--only", kind, "--to", tmp_path / kind, "-q")
    assert (tmp_path / kind / FILES[kind]).stat().st_size > 0


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_view_shows_a_page_and_ends(demo: Path, stop: signal.Signals, tmp_path: Path) -> None:
    said = tmp_path / "said.txt"
    with said.open("w") as stream:
        viewer = subprocess.Popen(
            [str(PROGRAM), "view", str(demo)], cwd=tmp_path, env=environment(),
            stdout=stream, stderr=stream,
        )  # fmt: skip
    try:
        while not (found := re.search(r"open (http://\S+)", said.read_text())):
            assert viewer.poll() is None, said.read_text()[-2000:]
            time.sleep(0.2)
        assert b"<iframe" in urllib.request.urlopen(found[1], timeout=30).read()
        assert b"<canvas" in urllib.request.urlopen(f"{found[1]}map", timeout=60).read()
        viewer.send_signal(stop)
        assert viewer.wait(timeout=60) == 0
        assert "Traceback" not in said.read_text()
        assert "stack trace" not in said.read_text()
    finally:
        viewer.kill()
        viewer.wait()


def test_the_doctor_finds_nothing_amiss(here: Path) -> None:
    assert "python" in succeeds(here, "doctor").lower()
