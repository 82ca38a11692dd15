"""The worlds of benchmarks hold what they are made for."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.benchmarks.worlds import building
from tests.world import ClipOptions, make_world, render_frame, render_view, walk

OPTIONS = ClipOptions(frames=40, width=160, height=120, laps=1.0)


def test_the_corridor_is_walked_smoothly_and_shows_many_classes() -> None:
    corridor = make_world("corridor", texel=0.02)
    poses = walk(corridor, np.arange(401) / 400)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert np.linalg.norm(poses[0, :3, 3] - poses[-1, :3, 3]) < 0.1
    assert 0.4 < steps.min() / np.median(steps) < steps.max() / np.median(steps) < 2
    frames = [render_frame(corridor, OPTIONS, i) for i in range(0, OPTIONS.frames, 4)]
    assert 0.3 < min(f.depth.min() for f in frames) < max(f.depth.max() for f in frames) < 14
    assert len({int(i) for f in frames for i in np.unique(f.labels)} - {0}) >= 8
    assert all(70 < f.rgb.mean() < 190 for f in frames)


def test_the_stairwell_has_bars_of_few_pixels_before_other_things_and_its_floor_mirrors() -> None:
    stairs = make_world("stairwell", texel=0.03)
    pose = walk(stairs, np.array([0.2]))[0]
    color, depth, solid = render_view(stairs, OPTIONS, pose)
    names = np.array(stairs.class_names)[stairs.labels[solid]]
    bars = (names == "bar").astype(np.uint8)
    gaps = (cv2.morphologyEx(bars, cv2.MORPH_CLOSE, np.ones((1, 9), np.uint8)) > 0) & (bars == 0)
    assert 0.04 < bars.mean() < 0.25
    assert cv2.erode(bars, np.ones((5, 5), np.uint8)).mean() < 0.1 * bars.mean()
    beside = cv2.dilate(depth * bars, np.ones((1, 17), np.uint8))
    assert (depth > 1.1 * beside)[gaps].mean() > 0.6
    dull, same, _ = render_view(replace(stairs, gloss=0.0), OPTIONS, pose)
    assert (same == depth).all()
    assert (color == dull)[names != "floor"].all()
    assert np.abs(color - dull)[names == "floor"].mean() > 0.01


def test_the_classroom_has_thirty_desks_on_thin_legs_over_a_floor_without_texture() -> None:
    room = make_world("classroom", texel=0.03)
    pose = walk(room, np.array([0.1]))[0]
    color, depth, solid = render_view(room, OPTIONS, pose)
    names = np.array(room.class_names)[room.labels[solid]]
    seen = {name: (names == name).mean() for name in room.class_names}
    assert min(seen["desk"], seen["wall"], seen["floor"]) > 0.04
    assert len(np.unique(solid[names == "desk"])) > 30  # tops and legs
    floor = cv2.erode((names == "floor").astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    steps = np.abs(np.diff(color.astype(np.float32), axis=1))[:, :, 0]
    assert np.median(steps[floor[:, 1:]]) < 0.2 * np.median(steps[names[:, 1:] == "desk"])
    assert (depth > 0).all()


def test_the_building_goes_on_without_a_hole_and_without_the_whole_of_it() -> None:
    """Every ray ends at a surface, and a place looks the same from whatever module it is built."""
    path = building.Walk(400).poses(np.arange(0, 400, 0.2))
    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    assert 0.8 < steps.min() / np.median(steps) < steps.max() / np.median(steps) < 1.3
    back = building.Walk(40, turns=2).poses(np.array([0.0, 10, 20, 30, 40]))[:, 0, 3]
    assert back[[1, 3]] == pytest.approx(back[0] + 5)
    assert back[[2, 4]] == pytest.approx(back[0])
    options = ClipOptions(width=48, height=36)
    for pose in path[[0, 20, 51]]:  # in the first room, and in its door
        color, depth, solid = render_view(building.around(building.module_at(pose[0, 3]), 0.05), options, pose)
        assert (solid >= 0).all()
        assert depth.min() > 0.3
        assert color.std() > 0.02
    again = building.module.__wrapped__(2, 0.05)
    assert again.atlas.codes.tobytes() == building.module(2, 0.05).atlas.codes.tobytes()
    assert building.module_at(path[-1, 0, 3]) > 30
