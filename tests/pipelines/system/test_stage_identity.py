"""What code a stage's result depends on."""

from pathlib import Path

import pytest

from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.engine.stages import Later
from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.system.identity import ROOT, source_digest, stage_sources


def sources(stage: str) -> set[str]:
    return {p.relative_to(ROOT).as_posix() for p in stage_sources(ROOT / "pipelines" / stage / "stage.py")}


def test_sources_are_what_the_stage_imports_and_nothing_else() -> None:
    assert {"pipelines/render/cpu_forward.py", "pipelines/render/__init__.py"} <= sources("mapping")
    assert {"pipelines/sfm/driver.py", "formats/video.py", "pipelines/run/folder.py"} <= sources("frames")
    assert "pipelines/sfm/bundle_kernels.py" in sources("global_ba")
    for stage in STAGES:
        assert not {
            s for s in sources(stage) if "evaluation" in s or "msgs_cli" in s or s.endswith("pipelines/config.py")
        }
    assert not {s for s in sources("frames") if s.startswith("pipelines/gaussians")}


def test_any_change_of_them_is_another_digest(tmp_path: Path) -> None:
    room = tmp_path / "pipelines"
    room.mkdir()
    (room / "__init__.py").write_text("")
    (room / "stage.py").write_text("def run():\n    from . import far\n    return far\n")
    (room / "far.py").write_text("from .config import Config\nfrom ..pipelines.farther import VALUE\n")
    (room / "farther.py").write_text("VALUE = 1\n")
    (room / "config.py").write_text("from . import beside\n")
    (room / "beside.py").write_text("")
    before = source_digest(room / "stage.py", tmp_path)
    (room / "beside.py").write_text("# not imported but by the plumbing\n")
    (room / "farther.py").write_bytes(b"VALUE = 1\r\n")
    assert source_digest(room / "stage.py", tmp_path) == before
    (room / "farther.py").write_text("VALUE = 2\n")
    assert source_digest(room / "stage.py", tmp_path) != before


def test_every_stage_lies_where_its_identity_is_looked_for() -> None:
    for stage in all_stages():
        assert stage.file.resolve() == ROOT / "pipelines" / stage.name / "stage.py"


@pytest.mark.parametrize("method", ["default", "paper"])
def test_every_stage_names_a_function_that_there_is(method: str) -> None:
    for stage in all_stages(method):
        assert isinstance(stage.run, Later)
        assert callable(stage.run.function)
