"""What all windows of a long recording tell of the camera, and windows that do not become one model."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.sfm.bundle import Bundle
from msgs_slam.pipelines.sfm.candidates import AdjustedModel, KeyframeSet
from msgs_slam.pipelines.sfm.driver import StructureFromMotion
from msgs_slam.pipelines.sfm.joining import WindowModels, found_readout
from msgs_slam.pipelines.sfm.rolling import NO_READOUT, Readout
from msgs_slam.pipelines.sfm.snapshots import Snapshots
from msgs_slam.pipelines.system.machine import windows_of
from msgs_slam.pipelines.system.parallel import LruSequence
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.pipelines.frames.test_frames_rolling import COUNT, READOUT, TIMES, as_model, off_by, poses_of, seen_by

WINDOWS = windows_of(COUNT, 14, 6)


def of_window(bundle: Bundle, window: range) -> pycolmap.Reconstruction:
    """A window as a mapper leaves it, its images counted from 1."""
    inside = (bundle.obs_cam >= window.start) & (bundle.obs_cam < window.stop)
    mine = bundle.select(np.flatnonzero(inside))
    mine = replace(mine, obs_cam=mine.obs_cam - window.start)
    return as_model(replace(mine, cam_from_world=bundle.cam_from_world[window.start : window.stop]))[0]


def in_windows(
    readouts: Sequence[Readout | None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, readout: float = READOUT
) -> tuple[AdjustedModel | None, list[pycolmap.Reconstruction]]:
    """The joined windows of a held camera, each of which has found another readout, or (None) nothing."""
    bundle = seen_by(readout)[0]
    xy = [bundle.obs_xy[bundle.obs_cam == k] for k in range(COUNT)]
    found = {
        w: None if r is None else AdjustedModel(of_window(bundle, w), "global", 0.0, 1.0, r)
        for w, r in zip(WINDOWS, readouts, strict=True)
    }
    monkeypatch.setattr(StructureFromMotion, "_window", lambda self, window, views, pairs: found[window])
    camera = of_window(bundle, WINDOWS[0]).cameras[1]
    nothing: LruSequence = LruSequence(COUNT, lambda _: None, lambda _: 0, 0)
    structure = StructureFromMotion(
        config=FramesConfig(), camera=camera, is_fixed=True, snapshots=Snapshots(tmp_path), progress=SilentProgress(),
        threads=1, seed=0, extract=lambda _: None, picture=lambda _: None, time=float,
        match=lambda *_: None,
    )  # type: ignore[arg-type, return-value] # fmt: skip
    return structure._in_windows(WINDOWS, KeyframeSet(nothing, xy, TIMES, []), [])


def test_the_readout_is_that_of_all_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first shows none, as a window does in which the camera stands still: it used to decide for all."""
    late = (0.0, 0.8 * READOUT)
    whole, others = in_windows([NO_READOUT, late, late], tmp_path, monkeypatch)
    assert whole is not None
    assert whole.readout[0] == 0
    assert whole.readout[1] == pytest.approx(READOUT, rel=0.03)
    assert others == []
    alone, _ = in_windows([NO_READOUT] * 3, tmp_path, monkeypatch)
    assert alone is not None
    assert 0 < off_by(poses_of(whole.model)) < 0.4 * off_by(poses_of(alone.model))


def test_what_one_window_takes_for_a_readout_is_none_where_the_whole_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, _ = in_windows([(0.0, 0.01), NO_READOUT, NO_READOUT], tmp_path, monkeypatch, readout=0.0)
    assert whole is not None
    assert whole.readout == NO_READOUT


def test_the_readout_of_a_whole_is_found_from_a_first_guess() -> None:
    for start in (0.3, 2.0):
        model, pixels = as_model(seen_by(READOUT)[0])
        found = found_readout(model, pixels, TIMES, (0.0, start * READOUT))
        assert found[1] == pytest.approx(READOUT, rel=0.03)


def test_a_camera_is_the_mean_of_all_windows_by_how_sure_they_are() -> None:
    made, model = WindowModels(), of_window(seen_by(0.0)[0], WINDOWS[0])
    for focal, sd in ((500.0, 1.0), (504.0, 1.0), (600.0, 50.0)):
        model.cameras[1].focal_length = focal
        made.add(model, 0, sd, NO_READOUT)
    sd = made.calibrate(model.cameras[1])
    assert model.cameras[1].focal_length == pytest.approx(502.02, abs=0.01)
    assert 0.7 < sd < 3


@pytest.mark.parametrize("failed", [0, 1])
def test_a_window_without_a_model_costs_only_itself(
    failed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All at once would take more memory than there is."""
    readouts = [None if n == failed else NO_READOUT for n in range(3)]
    whole, others = in_windows(readouts, tmp_path, monkeypatch)
    assert whole is not None
    placed = [{i - 1 for i in m.reg_image_ids()} for m in (whole.model, *others)]
    if failed == 0:
        assert placed == [set(range(8, COUNT))]
    else:
        assert placed == [set(WINDOWS[0]), set(WINDOWS[2])]


def test_no_window_with_a_model_is_no_structure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert in_windows([None] * 3, tmp_path, monkeypatch) == (None, [])
