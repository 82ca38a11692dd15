"""run.toml and manifest.json of an earlier state of the program: what is no more is told of, another format refused."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import Config, ExportConfig
from msgs_slam.pipelines.run.folder import RunFolder, load_records, load_settings


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.stage("frames").mkdir(parents=True)
    note_finished(run, ("frames",))
    return run


def edit(run: RunFolder, old: str, new: str) -> None:
    text = run.settings_file.read_text()
    assert old in text
    run.settings_file.write_text(text.replace(old, new))


def test_the_file_may_be_edited(run: RunFolder) -> None:
    edit(run, "voxel = 0.008", "voxel = 0.05  # coarser")
    assert load_settings(RunFolder(run.root)) == replace(Config(), export=ExportConfig(voxel=0.05))


def test_a_setting_that_is_no_more_does_not_stop_a_run(run: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    edit(run, "[frames]\n", "[frames]\npeak_threshold = 0.01\nrat = 3\n")
    with caplog.at_level(logging.WARNING):
        assert load_settings(RunFolder(run.root)) == Config()
    assert "there is no setting frames.peak_threshold" in caplog.text
    assert "there is no setting frames.rat; did you mean frames.rate?: it is ignored" in caplog.text


def test_a_manifest_of_another_format_is_refused(run: RunFolder) -> None:
    value = json.loads(run.manifest_file.read_text())
    for format in (1, 99):
        run.manifest_file.write_text(json.dumps(value | {"format": format}))
        with pytest.raises(InputError, match=f"its format is {format}, this version of the program knows 2"):
            load_records(RunFolder(run.root))
