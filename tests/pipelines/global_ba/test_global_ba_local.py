"""MSGS-SLAM eq. (25): poses at a loop's ends by labels and depth, the map held."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.gaussian_map import GaussianMap
from msgs_slam.pipelines.gaussians.render import render
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.global_ba.local import adjusted_poses, loop_keyframes
from msgs_slam.pipelines.global_ba.verify import Loop
from msgs_slam.pipelines.mapping.views import View, make_view
from msgs_slam.pipelines.tracking.state import NO_SIGHTINGS
from msgs_slam.pipelines.types import Intrinsics, LoopEdge, ProxyMaps

CAMERA = Intrinsics(160, 120, 140.0, 140.0, 80.0, 60.0)
OFF = se3.exp(np.array([0.02, -0.015, 0.02, 0.004, 0.006, -0.003]))


@pytest.fixture(scope="module")
def steps() -> GaussianMap:
    """A wall of steps, each of nine squares a class of its own."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-1.6, 1.6, 130), np.linspace(-1.2, 1.2, 100)))
    square = (np.digitize(x, (-0.5, 0.5)) + 3 * np.digitize(y, (-0.4, 0.4))).astype(np.int64)
    z = 2 + 0.15 * (square * 7 % 5)
    return GaussianMap(
        torch.tensor(np.stack([x, y, z], 1), dtype=torch.float32),
        torch.full((len(x),), float(np.log(0.018))),
        torch.full((len(x),), 3.0),
        torch.rand(len(x), 3, generator=torch.Generator().manual_seed(0)),
        4 * torch.nn.functional.one_hot(torch.tensor(square), 9).float(),
        torch.zeros(len(x), dtype=torch.int64),
    )


def seen(gaussian_map: GaussianMap, frame_id: int, believed: np.ndarray) -> View:
    """What a camera at the origin sees of the map, said to stand at `believed`."""
    m = gaussian_map
    shown = render(m.means, m.radii, m.opacities, m.class_logits, torch.eye(4).double(), CAMERA)
    sure = np.ones((120, 160), np.float32)
    maps = ProxyMaps(shown.depth.numpy(), sure, shown.features.argmax(-1).numpy().astype(np.uint8), sure)
    image = np.zeros((120, 160, 3), np.uint8)
    return make_view(frame_id, CAMERA, believed, image, maps, tuple(range(9)))


def error(pose: np.ndarray) -> tuple[float, float]:
    """Pixels by which the camera looks astray at two metres."""
    return float(np.linalg.norm(pose[:3, 3])) / 2 * 140, float(se3.rotation_angle(pose)) * 140


def test_poses_come_nearer_and_true_ones_stay(steps: GaussianMap) -> None:
    views = [seen(steps, 7, OFF), seen(steps, 9, np.eye(4))]
    found = adjusted_poses(views, steps, MappingConfig(), 60)
    before, after = np.array(error(OFF)), np.array(error(found[7]))
    assert (after > 0).all()
    assert (after < 0.6 * before).all(), (before, after)
    assert max(error(found[9])) < 0.3


def test_a_depth_that_contradicts_the_map_everywhere_moves_little(steps: GaussianMap) -> None:
    view = seen(steps, 7, np.eye(4))
    wrong = replace(view, reliability=torch.zeros_like(view.reliability), channel_confidence=view.reliability * 0)
    assert max(error(adjusted_poses([wrong], steps, MappingConfig(), 20)[7])) < 1e-6


def test_loop_keyframes_are_those_around_both_ends() -> None:
    edge = LoopEdge(4, 40, np.eye(4), 1.0, 30)
    loop = Loop(edge, NO_SIGHTINGS, NO_SIGHTINGS)
    assert loop_keyframes([loop], [0, 2, 4, 6, 8, 20, 30, 38, 40]) == {0, 2, 4, 6, 8, 30, 38, 40}
    assert loop_keyframes([], [0, 2]) == set()
