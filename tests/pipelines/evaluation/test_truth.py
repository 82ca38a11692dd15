"""ATE and RPE against evo's published figures, and against what theory says of a known disturbance."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.trajectory import read_tum, write_tum
from msgs_slam.pipelines.evaluation.truth import absolute_error, associate, relative_error, true_trajectory
from tests.matrices import random_poses, write_matrices


@pytest.mark.parametrize(
    ("name", "truth", "sim3", "se3"),
    [
        ("freiburg1_xyz-ORB_kf_mono.txt", "freiburg1_xyz-groundtruth.txt", (0.009755, 0.008219, 0.027924), 0.024302),
        ("fr2_desk_ORB_kf_mono.txt", "fr2_desk_groundtruth.txt", (0.007729, 0.007104, 0.015689), 0.939049),
    ],
)
def test_figures_of_evo_on_recorded_trajectories(
    shared_data: Path, name: str, truth: str, sim3: tuple[float, float, float], se3: float
) -> None:
    folder = shared_data / "format_cases" / "trajectories"
    times, poses = read_tum(folder / name)
    true_times, true_poses = read_tum(folder / truth)
    i, j = associate(times, true_times)
    found = absolute_error(poses[i, :3, 3], true_poses[j, :3, 3], with_scale=True).statistics
    assert (found.rmse, found.mean, found.max) == pytest.approx(sim3, abs=1e-6)
    rigid = absolute_error(poses[i, :3, 3], true_poses[j, :3, 3], with_scale=False).statistics
    assert rigid.rmse == pytest.approx(se3, abs=1e-6)


@pytest.mark.parametrize("kind", ["matrices", "TUM"])
def test_a_trajectory_that_is_denser_than_the_images_is_read_in_every_form(kind: str, tmp_path: Path) -> None:
    poses, times = random_poses(9, 3), np.arange(9) / 10
    for i in range(0, 9, 3):
        write_rgb(tmp_path / "rgb" / f"{i}.png", np.zeros((12, 16, 3), np.uint8))
    (tmp_path / "timestamps.txt").write_text("".join(f"{t}\n" for t in times))
    if kind == "TUM":
        write_tum(tmp_path / "traj.txt", times, poses)
    else:
        write_matrices(tmp_path / "traj.txt", poses)
    found_times, found = true_trajectory(open_sequence(tmp_path))
    np.testing.assert_allclose(found_times, times)
    np.testing.assert_allclose(found, poses, atol=1e-8)


@pytest.mark.parametrize("with_scale", [True, False])
def test_same_as_evo_on_random_trajectories(with_scale: bool) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PosePath3D

    rng = np.random.default_rng(3)
    truth = random_poses(40, 3)
    estimate = truth.copy()
    estimate[:, :3, 3] = 0.4 * estimate[:, :3, 3] + rng.normal(scale=0.05, size=(40, 3))
    estimate[:, :3, :3] = estimate[:, :3, :3] @ Rotation.from_rotvec(rng.normal(scale=0.05, size=(40, 3))).as_matrix()
    ours = absolute_error(estimate[:, :3, 3], truth[:, :3, 3], with_scale)
    theirs, reference = PosePath3D(poses_se3=list(estimate)), PosePath3D(poses_se3=list(truth))
    theirs.align(reference, correct_scale=with_scale)
    metric = metrics.APE(metrics.PoseRelation.translation_part)
    metric.process_data((reference, theirs))
    for name in ("rmse", "mean", "median", "max"):
        value = metric.get_statistic(metrics.StatisticsType[name])
        assert getattr(ours.statistics, name) == pytest.approx(value, rel=1e-9)
    for relation, errors in (
        (metrics.PoseRelation.translation_part, "translation"),
        (metrics.PoseRelation.rotation_angle_deg, "rotation"),
    ):
        rpe = metrics.RPE(relation, delta=2, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, PosePath3D(poses_se3=list(estimate))))
        np.testing.assert_allclose(getattr(relative_error(estimate, truth, 2), errors), rpe.error, rtol=1e-6, atol=1e-9)


def test_noise_of_known_size_is_found_again_and_a_similarity_is_forgiven() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(scale=3, size=(2000, 3))
    rotation = Rotation.random(None, rng).as_matrix()
    noise = rng.normal(scale=0.02, size=truth.shape)
    moved = 1.7 * (truth + noise) @ rotation.T + (1, 2, 3)
    found = absolute_error(moved, truth, with_scale=True)
    # 2000 * 3 samples: the spread of the figure is below one percent; 7 degrees of freedom are fitted away.
    assert found.statistics.rmse == pytest.approx(0.02 * np.sqrt(3), rel=0.03)
    assert found.alignment.scale == pytest.approx(1 / 1.7, rel=1e-3)
    rigid = absolute_error(moved, truth, with_scale=False)
    # Without a scale, the best rigid motion leaves |1.7 - 1| of each distance from the middle.
    assert rigid.statistics.rmse == pytest.approx(0.7 * 3 * np.sqrt(3), rel=0.03)
    assert absolute_error(truth, truth, with_scale=True).statistics.max < 1e-12


def test_relative_error_of_a_known_drift() -> None:
    truth = random_poses(30, 1)
    slip = np.eye(4)
    slip[:3, :3] = Rotation.from_rotvec((0, 0.01, 0)).as_matrix()
    slip[:3, 3] = (0.003, 0, 0.004)
    drifting = [truth[0]]
    for i in range(1, 30):
        drifting.append(drifting[-1] @ np.linalg.inv(truth[i - 1]) @ truth[i] @ slip)
    error = relative_error(np.array(drifting), truth)
    np.testing.assert_allclose(error.translation, 0.005, rtol=1e-9)
    np.testing.assert_allclose(error.rotation, np.degrees(0.01), rtol=1e-9)
    shrunk = truth.copy()
    shrunk[:, :3, 3] /= 5
    assert relative_error(shrunk, truth, scale=5.0).translation.max() < 1e-12
    assert relative_error(shrunk, truth).translation.min() > 0.01
    with pytest.raises(ValueError, match="needs more"):
        relative_error(truth[:2], truth[:2], delta=2)


def test_association_takes_nearest_pairs_once_in_any_order() -> None:
    truth = np.array([0.3, 0.0, 0.1, 0.2])
    i, j = associate(np.array([0.001, 0.104, 0.096, 0.25, 0.299]), truth, 0.01)
    assert i.tolist() == [0, 1, 4] or i.tolist() == [0, 2, 4]
    assert np.abs(truth[j] - np.array([0.001, 0.104, 0.096, 0.25, 0.299])[i]).max() < 0.005
    assert len(set(j.tolist())) == len(j)
    assert associate(np.zeros(0), truth)[0].size == 0
