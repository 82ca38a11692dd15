"""Poses by another program carry a path over what the pictures do not show, and make metres."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_rgb, write_rgb
from msgs_slam.formats.trajectory import write_matrices
from msgs_slam.pipelines.geometry.alignment import align_points
from msgs_slam.pipelines.read_config import load_config
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import BACKBONE, FIGURES, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.pipelines.frames.conftest import FOCAL, HEIGHT, QUICK, WIDTH, render, sideways

FRAMES, BLANK = 18, range(7, 11)
SETTINGS = (
    *QUICK, "proxy.stereo_side=64", "proxy.stereo_planes=8", "frames.people=keep",
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
    assert trajectory.is_placed.all()
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
    with pytest.raises(InputError, match="no parallax"):
        reconstruct(tmp_path / "pictures", RunFolder(tmp_path / "alone"), load_config(overrides=[*SETTINGS]),
                    SilentProgress(), "frames")  # fmt: skip


def test_poses_of_another_recording_are_refused_before_anything(tmp_path: Path) -> None:
    true = write_recording(tmp_path / "pictures", range(0))
    write_matrices(tmp_path / "few.txt", true[:5])
    config = load_config(overrides=[*SETTINGS, f'frames.poses="{tmp_path / "few.txt"}"'])
    with pytest.raises(InputError, match="5 poses for 18 images"):
        reconstruct(tmp_path / "pictures", RunFolder(tmp_path / "run"), config, SilentProgress(), "tracking")
    assert read_rgb(tmp_path / "pictures" / "view_000.png").shape == (HEIGHT, WIDTH, 3)
