"""A splat file drawn on the CPU: balls as the run's own renderer draws them, ellipsoids as the formula says."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.gaussians import GaussianCloud, isotropic_cloud
from msgs_slam.formats.image_folder import list_images
from msgs_slam.formats.images import read_rgb
from msgs_slam.formats.ply import write_gaussian_ply
from msgs_slam.pipelines.evaluation.image_quality import psnr
from msgs_slam.pipelines.evaluation.views import SplatScene, draw_splats, render_outcome
from msgs_slam.pipelines.outcome import load_outcome, map_cloud
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.types import Intrinsics
from msgs_slam.pipelines.viewer.render_run import render_file

CAMERA = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)


def test_balls_look_as_in_the_run(oracle_run: Callable[..., RunFolder]) -> None:
    outcome = load_outcome(oracle_run())
    pose = outcome.trajectory.cam_from_world[5]
    drawn = draw_splats(SplatScene.of(map_cloud(outcome)), outcome.calibration.intrinsics, pose)
    assert 38 < psnr(drawn, render_outcome(outcome, pose).exposed(None, 0.0)) < 90


def one(quat_wxyz: tuple[float, ...], scales: tuple[float, float, float], at: tuple[float, float, float]) -> SplatScene:
    """A white Gaussian of half opacity, and a faint one far away that gives the scene its size."""
    means = np.array([at, (0.0, 0, 40)], np.float32)
    cloud = GaussianCloud(
        means=means,
        log_scales=np.log(np.array([scales, (1e-3, 1e-3, 1e-3)], np.float32)),
        quat_wxyz=np.array([quat_wxyz, (1, 0, 0, 0)], np.float32),
        opacity_logits=np.array([0.0, -20], np.float32),
        colors=np.ones((2, 3), np.float32),
    )
    return replace(SplatScene.of(cloud), size=1.0)


def test_an_ellipsoid_is_the_ellipse_of_its_projection() -> None:
    turn = Rotation.from_euler("zx", (30, 20), degrees=True)
    scales = np.array([0.3, 0.05, 0.1])
    scene = one(tuple(np.roll(turn.as_quat(), 1)), tuple(scales), (0.1, -0.1, 3.0))
    drawn = draw_splats(scene, CAMERA, np.eye(4))[..., 0] / 255.0
    # Moments of what is drawn, against samples of the ellipsoid in perspective.
    points = np.random.default_rng(0).normal(size=(200_000, 3)) * scales @ turn.as_matrix().T + (0.1, -0.1, 3.0)
    uv = CAMERA.fx * points[:, :2] / points[:, 2:] + (CAMERA.cx, CAMERA.cy)
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    weight = drawn / drawn.sum()
    mean = np.array([(weight * columns).sum(), (weight * rows).sum()])
    np.testing.assert_allclose(mean, uv.mean(axis=0), atol=0.15)
    away = np.stack([columns - mean[0], rows - mean[1]])
    spread = np.einsum("hw,ahw,bhw->ab", weight, away, away)
    expected = np.cov(uv.T) + 0.3 * np.eye(2)
    assert 0 < np.abs(spread - expected).max() < 0.15 * np.abs(expected).max()
    assert drawn.max() == pytest.approx(0.5, abs=0.02)


def test_a_file_becomes_pictures_from_all_sides(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    means = rng.uniform(-1, 1, (400, 3)).astype(np.float32)
    colors = (means - means.min(axis=0)) / 2
    cloud = isotropic_cloud(means, np.full(400, -2.5, np.float32), np.full(400, 2.0, np.float32), colors)
    write_gaussian_ply(tmp_path / "scene.ply", cloud)
    folder = render_file(tmp_path / "scene.ply", tmp_path / "out", fps=0.4, size=(96, 64))
    images = [read_rgb(p).astype(float) for p in list_images(folder)]
    assert [i.shape for i in images] == 4 * [(64, 96, 3)]
    assert all(i[16:48, 32:64].mean() > 2 * i[:, :8].mean() + 10 for i in images)  # the scene is in the middle
    assert np.abs(images[0] - images[2]).mean() > 5
    write_gaussian_ply(tmp_path / "none.ply", cloud.only(np.zeros(400, bool)))
    with pytest.raises(InputError, match="contains no Gaussians"):
        render_file(tmp_path / "none.ply", tmp_path / "none")
    assert not (tmp_path / "none").exists()
