"""What a run writes is read back however large; what an earlier program wrote is told of, another format refused."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finished import note_finished

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.tensors import MOST_PACKED, load_arrays, save_arrays
from msgs_slam.formats.textfile import MAX_JSON_BYTES, read_json
from msgs_slam.pipelines.config import Config, ExportConfig
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.manifest import Manifest, Source, write_manifest
from msgs_slam.pipelines.run.reads import Reads, StageRecord
from msgs_slam.pipelines.system.values import load_value, save_value
from msgs_slam.pipelines.tracking.state import Sightings, TrackState


def test_a_large_manifest_is_read_again(tmp_path: Path) -> None:
    files = {f"correspondence/{n:0240d}.npz": (n, f"{n:064x}") for n in range(100_000)}
    run = RunFolder(tmp_path)
    write_manifest(
        run.manifest_file, Manifest(Source("v", "d"), {"frames": StageRecord(Reads(), files, 1, 1, {}, [], "c")})
    )
    assert run.manifest_file.stat().st_size > MAX_JSON_BYTES
    assert run.records["frames"].files == files
    with pytest.raises(InputError, match="larger than expected"):
        read_json(run.manifest_file)  # as anybody else's


def test_a_snapshot_of_many_sightings_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msgs_slam.formats.tensors.MAX_UNPACKED_BYTES", 10_000)
    state = TrackState(np.ones((10, 3)), np.zeros((10, 3), np.uint8))
    for k in range(20):
        seen = Sightings.of(np.arange(10), np.full((10, 2), float(k)), 1.0)
        state.add_frame(k, np.eye(4), seen, is_keyframe=k % 2 == 0, segment=0)
    save_value(tmp_path / "state.npz", state)
    back = load_value(tmp_path / "state.npz")
    assert back.keyframes == state.keyframes
    np.testing.assert_array_equal(back.sightings[19].xy, state.sightings[19].xy)
    with pytest.raises(InputError, match="would unpack"):
        load_arrays(tmp_path / "state.npz")


def test_a_large_task_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("msgs_slam.formats.tensors.MAX_UNPACKED_BYTES", 10_000)
    save_value(tmp_path / "task.npz", {"times": np.arange(5000)})
    np.testing.assert_array_equal(load_value(tmp_path / "task.npz")["times"], np.arange(5000))


def test_what_is_packed_beyond_measure_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run may be anybody's: a few kilobytes of it must not take all memory."""
    monkeypatch.setattr("msgs_slam.formats.tensors.MAX_UNPACKED_BYTES", 10_000)
    save_arrays(tmp_path / "zeros.npz", {"a": np.zeros(2_000_000, np.uint8)})
    assert (tmp_path / "zeros.npz").stat().st_size * MOST_PACKED < 2_000_000
    with pytest.raises(InputError, match="would unpack"):
        load_arrays(tmp_path / "zeros.npz", own=True)
    monkeypatch.setattr("msgs_slam.pipelines.run.manifest.MAX_OWN_JSON_BYTES", 1000)
    (tmp_path / "manifest.json").write_text("[" + " " * 1000 + "]")
    with pytest.raises(InputError, match="larger than expected"):
        _ = RunFolder(tmp_path).records


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
    assert RunFolder(run.root).settings() == replace(Config(), export=ExportConfig(voxel=0.05))


def test_a_setting_that_is_no_more_does_not_stop_a_run(run: RunFolder, caplog: pytest.LogCaptureFixture) -> None:
    edit(run, "[frames]\n", "[frames]\npeak_threshold = 0.01\nrat = 3\n")
    with caplog.at_level(logging.WARNING):
        assert RunFolder(run.root).settings() == Config()
    assert "there is no setting frames.peak_threshold" in caplog.text
    assert "there is no setting frames.rat; did you mean frames.rate?: it is ignored" in caplog.text


def test_a_manifest_of_another_format_is_refused(run: RunFolder) -> None:
    value = json.loads(run.manifest_file.read_text())
    for format in (1, 2, 99):
        run.manifest_file.write_text(json.dumps(value | {"format": format}))
        with pytest.raises(InputError, match=f"its format is {format}, this version of the program knows 3"):
            _ = RunFolder(run.root).records


def test_the_working_folder_is_a_run_with_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`cd both.msgs/piece_2; msgs-slam resume .`: a piece has to be known there, and titles take its name."""
    (tmp_path / "both.msgs" / "piece_2").mkdir(parents=True)
    (tmp_path / "both.msgs" / "manifest.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "both.msgs" / "piece_2")
    for path, name in ((".", "piece_2"), ("..", "both.msgs")):
        run = RunFolder(Path(path))
        assert (run.place.name, run.is_piece) == (name, path == ".")
