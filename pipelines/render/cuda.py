"""The renderer on NVIDIA cards, by Triton, which comes with torch's CUDA builds.

Gradients are summed by atomic additions: their last bits may differ from run to run.
"""

from typing import Any

import torch
from torch import Tensor

from ..compute import gpu
from . import reference
from .cuda_kernels import backward_tile, divide_back_pixels, divide_pixels, forward_tile, inspect_tile
from .cuda_projection import project, record
from .cuda_tiles import TILE, list_tiles

__all__ = ["composite", "composite_records", "depth_ratio", "inspect", "inspect_records", "list_tiles", "project"]

STEP = 16
_BLOCK = 1024


def composite(
    u: Tensor,
    v: Tensor,
    sigma_px: Tensor,
    z: Tensor,
    opacity: Tensor,
    features: Tensor,
    width: int,
    height: int,
    near: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of tensors on one GPU."""
    records = record((u, v, sigma_px, z, opacity), width, height, near)
    return composite_records(records, features, width, height)


def composite_records(
    records: Tensor,
    features: Tensor,
    width: int,
    height: int,
    tiles: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same of the Gaussians' records (M, 6); `tiles`: what `list_tiles` says of them, where that is known."""
    if features.dtype != torch.float32:
        raise ValueError(f"the cuda backend renders float32, got {features.dtype}")
    return _Composite.apply(records, features, width, height, tiles)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Median depth (H, W), and summed and largest blending weight of each Gaussian, (M,) each, of float32 tensors on
    one card. In the sums a pixel counts as counts (H, W) says, as 1 where None."""
    return inspect_records(record((u, v, sigma_px, z, opacity), width, height, near), width, height, counts)


def inspect_records(
    records: Tensor, width: int, height: int, counts: Tensor | None, tiles: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The same of the Gaussians' records (M, 6)."""
    records = records.detach()
    starts, members = tiles or list_tiles(records, width, height)
    counted = records if counts is None else counts.to(records).contiguous()
    median, weights = records.new_empty(height, width), records.new_zeros(2, len(records))
    settings = {key: value for key, value in _settings(1).items() if key != "PADDED"}
    gpu.launch(
        inspect_tile, len(starts) - 1, starts, members, records, counted, median, *weights.unbind(0), width, height,
        COUNTED=counts is not None, **settings,
    )  # fmt: skip
    return median, weights[0], weights[1]


def depth_ratio(depth_sum: Tensor, depth_silhouette: Tensor) -> Tensor:
    """Divide sums as `api.depth_ratio`, of tensors on one GPU."""
    return _Ratio.apply(depth_sum, depth_silhouette)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        records, features = (x.detach().contiguous() for x in arguments[:2])
        width, height, tiles = arguments[2:]
        starts, members = tiles or list_tiles(records, width, height)
        image = features.new_empty(height, width, features.shape[1])
        planes = [features.new_empty(height, width) for _ in range(3)]
        inputs = (starts, members, records, features)
        settings = _settings(features.shape[1])
        size = (width, height, features.shape[1])
        gpu.launch(forward_tile, len(starts) - 1, *inputs, image, *planes, *size, **settings)
        ctx.save_for_backward(*inputs, image, *planes)
        ctx.size, ctx.settings = size, settings
        ctx.set_materialize_grads(False)
        return (image, *planes)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        inputs, images = saved[:4], saved[4:]
        starts, _, records, features = inputs
        upstream = [
            torch.zeros_like(image) if gradient is None else gradient.contiguous()
            for image, gradient in zip(images, gradients, strict=True)
        ]
        results = features.new_zeros(records.numel() + features.numel()).split([records.numel(), features.numel()])
        given = (*results, *ctx.size)
        gpu.launch(backward_tile, len(starts) - 1, *inputs, *images, *upstream, *given, **ctx.settings)
        return results[0].view_as(records), results[1].view_as(features), *[None] * 3


class _Ratio(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Tensor) -> Tensor:
        above, below = (x.detach().contiguous() for x in arguments)
        depth = torch.empty_like(above)
        gpu.launch(
            divide_pixels, -(-depth.numel() // _BLOCK), above, below, depth, depth.numel(), BLOCK=_BLOCK
        )  # fmt: skip
        ctx.save_for_backward(depth, below)
        return depth

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        depth, below = ctx.saved_tensors
        pulls = (gradients[0].contiguous(), torch.empty_like(depth), torch.empty_like(depth))
        gpu.launch(
            divide_back_pixels, -(-depth.numel() // _BLOCK), depth, below, *pulls, depth.numel(), BLOCK=_BLOCK
        )  # fmt: skip
        return pulls[1], pulls[2]


def _settings(channels: int) -> dict[str, Any]:
    """Compile-time numbers; matrix products want powers of two, at least 16."""
    padded = max(16, 1 << (channels - 1).bit_length())
    return {
        "PADDED": padded,
        "STEP": STEP,
        "TILE": TILE,
        "ALPHA_MAX": reference.ALPHA_MAX,
        "LIGHT_MIN": reference.TRANSMITTANCE_MIN,
        "num_warps": 8,
    }
