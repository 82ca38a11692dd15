"""The focal length from pairs of views alone."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.frames.findings import warn_of_focal
from msgs_slam.pipelines.sfm import two_views
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.sfm.two_views import _errors, _rotation, calibrated, two_view_lens
from tests.pipelines.frames.made_views import MadeViews, structure_of, walk_round

SIZE = (640, 480)
GUESS = unknown_camera(*SIZE, 768.0, is_prior=False)


def camera_of(focal: float, k1: float = 0.0) -> pycolmap.Camera:
    camera = unknown_camera(*SIZE, focal, is_prior=True)
    camera.params = [focal, 320.0, 240.0, k1]
    return camera


@pytest.mark.parametrize("focal", [330.0, 520.0, 1100.0])
def test_the_focal_length_is_found_without_poses(focal: float) -> None:
    made = walk_round(camera_of(focal))
    pairs, xy = made.pairs(GUESS), [f.xy for f in made.features]
    found, bend = two_view_lens(pairs, xy, SIZE) or (0.0, 1.0)
    assert found == pytest.approx(focal, rel=0.06)
    assert bend == 0
    assert two_view_lens(pairs, xy, SIZE) == (found, bend)
    camera, posed = calibrated(GUESS, pairs, xy)
    assert (camera.mean_focal_length(), camera.has_prior_focal_length) == (found, True)
    assert (GUESS.mean_focal_length(), GUESS.has_prior_focal_length) == (768.0, False)
    kept = sum(len(p.matches) for p in posed) / sum(len(p.matches) for p in pairs)
    assert 0.8 < kept < 1  # the noise is of 0.3 pixels
    turns, off = made.cam_from_world[:, :3, :3], []
    for pair in posed:
        true = turns[pair.second] @ turns[pair.first].T
        found = cv2.decomposeEssentialMat(pair.matrices[1])[:2]
        off.append(min(np.arccos(np.clip((np.trace(r.T @ true) - 1) / 2, -1, 1)) for r in found))
    assert np.degrees(np.median(off)) < 0.5


def test_false_pairs_do_not_turn_it() -> None:
    made = walk_round(camera_of(520.0))
    pairs, xy, rng = made.pairs(GUESS), [f.xy for f in made.features], np.random.default_rng(0)
    false = [
        replace(p, matches=np.column_stack([p.matches[:, 0], rng.permutation(p.matches[:, 1])])) for p in pairs[::4]
    ]
    assert two_view_lens([*pairs, *false], xy, SIZE) == (pytest.approx(520, rel=0.08), 0.0)


@pytest.mark.parametrize(("focal", "k1"), [(512.0, -0.1), (384.0, -0.2), (384.0, -0.3), (512.0, 0.1)])
def test_a_lens_that_bends_keeps_its_matches(focal: float, k1: float) -> None:
    """Up to 40 % of them contradict a pinhole."""
    made = walk_round(camera_of(focal, k1), 16)
    pairs, xy = made.pairs(GUESS), [f.xy for f in made.features]
    found, posed = calibrated(GUESS, pairs, xy)
    assert found.params[3] / k1 > 0.4
    assert [len(p.matches) for p in posed] == [len(p.matches) for p in pairs]
    assert all(p.matrices[1].any() for p in posed)


@pytest.mark.parametrize(("focal", "k1"), [(512.0, 0.0), (384.0, -0.2), (384.0, -0.3), (512.0, 0.1)])
def test_the_lens_of_a_path_is_found_and_none_where_there_is_none(focal: float, k1: float, tmp_path: Path) -> None:
    made = walk_round(camera_of(focal, k1), 16)
    structure = structure_of(made, GUESS, tmp_path, is_fixed=False)
    found = structure._calibrated(made.views(), made.pairs(GUESS))
    assert found is not None
    params = found.model.cameras[1].params
    assert abs(params[0] - focal) < min(2 * found.focal_sd, 0.01 * focal)
    assert found.focal_sd < 0.03 * focal
    assert params[3] == pytest.approx(k1, abs=0.01 if k1 else 0)
    assert 0 < made.off(found.model) < 0.004


def test_a_bad_start_from_pairs_is_not_the_last_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = walk_round(camera_of(520.0), 16)
    monkeypatch.setattr(two_views, "two_view_lens", lambda *_: (2.5 * 520.0, 0.0))
    found = structure_of(made, GUESS, tmp_path, is_fixed=False)._calibrated(made.views(), made.pairs(GUESS))
    assert found is not None
    assert found.model.cameras[1].focal_length == pytest.approx(520, rel=0.01)
    assert 0 < made.off(found.model) < 0.004


def test_a_known_focal_length_is_kept_and_none_is_made_of_nothing() -> None:
    known = unknown_camera(*SIZE, 700.0, is_prior=True)
    made = walk_round(known)
    pairs, xy = made.pairs(known), [f.xy for f in made.features]
    assert calibrated(known, pairs, xy) == (known, pairs)
    assert two_view_lens([], xy, SIZE) is None
    camera, none = calibrated(GUESS, [], xy)
    assert (camera.mean_focal_length(), none) == (768.0, [])


def test_derivatives_of_the_epipolar_error() -> None:
    """But for the change of Sampson's denominator, which Gauss-Newton leaves out: so of matches that obey the pose."""
    rng = np.random.default_rng(0)
    u, v = _rotation(rng.normal(size=(1, 3))), _rotation(rng.normal(size=(1, 3)))
    x, y = (np.pad(rng.normal(size=(1, 30, 2)), ((0, 0), (0, 0), (0, 1)), constant_values=1.0) for _ in "xy")
    # Moved along the second view's line until they agree: y^T E x = 0.
    line = x @ v * [1, 1, 0] @ u.transpose(0, 2, 1)
    y[..., 1] = -(line[..., 0] * y[..., 0] + line[..., 2]) / line[..., 1]
    error, jacobian = _errors(u, v, x, y)
    assert np.abs(error).max() < 1e-12
    for k in range(5):
        turn = np.zeros((1, 5))
        turn[0, k] = 1e-6
        moved = u @ _rotation(turn[:, :3]), v @ _rotation(np.pad(turn[:, 3:], ((0, 0), (0, 1))))
        assert (_errors(*moved, x, y)[0] - error) / 1e-6 == pytest.approx(jacobian[..., k], abs=1e-4)


def told_of(made: MadeViews, prior: pycolmap.Camera, origin: str, folder: Path) -> tuple[str, list[str]]:
    """The final origin of the camera, and the warnings."""
    found = structure_of(made, prior, folder, is_fixed=origin == "given")._calibrated(made.views(), made.pairs(prior))
    assert found is not None
    said: list[str] = []
    around, structure = SimpleNamespace(warn=said.append), SimpleNamespace(**vars(found))
    return warn_of_focal(around, origin, prior, structure, found.model, has_times=False), said  # type: ignore[arg-type]


@pytest.mark.parametrize("last", [520.0, 580.0])
def test_a_zoom_is_noticed_and_a_walk_without_one_is_not_called_so(last: float, tmp_path: Path) -> None:
    first, second = (walk_round(camera_of(f), 16) for f in (520.0, last))
    made = replace(first, features=first.features[:8] + second.features[8:], seen=first.seen[:8] + second.seen[8:])
    origin, said = told_of(made, GUESS, "self-calibrated", tmp_path)
    assert origin == "self-calibrated"
    assert ["the focal length seems to change: " in w and "52" in w and "58" in w for w in said] == [True] * (
        last > 520
    )
    assert all("give the video" in w for w in said)


@pytest.mark.parametrize("origin", ["exif", "given"])
@pytest.mark.parametrize("stated", [520.0, 600.0])
def test_a_known_focal_length_far_from_the_images_is_said_to_be(origin: str, stated: float, tmp_path: Path) -> None:
    made = walk_round(camera_of(520.0), 16)
    prior = unknown_camera(*SIZE, stated, is_prior=True)
    final, said = told_of(made, prior, origin, tmp_path)
    if stated == 520:
        assert (final, said) == (origin, [])
    else:
        assert final == ("given" if origin == "given" else "self-calibrated")
        assert len(said) == 1
        assert (
            "--intrinsics (focal length 600 px) contradicts" if origin == "given" else "the metadata state"
        ) in said[0]
