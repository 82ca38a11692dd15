"""What a run of many hours writes is larger than what is taken from strangers, and is read back all the same."""

from pathlib import Path

import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.tensors import load_arrays
from msgs_slam.formats.textfile import MAX_JSON_BYTES, read_json
from msgs_slam.pipelines.run.folder import RunFolder, load_records
from msgs_slam.pipelines.run.manifest import Manifest, Source, StageRecord, write_manifest
from msgs_slam.pipelines.system.values import load_value, save_value
from msgs_slam.pipelines.tracking.state import Sightings, TrackState


def test_a_large_manifest_is_read_again(tmp_path: Path) -> None:
    files = {f"correspondence/{n:04000d}.npz": (n, f"{n:064x}") for n in range(8500)}
    run = RunFolder(tmp_path)
    write_manifest(
        run.manifest_file, Manifest(Source("v", "d"), {"frames": StageRecord("f", files, 1, 1, {}, [], "c")})
    )
    assert run.manifest_file.stat().st_size > MAX_JSON_BYTES
    assert load_records(run)["frames"].files == files
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
