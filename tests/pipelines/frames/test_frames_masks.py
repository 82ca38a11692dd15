"""The whole stage with masks: something large that moves by itself leaves no trace."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.formats.images import read_grey_png, read_rgb, write_grey_png, write_rgb
from msgs_slam.pipelines.config import Config, FramesConfig
from msgs_slam.pipelines.frames.findings import warn_of_people
from msgs_slam.pipelines.frames.masks import masks_for
from msgs_slam.pipelines.frames.stage import run
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.run.files import SPARSE
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.sfm.driver import Structure
from msgs_slam.pipelines.source.recording import open_recording
from tests.pipelines.frames.conftest import HEIGHT, WALK_FRAMES, WIDTH, Walk, bluish, render, sideways
from tests.pipelines.frames.test_frames_stage import digests
from tests.pipelines.proxy.tiny_tflite import blue_people
from tests.pipelines.travelling import Travelling

Moving = tuple[Path, Path, list[np.ndarray]]


@pytest.fixture
def crossing(bent_walk: Walk, tmp_path: Path) -> Moving:
    """The walk, with a textured board that crosses it the other way, and masks of the board."""
    board = np.random.default_rng(5).integers(0, 255, (40, 30, 3), dtype=np.uint8)
    board = np.kron(board, np.ones((4, 4, 1), np.uint8)).astype(np.uint8)
    covered = []
    for i, path in enumerate(sorted(bent_walk.folder.iterdir())):
        image, left_out = read_rgb(path), np.zeros((HEIGHT, WIDTH), bool)
        x = 10 + 15 * i
        image[40:200, x : x + 120] = board
        left_out[38:202, max(x - 2, 0) : x + 122] = True
        write_rgb(tmp_path / "pictures" / path.name, image)
        (tmp_path / "masks").mkdir(exist_ok=True)
        write_grey_png(tmp_path / "masks" / f"{path.name}.png", np.where(left_out, 0, 255).astype(np.uint8))
        covered.append(left_out)
    return tmp_path / "pictures", tmp_path / "masks", covered


@pytest.mark.parametrize("by", ["masks", "thin masks", "transparency"])
def test_masks_over_everything_are_named_as_the_reason(
    bent_walk: Walk, tmp_path: Path, make_context: Callable[..., StageContext], by: str
) -> None:
    kept = np.zeros((HEIGHT, WIDTH), np.uint8)
    kept[:2] = 255 * (by == "thin masks")
    pictures = bent_walk.folder
    for path in sorted(pictures.iterdir()):
        if by == "transparency":
            (tmp_path / "clear").mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / "clear" / f"{path.stem}.png"), np.dstack([cv2.imread(str(path)), kept]))
        else:
            write_grey_png(tmp_path / "masks" / f"{path.name}.png", kept)
    masks = "" if by == "transparency" else str(tmp_path / "masks")
    said = (
        "--masks.*leave only 0.[08]%.*invert"
        if masks
        else "transparent backgrounds.*leave only 0.0%.*without transparency"
    )
    with pytest.raises(InputError, match=said):
        run(make_context(tmp_path / "clear" if not masks else pictures, f'frames.masks="{masks}"'))


def test_a_board_that_crosses_the_picture_leaves_no_trace(
    crossing: Moving, bent_walk: Walk, make_context: Callable[..., StageContext]
) -> None:
    pictures, masks, covered = crossing
    context = make_context(pictures, f'frames.masks="{masks}"')
    figures = run(context)
    assert figures["masked_frames"] == len(covered)
    assert 0.2 < figures["masked_share"] < 0.3
    model = SPARSE.read(context.folder / "backbone" / "model.npz")
    assert len(model.frame_ids) == len(covered)
    centres = np.linalg.inv(model.cam_from_world)[:, :3, 3]
    aligned = align_points(centres, bent_walk.centers[model.frame_ids])
    assert np.linalg.norm(aligned.apply(centres) - bent_walk.centers[model.frame_ids], axis=1).max() < 0.05
    for n, frame_id in enumerate(model.frame_ids.tolist()):
        name = sorted(p.name for p in pictures.iterdir())[frame_id]
        left_out = read_grey_png(context.folder / "masks" / f"{name}.png") == 0
        seen = model.obs_xy[model.obs_frame == n].astype(int)  # some beyond the border of the undistorted frame
        seen = seen[((seen >= 0) & (seen < [WIDTH, HEIGHT])).all(1)]
        # A feature on the border may be undistorted to the other side of it.
        inner = left_out & np.roll(left_out, 2, 1) & np.roll(left_out, -2, 1)
        assert not inner[seen[:, 1], seen[:, 0]].any()
        # The lens has been taken out of the masks as out of the pictures: what was straight is no longer.
        assert (left_out != covered[frame_id]).any()
        board = read_rgb(context.folder / name)[left_out].std()
        assert board > 50


@pytest.fixture
def stand_ins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path / "cache"))
    blue_people(tmp_path)


@pytest.fixture
def posters(tmp_path: Path) -> Path:
    """The walk with a blue poster on a wall."""
    for i, (center, rotation) in enumerate(sideways(WALK_FRAMES)):
        write_rgb(tmp_path / "posters" / f"view_{i:03d}.png", render(center, rotation, poster=True))
    return tmp_path / "posters"


def test_what_looks_like_a_person_and_stands_still_is_scene(
    stand_ins: None, posters: Path, make_context: Callable[..., StageContext]
) -> None:
    found = make_context(posters, name="found")
    figures = run(found)
    assert WALK_FRAMES == figures["people_still"] < figures["people_named"]
    assert figures["masked_share"] < 0.01, "specks with too few matches to tell"
    assert any("regions of keyframes that look like people stand as still" in m for m in found.warnings)
    kept = make_context(posters, 'frames.people="keep"', name="kept")
    run(kept)
    poses, same = (digests(c.folder)["backbone/model.npz"] for c in (found, kept))
    assert poses == same, "as if nobody had looked for people"
    masked = run(make_context(posters, 'frames.people="mask"', name="masked"))
    assert masked["masked_frames"] == WALK_FRAMES
    assert 0.05 < masked["masked_share"] < 0.4


def test_who_crosses_the_picture_is_left_out(
    stand_ins: None, crossing: Moving, bent_walk: Walk, make_context: Callable[..., StageContext], tmp_path: Path
) -> None:
    """The board is blue, and there are no masks of it; workers, who get the tasks as files, leave it out too."""
    pictures, _, covered = crossing
    for path, left_out in zip(sorted(pictures.iterdir()), covered, strict=True):
        image = read_rgb(path)
        image[left_out] = bluish(image[left_out])
        write_rgb(path, image)
    context = replace(make_context(pictures), workers=Travelling(2))
    figures = run(context)
    assert figures["people_still"] == 0 < figures["people_named"]
    assert figures["masked_frames"] == len(covered)
    model = SPARSE.read(context.folder / "backbone" / "model.npz")
    centres = np.linalg.inv(model.cam_from_world)[:, :3, 3]
    aligned = align_points(centres, bent_walk.centers[model.frame_ids])
    assert 0 < np.linalg.norm(aligned.apply(centres) - bent_walk.centers[model.frame_ids], axis=1).max() < 0.05


@pytest.mark.parametrize(("left", "said"), [(60, ["40% of the matches"]), (70, [])])
def test_masks_that_cost_more_than_a_third_of_the_matches_are_warned_of(
    make_context: Callable[..., StageContext], tmp_path: Path, left: int, said: list[str]
) -> None:
    context = make_context(tmp_path)
    structure = cast(Structure, SimpleNamespace(pairs=[SimpleNamespace(matches=np.zeros((left // 2, 2)))] * 2))
    warn_of_people(context, {"named": 3, "still": 0, "matches": 100}, structure)
    assert len(context.warnings) == len(said)
    assert all(part in message for part, message in zip(said, context.warnings, strict=True))
    warn_of_people(context, None, structure)
    assert len(context.warnings) == len(said)


def _masked_data_set(folder: Path) -> None:
    """Two cameras' folders with images of equal names; the mask of each image of the first covers its left half."""
    frames = []
    for i, name in enumerate(("cam_a/0.png", "cam_b/0.png", "cam_b/1.png")):
        image = np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        write_rgb(folder / "images" / name, image)
        frames.append({"file_path": f"images/{name}", "transform_matrix": np.eye(4).tolist()})
        if name.startswith("cam_a"):
            kept = np.full((48, 64), 255, np.uint8)
            kept[:, :32] = 0
            write_grey_png(folder / "masks" / name, kept)
            frames[-1]["mask_path"] = f"masks/{name}"
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 50, "frames": frames}))


def test_masks_of_a_data_set_are_used_and_those_of_the_user_win(tmp_path: Path) -> None:
    _masked_data_set(tmp_path)
    source = open_recording(tmp_path)
    found = masks_for(Config(), source).left_out(0, 64, 48)
    assert found is not None
    assert (found[:, :32].all(), found[:, 32:].any()) == (True, False)
    assert masks_for(Config(), source).left_out(1, 64, 48) is None
    write_grey_png(tmp_path / "own" / "cam_b" / "0.png.png", np.zeros((48, 64), np.uint8))
    own = masks_for(Config(frames=FramesConfig(masks=str(tmp_path / "own"))), source)
    assert [own.left_out(i, 64, 48) is None for i in range(3)] == [True, False, True]
    write_grey_png(tmp_path / "masks" / "cam_a" / "0.png", np.zeros((24, 32), np.uint8))
    with pytest.raises(InputError, match="is 32x24, the images are 64x48"):
        masks_for(Config(), source)
