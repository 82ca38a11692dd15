"""The stage on a made-up room: every frame posed, metres from the proxies, losses named, the same bytes again."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run.files import (
    BACKBONE,
    CALIBRATION,
    DEPTH_FIELDS,
    FRAME_OBSERVATIONS,
    FRAMES,
    GIVEN_POSES,
    SPARSE,
    TRAJECTORY,
)
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm.features import global_descriptor
from msgs_slam.pipelines.tracking import adjust, stage
from msgs_slam.pipelines.tracking import state as tracking_state
from msgs_slam.pipelines.tracking.stage import run as run_tracking
from msgs_slam.pipelines.tracking.stage import stretches
from msgs_slam.pipelines.tracking.state import TrackState
from msgs_slam.pipelines.types import GivenPoses
from tests.pipelines.tracking.conftest import MadeRun

Track = Callable[..., tuple[MadeRun, dict[str, Any], list[str]]]


@pytest.fixture
def track(tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext]) -> Track:
    """track(change, config, folder, **made): a run is made and changed, the stage run, its folder put in place as by
    the runner; the run, its figures and its warnings."""

    def finish(
        change: Callable[[MadeRun], object] = lambda _: None,
        config: Config | None = None,
        folder: str = "run",
        **made: Any,
    ) -> tuple[MadeRun, dict[str, Any], list[str]]:
        found = make_run(tmp_path / folder, **made)
        change(found)
        context = open_stage(found.run, "tracking", config)
        figures = run_tracking(context)
        shutil.rmtree(context.folder / "snapshot", ignore_errors=True)
        context.folder.rename(found.run.stage("tracking"))
        return found, figures, context.warnings

    return finish


def trajectory_error(made: MadeRun, scale: bool) -> float:
    found = made.run.load(TRAJECTORY, "tracking")
    posed = found.is_posed
    centres, truth = found.centers[posed], se3.inverse(made.cam_from_world)[posed, :3, 3]
    moved = align_points(centres, truth, with_scale=scale).apply(centres)
    return float(np.sqrt(((moved - truth) ** 2).sum(1).mean()))


def test_poses_every_frame_in_metres(track: Track) -> None:
    made, figures, _ = track()
    assert figures["posed"] == 24
    assert figures["scale"] == "metric"
    # Frames of 320 x 240 in a room of metres: millimetres, but never exact.
    assert 0 < trajectory_error(made, scale=False) < 0.01
    trajectory = made.run.load(TRAJECTORY, "tracking")
    assert np.allclose(trajectory.cam_from_world[0], np.eye(4), atol=1e-9)
    assert trajectory.is_keyframe.sum() == 9


def test_given_poses_of_which_no_frame_could_be_posed_are_no_motion(
    track: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = GivenPoses(np.full((24, 4, 4), np.nan), True, "made up")
    monkeypatch.setattr(stage.TrackingStage, "_track_frames", lambda *_: TrackState())
    with pytest.raises(InputError, match="no camera motion could be recovered from 24 frames"):
        track(lambda made: GIVEN_POSES.save(made.run.stage("frames"), given))


def test_a_keyframe_is_described_once_however_often_frames_are_compared_with_it(
    tmp_path: Path, make_run: Callable[..., MadeRun], open_stage: Callable[..., StageContext],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Also where few of them have room in memory; for each is read, which takes milliseconds."""
    made, described = make_run(tmp_path / "run"), []

    def counted(*given: Any) -> np.ndarray:
        described.append(len(described))
        return global_descriptor(*given)

    monkeypatch.setattr(tracking_state, "global_descriptor", counted)
    context = open_stage(made.run, "tracking")
    looked_up = tracking_state.Pictures(made.run, context.config.frames)
    keyframes = list(range(0, 24, 2))
    first = looked_up.similarities(looked_up.descriptor(1)[None], keyframes)
    for _ in range(3):
        assert np.array_equal(looked_up.similarities(looked_up.descriptor(1)[None], keyframes), first)
    assert len(described) == len(keyframes) + 4
    exact = [[float(looked_up.descriptor(1) @ looked_up.descriptor(k)) for k in keyframes]]
    assert 0 < np.abs(first - exact).max() < 1e-4


def test_sparse_model_reprojects_and_scales_are_right(track: Track) -> None:
    made, _, _ = track(depth_factor=1.25)
    model = SPARSE.read(made.run.stage("tracking") / "sparse.npz")
    camera = made.run.load(CALIBRATION).intrinsics
    pose, point = model.cam_from_world[model.obs_frame], model.points_in_world[model.obs_point]
    in_cam = np.einsum("oij,oj->oi", pose[:, :3, :3], point) + pose[:, :3, 3]
    xy = (in_cam @ camera.matrix.T)[:, :2] / in_cam[:, 2:]
    errors = np.linalg.norm(xy - model.obs_xy, axis=1)
    assert 0.1 < np.median(errors) < 1.0
    # The frames between keyframes see the same points, with the poses of the trajectory.
    seen, trajectory = made.run.load(FRAME_OBSERVATIONS), made.run.load(TRAJECTORY, "tracking")
    assert set(seen.frame_id) == set(trajectory.frame_ids[~trajectory.is_keyframe])
    row = {int(i): n for n, i in enumerate(trajectory.frame_ids)}
    poses, points = trajectory.cam_from_world, model.points_in_world
    agreeing = [len(seen.agreeing(points, row, camera, poses, within)[0]) for within in (0.1, 1.0, 4.0)]
    assert agreeing[0] < len(seen.obs_xy) / 2 < agreeing[1]
    assert agreeing[2] > 0.95 * len(seen.obs_xy)
    assert np.unique(seen.frame_id, return_counts=True)[1].min() > 20
    # Depths a quarter too large make a world a quarter too large, and then they are right.
    assert 0 < scale_error(made, 1.0) < 0.02
    assert trajectory_error(made, scale=True) < 0.01
    assert trajectory_error(made, scale=False) > 0.05


def scale_error(made: MadeRun, expected: float) -> float:
    """Mean relative error of the scales that bring the keyframes' proxy depths into the world."""
    fields = made.run.load(DEPTH_FIELDS, "tracking")
    assert list(fields.of_frame) == made.run.load(SPARSE, "tracking").frame_ids.tolist()
    return float(np.mean([np.abs(fields.scales(i, 24, 32) / expected - 1) for i in fields.of_frame]))


def test_scale_free_proxies_leave_the_world_as_it_is(track: Track) -> None:
    made, figures, _ = track(backbone_scale=0.4, metric=False)
    assert figures["scale"] == "free"
    assert 0 < scale_error(made, 0.4) < 0.02


def test_frames_outside_the_adjustment_follow_it(track: Track, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjust, "MAX_FRAMES", 12)
    made, figures, _ = track(backbone_scale=0.4)
    assert figures["adjusted_frames"] == 9
    assert figures["posed"] == 24
    assert 0 < trajectory_error(made, scale=False) < 0.01


def test_a_frame_without_picture_is_lost_and_named(track: Track) -> None:
    made, figures, warnings = track(blank=(7, 8))
    assert figures["posed"] == 22
    assert set(figures["lost"]) == {"7", "8"}
    assert any("7-8" in w for w in warnings)
    assert all("agree" in reason for reason in figures["lost"].values())
    assert 0 < trajectory_error(made, scale=False) < 0.01


def test_interrupted_work_ends_with_the_same_bytes(
    track: Track, open_stage: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage, "SNAPSHOT_EVERY", 5)

    def interrupt(broken: MadeRun) -> None:
        with pytest.raises(KeyboardInterrupt):
            run_tracking(interrupted(open_stage(broken.run, "tracking"), after=13))
        assert (broken.run.partial("tracking") / "snapshot" / "state.npz").exists()

    whole, broken = track(folder="a")[0], track(interrupt, folder="b")[0]
    for name in ("trajectory.npz", "sparse.npz", "depth_fields.npz", "tracking.json"):
        assert (whole.run.stage("tracking") / name).read_bytes() == (broken.run.stage("tracking") / name).read_bytes()


def interrupted(context: StageContext, after: int) -> StageContext:
    """A context whose progress breaks off."""

    class Breaking:
        def track(self, items, label, total=None):  # type: ignore[no-untyped-def]
            for n, item in enumerate(items):
                if n == after:
                    raise KeyboardInterrupt
                yield item

    return StageContext(context.run, context.source, context.config, context.folder, Breaking())


@pytest.mark.parametrize("keyframes", [(), (8, 11, 14)])
def test_works_without_structure_from_motion_and_goes_on_where_it_ends(
    keyframes: tuple[int, ...], track: Track
) -> None:
    made, figures, _ = track(keyframes=keyframes, all_proxies=True)
    assert (figures["posed"], figures["pieces"]) == (24, [])
    assert 2 <= figures["keyframes"] <= 12 or keyframes
    assert 0 < trajectory_error(made, scale=False) < 0.02


def in_two_parts(model: SparseModel, first_of_second: int) -> SparseModel:
    """Keyframes from `first_of_second` on in a world of their own, moved and 1.6 times as large; no common points."""
    late = model.frame_ids >= first_of_second
    owner = np.zeros(len(model.points_in_world))
    np.add.at(owner, model.obs_point, np.where(late[model.obs_frame], 1, -1))
    second = owner > 0
    keep = late[model.obs_frame] == second[model.obs_point]
    motion = se3.exp(np.array([0.5, -0.3, 0.8, 0.2, -0.4, 0.1]))
    points, poses = model.points_in_world.copy(), model.cam_from_world.copy()
    points[second] = 1.6 * se3.transform(motion, points[second])
    poses[late] = poses[late] @ se3.inverse(motion)
    poses[late, :3, 3] *= 1.6
    return replace(
        model, cam_from_world=poses, points_in_world=points, obs_frame=model.obs_frame[keep],
        obs_point=model.obs_point[keep], obs_xy=model.obs_xy[keep],
    )  # fmt: skip


def split_at(first_of_second: int, made: MadeRun) -> None:
    model = made.run.find(BACKBONE)
    assert model is not None
    BACKBONE.save(made.run.stage("frames"), in_two_parts(model, first_of_second))


def test_parts_of_structure_from_motion_are_joined_where_they_recognise_each_other(track: Track) -> None:
    made, figures, _ = track(partial(split_at, 12), metric=False)
    assert (figures["posed"], figures["pieces"]) == (24, [])
    assert 0 < trajectory_error(made, scale=True) < 0.02


def test_a_part_that_shows_another_place_is_not_glued_on(track: Track) -> None:
    def split_and_mirror(made: MadeRun) -> None:
        split_at(15, made)
        for frame in made.run.load(FRAMES)[14:]:  # upside down and mirrored, as good as another room
            path = made.run.stage("frames") / frame.name
            write_rgb(path, np.ascontiguousarray(read_rgb(path)[::-1]))

    made, figures, warnings = track(split_and_mirror, metric=False)
    assert figures["posed"] == 14
    assert set(figures["lost"]) == {str(i) for i in range(14, 24)}
    assert any("15-23" in w and "piece_2" in w for w in warnings)
    assert 0 < trajectory_error(made, scale=True) < 0.01


def test_nothing_to_go_by_is_refused(track: Track) -> None:
    with pytest.raises(InputError, match="Possible causes: a camera that stands still or only turns"):
        track(keyframes=())


def test_stretches() -> None:
    assert stretches([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert stretches([]) == ""


OTHERS = (15, 18, 21, 23)
"""Keyframes of a second model; their pictures and those between are blank, so that nobody recognises anything."""


@pytest.mark.parametrize("hidden", [True, False])
def test_a_second_model_becomes_a_piece_unless_the_pictures_join_it(
    hidden: bool, track: Track, make_run: Callable[..., MadeRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msgs_slam.pipelines.tracking.stage.LEAST_PIECE", 4)
    other = make_run(tmp_path / "other", keyframes=OTHERS, backbone_scale=0.7).run.find(BACKBONE)
    assert other is not None
    made, figures, warnings = track(
        lambda made: SPARSE.save(made.run.stage("frames") / "piece_2", other),
        keyframes=(0, 3, 6, 9), blank=tuple(range(10, 24)) if hidden else (),
    )  # fmt: skip
    if not hidden:
        assert (figures["pieces"], figures["posed"]) == ([], 24)
        return
    assert figures["pieces"] == [4]
    assert figures["posed"] >= 10
    assert any("piece_2" in w and "15, 18, 21, 23" in w for w in warnings)
    assert not set(np.flatnonzero(made.run.load(TRAJECTORY, "tracking").is_posed)) & set(OTHERS)
    piece = made.run.load(TRAJECTORY, "tracking", piece="piece_2")
    assert np.flatnonzero(piece.is_posed).tolist() == [*OTHERS]
    assert len(made.run.load(SPARSE, "tracking", piece="piece_2").points_in_world) > 50
    found, truth = piece.centers[piece.is_posed], np.linalg.inv(made.cam_from_world[[*OTHERS]])
    moved = align_points(found, truth[:, :3, 3], with_scale=True).apply(found)
    assert 0 < np.linalg.norm(moved - truth[:, :3, 3], axis=1).max() < 0.02
