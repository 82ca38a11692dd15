"""Clipping beside boundaries."""

import torch

from msgs_slam.pipelines.mapping.paper.boundary_clip import beside_boundary, clip_beside_boundary
from msgs_slam.pipelines.types import VOID


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
