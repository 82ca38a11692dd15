"""Noise and shifted images are told from a motion of the camera."""

import numpy as np
import pycolmap
import pytest

from msgs_slam.pipelines.frames.findings import noise_of, shift_of_images
from msgs_slam.pipelines.sfm.adjust import adjust_model
from msgs_slam.pipelines.sfm.given import bare_model, complete_tracks
from msgs_slam.pipelines.sfm.lens import unknown_camera
from msgs_slam.pipelines.types import Features
from tests.pipelines.frames.made_views import MadeViews, walk_round


def adjusted(shift: float) -> pycolmap.Reconstruction:
    """The model of a walk of which each image is shifted by about so many pixels, its poses adjusted."""
    camera, rng = unknown_camera(640, 480, 500.0, is_prior=True), np.random.default_rng(1)
    made = walk_round(camera)
    features = []
    for feature in made.features:
        keypoints = feature.keypoints.copy()
        keypoints[:, :2] += rng.normal(0, shift / np.sqrt(2), 2).astype(np.float32)
        features.append(Features(keypoints, feature.descriptors))
    moved = MadeViews(made.cam_from_world, features, made.seen)
    model = bare_model(camera, [f.xy for f in features], made.cam_from_world)
    complete_tracks(model, moved.pairs(camera), 0, 4 * shift + 4)
    adjust_model(model, refine_camera=False)
    return model


def test_shift_of_each_image_is_found_where_there_is_one() -> None:
    still, _ = shift_of_images(adjusted(0.0))
    shifted, explained = shift_of_images(adjusted(5.0))
    assert 0 < still < 1
    assert shifted == pytest.approx(5, rel=0.5)
    assert explained > 0.15
    assert shift_of_images(adjusted(0.0))[1] < 0.05
    assert shift_of_images(pycolmap.Reconstruction(_without_points())) == (0, 0)


def _without_points() -> pycolmap.Reconstruction:
    camera = unknown_camera(640, 480, 500.0, is_prior=True)
    return bare_model(camera, [np.zeros((0, 2))] * 2, np.tile(np.eye(4), (2, 1, 1)))


@pytest.mark.parametrize("sd", [0.0, 2.0, 10.0])
def test_noise_is_measured_beside_edges(sd: float) -> None:
    rng = np.random.default_rng(0)
    picture = np.kron(rng.integers(60, 200, (12, 16)), np.ones((20, 20))) + rng.normal(0, sd, (240, 320))
    gray = np.clip(np.round(picture), 0, 255).astype(np.uint8)
    contrast = np.ptp(np.percentile(gray, (5, 95)))
    assert noise_of(gray) * contrast == pytest.approx(sd, rel=0.15, abs=0.3)
