"""The data set for trainers: every posed image has points, there are enough to start from, and images as large as the
source's; all of it stands as the map does in viewers of splats."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import plyfile
import pycolmap
import pytest
from finished import note_finished

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.pipelines.config import Config, FramesConfig
from msgs_slam.pipelines.export import colmap
from msgs_slam.pipelines.export.stage import export_run
from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.geometry.sparse_model import FrameObservations, SparseModel
from msgs_slam.pipelines.geometry.voxels import normals_in_cam
from msgs_slam.pipelines.run.files import CALIBRATION, FRAME_OBSERVATIONS, LEFT_OUT, SPARSE
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD, World
from msgs_slam.pipelines.tracking.state import Sightings, TrackState, sparse_model_of, to_frame_observations

OracleRun = Callable[..., RunFolder]
STAGES = ("frames", "proxy", "tracking", "mapping", "export")
POINTS, WRONG = 300, 5


def with_points(run: RunFolder) -> SparseModel:
    """Give a run points that its keyframes see, and observations of the frames between, of which a few are wrong."""
    outcome = load_outcome(run)
    t, k, m = outcome.trajectory, outcome.calibration.intrinsics, outcome.require_map()
    points = m.means.numpy()[:: len(m) // POINTS][:POINTS].astype(np.float64)
    ids, seen = t.frame_ids.tolist(), {}
    for row, pose in enumerate(t.cam_from_world):
        xy, z = project(points @ pose[:3, :3].T + pose[:3, 3], k)
        inside = (z > 0) & (xy >= 0).all(1) & (xy < (k.width, k.height)).all(1)
        seen[ids[row]] = np.flatnonzero(inside), xy[inside]
    state = TrackState(points, np.full((POINTS, 3), 99, np.uint8))
    for row, (frame_id, (point, xy)) in enumerate(seen.items()):
        key = bool(t.is_keyframe[row])
        xy = xy + 0 if key else np.where(np.arange(len(xy))[:, None] < WRONG, xy + 30, xy)
        state.add_frame(frame_id, t.cam_from_world[row], Sightings.of(point, xy, 1.0), key, 0)
    model = sparse_model_of(state)
    SPARSE.save(run.stage("tracking"), model)
    FRAME_OBSERVATIONS.save(run.stage("tracking"), to_frame_observations(state))
    return model


def test_every_image_has_points_and_there_are_enough_to_start_from(
    oracle_run: OracleRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = oracle_run()
    sparse = with_points(run)
    note_finished(run, STAGES[:4], source="gone.mp4")
    monkeypatch.setattr(colmap, "_START_POINTS", 3000)
    export_run(run, tmp_path, "colmap")
    model, outcome = pycolmap.Reconstruction(tmp_path / "sparse" / "0"), load_outcome(run)
    between = [f.name for f, key in zip(outcome.frames, outcome.trajectory.is_keyframe, strict=True) if not key]
    for image in model.images.values():
        assert image.num_points3D > 5
        for point in (p for p in image.points2D if p.has_point3D()):
            expected = image.project_point(model.points3D[point.point3D_id].xyz)
            assert np.linalg.norm(expected - point.xy) < 0.01, "the wrong ones are left out"
    assert len(between) > len(model.images) / 2
    tracks = np.array([p.track.length() for p in model.points3D.values()])
    assert 2900 < len(tracks) <= 3000
    assert (tracks > 0).sum() == len(sparse.points_in_world)
    ply = plyfile.PlyData.read(str(tmp_path / "sparse/0/points3D.ply"))["vertex"]
    assert len(ply["x"]) == len(tracks)
    assert 0 < model.compute_mean_reprojection_error() < 0.01, "of those with a track"
    text = pycolmap.Reconstruction()
    text.read_text(tmp_path / "sparse" / "0")
    assert text.num_points3D() == len(tracks)


def test_observations_follow_their_points_through_a_loop() -> None:
    """The adjustment after tracking drops points, adds others and counts anew; pixels of keyframes stay."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 99, (8, 2))
    old = SparseModel(
        np.array([0, 7]), np.tile(np.eye(4), (2, 1, 1)), np.zeros((4, 3)), np.zeros((4, 3), np.uint8),
        np.repeat([0, 1], 4), np.tile(np.arange(4), 2), xy,
    )  # fmt: skip
    kept = old.obs_point != 1
    new = replace(
        old, points_in_world=np.zeros((5, 3)), colors=np.zeros((5, 3), np.uint8),
        obs_frame=old.obs_frame[kept], obs_point=np.array([4, -1, 0, 2])[old.obs_point[kept]], obs_xy=xy[kept],
    )  # fmt: skip
    seen = FrameObservations(np.array([3, 3, 4]), np.array([0, 1, 3]), np.float32([[1, 2], [3, 4], [5, 6]]))
    found = seen.carried(old, new)
    assert (found.frame_id.tolist(), found.obs_point.tolist()) == ([3, 4], [4, 2])
    assert found.obs_xy.tolist() == [[1, 2], [5, 6]]


def test_splats_and_what_they_are_trained_on_stand_in_one_world_with_y_down(
    oracle_run: OracleRun, tmp_path: Path
) -> None:
    """As SuperSplat and the viewers of the original program take it; (x, y, z) with z up is (x, -z, y) there."""
    run = oracle_run(video=True)
    for kind in ("ply", "colmap", "tum"):
        export_run(run, tmp_path, kind)
    world: World = WORLD.read(tmp_path / "world.json")
    outcome = load_outcome(run).moved(world.exported_from_run)
    assert world.axes == "up"
    vertex = plyfile.PlyData.read(str(tmp_path / "point_cloud.ply"))["vertex"]
    x, y, z = outcome.require_map().means.numpy().T
    np.testing.assert_allclose(np.stack([vertex[n] for n in "xyz"]), [x, -z, y], atol=1e-5)
    turned = json.loads((tmp_path / "world.json").read_text())["splats_from_exported"]
    assert turned == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    x, y, z = outcome.trajectory.centers.T
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    centers = {image.name: image.projection_center() for image in model.images.values()}
    np.testing.assert_allclose(np.stack([centers[f.name] for f in outcome.frames]).T, [x, -z, y], atol=1e-6)
    rows = np.loadtxt(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(rows[:, 1:4].T, [x, y, z], atol=1e-6)
    # The cameras were held upright, so y of the picture points down in the data set.
    down = np.mean([image.cam_from_world().matrix()[1, :3] for image in model.images.values()], axis=0)
    assert down[1] > 0.9


def test_images_are_as_large_as_the_source_and_fit_their_camera(
    oracle_run: OracleRun, truth: Dataset, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = oracle_run()
    with_points(run)
    frame = load_outcome(run).frames[3]
    LEFT_OUT.save(run.stage("frames"), np.arange(240)[None].repeat(180, 0) < 60, frame.name)
    for i, name in enumerate(truth.names):
        write_rgb(tmp_path / "film" / name, cv2.resize(truth.rgb(i), (720, 540), interpolation=cv2.INTER_LINEAR))
    config = Config(frames=FramesConfig(max_side=240))
    note_finished(run, STAGES[:4], config, str(tmp_path / "film"))

    for wanted, side in ((480, 480), (1600, 720), (100, 240)):
        folder = tmp_path / str(side)
        export_run(run, folder, "colmap", settings=replace(config.export, image_side=wanted))
        meta = json.loads((folder / "transforms.json").read_text())
        model = pycolmap.Reconstruction(folder / "sparse" / "0")
        k, size = load_outcome(run).calibration.intrinsics, (side, side * 3 // 4)
        assert {read_rgb(p).shape[1::-1] for p in (folder / "images").iterdir()} == {size}
        camera = model.cameras[1]
        np.testing.assert_allclose(camera.params, np.array([k.fx, k.fy, k.cx, k.cy]) * side / 240)
        np.testing.assert_allclose([meta[n] for n in ("fl_x", "fl_y", "cx", "cy")], camera.params)
        assert (camera.width, camera.height) == (meta["w"], meta["h"]) == size
        image = model.images[1]
        errors = [
            np.linalg.norm(image.project_point(model.points3D[p.point3D_id].xyz) - p.xy)
            for p in image.points2D if p.has_point3D()
        ]  # fmt: skip
        assert np.max(errors) < 0.05
        # Masks: of all frames, as nerfstudio wants them, and as large as the images.
        masks = {Path(f["file_path"]).name: LEFT_OUT.read(folder / f["mask_path"]) for f in meta["frames"]}
        assert {mask.shape[::-1] for mask in masks.values()} == {size}
        assert [round(float(masks[n].mean()), 2) for n in (frame.name, truth.names[4])] == [0.25, 0]
    assert not caplog.text


def test_depth_maps_are_named_and_true(oracle_run: OracleRun, truth: Dataset, tmp_path: Path) -> None:
    run = oracle_run()
    note_finished(run, STAGES[:4], source="gone.mp4")
    export_run(run, tmp_path / "out", "depth")
    found = open_sequence(tmp_path / "out", "nerfstudio")
    assert found.names == truth.names
    for i in (0, 13, 31):
        depth, true = found.depth(i), truth.depth(i)
        both = (depth > 0) & (true > 0)
        assert both.mean() > 0.6
        assert 0 < np.median(np.abs(depth - true)[both] / true[both]) < 0.02
        normals = read_rgb(tmp_path / "out" / "normals" / f"{truth.names[i]}.png") / 127.5 - 1
        wanted = normals_in_cam(true.astype(np.float32), run.load(CALIBRATION).intrinsics)
        known = (normals > -1).any(-1) & wanted.any(-1)
        cosine = (normals * wanted).sum(-1)[known]
        assert known.mean() > 0.6
        assert abs(np.linalg.norm(normals[known], axis=-1) - 1).max() < 0.01
        assert 0.95 < np.median(cosine) < 1
    assert pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0").num_images() == len(truth.names)


def test_another_source_under_the_same_name_is_not_taken(
    oracle_run: OracleRun, truth: Dataset, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = oracle_run()
    for i, name in enumerate(truth.names):
        write_rgb(tmp_path / "film" / name, cv2.resize(truth.rgb((i + 9) % 32), (480, 360)))
    for source in (tmp_path / "film", tmp_path / "gone"):
        note_finished(run, STAGES[:4], Config(frames=FramesConfig(max_side=240)), str(source))
        caplog.clear()
        export_run(run, tmp_path / "out", "colmap")
        assert "images/ has the frames of the run, 240x180, and none larger" in caplog.text
        assert read_rgb(tmp_path / "out" / "images" / truth.names[0]).shape == (180, 240, 3)
        assert pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0").cameras[1].width == 240
