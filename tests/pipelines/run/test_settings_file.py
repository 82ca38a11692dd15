"""run.toml and manifest.json of an earlier state of the program: what is no more is told of, another format refused."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import Config, ExportConfig
from msgs_slam.pipelines.read_config import config_to_toml
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.records import load_records, load_source
from msgs_slam.pipelines.run.settings_file import load_settings, save_settings


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder(tmp_path / "run")
    run.stage("frames").mkdir(parents=True)
    note_finished(run, ("frames",))
    return run


def test_a_setting_that_is_no_more_does_not_stop_a_run(
    run: RunFolder, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a version would leave it that still had one: with its checksum."""
    config = replace(Config(), export=ExportConfig(voxel=0.05))
    text = config_to_toml(config).replace("[frames]\n", "[frames]\npeak_threshold = 0.01\n")
    monkeypatch.setattr("msgs_slam.pipelines.run.settings_file.config_to_toml", lambda _: text)
    save_settings(run, config)
    with caplog.at_level(logging.WARNING):
        assert load_settings(RunFolder(run.root)) == config
    assert "1 settings in it are none any more (frames.peak_threshold)" in caplog.text
    run.settings_file.write_text(
        run.settings_file.read_text().replace("peak_threshold = 0.01", "peak_threshold = 0.02")
    )
    with pytest.raises(InputError, match="not as the program left it"):
        load_settings(RunFolder(run.root))


def test_settings_without_their_checksum_are_refused(run: RunFolder) -> None:
    run.settings_file.write_text(run.settings_file.read_text().partition("\n")[2])
    with pytest.raises(InputError, match="not as the program left it"):
        load_settings(RunFolder(run.root))


def test_a_manifest_of_another_format_is_refused(run: RunFolder) -> None:
    value = json.loads(run.manifest_file.read_text())
    for format in (1, 99):
        run.manifest_file.write_text(json.dumps(value | {"format": format}))
        with pytest.raises(InputError, match=f"its format is {format}, this version of the program knows 2"):
            load_records(RunFolder(run.root))
    for spoilt in (value | {"source": 5}, {"stages": {}}, value | {"stages": {"frames": []}}):
        run.manifest_file.write_text(json.dumps(spoilt))
        with pytest.raises(InputError, match="msgs-slam reconstruct"):
            load_source(RunFolder(run.root))
