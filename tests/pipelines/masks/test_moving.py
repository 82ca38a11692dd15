"""What moved is found by what the other keyframes see behind it; where nothing moves, nothing is found."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.geometry.voxels import to_lab
from msgs_slam.pipelines.masks.moving import MovingView, find_moving, look_once
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Intrinsics

CAMERA = Intrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
WALL, KEYFRAMES = 4.0, 14


def textured(seed: int) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(30, 225, (40, 90, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (900, 400), interpolation=cv2.INTER_CUBIC), np.uint8)


def clip(stands_at: float | None) -> tuple[list[MovingView], list[NDArray[np.bool_]]]:
    """A camera that moves along a wall, and a red thing before it: still at `stands_at` metres, or walking along."""
    wall, views, things = textured(0), [], []
    for k in range(KEYFRAMES):
        left, brighter = 0.12 * k, 1 + 0.01 * k
        pose = np.eye(4)
        pose[0, 3] = -left
        x = np.arange(160) + 0.5
        column = 100 + ((x - 80) / 140 * WALL + left) * 120
        image = wall[(150 + np.arange(120))[:, None], np.round(column).astype(int)[None]]
        middle = 20 + 9 * k if stands_at is None else 80 + 140 * (0.8 - left) / stands_at
        thing = (np.abs(x[None] - middle) < 14) & (np.arange(120)[:, None] > 30)
        image = np.where(thing[..., None], np.uint8([180, 40, 40]), image)
        # Stereo finds the depth of a thing that stands, and is unsure of one that moves.
        depth = np.where(thing, 2.0 if stands_at is None else stands_at, WALL).astype(np.float32)
        confidence = np.where(thing & (stands_at is None), 0.05, 0.8).astype(np.float32)
        shown = np.clip(image * brighter, 0, 255).astype(np.uint8)
        views.append(MovingView(depth, confidence, to_lab(shown), pose))
        things.append(thing)
    return views, things


def find(views: list[MovingView]) -> dict[int, NDArray[np.bool_]]:
    poses = np.array([v.cam_from_world for v in views])
    shown = poses, lambda k: views[k], CAMERA, SilentProgress()
    return find_moving(*shown, look_once(range(len(views)), *shown))


def test_a_thing_that_walks_along_a_wall_is_found() -> None:
    views, things = clip(None)
    found = find(views)
    assert len(found) >= KEYFRAMES - 2
    hit = [(found[k] & things[k]).sum() / things[k].sum() for k in found]
    beside = [(found[k] & ~things[k]).mean() for k in found]
    assert np.mean(hit) > 0.9
    assert 0 < np.mean(beside) < 0.04  # the rim


@pytest.mark.parametrize("stands_at", [0.5, 2.0, 3.5])
def test_a_thing_that_stands_is_part_of_the_scene(stands_at: float) -> None:
    """Also one that is so close that most of the others look past it, at the wall behind."""
    assert find(clip(stands_at)[0]) == {}


def test_wrong_guesses_over_a_plain_surface_accuse_nobody() -> None:
    views, things = clip(WALL)
    guessed = [
        replace(v, depth=np.where(t, v.depth * 0.7, v.depth), confidence=np.where(t, np.float32(0.276), v.confidence))
        for v, t in zip(views, things, strict=True)
    ]
    assert find(guessed) == {}


def test_nothing_is_said_of_one_view_or_of_views_without_depth() -> None:
    views, _ = clip(None)
    assert find(views[:1]) == {}
    blind = [MovingView(v.depth * 0, v.confidence * 0, v.lab, v.cam_from_world) for v in views]
    assert find(blind) == {}
