"""Completion of a keyframe's depth: planes along like colours, what others lend, the network that weighs it and how it
learns."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from msgs_slam.formats.tensors import load_arrays, save_arrays
from msgs_slam.pipelines.depth.completion import network as rooms_network
from msgs_slam.pipelines.depth.completion.evidence import (
    KINDS,
    STEP_OF_NUMBERS,
    CompletionInputs,
    HalfResKeyframe,
    build_inputs,
    find_speakers,
    update_view_evidence,
)
from msgs_slam.pipelines.depth.completion.fill import SURE, agreed_depth, carry_depth, local_planes, smooth_confidence
from msgs_slam.pipelines.depth.completion.network import (
    HALF,
    TWICE,
    CompletionNetwork,
    Mixture,
    complete,
    completed_keyframe,
    halved,
    inputs_of,
    load_network,
    mixture_median,
    numbers_of,
)
from msgs_slam.pipelines.depth.stereo.sweep import warps_to
from msgs_slam.pipelines.depth.stereo.window import surface_contrast
from msgs_slam.pipelines.providers import confidence_of, error_of
from tests.benchmarks.rooms.learning import Example, Examples, Fit, example_arrays, loss_of

HEIGHT, WIDTH, FOCAL = 40, 60, 50.0
MATRIX = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
MIDDLE, ASIDE = np.eye(4), np.array([[1.0, 0, 0, 0.12], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def plane_depth(cam_from_world: NDArray, slope: float = 0.3) -> NDArray[np.float64]:
    """Depth of the plane z = 2 + slope·x from a camera that is only shifted."""
    u = (np.indices((HEIGHT, WIDTH)) + 0.5)[1]
    return (2 - slope * cam_from_world[0, 3]) / (1 - slope * (u - WIDTH / 2) / FOCAL)


def with_planes(depth: NDArray, confidence: NDArray, image: NDArray) -> NDArray:
    """Depths that are sure, and the planes through them elsewhere."""
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    guess, _ = local_planes(inverse, confidence.astype(np.float64) ** 2.5, image)
    return np.where((confidence >= SURE) & (depth > 0), depth, 1 / np.maximum(guess, 1e-9)).astype(np.float32)


def test_a_blank_wall_is_filled_with_the_plane_of_its_border() -> None:
    truth = 1 / (0.5 - 0.002 * np.arange(WIDTH)[None] + 0.001 * np.arange(HEIGHT)[:, None])
    image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    confidence = np.full((HEIGHT, WIDTH), 0.9, np.float32)
    blank = np.zeros((HEIGHT, WIDTH), bool)
    blank[5:-5, 6:-6] = True
    confidence[blank] = 0.05
    seen = np.where(blank, np.random.default_rng(2).uniform(1, 9, truth.shape), truth).astype(np.float32)
    filled = with_planes(seen, confidence, image)
    np.testing.assert_array_equal(filled[~blank], seen[~blank])
    assert np.abs(filled / truth - 1)[blank].max() < 0.02


def test_each_of_two_blank_surfaces_takes_its_own_plane() -> None:
    left = np.broadcast_to(np.arange(WIDTH) < 30, (HEIGHT, WIDTH))
    slope = 0.002 * np.arange(WIDTH)[None] + 0 * np.arange(HEIGHT)[:, None]
    truth = np.where(left, 1 / (0.3 + slope), 1 / (0.9 - slope))
    image = np.where(left, 60, 180).astype(np.uint8)[..., None].repeat(3, -1)
    sure = np.ones((HEIGHT, WIDTH), bool)
    sure[8:-8] = False
    filled = with_planes(truth.astype(np.float32), np.where(sure, 0.9, 0).astype(np.float32), image)
    assert np.abs(filled / truth - 1).max() < 0.03


SURE_PLACES = {
    "top rows": np.s_[:9],
    "a corner": np.s_[:8, :8],
    "the other corner": np.s_[-8:, -8:],
    "left columns": np.s_[:, :6],
    "one pixel": np.s_[3:4, 5:6],
}


@pytest.mark.parametrize("shape", [(96, 54), (54, 96), (72, 72), (320, 20), (20, 320)])
@pytest.mark.parametrize("place", SURE_PLACES)
def test_filled_depths_stay_near_the_sure_ones_in_pictures_of_any_shape(shape: tuple[int, int], place: str) -> None:
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (*shape, 3)).astype(np.uint8)  # no two colours are alike: votes hardly spread
    depth, confidence = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    depth[SURE_PLACES[place]] = rng.uniform(2, 3, depth[SURE_PLACES[place]].shape)
    confidence[SURE_PLACES[place]] = 0.9
    filled = with_planes(depth, confidence, image)
    assert np.isfinite(filled).all()
    sure = confidence > 0
    np.testing.assert_array_equal(filled[sure], depth[sure])
    assert sure.sum() < 40 or 0.5 * 2 < filled.min() <= filled.max() < 2 * 3
    judged = smooth_confidence(confidence, image)
    assert 0 <= judged.min() <= judged.max() <= 1


def test_a_picture_held_upright_is_filled_like_one_held_across() -> None:
    """A plane of which the first third is sure."""
    rows, columns = np.mgrid[:54, :96]
    truth = (1 / (0.6 - 0.003 * columns + 0.001 * rows)).astype(np.float32)
    confidence = np.where(columns < 32, 0.9, 0).astype(np.float32)
    image = np.full((54, 96, 3), 120, np.uint8)
    across = with_planes(truth, confidence, image)
    upright = with_planes(truth.T.copy(), confidence.T.copy(), image.swapaxes(0, 1).copy())
    np.testing.assert_allclose(upright.T, across, rtol=0.02)


def lend(truth: NDArray, color: float, confidence: float = 0.9) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The plane's depths of a camera aside, whose picture has one lightness, carried into the middle camera."""
    warp = warps_to(MATRIX, ASIDE, [MATRIX], [np.eye(4)])[0]
    seen = plane_depth(ASIDE).astype(np.float32)
    lab, target = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.zeros((HEIGHT, WIDTH, 3), np.float32)
    lab[..., 1] = color
    return carry_depth(seen, np.full(seen.shape, confidence, np.float32), lab, warp, target)


def test_depths_are_borrowed_from_views_that_show_the_same_colour() -> None:
    truth = plane_depth(MIDDLE)
    everywhere, inner = np.ones(truth.shape, np.bool_), (slice(4, -4), slice(10, -10))
    for carried in ([lend(truth, 0.5), lend(truth, 0.0)], [lend(truth, 0.0)], [lend(truth, 4.0)] * 2):
        depth, mass = agreed_depth(carried, everywhere)
        assert np.abs(depth / truth - 1)[inner].max() < 0.02
        assert mass[inner].min() > 0.5
    for carried in ([lend(truth, 12.0)] * 4, [lend(truth, 0.0, 0.2)] * 4, [lend(truth, 4.0)]):
        assert agreed_depth(carried, everywhere)[1].max() < 0.5
    assert not agreed_depth([lend(truth, 0.0)] * 3, ~everywhere)[1].any()


def test_of_two_carried_depths_the_nearer_hides_the_other() -> None:
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    depth[:, :20] = 1.5
    lab, aside = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.eye(4)
    aside[0, 3] = -0.3
    warp = warps_to(MATRIX, aside, [MATRIX], [np.eye(4)])[0]
    carried, likeness = carry_depth(depth, np.ones_like(depth), lab, warp, lab)
    # Seen from 0.3 to the right, the near board moves right by 10 pixels and the wall by 5.
    np.testing.assert_allclose(carried[:, 25:29], 1.5, rtol=1e-5)
    np.testing.assert_allclose(carried[:, 31:50], 3.0, rtol=1e-5)
    assert set(np.unique(likeness)) <= {0.0, 1.0}


def wall_views() -> tuple[HalfResKeyframe, HalfResKeyframe, list[NDArray], list[NDArray]]:
    """A textured plane with a blank middle, from two cameras: the middle is matched at random and unsure."""
    rng, halves = np.random.default_rng(7), []
    for pose in (MIDDLE, ASIDE):
        depth = plane_depth(pose).astype(np.float32)
        image = rng.integers(90, 150, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        confidence = np.full(depth.shape, 0.8, np.float32)
        blank = np.s_[10:30, 20:44]
        depth[blank] *= rng.uniform(0.5, 1.5, depth[blank].shape)
        confidence[blank], image[blank] = 0.05, 120
        small = image.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3)).astype(np.uint8)
        halves.append(halved(depth, confidence, small, surface_contrast(image[..., 0].astype(np.float32) / 255)))
    there, back = (
        [HALF @ warps_to(MATRIX, a, [MATRIX], [b])[0] @ TWICE] for a, b in ((ASIDE, MIDDLE), (MIDDLE, ASIDE))
    )
    return *halves, there, back


def wall_case() -> CompletionInputs:
    own, aside, there, back = wall_views()
    case = build_inputs(own, [aside], there, back)
    assert case is not None
    return case


def test_a_blank_part_of_a_wall_is_completed_as_a_wall() -> None:
    case, truth = wall_case(), plane_depth(MIDDLE).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean((1, 3))
    depth, expected = complete(case, "cpu")
    blank = ~case.sure
    assert blank.sum() > 100
    error = np.abs(np.log(depth / truth))
    assert error[blank].mean() < 0.3 * np.abs(np.log(case.own.inverse * truth))[blank].mean()
    assert error[blank].max() < 0.1
    assert np.median(expected[blank]) > 1.5 * np.median(expected[~blank])
    np.testing.assert_allclose(
        depth[~blank & ~case.from_other_views], 1 / case.own.inverse[~blank & ~case.from_other_views], rtol=1e-6
    )


def test_half_of_the_unsure_pixels_speak_for_those_of_like_colour_beside_them() -> None:
    rng = np.random.default_rng(2)
    sure, lab = rng.random((20, 31)) < 0.4, rng.uniform(0, 100, (20, 31, 3)).astype(np.float32)
    pixels, speaker = find_speakers(sure, lab)
    unsure = np.flatnonzero(~sure)
    assert len(pixels) < 0.65 * len(unsure)
    assert not sure.ravel()[pixels].any()
    np.testing.assert_array_equal(pixels[speaker[np.isin(unsure, pixels)]], pixels)
    for at, by in zip(unsure, pixels[speaker], strict=True):
        y, x = divmod(int(at), 31)
        beside = [(y + a, x + b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)) if 0 <= y + a < 20 and 0 <= x + b < 31]
        beside = [place for place in beside if not sure[place]]
        if at != by:
            best = min(beside, key=lambda place: float(((lab[place] - lab[y, x]) ** 2).sum()))
            assert divmod(int(by), 31) == best
        else:
            assert (y + x) % 2 == 0 or not beside


def test_keyframes_are_asked_again_once_they_are_completed() -> None:
    own, aside, there, back = wall_views()
    case, other = build_inputs(own, [aside], there, back), build_inputs(aside, [own], back, there)
    assert case is not None
    assert other is not None
    known = completed_keyframe(other, "cpu")
    assert (known.confidence[other.own.confidence < SURE] < SURE).all()
    again = update_view_evidence(case, [known], back)
    np.testing.assert_array_equal(again.evidence[..., :3], case.evidence[..., :3])
    assert again.place is case.place
    weakly_on = 6  # how many views have it there, unsurely
    assert again.evidence[:, 0, weakly_on].mean() > case.evidence[:, 0, weakly_on].mean() + 0.3 / STEP_OF_NUMBERS
    assert (numbers_of(torch.from_numpy(update_view_evidence(case, [], []).evidence[..., 3:])) == 0).all()


def test_with_hardly_any_sure_pixel_there_is_nothing_to_complete_from() -> None:
    own, aside, there, back = wall_views()
    doubtful = HalfResKeyframe(own.inverse, own.confidence * 0.1, own.image, own.lab, own.contrast)
    assert build_inputs(doubtful, [aside], there, back) is None


def test_a_keyframe_without_neighbours_is_completed_from_itself() -> None:
    own = wall_views()[0]
    case = build_inputs(own, [], [], [])
    assert case is not None
    depth, expected = complete(case, "cpu")
    assert np.isfinite(depth).all()
    assert depth.min() > 0
    assert 0 < expected.min() <= expected.max() <= 1


def test_confidence_is_a_view_of_the_expected_error() -> None:
    error = np.geomspace(0.005, 1, 50)
    confidence = confidence_of(error)
    assert (np.diff(confidence) < 0).all()
    assert confidence_of(np.array([0.0, 0.001])).max() == 1
    np.testing.assert_allclose(error_of(confidence), error, rtol=1e-4)


def test_the_middle_of_a_mixture_has_the_least_expected_error() -> None:
    rng = np.random.default_rng(3)
    share = rng.dirichlet(np.full(len(KINDS) + 1, 0.3), 50)
    logs, spread = rng.normal(size=share.shape) * 0.2, rng.uniform(0.01, 0.1, share.shape)
    mixture = Mixture(*(torch.from_numpy(a) for a in (np.log(share + 1e-12), logs, np.log(spread), np.zeros((1, 1)))))
    middle, error = (x.numpy() for x in mixture_median(mixture))
    samples = logs[:, None] + spread[:, None] * rng.laplace(size=(50, 4000, logs.shape[1]))
    for k in range(50):
        drawn = rng.choice(logs.shape[1], 4000, p=share[k])
        seen = samples[k, np.arange(4000), drawn]
        assert error[k] == pytest.approx(np.abs(seen - middle[k]).mean(), rel=0.12, abs=0.004)
        assert error[k] < np.abs(seen - logs[k, 0]).mean() + 0.03


def test_pixels_in_blocks_are_weighed_like_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    given = inputs_of(wall_case())
    whole = load_network().evaluate(given)
    monkeypatch.setattr(rooms_network, "_BLOCK", 17)
    blocks = load_network().evaluate(given)
    for name, values in vars(whole).items():
        torch.testing.assert_close(getattr(blocks, name), values, rtol=1e-4, atol=1e-4, msg=name)


def test_the_network_knows_no_unit_of_depth() -> None:
    own, aside, there, back = wall_views()
    far = [HalfResKeyframe(h.inverse / 8, h.confidence, h.image, h.lab, h.contrast) for h in (own, aside)]
    grown = [w * np.array([1, 1, 1, 8.0]) for w in (there[0], back[0])]
    near, distant = build_inputs(own, [aside], there, back), build_inputs(far[0], [far[1]], [grown[0]], [grown[1]])
    assert near is not None
    assert distant is not None
    for ours, theirs in zip(complete(near, "cpu"), complete(distant, "cpu"), strict=True):
        assert np.median(np.abs(theirs / ours - theirs.mean() / ours.mean())) < 0.01


# learning -------------------------------------------------------------------------------------------------------


def wall_arrays() -> dict[str, NDArray]:
    truth = plane_depth(MIDDLE).reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean((1, 3)).astype(np.float32)
    return example_arrays(wall_case(), truth)


def test_a_mirrored_example_is_as_likely_as_its_mirror_image() -> None:
    example = Example.of(wall_arrays(), "cpu")
    twice = example.mirrored().mirrored()
    for name, values in vars(example.given).items():
        assert values is None or torch.equal(torch.as_tensor(getattr(twice.given, name)), torch.as_tensor(values)), name
    assert torch.equal(twice.sure_error, example.sure_error)
    width, mirrored = example.given.planes.shape[2], example.mirrored().given
    columns = example.given.pixels % width + mirrored.pixels % width
    assert (columns == width - 1).all()


def test_the_truth_becomes_likelier_with_each_step() -> None:
    torch.manual_seed(0)
    network, batch = CompletionNetwork(), [Example.of(wall_arrays(), "cpu")] * 2
    optimizer = torch.optim.AdamW(network.parameters(), 3e-3)
    losses = []
    for _ in range(12):
        optimizer.zero_grad()
        loss = loss_of(network, batch)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-3:]) < np.mean(losses[:3]) - 0.4


def test_learning_goes_on_after_a_pause(tmp_path: Path) -> None:
    torch.manual_seed(0)
    for k in range(8):
        save_arrays(tmp_path / f"3_{k}.npz", wall_arrays(), compress=False)
    examples = Examples(tmp_path, "cpu", fewest=8)
    try:
        first = Fit(CompletionNetwork(), examples, 60.0, 1.0)
        assert not first.run(2.0)
        save_arrays(tmp_path / "paused.npz", first.state())
        again = Fit(CompletionNetwork(), examples, first.done + 1.0, 1.0)
        again.load(load_arrays(tmp_path / "paused.npz"))
        for name, values in again.state().items():
            np.testing.assert_array_equal(values, first.state()[name], err_msg=name)
        assert again.run(np.inf)
    finally:
        examples.close()
