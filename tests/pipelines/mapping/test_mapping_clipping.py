"""Clipping beside boundaries, and the symmetry terms."""

import numpy as np
import torch

from msgs_slam.pipelines.mapping.paper.boundary_clip import beside_boundary, clip_beside_boundary
from msgs_slam.pipelines.mapping.paper.mirrors import Mirrors, at, label_symmetry_loss, symmetry_loss
from msgs_slam.pipelines.types import VOID, Intrinsics, MirrorPairs


def halves() -> torch.Tensor:
    channels = torch.zeros(6, 8, dtype=torch.uint8)
    channels[:, 4:] = 1
    channels[4:, :] = VOID
    return channels


def test_boundaries_lie_between_classes_and_not_at_void() -> None:
    near = beside_boundary(halves())
    assert near[:4, 3:5].all()
    assert not near[:, :3].any()
    assert not near[:, 5:].any()


def test_large_gradients_are_clipped_beside_boundaries_only() -> None:
    image = torch.zeros(6, 8, 2, requires_grad=True)
    clip_beside_boundary(image, halves(), 1.0)
    upstream = torch.ones(6, 8, 2)
    upstream[1, 3], upstream[1, 0] = 50.0, 50.0
    (image * upstream).sum().backward()
    assert image.grad is not None
    mean = upstream.norm(dim=-1).mean()
    assert torch.allclose(image.grad[1, 3].norm(), mean)
    assert torch.equal(image.grad[1, 0], upstream[1, 0])
    assert torch.equal(image.grad[2, 3], upstream[2, 3])


def pairs() -> Mirrors:
    found = MirrorPairs(
        np.array([[1.5, 2.5, 6.5, 2.5], [2.5, 3.5, 5.5, 3.5]], np.float32),
        np.array([1.0, 0.5], np.float32),
        np.array([1.0, 1.0], np.float32),
        np.array([0.2, 0.2], np.float32),
    )
    full = Intrinsics(8, 6, 8.0, 8.0, 4.0, 3.0)
    return Mirrors.of(found, full, full, "cpu")


def test_symmetry_pulls_the_halves_to_what_they_say_of_each_other() -> None:
    mirrors = pairs()
    assert mirrors.first.tolist() == [[2, 1], [3, 2]]
    depth = torch.full((6, 8), 2.0)
    depth[:, 4:] = 2.2
    assert symmetry_loss(depth, mirrors, 1.0) < 1e-6
    depth[2, 6] = 2.6
    assert torch.allclose(symmetry_loss(depth, mirrors, 2.0), torch.tensor(0.4 / 2 / 2))
    logits = torch.zeros(6, 8, 3)
    assert label_symmetry_loss(logits, mirrors) == 0
    logits[2, 1, 0], logits[2, 6, 1] = 20.0, 20.0
    assert torch.allclose(label_symmetry_loss(logits, mirrors), torch.tensor(0.5), atol=1e-4)


def test_pairs_follow_the_scale_and_the_size_of_the_view() -> None:
    mirrors, field = pairs(), torch.ones(6, 8)
    field[:, 4:] = 3.0
    scaled = mirrors.scaled(field)
    depth = torch.full((6, 8), 2.0)
    depth[:, 4:] = 2.2
    assert symmetry_loss(depth * field, scaled, 1.0) < 1e-6
    half = mirrors.halved(3, 4)
    assert half.second.tolist() == [[1, 3], [1, 2]]
    assert at(depth, mirrors.second).tolist() == [depth[2, 6].item()] * 2
