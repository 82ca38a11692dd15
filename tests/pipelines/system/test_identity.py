"""What code a stage's result depends on."""

from pathlib import Path

import pytest

from msgs_slam.pipelines.reconstruct import all_stages
from msgs_slam.pipelines.run.stages import LazyFunction
from msgs_slam.pipelines.system.identity import package_digest


def test_any_change_of_sources_or_data_is_another_digest_and_nothing_else_is(tmp_path: Path) -> None:
    for name in ("formats/a.py", "pipelines/depth/weights.npz", "pipelines/depth/b.py"):
        (file := tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        file.write_text("x = 1\n")

    def changed(name: str, text: str) -> bool:
        before = package_digest.__wrapped__(tmp_path)
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(text.encode())
        return package_digest.__wrapped__(tmp_path) != before

    for name in ("formats/a.py", "pipelines/depth/weights.npz", "pipelines/depth/b.py"):
        assert changed(name, "x = 2\n")
        assert not changed(name, "x = 2\r\n")
    for name in ("pipelines/new.py", "pipelines/page/page.js"):
        assert changed(name, "")
    for name in ("msgs_cli/main.py", "pipelines/depth/.hidden", "formats/__pycache__/a.pyc", "tests/a.py"):
        assert not changed(name, "x = 3\n")


@pytest.mark.parametrize("method", ["default", "paper"])
def test_every_stage_names_a_function_that_there_is(method: str) -> None:
    for stage in all_stages(method):
        assert isinstance(stage.run, LazyFunction)
        assert callable(stage.run.function)
