"""Parameters under optimisation, seeding, and the masks of densification."""

import numpy as np
import pytest
import torch

from msgs_slam.pipelines.geometry.camera import project
from msgs_slam.pipelines.mapping import growth as densify
from msgs_slam.pipelines.mapping.growth import complete_depth, fill_smoothly, seed_gaussians, seed_grid, seed_spacing
from msgs_slam.pipelines.mapping.state import KEYS, MapParameters, empty_map
from msgs_slam.pipelines.render.gaussian_map import decided_channels
from msgs_slam.pipelines.types import VOID, Intrinsics

CAMERA = Intrinsics(40, 30, 35.0, 35.0, 20.0, 15.0)


def seeds(count: int = 12, frame_id: int = 3):
    generator = torch.Generator().manual_seed(count)
    pixels = torch.zeros(30, 40, dtype=torch.bool)
    pixels.view(-1)[torch.randperm(1200, generator=generator)[:count]] = True
    depth = 1 + torch.rand(30, 40, generator=generator)
    colors = torch.rand(30, 40, 3, generator=generator)
    channels = torch.full((30, 40), 1, dtype=torch.uint8)
    return (
        seed_gaussians(pixels, depth, colors, channels, 2.0, 3, torch.eye(4).double(), CAMERA, frame_id),
        pixels,
        depth,
    )


def test_moments_stay_with_their_gaussians() -> None:
    parameters = MapParameters.from_map(seeds(12)[0])
    gradients: dict[str, torch.Tensor | None] = {k: torch.ones_like(parameters[k]) for k in KEYS}
    parameters.table.step(gradients, dict.fromkeys(KEYS, 0.1))
    before = {k: (parameters[k].detach().clone(), parameters.table.first[k].clone()) for k in KEYS}
    parameters.append(seeds(5, frame_id=8)[0], torch.full((5,), 0.5))
    assert len(parameters) == 17
    kept = torch.tensor([0, 13, 4])
    parameters.keep(kept)
    assert parameters.anchor_frame_ids.tolist() == [3, 8, 3]
    assert parameters.trust.tolist() == [1.0, 0.5, 1.0]
    for key, (value, moment) in before.items():
        assert torch.equal(parameters[key][[0, 2]], value[[0, 4]])
        assert torch.equal(parameters.table.first[key][[0, 2]], moment[[0, 4]])
        assert parameters.table.first[key][1].abs().max() == 0
        assert parameters[key].requires_grad


def test_snapshot_gives_everything_back() -> None:
    parameters = MapParameters.from_map(seeds()[0])
    parameters.table.step({"means": parameters["means"].detach()}, {"means": 0.1})
    again = MapParameters.from_tensors(parameters.to_tensors())
    tensors, others = parameters.to_tensors(), again.to_tensors()
    assert tensors.keys() == others.keys()
    assert all(torch.equal(tensors[k], others[k]) for k in tensors)


def test_seeds_project_onto_their_pixels() -> None:
    gaussians, pixels, depth = seeds()
    xy, z = project(gaussians.means.double().numpy(), CAMERA)
    rows, columns = np.nonzero(pixels.numpy())
    assert np.abs(xy - np.stack([columns, rows], 1) - 0.5).max() < 1e-4
    assert np.abs(z - depth.numpy()[rows, columns]).max() < 1e-6
    assert torch.allclose(gaussians.radii / torch.from_numpy(z).float() * 35, torch.tensor(2 * 0.7))
    assert (gaussians.class_logits.argmax(1) == 1).all()


def test_a_void_pixel_seeds_no_class() -> None:
    pixels, depth = torch.ones(30, 40, dtype=torch.bool), torch.ones(30, 40)
    channels = torch.full((30, 40), VOID, dtype=torch.uint8)
    gaussians = seed_gaussians(
        pixels, depth, torch.zeros(30, 40, 3), channels, 1.0, 3, torch.eye(4).double(), CAMERA, 0
    )
    assert gaussians.class_logits.shape == (1200, 3)
    assert gaussians.class_logits.abs().max() == 0
    assert len(empty_map(4)) == 0


def slanted() -> np.ndarray:
    y, x = np.mgrid[:60, :80]
    return (1 / (0.4 + 0.002 * x + 0.001 * y)).astype(np.float32)


def test_unknown_depth_is_filled_and_not_trusted() -> None:
    truth = slanted()
    depth = truth.copy()
    depth[25:35, 35:50] = 0
    completed, trust = complete_depth(depth, np.ones_like(depth))
    hole = depth == 0
    assert trust[hole].max() == 0
    assert 0 < np.abs(completed / truth - 1)[hole].max() < 0.1
    assert complete_depth(depth * 0, depth * 0)[0].max() == 0


def test_fill_keeps_a_constant_and_the_range() -> None:
    values = np.zeros((33, 47), np.float32)
    values[::9, ::11] = 3.0
    filled = fill_smoothly(values, np.ones_like(values))
    assert np.abs(filled - 3).max() < 1e-3


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_grid_spacing(stride: int) -> None:
    grid = seed_grid(30, 41, stride)
    assert grid.sum() == len(range(stride // 2, 30, stride)) * len(range(stride // 2, 41, stride))


def test_seeds_stand_close_where_there_is_detail_and_far_apart_where_there_is_none() -> None:
    rng = np.random.default_rng(0)
    image = np.full((64, 96, 3), 128, np.uint8)
    image[:, :24] = rng.integers(0, 255, (64, 24, 3))
    image[:, 24:56] += np.arange(32, dtype=np.uint8)[None, :, None]
    depth = np.full((64, 96), 2.0, np.float32)
    depth[40:, 60:] = 3.0
    spacing = seed_spacing(image, depth, 2, fine_share=0.3, flat_share=0.35)
    assert (spacing[:, 2:18] == 1).all()
    assert set(np.unique(spacing[:, 30:52])) == {0, 2}
    assert set(np.unique(spacing[4:32, 64:92])) == {0, 4}
    assert (spacing[4:32, 64:92] == 4).sum() == 7 * 7
    # Beside a depth step the seeds stay close, however even the colour.
    assert (spacing[38:42, 64:92] == 2).any()
    # Every pixel is covered once: the squares of the seeds add up to the picture.
    assert (spacing**2).sum() == spacing.size
    assert np.array_equal(seed_spacing(image, depth, 2, 0.0, 0.0) > 0, seed_grid(64, 96, 2))


def test_conditions_of_densification() -> None:
    rendered, proxy = torch.tensor([2.0, 2.0, 2.0, 2.0]), torch.tensor([1.0, 3.0, 0.0, 1.7])
    trust = torch.tensor([1.0, 1.0, 1.0, 0.1])
    assert densify.hidden_surfaces(rendered, proxy, trust).tolist() == [True, False, False, False]


def test_useless_gaussians() -> None:
    gaussians, _, _ = seeds(4)
    gaussians.opacity_logits[0] = -9
    gaussians.log_radii[1] = 3
    gaussians.means[2, 0] = float("nan")
    assert densify.useless(gaussians, 0.02, 1.0).tolist() == [True, True, True, False]


def test_what_no_label_has_spoken_for_has_no_class() -> None:
    logits = torch.tensor([[3.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.5, -0.1], [-2.0, 1.5, 1.4]])
    assert decided_channels(logits).tolist() == [0, -1, -1, 1]
    assert decided_channels(torch.zeros(2, 0)).tolist() == [-1, -1]
