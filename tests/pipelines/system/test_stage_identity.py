"""What code a stage's result depends on, and that a release says so."""

import tomllib
from pathlib import Path

import pytest

from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.engine.stages import Later
from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.system.identity import ROOT, TABLE, source_digest, stage_identity, stage_sources

REPOSITORY = Path(__file__).resolve().parents[3]


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


def test_a_release_has_the_digests_of_its_sources() -> None:
    table = tomllib.loads(TABLE.read_text())
    version = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["version"]
    if table["release"] != version:
        assert "dev" in version, "a release needs its numbers: type `python tests/release.py`"
        pytest.skip(f"{version} is no release: stages are known by the digest of their sources")
    for name in STAGES:
        digest = source_digest(ROOT / "pipelines" / name / "stage.py")
        assert table[name]["sources"] == digest, "the sources have changed: type `python tests/release.py`"


def test_identity_is_a_number_only_where_the_sources_are_the_released_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = ROOT / "pipelines" / "export" / "stage.py"
    digest = source_digest(file)
    for written, expected in ((digest, "7"), ("0" * 16, digest)):
        table = tmp_path / f"{expected}.toml"
        table.write_text(f'[export]\nnumber = 7\nsources = "{written}"\n')
        monkeypatch.setattr("msgs_slam.pipelines.system.identity.TABLE", table)
        stage_identity.cache_clear()
        assert stage_identity("export", file) == expected
    stage_identity.cache_clear()


def test_every_stage_lies_where_the_release_looks_for_it() -> None:
    for stage in all_stages():
        assert stage.file.resolve() == ROOT / "pipelines" / stage.name / "stage.py"


@pytest.mark.parametrize("method", ["default", "paper"])
def test_every_stage_names_a_function_that_there_is(method: str) -> None:
    for stage in all_stages(method):
        assert isinstance(stage.run, Later)
        assert callable(stage.run.function)
