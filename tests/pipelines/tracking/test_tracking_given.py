"""Poses by another program carry a path over what the pictures do not show, and make metres."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.formats.trajectory import OPENCV_FROM_OPENGL
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import BACKBONE, FIGURES, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.tracking.segments import carry_given, drop_inconsistent_segments, pose_lost
from msgs_slam.pipelines.tracking.state import Sightings, TrackState
from msgs_slam.pipelines.types import GivenPoses
from tests.matrices import write_matrices
from tests.pipelines.frames.conftest import FOCAL, HEIGHT, QUICK, WIDTH, render, sideways, turn

FRAMES, BLANK = 18, range(7, 11)
SETTINGS = (
    *QUICK, "proxy.stereo_side=64", "frames.people=keep",
    f"frames.intrinsics={FOCAL},{FOCAL},{WIDTH / 2},{HEIGHT / 2}",
)  # fmt: skip


def write_recording(folder: Path, blank: range) -> NDArray[np.float64]:
    """An arc through the corner in pictures, those of `blank` all grey; its world_from_cam (N, 4, 4) in metres."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for i, (center, rotation) in enumerate(sideways(FRAMES)):
        poses[i, :3, :3], poses[i, :3, 3] = rotation, center
        picture = render(center, rotation)
        write_rgb(folder / f"view_{i:03d}.png", np.full_like(picture, 128) if i in blank else picture)
    return poses


def write_given(path: Path, poses: NDArray[np.float64]) -> Path:
    """The poses, half a centimetre off, one of them elsewhere."""
    off = poses.copy()
    off[:, :3, 3] += np.random.default_rng(0).normal(0, 0.003, (FRAMES, 3))
    off[3, :3, 3] += [9.0, 0.0, 0.0]
    write_matrices(path, off)
    return path


def test_a_blank_stretch_is_carried_and_the_rest_is_metric(tmp_path: Path) -> None:
    true = write_recording(tmp_path / "pictures", BLANK)
    given = write_given(tmp_path / "poses.txt", true)
    config = load_config(overrides=[*SETTINGS, f'frames.poses="{given}"', "proxy.scale_ref=poses"])
    run = RunFolder(tmp_path / "run")
    records = reconstruct(tmp_path / "pictures", run, config, SilentProgress(), "tracking")
    trajectory = run.load(TRAJECTORY, "tracking")
    assert trajectory.is_posed.all()
    told = " ".join(w for r in records.values() for w in r.warnings)
    assert "posed by --poses alone" in told
    assert records["frames"].figures["given_wrong"] == [3]
    assert records["tracking"].figures["given_carried"] >= len(BLANK)
    placed = trajectory.world_from_cam[:, :3, 3]
    similarity = align_points(placed, true[:, :3, 3], with_scale=True)
    assert np.linalg.norm(similarity.apply(placed) - true[:, :3, 3], axis=1).max() < 0.02
    assert run.load(FIGURES["proxy"])["metric"]
    assert similarity.scale == pytest.approx(1.0, abs=0.02)


def test_pictures_that_show_nothing_stand_where_the_poses_say(tmp_path: Path) -> None:
    true = write_recording(tmp_path / "pictures", range(FRAMES))
    given = write_given(tmp_path / "poses.txt", true)
    config = load_config(overrides=[*SETTINGS, f'frames.poses="{given}"'])
    run = RunFolder(tmp_path / "run")
    records = reconstruct(tmp_path / "pictures", run, config, SilentProgress(), "frames")
    backbone = run.find(BACKBONE)
    assert backbone is not None
    assert len(backbone.frame_ids) >= 12
    relative = true[0, :3, :3].T @ (true[backbone.frame_ids, :3, 3] - true[0, :3, 3]).T
    placed = np.linalg.inv(backbone.cam_from_world)[:, :3, 3]
    good = backbone.frame_ids != 3
    assert np.abs(placed - relative.T)[good].max() < 0.03
    assert any("), unchecked" in w for w in records["frames"].warnings)
    with pytest.raises(InputError, match="no image shows detail"):
        reconstruct(tmp_path / "pictures", RunFolder(tmp_path / "alone"), load_config(overrides=[*SETTINGS]),
                    SilentProgress(), "frames")  # fmt: skip


def test_poses_under_another_numbering_are_refused_and_the_numbering_is_named(tmp_path: Path) -> None:
    """A program that extracts every second frame of a video numbers them from 1."""
    path = [(center, turn(-0.6 * t, 0.08 * np.cos(2 * t) - 0.25))
            for t, (center, _) in zip(np.linspace(-1, 1, FRAMES), sideways(FRAMES), strict=True)]  # fmt: skip
    video = write_video(tmp_path / "walk.avi", (render(*pose) for pose in path), 5, "MJPG")
    table = []
    for i, (center, rotation) in enumerate(path[::2], 1):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, center
        matrix = (pose @ OPENCV_FROM_OPENGL).tolist()
        table.append({"file_path": f"images/frame_{i:05d}.png", "transform_matrix": matrix})
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": table}))
    config = load_config(overrides=[*SETTINGS, "frames.rate=0", f'frames.poses="{tmp_path / "transforms.json"}"'])
    with pytest.raises(InputError, match=r"contradict the images.*every 2nd image, counted from 1, they agree"):
        reconstruct(video, RunFolder(tmp_path / "run"), config, SilentProgress(), "frames")


def walked(count: int) -> NDArray[np.float64]:
    """(N, 4, 4) cam_from_world of someone who walks round in a circle."""
    turns = np.linspace(0, 6, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.column_stack([3 * np.cos(turns), 3 * np.sin(turns), np.zeros(count)])
    return se3.inverse(poses)


def stretch_at(frames: range, poses: NDArray[np.float64]) -> TrackState:
    """A state of these frames alone, each seeing one point; the others are lost."""
    state = TrackState(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    seen = Sightings.of(np.zeros(1, np.int64), np.zeros((1, 2)), 1.0)
    for i in frames:
        state.add_frame(i, poses[i], seen, True, 0)
    state.lost = {i: "blank" for i in range(len(poses)) if i not in frames}
    return state


def test_a_short_stretch_that_does_not_fit_leaves_the_path_to_the_given_poses() -> None:
    true = walked(40)
    given = true.copy()
    given[5::10] = np.nan
    given[20, :3, 3] += 30.0
    state = stretch_at(range(8, 13), se3.exp(np.random.default_rng(0).normal(size=(40, 6))))
    drop_inconsistent_segments(state, GivenPoses(given, True, "made up"))
    carried = pose_lost(state, GivenPoses(given, True, "made up"))
    assert sorted(state.lost) == [5, 15, 20, 25, 35]
    np.testing.assert_allclose([state.poses[i] for i in carried], true[carried], atol=1e-9)


@pytest.mark.parametrize(("frames", "known"), [(range(8, 13), range(4)), (range(25), range(20, 40))])
def test_a_stretch_that_the_given_poses_could_not_replace_stays(frames: range, known: range) -> None:
    true = walked(40)
    given = np.full_like(true, np.nan)
    given[known] = true[known]
    found = se3.exp(np.random.default_rng(0).normal(size=(40, 6)))
    state = stretch_at(frames, found)
    drop_inconsistent_segments(state, GivenPoses(given, True, "made up"))
    assert sorted(state.poses) == list(frames)


def test_a_stretch_that_fits_is_never_left() -> None:
    true = walked(40)
    state = stretch_at(range(5, 15), true)
    drop_inconsistent_segments(state, GivenPoses(true, True, "made up"))
    assert pose_lost(state, GivenPoses(true, True, "made up")) == [*range(5), *range(15, 40)]
    np.testing.assert_allclose([state.poses[i] for i in range(40)], true, atol=1e-9)


def test_poses_of_another_recording_are_refused_before_anything(tmp_path: Path) -> None:
    true = write_recording(tmp_path / "pictures", range(0))
    write_matrices(tmp_path / "few.txt", true[:5])
    config = load_config(overrides=[*SETTINGS, f'frames.poses="{tmp_path / "few.txt"}"'])
    with pytest.raises(InputError, match="5 poses for 18 images"):
        reconstruct(tmp_path / "pictures", RunFolder(tmp_path / "run"), config, SilentProgress(), "tracking")
    assert read_rgb(tmp_path / "pictures" / "view_000.png").shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("is_given", [True, False])
def test_a_group_that_lies_loosely_beside_the_rest_is_put_where_the_given_poses_say(is_given: bool) -> None:
    """Its depths are right: only the way from the rest to it is bent."""
    true, group = walked(40), list(range(10, 20))
    state = stretch_at(range(40), true)
    state.points = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    bent = Similarity(1.3, Rotation.from_rotvec([0.1, 0.2, 0]).as_matrix(), np.array([1.0, 0, 2]))
    for i in group:
        state.poses[i] = bent.apply_to_poses(true[i][None])[0]
        state.sightings[i] = Sightings.of(np.arange(2), np.zeros((2, 2)), 1.0)  # the first is seen by all
    given = GivenPoses(true, True, "made up") if is_given else None
    warned: list[str] = []
    context: Any = SimpleNamespace(run=SimpleNamespace(find=lambda _: given), warn=warned.append)
    state.detach(group)
    figures = carry_given(context, state)
    assert figures.get("given_joined") == (1 if is_given else None)
    assert ["disconnected components" in w for w in warned] == [True] * is_given
    assert len({state.segment[0], state.segment[group[0]]}) == 2 - is_given
    off = np.abs([state.poses[i] - true[i] for i in range(40)]).max((1, 2))
    assert off[:10].max() == off[20:].max() == 0
    assert (off[group].max() < 1e-9) == is_given
    moved = bent.inverse().apply(np.array([[1.0, 0.0, 1.0]]))[0] if is_given else [1.0, 0.0, 1.0]
    np.testing.assert_allclose(state.points, [[0, 0, 1], moved], atol=1e-9)
