"""Stereo by Triton's kernels against the same compiled for a CPU: on a card, else in Triton's interpreter."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

ON_CARD = torch.cuda.is_available()
if not ON_CARD:
    os.environ["TRITON_INTERPRET"] = "1"  # read when triton is imported and again when the kernels are
pytest.importorskip("triton", minversion="3.3", reason="needs triton >= 3.3: pip install '.[cuda-check]'")

from test_proxy_stereo import CAMERAS, MATRIX, scene, view_of_plane  # noqa: E402

from msgs_slam.pipelines.depth.stereo import cuda, matching  # noqa: E402
from msgs_slam.pipelines.depth.stereo.consistency import fuse_depths  # noqa: E402
from msgs_slam.pipelines.depth.stereo.sweep import (  # noqa: E402
    refine_inverse_depth,
    sweep_cost,
    warps_to,
)
from msgs_slam.pipelines.depth.stereo.volume import (  # noqa: E402
    TILE,
    UNREACHED,
    Bands,
    pick_planes,
    smooth_cost,
)
from msgs_slam.pipelines.system import gpu  # noqa: E402
from tests.card_builds import build  # noqa: E402
from tests.dense_volumes import of_dense, to_dense  # noqa: E402

DEVICE = "cuda" if ON_CARD else "cpu"
PLANES = np.linspace(1 / 4, 1 / 1.2, 19)
BANDS = Bands(1)
ROWS, COLUMNS = 14, 24


@pytest.fixture(scope="module")
def pictures() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A slanted plane from five places, some of it: the interpreter is slow; one shows no scene in a corner."""
    image, others, warps, _ = scene(0.3)
    others[1, :4, :6] = np.nan
    return image[:ROWS, :COLUMNS].copy(), others[:, :ROWS, :COLUMNS].copy(), warps


@pytest.fixture(scope="module")
def on_card(pictures: tuple[np.ndarray, np.ndarray, np.ndarray]) -> cuda.CudaMatcher:
    image, others, warps = pictures
    return cuda.CudaMatcher(
        *(torch.from_numpy(np.float32(x)).to(DEVICE) for x in (image, others, warps.reshape(-1, 12)))
    )


def test_the_sweep_has_the_costs_of_the_cpu(pictures: tuple, on_card: cuda.CudaMatcher) -> None:
    found = on_card.cost(PLANES).cpu().numpy()
    expected = to_dense(sweep_cost(*pictures, PLANES, matching.best_count(len(pictures[1])), BANDS))
    assert found.shape == expected.shape
    assert expected.std() > 0.1
    # Where the rim of a view, or of what is no scene, runs through a pixel, rounding decides whether it is seen.
    assert (np.abs(found - expected) > 1e-3).mean() < 5e-3


def test_paths_are_smoothed_as_on_the_cpu(pictures: tuple, on_card: cuda.CudaMatcher) -> None:
    cost = np.random.default_rng(1).random((*pictures[0].shape, 19)).astype(np.float32)
    found = on_card.smoothed(torch.from_numpy(cost).to(DEVICE), matching.SMALL_STEP).cpu().numpy()
    dense = of_dense(cost)
    expected = to_dense(smooth_cost(dense, pictures[0], matching.SMALL_STEP, matching.JUMP, matching.EDGE, BANDS))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_planes_that_are_not_tried_are_left_out_as_on_the_cpu(pictures: tuple, on_card: cuda.CudaMatcher) -> None:
    cost = np.random.default_rng(1).random((*pictures[0].shape, 19)).astype(np.float32)
    tried = np.zeros((1, 2, 19), np.bool_)
    tried[0, 0, [2, 3, 6]], tried[0, 1, 9:14] = True, True
    left = cuda.leave_out(torch.from_numpy(cost).to(DEVICE), tried)
    there = of_dense(np.where(tried.repeat(TILE, 0)[:ROWS].repeat(TILE, 1)[:, :COLUMNS], cost, UNREACHED))
    expected = smooth_cost(there, pictures[0], matching.SMALL_STEP, matching.JUMP, matching.EDGE, BANDS)
    found = on_card.best_planes(on_card.smoothed(left, matching.SMALL_STEP), PLANES).cpu().numpy()
    planes = PLANES[0] + pick_planes(expected) * (PLANES[1] - PLANES[0])
    np.testing.assert_allclose(found, planes, atol=1e-4)
    assert (to_dense(expected)[:, :16, [*range(2), 4, 5, *range(7, 19)]] == UNREACHED).all()
    assert (to_dense(expected)[:, :16, [2, 3, 6]] < UNREACHED).all()


def test_the_refinement_and_the_filter_are_those_of_the_cpu(pictures: tuple, on_card: cuda.CudaMatcher) -> None:
    inverse = (0.45 + 0.05 * np.random.default_rng(2).random(pictures[0].shape)).astype(np.float32)
    there = torch.from_numpy(inverse).to(DEVICE)
    expected = refine_inverse_depth(
        *pictures, inverse, 0.01, matching.REACH, matching.STIFFNESS, matching.best_count(len(pictures[1])), BANDS
    )
    found = on_card.refined(there, 0.01).cpu().numpy()
    assert np.abs(expected - inverse).max() > 0.005
    assert (np.abs(found - expected) > 1e-4).mean() < 0.01
    soft = cv2.bilateralFilter(inverse, matching.SOFT_SIZE, 0.03, matching.SOFT_PLACE)
    np.testing.assert_allclose(on_card.soften(there, 0.03).cpu().numpy(), soft, atol=1e-4)
    assert np.abs(soft - inverse).max() > 0.01


@pytest.mark.parametrize("large", [5, 200])
def test_the_whole_match_finds_the_plane(pictures: tuple, monkeypatch: pytest.MonkeyPatch, large: int) -> None:
    """At two sizes, and at three."""
    monkeypatch.setattr(matching, "LARGE", large)
    found = cuda.match_planes(matching.StereoImages(*pictures), PLANES, DEVICE)
    expected = matching.match_planes(matching.StereoImages(*pictures), PLANES, BANDS)
    truth = 1 / view_of_plane(np.eye(4), 0.3)[1][:ROWS, :COLUMNS]
    assert np.median(np.abs(found - truth)) < 0.5 * (PLANES[1] - PLANES[0])
    assert (np.abs(found - expected) > 1e-3).mean() < 0.02


def test_depths_are_fused_as_on_the_cpu() -> None:
    """With depths that agree, that are seen through, that are unknown, and an edge between two surfaces."""
    depth = view_of_plane(np.eye(4), 0.3)[1].astype(np.float32)
    rng = np.random.default_rng(3)
    # A little aside: no place of a pixel falls just between two others, where rounding decides which is the nearest.
    aside = np.eye(4)
    aside[:3, 3] = 0.0031, 0.0017, 0.0023
    cameras = [aside @ c for c in CAMERAS]
    others = np.stack([view_of_plane(c, 0.3)[1] for c in cameras]) * (1 + 0.01 * rng.standard_normal((4, 1, 1)))
    others = (others * np.where(rng.random(others.shape) < 0.05, 1.3, 1.0)).astype(np.float32)
    others[2, :, 30:] *= 1.5
    depth[:4], others[0, 20:25] = 0, 0
    warps = warps_to(MATRIX, np.eye(4), [MATRIX] * 4, cameras)
    back = np.array([warps_to(MATRIX, c, [MATRIX], [np.eye(4)])[0][2] for c in cameras])
    found = cuda.fuse_depths(depth, others, warps, back, 0.01, DEVICE)
    expected = fuse_depths(depth, others, warps, back, 0.01, BANDS)
    for mine, theirs in zip(found, expected, strict=True):
        assert theirs.max() > 0.5
        assert (np.abs(mine - theirs) > 1e-4).mean() < 2e-3


def test_a_keyframe_asks_for_few_launches(pictures: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    launched, right = [], gpu.launch
    monkeypatch.setattr(gpu, "launch", lambda kernel, *a, **k: launched.append(kernel) or right(kernel, *a, **k))
    small = matching.StereoImages(pictures[0][:6, :8].copy(), pictures[1][:, :6, :8].copy(), pictures[2])
    cuda.match_planes(small, PLANES[:4], DEVICE)
    assert len(launched) == (8 + 2) + (8 + 5)


@pytest.mark.skipif(ON_CARD, reason="the tests above compile and run the kernels")
def test_the_kernels_compile_for_cards(tmp_path: Path) -> None:
    names = ["sweep_pixels", "refine_pixels", "scan_paths", "pick_pixels", "soften_pixels", "fuse_pixels"]
    constants = {"BEST": 3, "VIEWS": 8, "FLOOR": 2e-5, "OUTSIDE": -2.0, "SIDE": 4, "STEP": 2, "RADIUS": 3, "BLOCK": 64}
    constants |= {"REACH": 2, "MOVES": 8, "PLANES": 128, "TOLERANCE": 0.01, "UNREACHED": 1e9}
    numbers = ("views", "count", "width", "height", "down", "across", "pixels")
    floats = ("narrow", "step", "stiffness", "small", "large", "edge", "nearest", "by_value", "by_place")
    kinds = dict.fromkeys(numbers, "i32") | dict.fromkeys(floats, "fp32") | {"starts": "*i32"}
    build({"depth.stereo.cuda_kernels": names[:-1]}, constants, kinds, tmp_path)
    double = {"warps": "*fp64", "backs": "*fp64"}
    build({"depth.stereo.cuda_kernels": names[-1:]}, constants, kinds | double, tmp_path)
