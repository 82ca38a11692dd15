"""A run that version 0.1.0 has made: its run.toml and manifest.json as they were written, of a clip of 16 frames."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import ExportConfig, config_to_toml
from msgs_slam.pipelines.records import FORMAT, load_records, load_source, recorded_config, write_manifest
from msgs_slam.pipelines.run_folder import RunFolder
from msgs_slam.pipelines.run_folder_names import STAGES
from msgs_slam.pipelines.settings_file import load_settings, save_settings

WRITTEN = Path(__file__).with_name("run_of_0_1_0")


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder(shutil.copytree(WRITTEN, tmp_path / "run"))


def test_its_stages_are_done_and_its_settings_known(run: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    records = load_records(run)
    assert tuple(records) == STAGES
    assert load_source(run).path == "tiny.avi"
    assert records["tracking"].figures["posed"] == 16
    with caplog.at_level(logging.WARNING):
        config = recorded_config(records, load_settings(run))
    assert (config.mapping.min_iterations, config.mapping.max_gaussians, config.export.voxel) == (20, 8000, 0.05)
    assert config.run.threads == 1
    assert "settings in it are none any more" in caplog.text
    assert records["mapping"].settings["mapping"]["kappa"] == 0.0  # kept, though no setting any more


def test_written_anew_it_is_of_this_version(run: RunFolder) -> None:
    config, manifest = load_settings(run), run.manifest()
    assert manifest is not None
    assert manifest.format == 1
    write_manifest(run.manifest_file, manifest)
    save_settings(run, config)
    again = RunFolder(run.root)
    assert load_records(again) == manifest.records
    assert (again.manifest() or manifest).format == FORMAT
    assert load_settings(again) == config


def test_stages_made_with_other_settings_than_run_toml_says_are_not_done(run: RunFolder) -> None:
    """0.1.0 wrote run.toml before it made a stage again, and kept the old record while it did."""
    text = run.settings_file.read_text().replace("min_iterations = 20", "min_iterations = 30")
    run.settings_file.write_text(text)
    assert tuple(load_records(run)) == STAGES[:3]
    run.settings_file.write_text(text.replace("seed = 0", "seed = 1"))
    assert load_records(RunFolder(run.root)) == {}


def test_its_damage_is_refused(run: RunFolder) -> None:
    text, manifest = run.settings_file.read_text(), json.loads(run.manifest_file.read_text())
    for cut in ("", text[:700]):
        run.settings_file.write_text(cut)
        with pytest.raises(InputError, match=r"run\.toml"):
            load_records(RunFolder(run.root))
    run.settings_file.write_text(text)
    for spoilt in (manifest | {"source": 5}, {"stages": {}}, manifest | {"stages": {"frames": []}}):
        run.manifest_file.write_text(json.dumps(spoilt))
        with pytest.raises(InputError, match="msgs-slam reconstruct"):
            load_source(RunFolder(run.root))


def test_a_setting_that_is_no_more_does_not_stop_a_run_of_this_format(
    run: RunFolder, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a version would leave it that still had one: with its checksum."""
    config, manifest = replace(load_settings(run), export=ExportConfig(voxel=0.05)), run.manifest()
    assert manifest is not None
    write_manifest(run.manifest_file, manifest)
    text = config_to_toml(config).replace("[frames]\n", "[frames]\npeak_threshold = 0.01\n")
    monkeypatch.setattr("msgs_slam.pipelines.settings_file.config_to_toml", lambda _: text)
    save_settings(run, config)
    assert load_settings(RunFolder(run.root)) == config
    assert "1 settings in it are none any more (frames.peak_threshold)" in caplog.text
    run.settings_file.write_text(
        run.settings_file.read_text().replace("peak_threshold = 0.01", "peak_threshold = 0.02")
    )
    with pytest.raises(InputError, match="not as the program left it"):
        load_settings(RunFolder(run.root))
