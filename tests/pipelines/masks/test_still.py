"""What stands still while the rest moves is found, and nothing of a scene is taken for it."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.pipelines.masks.still import StillPart, find_still

HEIGHT, WIDTH, COUNT = 120, 160, 16
Grey = NDArray[np.uint8]


def texture(height: int, width: int, seed: int, cell: int = 4) -> Grey:
    coarse = np.random.default_rng(seed).integers(0, 255, (height // cell + 2, width // cell + 2), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)[:height, :width])


WORLD = texture(400, 600, 1)


def shifted(i: int, step: tuple[int, int] = (9, 3)) -> Grey:
    """A camera that moves over the world."""
    return WORLD[step[1] * i :][:HEIGHT, step[0] * i :][:, :WIDTH].copy()


def look(film: list[Grey], hidden: NDArray[np.bool_] | None = None) -> StillPart | None:
    return find_still((grey, hidden) for grey in film)


def with_bonnet(grey: Grey) -> Grey:
    grey[95:] = texture(25, WIDTH, 2)
    return grey


def bonnet() -> NDArray[np.bool_]:
    return np.arange(HEIGHT)[:, None].repeat(WIDTH, 1) >= 95


def test_a_bonnet_is_left_out_and_little_else() -> None:
    found = look([with_bonnet(shifted(i)) for i in range(COUNT)])
    assert found is not None
    assert found.left_out[bonnet()].mean() > 0.99
    assert 0 < found.left_out[~bonnet()].mean() < 0.06
    assert found.veil == 0


def test_a_clock_is_left_out_with_its_digits() -> None:
    film = [shifted(i) for i in range(COUNT)]
    for i, grey in enumerate(film):
        cv2.putText(grey, f"ALT {12 + 7 * i:03d} m", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 0, 5, cv2.LINE_AA)
        cv2.putText(grey, f"ALT {12 + 7 * i:03d} m", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 2, cv2.LINE_AA)
    found = look(film)
    assert found is not None
    assert found.left_out[45:60, 22:60].mean() > 0.9
    assert found.left_out.mean() < 0.25


def test_a_frame_around_the_view_is_left_out_up_to_its_plain_corners() -> None:
    film = []
    for i in range(COUNT):
        screen = np.full((HEIGHT, WIDTH), 40, np.uint8)
        screen[:15], screen[-15:] = texture(15, WIDTH, 3), texture(15, WIDTH, 4)
        screen[25:95, 40:120] = shifted(i)[25:95, 40:120]
        film.append(screen)
    found = look(film)
    assert found is not None
    view = np.zeros((HEIGHT, WIDTH), bool)
    view[25:95, 40:120] = True
    assert found.left_out[~view].mean() > 0.98
    assert found.left_out[view].mean() < 0.25


def test_a_reflection_over_all_is_said_and_not_left_out() -> None:
    pane = texture(HEIGHT, WIDTH, 5, 8)
    found = look([cv2.addWeighted(shifted(i), 0.4, pane, 0.6, 0) for i in range(COUNT)])
    assert found is not None
    assert found.veil > 0.3
    assert not found.left_out.any()


def zoomed(i: int) -> Grey:
    """Driven straight ahead: the middle of the image stays where it is."""
    turn = cv2.getRotationMatrix2D((300.0, 200.0), 0.0, 1.12**i)
    turn[:, 2] -= (300 - WIDTH / 2, 200 - HEIGHT / 2)
    return np.asarray(cv2.warpAffine(WORLD, turn, (WIDTH, HEIGHT)))


def on_rails(i: int) -> Grey:
    """Long edges along the motion stay where they are."""
    grey = shifted(i, (9, 0))
    grey[40:80] = np.where(np.arange(40)[:, None] // 10 % 2, 220, 30).astype(np.uint8)
    return grey


def before_a_far_wall(i: int) -> Grey:
    """A hand-held camera: what is far away trembles by some pixels and goes nowhere."""
    grey = shifted(i)
    x, y = np.random.default_rng(i).integers(0, 9, 2)
    grey[:60] = texture(100, 200, 6)[y:][:60, x:][:, :WIDTH]
    return grey


def dark(i: int) -> Grey:
    """Noise at half of the contrast, before a camera that stands for most of the time."""
    noise = np.random.default_rng(i).normal(0, 8, (HEIGHT, WIDTH))
    return np.clip(0.4 * shifted(max(0, i - 2 * COUNT)) + noise, 0, 255).astype(np.uint8)


FILMS: dict[str, Callable[[int], Grey]] = {
    "moves": shifted,
    "stands first": lambda i: shifted(max(0, i - COUNT // 2)),
    "ahead": zoomed,
    "rails": on_rails,
    "far wall": before_a_far_wall,
    "dark": dark,
    "to and fro": lambda i: shifted(4 + round(4 * np.sin(i))),
}


@pytest.mark.parametrize("film", FILMS)
def test_nothing_of_a_scene_is_taken_for_it(film: str) -> None:
    count = {"stands first": 2 * COUNT, "dark": 3 * COUNT}.get(film, COUNT)
    found = look([FILMS[film](i) for i in range(count)])
    assert found is not None, "there was evidence to judge by"
    assert not found.left_out.any()
    assert found.veil == 0


def test_no_judgement_without_motion_or_with_few_images() -> None:
    rng = np.random.default_rng(7)
    noisy = [np.clip(shifted(0) + rng.normal(0, 2, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8) for _ in range(COUNT)]
    assert look(noisy) is None
    assert look([with_bonnet(shifted(i)) for i in range(5)]) is None


def test_what_the_user_has_masked_is_not_found_again() -> None:
    film = [with_bonnet(shifted(i)) for i in range(COUNT)]
    found = look(film, bonnet())
    assert found is not None
    assert not found.left_out.any()
