"""Whole evaluations of runs whose disturbance is known."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from finished import note_finished
from scipy.spatial.transform import Rotation

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome, refined_pose, trajectory_cells
from msgs_slam.pipelines.evaluation.metrics import mesh_cells
from msgs_slam.pipelines.evaluation.report import truth_section
from msgs_slam.pipelines.evaluation.truth import match_truth
from msgs_slam.pipelines.evaluation.write import evaluation_rows, evaluation_table, write_evaluation
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.render.api import render
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD, World
from msgs_slam.pipelines.types import Frame
from tests.matrices import write_matrices
from tests.pipelines.part_of_sequence import part_of

OracleRun = Callable[..., RunFolder]

MOVE = Similarity(2.5, Rotation.from_euler("xyz", (0.3, -0.5, 0.9)).as_matrix(), np.array([4.0, -2.0, 1.0]))


def test_every_cell_of_a_true_run(oracle_run: OracleRun, truth: Dataset) -> None:
    run = oracle_run(hold_out=8, mesh=True)
    result = write_evaluation(run, truth, max_views=4)
    assert json.loads((run.root / "evaluation" / "evaluation.json").read_text()) == result
    assert result["frames"]["posed"] == 32
    for name in ("sim3 all", "se3 all", "sim3 keyframes", "se3 keyframes"):
        assert result["trajectory"][name]["max"] < 1e-6
        assert result["trajectory"][name]["scale"] == pytest.approx(1, abs=1e-6)
    assert abs(result["camera"]["focal error"]) < 1e-9
    assert 20 < result["images"]["keyframes"]["psnr"] < 40
    assert 18 < result["images"]["held out"]["psnr"] < result["images"]["keyframes"]["psnr"] + 1
    # Own poses are the true ones here.
    assert result["images"]["held out at true poses"]["psnr"] == pytest.approx(
        result["images"]["held out"]["psnr"], abs=0.01
    )
    # The fit starts at the truth and may leave it for what the coarse map shows, but not for worse.
    refined, own = (result["images"][k]["psnr"] for k in ("held out at refined poses", "held out"))
    assert own - 0.1 < refined < own + 3
    # A Gaussian every third pixel: errors at the edges alone.
    assert 0.001 < result["depth"]["metric_l1"] < 0.1
    assert result["depth"]["scale"] == pytest.approx(1, abs=0.01)
    assert result["depth"]["valid_fraction"] > 0.9
    assert result["labels"]["matching"] == "by name"
    assert 0.85 < result["labels"]["pixel_accuracy"] < 1
    assert 0.5 < result["labels"]["mean_iou"] < result["labels"]["pixel_accuracy"]
    assert 0 < result["mesh"]["accuracy"] < 0.02
    assert result["cost"]["total seconds"] == 10
    table = (run.root / "evaluation" / "evaluation.md").read_text()
    assert "ATE Sim(3)" in table
    assert (run.root / "evaluation" / "views.png").stat().st_size > 20_000


def test_a_similarity_of_the_whole_run_changes_no_figure_but_the_scale(oracle_run: OracleRun, truth: Dataset) -> None:
    plain, moved = (
        evaluate_outcome(load_outcome(oracle_run(m, metric=False, mesh=True)), truth, max_views=2) for m in (None, MOVE)
    )
    assert moved["trajectory"]["sim3 all"]["scale"] == pytest.approx(0.4, rel=1e-6)
    assert moved["trajectory"]["sim3 all"]["max"] < 1e-6
    assert "missing" in moved["trajectory"]["se3 all"]
    assert "missing" in moved["depth"]["metric_l1"]
    assert moved["depth"]["scale"] == pytest.approx(0.4, rel=0.01)
    assert moved["depth"]["scaled_l1"] == pytest.approx(plain["depth"]["scaled_l1"], rel=0.02)
    of_views = [[v["depth_l1"] for v in result["views"] if v["depth_l1"] is not None] for result in (plain, moved)]
    assert len(of_views[0]) == len(of_views[1]) >= 4
    assert of_views[1] == pytest.approx(of_views[0], rel=0.05)
    for kind in ("keyframes", "between", "between at true poses"):
        assert moved["images"][kind]["psnr"] == pytest.approx(plain["images"][kind]["psnr"], abs=0.05)
    assert moved["labels"]["mean_iou"] == pytest.approx(plain["labels"]["mean_iou"], abs=0.005)
    assert moved["mesh"]["completeness"] == pytest.approx(plain["mesh"]["completeness"], rel=0.02)
    # A metric run of the wrong scale is not forgiven.
    wrong = evaluate_outcome(load_outcome(oracle_run(MOVE, metric=True)), truth, max_views=1)
    assert wrong["trajectory"]["se3 all"]["rmse"] > 0.5
    assert wrong["depth"]["metric_l1"] > 2


def test_noise_on_the_poses_is_found_in_ate_and_costs_picture_quality(oracle_run: OracleRun, truth: Dataset) -> None:
    noise = np.random.default_rng(0).normal(scale=0.06, size=(32, 3))
    result = evaluate_outcome(load_outcome(oracle_run(wrong_centers=noise)), truth, max_views=3)
    # 96 numbers, 7 fitted: 0.06 sqrt(3) sqrt(89 / 96), give or take 1 / sqrt(2 x 89).
    assert result["trajectory"]["sim3 all"]["rmse"] == pytest.approx(0.06 * np.sqrt(3) * 0.963, rel=0.2)
    own, true = (result["images"][k]["psnr"] for k in ("between", "between at true poses"))
    assert own < true - 0.5


def test_labels_without_names_are_a_clustering_and_stand_apart(oracle_run: OracleRun, truth: Dataset) -> None:
    by_name = evaluate_outcome(load_outcome(oracle_run()), truth, max_views=2)["labels"]
    renamed = evaluate_outcome(load_outcome(oracle_run(rename=True)), truth, max_views=2)["labels"]
    assert "mean_iou" not in renamed
    assert renamed["clustering"]["one to one"]["mean_iou"] == pytest.approx(by_name["mean_iou"], abs=1e-9)
    assert renamed["clustering"]["majority"]["pixel_accuracy"] >= renamed["clustering"]["one to one"]["pixel_accuracy"]


def test_a_video_is_matched_by_time_and_a_shifted_clock_too(oracle_run: OracleRun, truth: Dataset) -> None:
    result = evaluate_outcome(load_outcome(oracle_run(video=True)), part_of(truth, range(0, 32, 2)), max_views=1)
    assert result["frames"]["with true pose"] == 32  # traj.txt keeps the poses of the images left out
    assert result["frames"]["with true image"] == 16
    assert result["trajectory"]["sim3 all"]["max"] < 1e-6
    frames = [Frame(i, f"{i}.jpg", 0.1 * i, i, 1.0) for i in range(8)]
    epoch = replace(truth, timestamps=truth.timestamps + 1_305_031_102.0, root=Path("nowhere"))
    matched = match_truth(frames, False, epoch)
    assert matched.image.tolist() == list(range(8))
    assert "shifted" in matched.by
    between = [Frame(i, f"{i}.jpg", 0.1 * i + 0.05, i, 1.0) for i in range(8)]
    assert (match_truth(between, False, truth).image == -1).all()


@pytest.mark.parametrize(
    ("name", "by"),
    [("{:06d}.png", "file name"), ("f{:03d}.png", "frame number"), ("p-{:d}.png", "frame number, counted from 1")],
)
def test_a_truth_without_times_is_matched_by_what_its_names_say(
    oracle_run: OracleRun, truth: Dataset, tmp_path: Path, name: str, by: str
) -> None:
    first = 1 if by.endswith("1") else 0
    folder = _untimed_copy(truth, tmp_path, {i: name.format(i + first) for i in range(1, 32, 2)})
    result = evaluate_outcome(load_outcome(oracle_run(video=True)), folder, max_views=1)
    assert result["protocol"][0].startswith(f"Frames belong to the truth of the same {by};")
    assert result["frames"]["with true pose"] == 16
    assert result["trajectory"]["sim3 all"]["max"] < 1e-6


def test_a_truth_without_times_that_nothing_assigns_is_refused(
    oracle_run: OracleRun, truth: Dataset, tmp_path: Path
) -> None:
    run = load_outcome(oracle_run(video=True))
    subsampled = _untimed_copy(truth, tmp_path / "a", {i: f"frame_{1 + i // 4:05d}.png" for i in range(0, 32, 4)})
    with pytest.raises(InputError, match=r"its images have no times, and neither .* timestamps\.txt"):
        evaluate_outcome(run, subsampled, max_views=1)
    named = _untimed_copy(truth, tmp_path / "b", dict(enumerate("abcdefgh")))
    with pytest.raises(InputError, match="its images have no times"):
        evaluate_outcome(run, replace(named, names=tuple("abcdefgh")), max_views=1)


def test_times_that_only_count_the_frames_match_nothing(
    oracle_run: OracleRun, truth: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = load_outcome(oracle_run())
    for record in run.records.values():
        monkeypatch.setitem(record.figures, "timed", False)
    renamed = replace(truth, names=tuple(f"shot {name}" for name in truth.names))
    result = evaluate_outcome(run, renamed, max_views=1)
    assert "frame number" in result["protocol"][0]
    assert result["trajectory"]["sim3 all"]["max"] < 1e-6
    with pytest.raises(InputError, match="images of the run have no times"):
        evaluate_outcome(run, replace(truth, names=tuple("a" * n for n in range(1, 33))), max_views=1)


def _untimed_copy(truth: Dataset, folder: Path, names: dict[int, str]) -> Dataset:
    """The images of `truth` under other names, with their poses in traj.txt."""
    folder.mkdir(exist_ok=True)
    for index, name in names.items():
        write_rgb(folder / name if "." in name else folder / f"{name}.png", truth.rgb(index))
    write_matrices(folder / "traj.txt", truth.world_from_cam[list(names)])
    sequence = open_sequence(folder, "folder")
    assert sequence.timestamps is None
    return sequence


def test_a_truth_of_free_unit_claims_no_metres(oracle_run: OracleRun, truth: Dataset) -> None:
    poses = truth.world_from_cam.copy()
    poses[:, :3, 3] *= 0.13
    free = replace(truth, world_from_cam=poses, metric=False)
    run = oracle_run(mesh=True)
    result = write_evaluation(run, free, max_views=2)
    assert result["unit"] == "units of the truth"
    assert result["trajectory"]["sim3 all"]["scale"] == pytest.approx(0.13, rel=1e-6)
    for group in (result["trajectory"]["se3 all"], result["scale"], result["mesh"]):
        assert "no metric scale" in group["missing"]
    rows = {row[0]: row for row in evaluation_rows(result)}
    ate = rows["ATE Sim(3), all: rmse / mean / median / max"][1]
    assert ate.endswith("units of the truth")
    assert rows["RPE rmse"][1].split(",")[0].endswith("units of the truth")
    assert rows["metres per unit"][1] == rows["mesh"][1] == "–"
    # The run's world and the true depth are metric, whatever the poses of the truth.
    assert 0.001 < result["depth"]["metric_l1"] < 0.1
    assert "units of the truth" in truth_section(result, load_outcome(run))


def test_every_image_of_the_source_is_judged_beside_the_picked_frames(oracle_run: OracleRun, truth: Dataset) -> None:
    outcome = load_outcome(oracle_run(video=True))
    every = outcome.trajectory
    picked = replace(outcome, frames=outcome.frames[::2], trajectory=every.of_frames(every.frame_ids[::2]), every=every)
    result = evaluate_outcome(picked, truth, max_views=1)
    assert [result["trajectory"][f"sim3 {rows}"]["frames"] for rows in ("all", "every image")] == [16, 32]
    assert result["trajectory"]["se3 every image"]["max"] < 1e-6
    table = evaluation_table(result)
    assert "of the source's 32 images 32 are posed" in table
    assert "ATE SE(3), every image" in table


def test_the_truth_of_another_recording_and_an_unfinished_run_are_refused(
    oracle_run: OracleRun, truth: Dataset, tmp_path: Path
) -> None:
    run = oracle_run(video=True)
    late = replace(truth, timestamps=truth.timestamps + 0.05, root=tmp_path)
    with pytest.raises(InputError, match="truth of another recording"):
        evaluate_outcome(load_outcome(run), late)
    note_finished(run, ("frames",))
    with pytest.raises(InputError, match="tracking is not done"):
        evaluate_outcome(load_outcome(run), truth)


def test_a_frame_that_is_all_masked_is_not_judged(
    oracle_run: OracleRun, truth: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    monkeypatch.setattr(RunFolder, "left_out", lambda self, frame: np.full(self.image(frame).shape[:2], frame.id == 0))
    views = evaluate_outcome(load_outcome(run), truth, max_views=2)["views"]
    assert len(views) > 1
    assert all(view["frame_id"] > 0 and view["psnr"] < 60 for view in views)


def test_without_a_map_the_poses_are_still_judged(oracle_run: OracleRun, truth: Dataset) -> None:
    run = oracle_run()
    note_finished(run, ("frames", "proxy", "tracking"))
    result = write_evaluation(run, truth)
    assert result["trajectory"]["sim3 all"]["max"] < 1e-6
    assert "mapping is not done" in result["images"]["missing"]
    assert not (run.root / "evaluation" / "views.png").exists()


def test_a_mesh_exported_into_another_world_is_brought_back(oracle_run: OracleRun, truth: Dataset) -> None:
    run = oracle_run(metric=False, mesh=True)
    outcome = load_outcome(run)
    matched = match_truth(outcome.frames, outcome.source_is_folder, truth)
    alignment = trajectory_cells(outcome, matched)[1]
    plain = mesh_cells(outcome, matched, alignment)
    file = run.stage("export") / "mesh.ply"
    mesh = trimesh.load(file, force="mesh", process=False)
    mesh.vertices = MOVE.apply(mesh.vertices)
    mesh.export(file)
    WORLD.save(run.stage("export"), World("up", "floor", True, MOVE))
    note_finished(run, outcome.records)
    moved = mesh_cells(load_outcome(run), matched, alignment)
    assert moved["accuracy"] == pytest.approx(plain["accuracy"], rel=0.05)
    assert moved["completeness"] == pytest.approx(plain["completeness"], rel=0.02)


def test_a_refined_pose_is_where_the_image_was_taken(oracle_run: OracleRun, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome, frame_id = load_outcome(oracle_run()), 9
    m, true = outcome.require_map(), outcome.trajectory.cam_from_world[9]
    with torch.no_grad():
        shown = render(
            m.means, m.radii, m.opacities, m.colors, torch.from_numpy(true), outcome.calibration.intrinsics
        ).features
    noise = 0.02 * torch.randn(shown.shape, generator=torch.Generator().manual_seed(0))
    image = (255 * (shown + noise).clamp(0, 1)).numpy().astype(np.uint8)
    monkeypatch.setattr(RunFolder, "image", lambda run, frame: image)
    start = se3.exp(np.array([0.01, -0.01, 0.01, 0.003, -0.003, 0.003])) @ true
    found = refined_pose(outcome, frame_id, start)
    before, after = (float(np.linalg.norm(se3.log(pose @ se3.inverse(true)))) for pose in (start, found))
    assert 0 < after < 0.1 * before
    away = se3.exp(np.array([0.0, 0, -50, 0, 0, 0])) @ true
    assert np.array_equal(refined_pose(outcome, frame_id, away), away), "the map covers nothing there"
