"""World Gaussians to an image's records on NVIDIA cards: one kernel there, one back.

A record is what the other kernels read of a Gaussian: u, v, sigma_px, z, opacity and its reach in pixels, 0 where it is
not in the image. Gradients of the pose are summed by atomic additions: their last bits may differ from run to run.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..system import gpu
from ..types import Intrinsics
from . import rules

RECORD = 6
"""Numbers of a record."""
_BLOCK = 256
"""Gaussians of a program."""


def project(
    means: Tensor, radii: Tensor, opacities: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float
) -> Tensor:
    """(M, RECORD) records of float32 Gaussians seen from cam_from_world (4, 4) on the same card; differentiable in the
    first four."""
    return _Projected.apply(means, radii, opacities, cam_from_world, intrinsics, near)


def record(geometry: tuple[Tensor, ...], width: int, height: int, near: float) -> Tensor:
    """(M, RECORD) records of Gaussians that are projected already: u, v, sigma_px, z, opacity; differentiable."""
    return _Recorded.apply(width, height, near, *geometry)


def mark_in_view(means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float) -> Tensor:
    """(M,) bool: what `api.in_view` lists."""
    marks = torch.empty(len(means), dtype=torch.bool, device=means.device)
    given = (means.detach().contiguous(), radii.detach().contiguous(), cam_from_world.detach().contiguous())
    _run(mark_rows, len(means), *given, marks.view(torch.uint8), *_camera(intrinsics, near), **_CUT)
    return marks


_CUT = {"CUT_SIGMAS": rules.CUT_SIGMAS}


def _camera(k: Intrinsics, near: float) -> tuple[float, ...]:
    return float(k.fx), float(k.fy), float(k.cx), float(k.cy), (k.fx * k.fy) ** 0.5, k.width, k.height, float(near)


def _run(kernel: Any, count: int, *arguments: Any, **settings: Any) -> None:
    gpu.launch(kernel, -(-count // _BLOCK), *arguments, count, BLOCK=_BLOCK, **settings)


class _Projected(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        means, radii, opacities, pose = (x.detach().contiguous() for x in arguments[:4])
        ctx.camera = _camera(*arguments[4:])
        records = means.new_empty(len(means), RECORD)
        given = (means, radii, opacities, pose, records)
        _run(project_rows, len(means), *given, *ctx.camera, ALPHA_MIN=rules.ALPHA_MIN, **_CUT)
        ctx.save_for_backward(means, radii, pose)
        return records

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, radii, pose = ctx.saved_tensors
        pull, moves = gradients[0].contiguous(), ctx.needs_input_grad[3]
        d_means, d_radii = torch.empty_like(means), torch.empty_like(radii)
        d_pose = torch.zeros_like(pose) if moves else pose
        given = (means, radii, pose, pull, d_means, d_radii, d_pose)
        _run(back_project_rows, len(means), *given, *ctx.camera, MOVES=moves)
        return d_means, d_radii, pull[:, 4], d_pose if moves else None, None, None


class _Recorded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, width: int, height: int, near: float, *geometry: Tensor) -> Tensor:
        given = [x.detach().contiguous() for x in geometry]
        records = given[0].new_empty(len(given[0]), RECORD)
        _run(
            record_rows, len(records), *given, records, width, height, near, ALPHA_MIN=rules.ALPHA_MIN, **_CUT
        )  # fmt: skip
        return records

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, None, *gradients[0].t().contiguous().unbind(0)[:5]


@triton.jit
def in_camera(
    means: tl.tensor, pose: tl.tensor, row: tl.tensor, inside: tl.tensor
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor, tl.tensor, tl.tensor]:
    """World and camera coordinates of some Gaussians' centres."""
    a = tl.load(means + row * 3, mask=inside, other=0.0)
    b = tl.load(means + row * 3 + 1, mask=inside, other=0.0)
    c = tl.load(means + row * 3 + 2, mask=inside, other=0.0)
    x = tl.load(pose) * a + tl.load(pose + 1) * b + tl.load(pose + 2) * c + tl.load(pose + 3)
    y = tl.load(pose + 4) * a + tl.load(pose + 5) * b + tl.load(pose + 6) * c + tl.load(pose + 7)
    z = tl.load(pose + 8) * a + tl.load(pose + 9) * b + tl.load(pose + 10) * c + tl.load(pose + 11)
    return a, b, c, x, y, z


@triton.jit
def on_image(
    x: tl.tensor, y: tl.tensor, z: tl.tensor, radius: tl.tensor, fx: tl.tensor, fy: tl.tensor, cx: tl.tensor,
    cy: tl.tensor, focal: tl.tensor, near: tl.tensor,
) -> tuple[tl.tensor, tl.tensor, tl.tensor, tl.tensor]:  # fmt: skip
    """u, v and sigma_px, and the inverse depth, 1 where a centre is too near."""
    inverse = 1.0 / tl.where(z > near, z, 1.0)
    return fx * (x * inverse) + cx, fy * (y * inverse) + cy, focal * (radius * inverse), inverse


@triton.jit
def store_record(
    records: tl.tensor, row: tl.tensor, inside: tl.tensor, u: tl.tensor, v: tl.tensor, sigma: tl.tensor, z: tl.tensor,
    opacity: tl.tensor, width: tl.tensor, height: tl.tensor, near: tl.tensor,
    ALPHA_MIN: tl.constexpr, CUT_SIGMAS: tl.constexpr,
) -> None:  # fmt: skip
    """Store them with their reaches; see `rules`."""
    reach2 = tl.minimum(2.0 * tl.log(tl.maximum(opacity / ALPHA_MIN, 1.0)), CUT_SIGMAS * CUT_SIGMAS)
    reach = tl.maximum(sigma, 0.0) * tl.sqrt(reach2)
    seen = (z > near) & (u + reach >= 0.5) & (u - reach <= width - 0.5)
    seen = seen & (v + reach >= 0.5) & (v - reach <= height - 0.5)
    at = records + row * 6
    tl.store(at, u, mask=inside)
    tl.store(at + 1, v, mask=inside)
    tl.store(at + 2, sigma, mask=inside)
    tl.store(at + 3, z, mask=inside)
    tl.store(at + 4, opacity, mask=inside)
    tl.store(at + 5, tl.where(seen, reach, 0.0), mask=inside)


@triton.jit
def project_rows(
    means: tl.tensor, radii: tl.tensor, opacities: tl.tensor, pose: tl.tensor, records: tl.tensor,
    fx: tl.tensor, fy: tl.tensor, cx: tl.tensor, cy: tl.tensor, focal: tl.tensor, width: tl.tensor, height: tl.tensor,
    near: tl.tensor, count: tl.tensor, ALPHA_MIN: tl.constexpr, CUT_SIGMAS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Records of a block of world Gaussians."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    _, _, _, x, y, z = in_camera(means, pose, row, inside)
    radius = tl.load(radii + row, mask=inside, other=0.0)
    u, v, sigma, _ = on_image(x, y, z, radius, fx, fy, cx, cy, focal, near)
    opacity = tl.load(opacities + row, mask=inside, other=0.0)
    store_record(records, row, inside, u, v, sigma, z, opacity, width, height, near, ALPHA_MIN, CUT_SIGMAS)


@triton.jit
def record_rows(
    us: tl.tensor, vs: tl.tensor, sigmas: tl.tensor, zs: tl.tensor, opacities: tl.tensor, records: tl.tensor,
    width: tl.tensor, height: tl.tensor, near: tl.tensor, count: tl.tensor,
    ALPHA_MIN: tl.constexpr, CUT_SIGMAS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Records of a block of Gaussians that are projected already."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    u, v = tl.load(us + row, mask=inside, other=0.0), tl.load(vs + row, mask=inside, other=0.0)
    sigma, z = tl.load(sigmas + row, mask=inside, other=0.0), tl.load(zs + row, mask=inside, other=0.0)
    opacity = tl.load(opacities + row, mask=inside, other=0.0)
    store_record(records, row, inside, u, v, sigma, z, opacity, width, height, near, ALPHA_MIN, CUT_SIGMAS)


@triton.jit
def mark_rows(
    means: tl.tensor, radii: tl.tensor, pose: tl.tensor, marks: tl.tensor,
    fx: tl.tensor, fy: tl.tensor, cx: tl.tensor, cy: tl.tensor, focal: tl.tensor, width: tl.tensor, height: tl.tensor,
    near: tl.tensor, count: tl.tensor, CUT_SIGMAS: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """1 for the Gaussians whose square reaches the image, a pixel to spare, else 0."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    _, _, _, x, y, z = in_camera(means, pose, row, inside)
    radius = tl.load(radii + row, mask=inside, other=0.0)
    u, v, sigma, _ = on_image(x, y, z, radius, fx, fy, cx, cy, focal, near)
    reach = CUT_SIGMAS * sigma + 1.0
    seen = (z > near) & (u > -reach) & (u < width + reach) & (v > -reach) & (v < height + reach)
    tl.store(marks + row, seen.to(tl.uint8), mask=inside)


@triton.jit
def back_project_rows(
    means: tl.tensor, radii: tl.tensor, pose: tl.tensor, pull: tl.tensor, d_means: tl.tensor, d_radii: tl.tensor,
    d_pose: tl.tensor,
    fx: tl.tensor, fy: tl.tensor, cx: tl.tensor, cy: tl.tensor, focal: tl.tensor, width: tl.tensor, height: tl.tensor,
    near: tl.tensor, count: tl.tensor, MOVES: tl.constexpr, BLOCK: tl.constexpr,
) -> None:  # fmt: skip
    """Gradients of a block of centres and radii by those of their records; with MOVES adds that of the pose."""
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = row < count
    a, b, c, x, y, z = in_camera(means, pose, row, inside)
    radius = tl.load(radii + row, mask=inside, other=0.0)
    _, _, _, inverse = on_image(x, y, z, radius, fx, fy, cx, cy, focal, near)
    at = pull + row * 6
    by_u = fx * tl.load(at, mask=inside, other=0.0)
    by_v = fy * tl.load(at + 1, mask=inside, other=0.0)
    by_sigma = focal * tl.load(at + 2, mask=inside, other=0.0)
    by_inverse = by_u * x + by_v * y + by_sigma * radius
    d_x, d_y = by_u * inverse, by_v * inverse
    d_z = tl.load(at + 3, mask=inside, other=0.0) - tl.where(z > near, by_inverse * inverse * inverse, 0.0)
    tl.store(d_radii + row, by_sigma * inverse, mask=inside)
    for k in tl.static_range(3):
        turned = tl.load(pose + k) * d_x + tl.load(pose + 4 + k) * d_y + tl.load(pose + 8 + k) * d_z
        tl.store(d_means + row * 3 + k, turned, mask=inside)
    if MOVES:
        add_to_row(d_pose, d_x, a, b, c)
        add_to_row(d_pose + 4, d_y, a, b, c)
        add_to_row(d_pose + 8, d_z, a, b, c)


@triton.jit
def add_to_row(target: tl.tensor, pulled: tl.tensor, a: tl.tensor, b: tl.tensor, c: tl.tensor) -> None:
    """Add a block's sums to a row of the pose's gradient."""
    tl.atomic_add(target, tl.sum(pulled * a, axis=0))
    tl.atomic_add(target + 1, tl.sum(pulled * b, axis=0))
    tl.atomic_add(target + 2, tl.sum(pulled * c, axis=0))
    tl.atomic_add(target + 3, tl.sum(pulled, axis=0))
