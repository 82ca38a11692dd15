"""What code a stage's result depends on."""

import re
from pathlib import Path

import pytest

from msgs_slam.pipelines.config import STAGES
from msgs_slam.pipelines.engine.stages import Later
from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.system.identity import ROOT, data_beside, source_digest, stage_sources


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


def test_data_beside_the_sources_are_part_of_the_digest(tmp_path: Path) -> None:
    room, other = tmp_path / "pipelines" / "depth", tmp_path / "pipelines" / "other"
    for folder in (room / "page", other):
        folder.mkdir(parents=True)
    (room / "stage.py").write_text("")
    digests = set()
    for file in (room / "weights.npz", room / "page" / "page.js", other / "weights.npz", room / ".hidden"):
        file.write_bytes(b"1")
        data_beside.cache_clear()
        digests.add(source_digest(room / "stage.py", tmp_path))
    assert len(digests) == 2
    (room / "weights.npz").write_bytes(b"2")
    assert source_digest(room / "stage.py", tmp_path) not in digests


@pytest.mark.parametrize(
    ("stage", "data"),
    [
        ("proxy", "depth/completion/weights.npz"),
        ("proxy", "networks/ade20k.toml"),
        ("export", "export/extra/page/page.js"),
    ],
)
def test_package_data_belong_to_the_stages_that_use_them(stage: str, data: str) -> None:
    rooms = {path.parent for path in stage_sources(ROOT / "pipelines" / stage / "stage.py")}
    assert (ROOT / "pipelines" / data).resolve() in {file for room in rooms for file in data_beside(room)}


FOREIGN = {
    "frames": {"proxy.depth", "proxy.scale_ref", "proxy.semantics"},  # what panoramas refuse
    "proxy": {"frames.poses", "frames.people"},  # refused without; an input
    "tracking": {"frames.poses", "frames.least_piece"},  # of `extend`; an input
    "global_ba": {"frames.max_side"},  # as the frames are, whose content is upstream
    "export": {"proxy.scale_ref", "frames.max_side"},  # of pieces, whose own stages have it; as for global_ba
}


def test_settings_of_other_sections_that_a_stage_reads_are_known() -> None:
    """Its identity holds its own section: another one's has to be among its inputs, or change the stage before it."""
    for stage in STAGES:
        text = "\n".join(p.read_text(encoding="utf-8") for p in (ROOT / "pipelines" / stage).rglob("*.py"))
        read = set(re.findall(rf"config\.((?:{'|'.join(STAGES)})\.\w+)", text))
        assert {name for name in read if not name.startswith(f"{stage}.")} == FOREIGN.get(stage, set()), stage


def test_every_stage_lies_where_its_identity_is_looked_for() -> None:
    for stage in all_stages():
        assert stage.file.resolve() == ROOT / "pipelines" / stage.name / "stage.py"


@pytest.mark.parametrize("method", ["default", "paper"])
def test_every_stage_names_a_function_that_there_is(method: str) -> None:
    for stage in all_stages(method):
        assert isinstance(stage.run, Later)
        assert callable(stage.run.function)
