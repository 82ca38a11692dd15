"""Picking by windows and sharpness."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs_slam.formats.images import read_rgb
from msgs_slam.formats.video import VideoFrame
from msgs_slam.formats.video_streams import write_video
from msgs_slam.pipelines.frames.keyframes import pick_frames
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.source.picking import Motion, reduce_image, reduced_size, sharpest_of_windows, sharpness
from msgs_slam.pipelines.source.recording import open_recording

BLANK = np.zeros((2, 2, 3), np.uint8)


def _pictures(times: list[float]) -> list[VideoFrame]:
    # The score travels in the first pixel, so that the choice can be checked.
    rng = np.random.default_rng(len(times))
    return [VideoFrame(i, t, np.full((2, 2, 3), rng.integers(0, 256), np.uint8)) for i, t in enumerate(times)]


@settings(max_examples=60, deadline=None)
@given(
    steps=st.lists(st.floats(0.001, 0.4), min_size=1, max_size=80),
    start=st.floats(0, 100),
    rate=st.sampled_from([1.0, 3.0, 10.0, 29.97]),
)
def test_each_window_gives_its_sharpest_picture(steps: list[float], start: float, rate: float) -> None:
    times = [start + sum(steps[:i]) for i in range(len(steps))]
    pictures = _pictures(times)
    chosen = [p for p, _ in sharpest_of_windows(pictures, rate, measure=lambda rgb: float(rgb[0, 0, 0]))]
    windows: dict[int, list[VideoFrame]] = {}
    for picture in pictures:
        windows.setdefault(int((picture.timestamp - start + 1e-6) * rate), []).append(picture)
    assert len(chosen) == len(windows)
    for picture, members in zip(chosen, windows.values(), strict=True):
        assert picture.rgb[0, 0, 0] == max(int(m.rgb[0, 0, 0]) for m in members)


def test_a_constant_rate_is_divided_evenly() -> None:
    pictures = [VideoFrame(i, i / 30, BLANK) for i in range(300)]
    chosen = [p.source_index for p, _ in sharpest_of_windows(pictures, 10, measure=lambda rgb: 0.0)]
    assert chosen == list(range(0, 300, 3))


def test_rate_zero_keeps_every_picture() -> None:
    pictures = _pictures([0.0, 0.001, 0.5, 0.501])
    assert [p.source_index for p, _ in sharpest_of_windows(pictures, 0)] == [0, 1, 2, 3]


def test_only_one_picture_is_held_at_a_time() -> None:
    handed_out = 0

    def pictures():  # type: ignore[no-untyped-def]
        nonlocal handed_out
        for i in range(30):
            handed_out += 1
            yield VideoFrame(i, i / 10, BLANK)

    first = next(sharpest_of_windows(pictures(), 2, measure=lambda rgb: 0.0))
    assert first[0].source_index == 0
    assert handed_out == 6  # five of the first window and the one that ended it


def test_blur_lowers_sharpness() -> None:
    rng = np.random.default_rng(0)
    sharp = cv2.resize(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8), (640, 480), interpolation=cv2.INTER_CUBIC)
    values = [sharpness(cv2.GaussianBlur(sharp, (0, 0), s) if s else sharp) for s in (0, 1, 2, 4, 8)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 2 * values[3] > 0


@pytest.mark.parametrize(
    ("size", "side", "expected"),
    [((1920, 1080), 960, (960, 540)), ((1080, 1920), 960, (540, 960)), ((640, 480), 960, (640, 480)),
     ((4000, 3000), 0, (4000, 3000)), ((5000, 1), 100, (100, 1))],
)  # fmt: skip
def test_reduced_size(size: tuple[int, int], side: int, expected: tuple[int, int]) -> None:
    assert reduced_size(*size, side) == expected


def test_an_image_that_is_small_enough_is_not_touched() -> None:
    image = np.zeros((10, 20, 3), np.uint8)
    assert reduce_image(image, 20) is image
    assert reduce_image(image, 10).shape == (5, 10, 3)


def _filmed(moves: list[float], fps: float = 30.0, seed: int = 0) -> list[VideoFrame]:
    """Images 240 wide of a textured wall; each is moved by so many pixels from the one before it."""
    rng = np.random.default_rng(seed)
    width = 240 + int(sum(moves)) + 2
    wall = cv2.resize(
        rng.integers(0, 255, (45, width // 4, 3), dtype=np.uint8), (width, 180), interpolation=cv2.INTER_CUBIC
    )
    places = np.concatenate([[0], np.cumsum(moves)]).astype(int)
    return [VideoFrame(i, i / fps, wall[:, x : x + 240]) for i, x in enumerate(places)]


def _wanted(pictures: list[VideoFrame], rate: float = 10.0) -> tuple[list[int], list[int]]:
    motion, chosen = Motion(), []
    for picture, _ in sharpest_of_windows(motion.watch(pictures), rate, measure=lambda rgb: 0.0):
        chosen.append(picture.source_index)
        motion.pick(picture.source_index)
    return chosen, motion.wanted()


def test_all_images_are_wanted_where_the_picked_ones_hardly_overlap() -> None:
    chosen, wanted = _wanted(_filmed([20.0] * 29))
    assert chosen == list(range(0, 30, 3))
    assert wanted == list(range(30))


@pytest.mark.parametrize("moves", [[2.0] * 29, [0.0] * 29, [1.0] * 12 + [20.0] * 3 + [1.0] * 14])
def test_a_walk_a_still_camera_and_one_quick_turn_keep_their_picks(moves: list[float]) -> None:
    chosen, wanted = _wanted(_filmed(moves))
    assert wanted == chosen


def test_a_low_rate_gets_so_many_more_that_images_overlap() -> None:
    """Not all: at two pixels of 240 an image it takes seven of them to a sixteenth."""
    chosen, wanted = _wanted(_filmed([2.0] * 119), rate=1.0)
    assert chosen == [0, 30, 60, 90]
    assert wanted == [second + n for second in chosen for n in range(0, 30, 7)]
    chosen, wanted = _wanted(_filmed([2.0] * 119), rate=3.0)
    assert wanted == chosen == list(range(0, 120, 10))


def test_only_the_fast_part_of_a_film_is_kept_whole() -> None:
    _, wanted = _wanted(_filmed([1.0] * 44 + [20.0] * 30 + [1.0] * 44))
    assert set(range(45, 73)) <= set(wanted)
    assert set(wanted) >= set(range(0, 119, 3))
    assert not set(wanted) & {1, 2, 4, 5, 28, 29, 100, 101, 115, 116}


def test_a_cut_and_a_blank_wall_are_no_motion() -> None:
    two = _filmed([1.0] * 14) + [
        p._replace(source_index=15 + i, timestamp=(15 + i) / 30) for i, p in enumerate(_filmed([1.0] * 14, seed=1))
    ]
    chosen, wanted = _wanted(two)
    assert wanted == chosen
    blank = [VideoFrame(i, i / 30, np.full((180, 240, 3), 90, np.uint8)) for i in range(30)]
    chosen, wanted = _wanted(blank)
    assert wanted == chosen


def test_a_time_lapse_is_kept_whole(tmp_path: Path, make_context: Callable[..., StageContext]) -> None:
    """As frames counted on, each in a file of its number."""
    path = tmp_path / "lapse.avi"
    write_video(path, [p.rgb for p in _filmed([20.0] * 23)], 30.0)
    context = make_context(path)
    frames = pick_frames(context, open_recording(path), None)
    assert [f.source_index for f in frames] == [f.id for f in frames] == list(range(24))
    assert [f.timestamp for f in frames] == pytest.approx(np.arange(24) / 30, abs=1e-3)
    stored = sorted(p.name for p in (context.snapshot / "picked").iterdir())
    assert stored == [f.name for f in frames] == [f"{i:06d}.jpg" for i in range(24)]
    own = [read_rgb(context.snapshot / "picked" / name).astype(float) for name in stored]
    assert all(np.abs(a - p.rgb).mean() < 6 for a, p in zip(own, _filmed([20.0] * 23), strict=True))
    assert pick_frames(context, open_recording(path), None) == frames
