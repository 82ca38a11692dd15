"""Stereo on a GPU: `match_planes` and `fuse_depths` by kernels of Triton. Arrays come from the host and go back; what
lies between stays there."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...system import gpu
from . import matching as rules
from .sweep import ALIKE
from .volume import DIRECTIONS, TILE, UNREACHED, path_starts
from .window import LIKENESS, OUTSIDE, RADIUS, SIDE, STEP, VARIANCE_FLOOR

Array = NDArray[np.float32]
_BLOCK = 64
"""Pixels of a program; windows multiply them by sixteen."""


def takes_kernels_on(device: str) -> bool:
    """Whether there is a GPU that runs them."""
    return gpu.supports_triton(torch.empty(0, device=device))


def match_planes(images: rules.StereoImages, planes: NDArray[np.float64], device: str) -> Array:
    """Return what `matching.match_planes` does, but for rounding."""
    step, fine = planes[1] - planes[0], CudaMatcher.of(images, device)
    tried = _planes_near(images, planes, rules.SMALL_STEP, device)
    total = fine.smoothed(leave_out(fine.cost(planes), tried), rules.SMALL_STEP)
    inverse = fine.best_planes(total, planes)
    inverse = fine.refined(fine.soften(inverse, rules.SOFT_VALUES[0] * step), rules.MOVE * step)
    return fine.soften(inverse, rules.SOFT_VALUES[1] * step).cpu().numpy()


def _planes_near(
    images: rules.StereoImages, planes: NDArray[np.float64], small_step: float, device: str
) -> NDArray[np.bool_]:
    step, size, few = planes[1] - planes[0], images.image.shape, planes[:: rules.COARSE]
    coarse = CudaMatcher.of(small := images.halved(), device)
    cost = coarse.cost(few)
    if rules.is_large(small):
        cost = leave_out(cost, _planes_near(small, few, rules.COARSE * small_step, device))
    found = (coarse.best_planes(coarse.smoothed(cost, rules.COARSE * small_step), few).cpu().numpy() - planes[0]) / step
    own, least = (x.cpu().numpy() for x in (cost.argmin(2), cost.amin(2)))
    return rules.planes_to_try(found.astype(np.float32), rules.COARSE * own, least, size, len(planes))


def leave_out(cost: Tensor, tried: NDArray[np.bool_]) -> Tensor:
    """(H, W, D) cost as the CPU has it where planes are not `tried`. All are compared: a GPU gains nothing else."""
    height, width, _ = cost.shape
    there = torch.from_numpy(tried).to(cost.device)
    there = there.repeat_interleave(TILE, 0)[:height].repeat_interleave(TILE, 1)[:, :width]
    return torch.where(there, cost, float(UNREACHED))


def fuse_depths(
    depth: Array,
    others: Array,
    warps: NDArray[np.float64],
    back_rows: NDArray[np.float64],
    tolerance: float,
    device: str,
) -> tuple[Array, Array, Array]:
    """Return what `consistency.fuse_depths` does."""
    from .cuda_kernels import fuse_pixels  # imports triton

    pictures = (_there(depth, device), _there(others, device))
    places = (torch.from_numpy(np.ascontiguousarray(x)).to(device) for x in (warps.reshape(-1, 12), back_rows))
    out = torch.empty(3, *depth.shape, device=device)
    _run(fuse_pixels, depth.size, *pictures, *places, *out.unbind(0), len(others), *depth.shape[::-1],
         TOLERANCE=tolerance)  # fmt: skip
    fused, support, conflict = out.cpu().numpy()
    return fused, support, conflict


class CudaMatcher:
    """The steps of the match: a picture (H, W), others (N, H, W) and their warps (N, 12), float32 on a GPU."""

    def __init__(self, image: Tensor, others: Tensor, warps: Tensor) -> None:
        self._image, self._given = image, (image, others, warps)
        self._size = (image.shape[1], image.shape[0])
        self._window = {
            "BEST": rules.best_count(len(others)), "VIEWS": _power_of_two(len(others)), "FLOOR": VARIANCE_FLOOR,
            "OUTSIDE": OUTSIDE, "SIDE": SIDE, "STEP": STEP, "RADIUS": RADIUS,
        }  # fmt: skip

    @classmethod
    def of(cls, images: rules.StereoImages, device: str) -> CudaMatcher:
        """StereoImages of the host, there."""
        return cls(*(_there(x, device) for x in (images.image, images.others, images.warps.reshape(-1, 12))))

    def best_planes(self, total: Tensor, planes: NDArray[np.float64]) -> Tensor:
        """(H, W) inverse depth of least total cost (H, W, D)."""
        from .cuda_kernels import pick_pixels

        inverse = torch.empty_like(self._image)
        numbers = (inverse.numel(), len(planes), float(planes[0]), float(planes[1] - planes[0]))
        _run(pick_pixels, inverse.numel(), total, inverse, *numbers, PLANES=_power_of_two(len(planes)),
             UNREACHED=float(UNREACHED))  # fmt: skip
        return inverse

    def cost(self, planes: NDArray[np.float64]) -> Tensor:
        """(H, W, D) as of `sweep_cost`."""
        from .cuda_kernels import sweep_pixels

        cost = self._image.new_empty(*self._image.shape, len(planes))
        numbers = (len(self._given[1]), len(planes), *self._size, -0.5 / LIKENESS**2)
        depths = _there(planes, self._image.device)
        _run(sweep_pixels, self._image.numel(), *self._given, depths, cost, *numbers, **self._window)
        return cost

    def smoothed(self, cost: Tensor, small: float) -> Tensor:
        """(H, W, D) as of `smooth_cost`, `small` the price of a step of one plane; a launch for each direction, a
        program for each path."""
        from .cuda_kernels import scan_paths

        total, count = torch.zeros_like(cost), cost.shape[2]
        numbers = (count, small, rules.JUMP, rules.EDGE)
        for direction in DIRECTIONS:
            starts = _starts(*self._size, *direction, cost.device)
            given = (cost, self._image, starts, total, *self._size, *direction, *numbers)
            gpu.launch(scan_paths, len(starts), *given, PLANES=_power_of_two(count))
        return total

    def soften(self, values: Tensor, spread: float) -> Tensor:
        """(H, W) after the bilateral filter, `spread` the sd of its values."""
        from .cuda_kernels import soften_pixels

        out, numbers = torch.empty_like(values), (-0.5 / spread**2, -0.5 / rules.SOFT_PLACE**2)
        _run(soften_pixels, out.numel(), values, out, *self._size, *numbers, REACH=rules.SOFT_SIZE // 2)
        return out

    def refined(self, inverse: Tensor, step: float) -> Tensor:
        """(H, W) as of `refine_inverse_depth`."""
        from .cuda_kernels import refine_pixels

        refined = torch.empty_like(inverse)
        numbers = (len(self._given[1]), *self._size, -0.5 / ALIKE**2, float(step), rules.STIFFNESS)
        moves = {"REACH": rules.REACH, "MOVES": _power_of_two(2 * rules.REACH + 1)}
        _run(refine_pixels, inverse.numel(), *self._given, inverse, refined, *numbers, **moves, **self._window)
        return refined


def _there(array: NDArray, device: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(device)


def _power_of_two(count: int) -> int:
    return max(2, 1 << (count - 1).bit_length())


def _run(kernel: Any, count: int, *arguments: Any, **settings: Any) -> None:
    gpu.launch(kernel, -(-count // _BLOCK), *arguments, BLOCK=_BLOCK, **settings)


@lru_cache(maxsize=16)
def _starts(width: int, height: int, down: int, across: int, device: torch.device) -> Tensor:
    """(S,) int32: number of each path's first pixel."""
    starts = path_starts(height, width, down, across)
    return torch.from_numpy((starts[:, 0] * width + starts[:, 1]).astype(np.int32)).to(device)
