"""Picking by windows and sharpness."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs_slam.formats.video import VideoFrame
from msgs_slam.pipelines.source.sharpness import reduce_image, reduced_size, sharpest_of_windows, sharpness

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
