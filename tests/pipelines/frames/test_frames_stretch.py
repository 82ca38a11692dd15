"""The focal length that a stretch of the path tells where pairs of views leave it unsure."""

from pathlib import Path

import pytest

from msgs_slam.pipelines.sfm.candidates import AdjustedModel, CandidateModels, pairs_within
from msgs_slam.pipelines.sfm.given import posed_model
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.rolling import NO_READOUT
from tests.pipelines.frames.made_views import structure_of, walk_round
from tests.pipelines.frames.test_frames_given import CAMERA


def test_a_stretch_tells_the_focal_length(tmp_path: Path) -> None:
    made = walk_round(CAMERA, 24)
    guess = unknown_camera(CAMERA.width, CAMERA.height, 2.5 * CAMERA.width, is_prior=False)
    structure = structure_of(made, guess, tmp_path, is_fixed=False)
    found = structure._by_stretch(made.views(), made.pairs(CAMERA))
    assert found is not None
    assert found.has_prior_focal_length
    assert 0 < abs(found.mean_focal_length() / CAMERA.mean_focal_length() - 1) < 0.01
    (tmp_path / "other").mkdir()
    nothing = structure_of(made, guess, tmp_path / "other", is_fixed=False)
    assert nothing._by_stretch(made.views(), []) is None


@pytest.mark.parametrize(("score", "focal_sd", "asked"), [(0.9, 1.0, 0), (0.3, 1.0, 1), (0.9, 30.0, 1)])
def test_another_start_is_tried_where_the_model_is_poor_or_unsure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, score: float, focal_sd: float, asked: int
) -> None:
    made = walk_round(CAMERA)
    guess = unknown_camera(CAMERA.width, CAMERA.height, 2.5 * CAMERA.width, is_prior=False)
    model = posed_model(CAMERA, made.views().xy, made.cam_from_world, made.pairs(CAMERA), False, 0)
    assert model is not None
    found, calls = AdjustedModel(model, "global", focal_sd, score, NO_READOUT), list[object]()
    monkeypatch.setattr(CandidateModels, "_adjusted", lambda *_: found)
    monkeypatch.setattr(CandidateModels, "_by_stretch", lambda *_: calls.append(None))
    structure = structure_of(made, guess, tmp_path, is_fixed=False)
    assert structure._best(made.views(), made.pairs(CAMERA)) is found
    assert len(calls) == asked


def test_pairs_of_a_part_are_numbered_anew() -> None:
    pairs = walk_round(CAMERA).pairs(CAMERA)
    inside = pairs_within(pairs, range(5, 9))
    assert [(p.first + 5, p.second + 5) for p in inside] == [
        (p.first, p.second) for p in pairs if p.first >= 5 and p.second < 9
    ]
    assert len(inside) == 6
