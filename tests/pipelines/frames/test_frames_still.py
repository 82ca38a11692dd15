"""The whole stage with a part of the image that stands still: left out, or named as the reason."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_grey_png, read_rgb, write_rgb
from msgs_slam.pipelines.frames.stage import run
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.run.files import SPARSE
from msgs_slam.pipelines.run.stages import StageContext
from tests.pipelines.frames.conftest import HEIGHT, WIDTH, Walk

TOP = 150
"""First row of the bonnet."""


def bonnet() -> np.ndarray:
    coarse = np.random.default_rng(3).integers(0, 255, (45, 80, 3), dtype=np.uint8)
    return np.kron(coarse, np.ones((4, 4, 1), np.uint8)).astype(np.uint8)[: HEIGHT - TOP, :WIDTH]


@pytest.fixture(scope="module")
def drive(bent_walk: Walk, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The walk behind a bonnet with texture."""
    folder = tmp_path_factory.mktemp("drive")
    for path in sorted(bent_walk.folder.iterdir()):
        image = read_rgb(path)
        image[TOP:] = bonnet()
        write_rgb(folder / path.name, image)
    return folder


def test_a_bonnet_is_left_out_the_path_is_right_and_a_second_start_finds_the_same(
    drive: Path, bent_walk: Walk, make_context: Callable[..., StageContext]
) -> None:
    context = make_context(drive)
    figures = run(context)
    model = SPARSE.read(context.folder / "backbone" / "model.npz")
    centres = np.linalg.inv(model.cam_from_world)[:, :3, 3]
    truth = bent_walk.centers[model.frame_ids]
    assert len(model.frame_ids) == len(bent_walk.centers)
    assert np.linalg.norm(align_points(centres, truth).apply(centres) - truth, axis=1).max() < 0.05
    assert 0.36 < figures["still_left_out"] < 0.46
    assert figures["masked_frames"] == len(bent_walk.centers)
    share = f"{figures['still_left_out']:.0%}"
    assert [w for w in context.warnings if w.startswith(f"{share} of the image stands still while the rest moves")]
    left_out = read_grey_png(next((context.folder / "masks").iterdir())) == 0
    assert left_out[TOP + 10 :].mean() > 0.97
    assert left_out[: TOP - 15].mean() < 0.03
    stored = {p: p.stat().st_mtime_ns for p in (context.snapshot / "left_out").rglob("*.*")}
    assert len(stored) == 2
    again = make_context(drive)
    assert run(again) == figures
    assert again.warnings == context.warnings
    assert {p: p.stat().st_mtime_ns for p in (context.snapshot / "left_out").rglob("*.*")} == stored


def test_it_can_be_kept(drive: Path, make_context: Callable[..., StageContext]) -> None:
    context = make_context(drive, 'frames.still="keep"')
    with pytest.raises(InputError, match="there is no parallax") as refused:
        run(context)
    assert "stands still while" not in str(refused.value)
    assert not any("stands still while" in w for w in context.warnings)
    assert not (context.folder / "masks").exists()


def test_a_turntable_is_named_and_not_told_to_walk_only(
    bent_walk: Walk, tmp_path: Path, make_context: Callable[..., StageContext]
) -> None:
    wall = cv2.resize(bonnet(), (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    for path in sorted(bent_walk.folder.iterdir()):
        image = wall.copy()
        image[70:170, 100:220] = read_rgb(path)[70:170, 100:220]
        write_rgb(tmp_path / "table" / path.name, image)
    said = re.escape("of the image stands still while the rest moves. If the scene is what moves, as on a turntable")
    with pytest.raises(InputError, match=rf"^8\d% {said}.*--masks FOLDER.*Otherwise.*film again"):
        run(make_context(tmp_path / "table"))


@pytest.mark.parametrize("wide", [40, 110])
def test_a_tripod_before_which_something_passes_is_no_moving_camera(
    bent_walk: Walk, tmp_path: Path, make_context: Callable[..., StageContext], wide: int
) -> None:
    still, board = read_rgb(sorted(bent_walk.folder.iterdir())[0]), bonnet()[:, :wide]
    for i in range(16):
        image, x = still.copy(), 5 + 11 * i
        image[60 : 60 + len(board), x : x + wide] = board
        write_rgb(tmp_path / "tripod" / f"{i:02d}.png", image)
    with pytest.raises(InputError, match="camera stands still"):
        run(make_context(tmp_path / "tripod"))
