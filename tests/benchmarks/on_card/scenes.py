"""The two places of every comparison, a card and the CPU beside it, and the scenes that both are given."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from render_scenes import room
from torch import Tensor

from msgs_slam.pipelines.config import MappingConfig
from msgs_slam.pipelines.depth.stereo.matching import StereoImages
from msgs_slam.pipelines.depth.stereo.sweep import warps_to
from msgs_slam.pipelines.mapping.optimise import MapOptimiser, Step
from msgs_slam.pipelines.mapping.state import OptimiserState
from msgs_slam.pipelines.mapping.views import View, make_view
from msgs_slam.pipelines.render.api import render
from msgs_slam.pipelines.render.gaussian_map import GaussianMap
from msgs_slam.pipelines.system import gpu
from msgs_slam.pipelines.types import ProxyMaps

REHEARSAL = os.environ.get("TRITON_INTERPRET") == "1"
Array = NDArray[Any]


@dataclass(frozen=True)
class Sizes:
    """rows: width, height, Gaussians and classes of the renderer's rooms; size, gaussians, views of a map; stereo_size,
    planes, matched, fused of a keyframe's stereo; repeats of what is timed."""

    rows: tuple[tuple[int, int, int, int], ...]
    size: tuple[int, int]
    gaussians: int
    views: int
    stereo_size: tuple[int, int]
    planes: int
    matched: int
    fused: int
    repeats: int


FULL = Sizes(
    ((320, 240, 50_000, 8), (320, 240, 200_000, 8), (640, 480, 200_000, 8), (640, 480, 200_000, 40)),
    (640, 480), 200_000, 3, (640, 480), 128, 12, 8, 15,
)  # fmt: skip
TINY = Sizes(((24, 17, 60, 2),), (24, 16), 80, 3, (12, 8), 4, 4, 3, 1)
SIZES = TINY if REHEARSAL else FULL
CLASSES = 5


@dataclass(frozen=True)
class Place:
    """Where something runs: `device`, and whether the card's kernels take its tensors."""

    name: str
    device: str
    kernels: bool

    @contextmanager
    def used(self) -> Iterator[Place]:
        """Within: float32 tensors go to the kernels, or none do. With a card their device decides, and nothing is done:
        in a rehearsal both places lie on the CPU."""
        if not REHEARSAL:
            yield self
            return
        takes = self.kernels
        with mock.patch.object(gpu, "supports_triton", lambda example: takes and example.dtype == torch.float32):
            yield self


CARD = Place("card", "cpu" if REHEARSAL else "cuda", True)
CPU = Place("cpu", "cpu", False)


def world_of(
    row: tuple[int, int, int, int], place: Place, kind: torch.dtype = torch.float32
) -> tuple[list[Tensor], Any]:
    """Leaves (means, radii, opacities, colours) of a room, and its intrinsics."""
    scene = room(*row)
    tensors = (scene.means, scene.radii, scene.opacities, scene.colors)
    return [x.to(place.device, kind, copy=True).requires_grad_() for x in tensors], scene.intrinsics


def mapper(place: Place) -> MapOptimiser:
    """A map of a room before the views that show it, a little wrong in size and colour; every view is visited once."""
    (width, height), count = SIZES.size, SIZES.gaussians
    scene = room(width, height, count, CLASSES)
    generator = torch.Generator().manual_seed(1)
    views = [_view(scene, i, generator, place) for i in range(SIZES.views)]
    colors = (scene.colors + 0.1 * torch.randn(scene.colors.shape, generator=generator)).clamp(0, 1)
    sizes = scene.radii.log() + 0.2 * torch.randn(count, generator=generator)
    floats = (scene.means, sizes, torch.logit(scene.opacities), colors, torch.zeros(count, CLASSES))
    given = GaussianMap(*(x.to(place.device) for x in floats), torch.zeros(count, dtype=torch.int64).to(place.device))
    state = OptimiserState.fresh(views, CLASSES, given, None)
    optimiser = MapOptimiser(views, CLASSES, MappingConfig(), state)
    for i in range(SIZES.views):
        optimiser.step(step(i))
    return optimiser


def step(view: int, note: bool = False) -> Step:
    """A steady visit: nothing is seeded, split or pruned."""
    return Step(view, 1.0, 0.5, False, note=note, refine_pose=True)


def _view(scene: Any, index: int, generator: torch.Generator, place: Place) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3], pose[1, 3] = 0.04 * index, -0.02 * index
    with CPU.used(), torch.no_grad():
        shown = render(scene.means, scene.radii, scene.opacities, scene.colors, pose, scene.intrinsics)
    image = (255 * (shown.features + 0.02 * torch.randn(shown.features.shape, generator=generator)).clamp(0, 1)).byte()
    size = shown.depth.shape
    maps = ProxyMaps(
        shown.depth.numpy(), torch.rand(size, generator=generator).numpy(),
        torch.randint(0, CLASSES, size, generator=generator).byte().numpy(), np.ones(size, np.float32),
    )  # fmt: skip
    return make_view(index, scene.intrinsics, pose.numpy(), image.numpy(), maps, tuple(range(CLASSES)), place.device)


def there(view: View, place: Place) -> View:
    """The view's tensors at a place; its pose stays on the host."""
    tensors = {k: x for k, x in vars(view).items() if isinstance(x, Tensor) and k != "cam_from_world"}
    return replace(view, **{k: x.to(place.device) for k, x in tensors.items()})


@dataclass(frozen=True)
class StereoScene:
    """A textured slanted plane: images to match, the inverse depths to try, and depths (H, W) and (N, H, W) to compare
    with their transforms, as `fuse_depths` wants them."""

    images: StereoImages
    planes: NDArray[np.float64]
    depth: NDArray[np.float32]
    others: NDArray[np.float32]
    warps: NDArray[np.float64]
    back: NDArray[np.float64]


def stereo_scene() -> StereoScene:
    """As many views as a keyframe is matched with, around it; their depths have 1 % of noise."""
    width, height = SIZES.stereo_size
    matrix = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    angles = np.linspace(0, 2 * np.pi, SIZES.matched, endpoint=False)
    # A little aside: no place of a pixel falls just between two others, where rounding decides which is the nearest.
    cameras = [_shifted(0.1231 * np.cos(a), 0.1217 * np.sin(a)) for a in angles]
    (image, depth), *rest = [_plane(matrix, c, (width, height)) for c in (np.eye(4), *cameras)]
    rng, near = np.random.default_rng(3), slice(0, SIZES.fused)
    others = np.stack([d for _, d in rest[near]]) * (1 + 0.01 * rng.standard_normal((SIZES.fused, 1, 1)))
    others *= np.where(rng.random(others.shape) < 0.05, 1.3, 1.0)
    warps = warps_to(matrix, np.eye(4), [matrix] * len(cameras), cameras)
    back = np.array([warps_to(matrix, c, [matrix], [np.eye(4)])[0][2] for c in cameras[near]])
    images = StereoImages(image, np.stack([i for i, _ in rest]), warps)
    planes = np.linspace(1 / 4, 1 / 1.2, SIZES.planes)
    return StereoScene(images, planes, depth.astype(np.float32), others.astype(np.float32), warps[near], back)


def _shifted(x: float, y: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = x, y, 0.0023
    return pose


def _plane(matrix: Array, pose: Array, size: tuple[int, int]) -> tuple[NDArray[np.float32], Array]:
    """Intensities and depth of the plane z = 2 + 0.3 x, from a camera that is only shifted."""
    v, u = np.indices(size[::-1]) + 0.5
    rays = np.stack([(u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1], np.ones_like(u)], -1)
    center = -pose[:3, 3]
    depth = (2 + 0.3 * center[0] - center[2]) / (1 - 0.3 * rays[..., 0])
    x, y, _ = np.moveaxis(rays * depth[..., None] + center, -1, 0)
    waves = 0.2 * np.sin(9 * x + 3 * y) + 0.15 * np.sin(17 * y - 5 * x) + 0.1 * np.sin(31 * x)
    return (0.5 + waves + 0.04 * np.sin(90 * x + 70 * y)).astype(np.float32), depth
