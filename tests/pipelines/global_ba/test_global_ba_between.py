"""Images between the picked frames: each gets a pose as good as theirs, and an interruption changes nothing."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.trajectory import read_tum
from msgs_slam.pipelines.config import Config, FramesConfig, GlobalBaConfig
from msgs_slam.pipelines.evaluation.truth import absolute_error
from msgs_slam.pipelines.export.colmap import write_trajectory
from msgs_slam.pipelines.geometry.se3 import Similarity
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.global_ba.between import Placer, pose_every_frame
from msgs_slam.pipelines.run.files import BACKBONE, EVERY_FRAME, FRAMES, LEFT_OUT, save_frames
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.run.target import Target
from msgs_slam.pipelines.types import Trajectory
from tests.pipelines.tracking.conftest import MadeRun, make_run, open_stage, room_frames
from tests.world.clip import WorldFrame

__all__ = ["make_run", "open_stage", "room_frames"]
EVERY = 3
KEYFRAMES = (0, 6, 12, 18, 21)


class BreakOff:
    """Progress that stops in the middle of one piece of work."""

    def __init__(self, label: str, after: int) -> None:
        self.label, self.after = label, after

    def track(self, items, label, total=None):  # type: ignore[no-untyped-def]
        for n, item in enumerate(items):
            if label == self.label and n == self.after:
                raise KeyboardInterrupt
            yield item


@pytest.fixture
def walk(
    tmp_path: Path, make_run: Callable[..., MadeRun], room_frames: tuple[object, list[WorldFrame]]
) -> Callable[..., tuple[MadeRun, Path, SparseModel, Trajectory]]:
    """walk(blank=(...)): a run of every third of 24 images, their folder, and its poses as true as its keyframes'."""

    def make(blank: tuple[int, ...] = ()) -> tuple[MadeRun, Path, SparseModel, Trajectory]:
        made = make_run(tmp_path / "run", keyframes=KEYFRAMES, backbone_scale=1.0)
        source = tmp_path / "images"
        source.mkdir()
        for i, frame in enumerate(room_frames[1]):
            noise = np.random.default_rng(i).integers(0, 255, frame.rgb.shape, np.uint8)
            write_rgb(source / f"{i:03d}.png", noise if i in blank else frame.rgb)
        (source / "timestamps.txt").write_text("".join(f"{i / 30}\n" for i in range(24)))
        model = made.run.find(BACKBONE)
        assert model is not None
        picked = [f for f in made.run.load(FRAMES) if f.id % EVERY == 0]
        save_frames(made.run.stage("frames"), [replace(f, id=n, timestamp=f.id / 30) for n, f in enumerate(picked)])
        correspondences = made.run.stage("frames") / "correspondence"
        for k in KEYFRAMES[1:]:
            (correspondences / f"{k:06d}.npz").rename(correspondences / f"{k // EVERY:06d}.npz")
        ids = np.arange(len(picked))
        model = replace(model, frame_ids=model.frame_ids // EVERY)
        poses = made.cam_from_world[::EVERY].copy()
        poses[model.frame_ids] = model.cam_from_world
        trajectory = Trajectory(ids, ids / 10, poses, np.isin(ids, model.frame_ids), ("",) * len(ids))
        return made, source, model, trajectory

    return make


def opened(context: StageContext, source: Path, **settings: str) -> StageContext:
    config = Config(frames=FramesConfig(rate=10), global_ba=GlobalBaConfig(**settings))
    return replace(context, source=source, config=config)


def test_every_image_is_posed_as_well_as_the_picked_ones_and_written(
    walk: Callable, open_stage: Callable[..., StageContext], tmp_path: Path
) -> None:
    made, source, model, trajectory = walk()
    context = opened(open_stage(made.run, "global_ba"), source)
    assert pose_every_frame(context, model, trajectory) == {"images": 24, "images_posed": 24}
    every = EVERY_FRAME.read(EVERY_FRAME.path(context.folder))
    assert every.frame_ids.tolist() == list(range(24))
    np.testing.assert_allclose(every.timestamps, np.arange(24) / 30)
    np.testing.assert_array_equal(every.cam_from_world[::EVERY], trajectory.cam_from_world)
    truth = np.linalg.inv(made.cam_from_world)[:, :3, 3]
    keyframes, between = np.isin(np.arange(24), KEYFRAMES), np.arange(24) % EVERY > 0
    rmse = [absolute_error(every.centers[rows], truth[rows], False).statistics.rmse for rows in (keyframes, between)]
    assert 0 < rmse[1] < 1.2 * rmse[0]
    # What is exported moves with the world, and lost images are left out of it.
    lost = replace(every, lost_reasons=("lost", *every.lost_reasons[1:]), is_keyframe=np.zeros(24, bool))
    moved = lost.moved(Similarity(2.0, np.eye(3), np.array([1.0, 2.0, 3.0])).apply_to_poses)
    outcome = SimpleNamespace(trajectory=trajectory, every=moved, metres=None, metric=True)
    write_trajectory(SimpleNamespace(outcome=outcome), Target(tmp_path))
    times, poses = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(times, np.arange(1, 24) / 30, atol=1e-8)
    np.testing.assert_allclose(poses[:, :3, 3], 2 * every.centers[1:] + [1, 2, 3], atol=1e-6)


def test_an_interruption_changes_nothing(
    walk: Callable, open_stage: Callable[..., StageContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, source, model, trajectory = walk()
    context = opened(open_stage(made.run, "global_ba"), source)
    pose_every_frame(context, model, trajectory)
    whole = EVERY_FRAME.path(context.folder).read_bytes()
    shutil.rmtree(context.folder)
    context = opened(open_stage(made.run, "global_ba"), source)
    monkeypatch.setattr("msgs_slam.pipelines.global_ba.between._SNAPSHOT_EVERY", 4)
    with pytest.raises(KeyboardInterrupt):
        pose_every_frame(replace(context, progress=BreakOff("frames between", 9)), model, trajectory)
    assert (context.snapshot / "between.npz").exists()
    pose_every_frame(context, model, trajectory)
    assert EVERY_FRAME.path(context.folder).read_bytes() == whole


def test_images_that_cannot_be_placed_are_counted(walk: Callable, open_stage: Callable[..., StageContext]) -> None:
    made, source, model, trajectory = walk(blank=(7, 8))
    reasons = ("", "", "", "", "", "blurred", "blurred", "")  # so images 16 and 17 have no neighbour with a pose
    keyframes = trajectory.is_keyframe & np.array([not r for r in reasons])
    context = opened(open_stage(made.run, "global_ba"), source)
    figures = pose_every_frame(context, model, replace(trajectory, lost_reasons=reasons, is_keyframe=keyframes))
    every = EVERY_FRAME.read(EVERY_FRAME.path(context.folder))
    assert np.flatnonzero(~every.is_posed).tolist() == [7, 8, 15, 16, 17, 18]
    assert every.lost_reasons[16] == "blurred"
    assert figures == {"images": 24, "images_posed": 18}
    assert (
        "4 of 16 images between the picked frames have no pose (counted from 0 in the source: 7-8, 16-17)"
        in (context.warnings[0])
    )


def test_on_request_and_without_the_source_only_the_picked_frames_have_a_pose(
    walk: Callable, open_stage: Callable[..., StageContext]
) -> None:
    made, source, model, trajectory = walk()
    context = opened(open_stage(made.run, "global_ba"), source, posed="picked")
    assert pose_every_frame(context, model, trajectory) == {}
    assert context.warnings == []
    context = opened(context, source.with_name("gone"))
    assert pose_every_frame(context, model, trajectory) == {}
    assert "only the picked frames have a pose" in context.warnings[0]
    assert not EVERY_FRAME.path(context.folder).exists()


def test_images_between_leave_out_what_the_frames_around_them_do(
    walk: Callable, open_stage: Callable[..., StageContext], room_frames: tuple[object, list[WorldFrame]]
) -> None:
    made, source, model, trajectory = walk()
    frames, shape = made.run.load(FRAMES), room_frames[1][0].rgb.shape[:2]
    left, top = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    left[:, : shape[1] // 3] = top[: shape[0] // 3] = True
    for number, mask in ((4, left), (5, top)):  # images 12 and 15
        LEFT_OUT.save(made.run.stage("frames"), mask, frames[number].name)
    placer = Placer(opened(open_stage(made.run, "global_ba"), source), model, trajectory)
    for index, left_out in ((10, left), (13, left | top), (16, top)):
        placed = placer.place(index, index / 30, [room_frames[1][index].rgb])
        assert placed is not None
        assert not placed.lost
        assert np.array_equal(placer.pictures.left_out(index), left_out)
        (column, row) = placer.pictures.features(index).xy.astype(int).T
        assert len(row) > 50
        assert not left_out[row, column].any()
    placer.place(19, 19 / 30, [room_frames[1][19].rgb])
    assert placer.pictures.left_out(19) is None
