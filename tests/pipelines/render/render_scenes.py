"""Scenes for the renderer's tests and benchmark, and a compositing written a second time, pixel by Gaussian."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from msgs_slam.pipelines.render import rules
from msgs_slam.pipelines.types import Intrinsics

NAMES = ("u", "v", "sigma_px", "z", "opacity", "features")
IMAGES = ("features", "depth_sum", "depth_silhouette", "silhouette")


def random_gaussians(
    count: int,
    width: int,
    height: int,
    channels: int,
    seed: int,
    sigma: tuple[float, float] = (0.3, 4.0),
    opacity: tuple[float, float] = (0.001, 1.0),
    behind: float = 0.1,
) -> dict[str, Tensor]:
    """Projected Gaussians in float32, some off screen, some behind the camera, radii spread evenly over orders."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 6.0, count) * np.where(rng.random(count) < behind, -1, 1)
    values = (
        rng.uniform(-0.2 * width, 1.2 * width, count),
        rng.uniform(-0.2 * height, 1.2 * height, count),
        np.exp(rng.uniform(*np.log(sigma), count)),
        z,
        rng.uniform(*opacity, count),
        rng.random((count, channels)),
    )
    return {name: torch.from_numpy(value).float() for name, value in zip(NAMES, values, strict=True)}


def dense_composite(gaussians: dict[str, Tensor], width: int, height: int) -> dict[str, Tensor]:
    """The same images from a (H*W, M) table of opacities and a running product; for small scenes only."""
    u, v, sigma, z, opacity, features = (gaussians[name] for name in NAMES)
    order = torch.argsort(z.detach(), stable=True)
    order = order[z.detach()[order] > 0]
    u, v, sigma, z, opacity, features = (x[order] for x in (u, v, sigma, z, opacity, features))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    distance2 = (x.reshape(-1, 1) - u) ** 2 + (y.reshape(-1, 1) - v) ** 2
    raw = opacity * torch.exp(-distance2 / (2 * sigma**2))
    seen = (distance2 <= (rules.CUT_SIGMAS * sigma) ** 2) & (raw >= rules.ALPHA_MIN)
    alpha = torch.where(seen, raw.clamp(max=rules.ALPHA_MAX), 0.0)
    before = torch.cat([torch.ones_like(alpha[:, :1]), torch.cumprod(1 - alpha, 1)[:, :-1]], 1)
    weight = torch.where((before >= rules.TRANSMITTANCE_MIN).detach(), alpha * before, 0.0)
    images = (weight @ features, weight @ z, weight.sum(1), weight.sum(1))
    shapes = ((height, width, -1), (height, width), (height, width), (height, width))
    return {name: image.reshape(shape) for name, image, shape in zip(IMAGES, images, shapes, strict=True)}


@dataclass(frozen=True)
class Room:
    """A textured room seen from its middle: Gaussians near its surfaces, and the camera they were seeded from.

    means (M, 3), radii, opacities (M,), colors (M, 3), logits (M, C) float32; the camera stands at the identity.
    """

    means: Tensor
    radii: Tensor
    opacities: Tensor
    colors: Tensor
    logits: Tensor
    intrinsics: Intrinsics


def room(width: int, height: int, count: int, classes: int, seed: int = 0) -> Room:
    """One Gaussian per cell of a grid over the image, a pixel or a cell wide, at the depth of the room's surface."""
    rng = np.random.default_rng(seed)
    intrinsics = Intrinsics(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2)
    spacing = np.sqrt(width * height / count)
    across = round(width / spacing)
    cell = np.arange(count)
    u = (cell % across + rng.uniform(0.2, 0.8, count)) * width / across
    v = (cell // across + rng.uniform(0.2, 0.8, count)) * height / np.ceil(count / across)
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    depth, surface = _room_depth(x, y)
    depth = depth * (1 + 0.004 * rng.normal(size=count))
    means = np.stack([x * depth, y * depth, depth], axis=1)
    radii = depth / intrinsics.fx * max(1.0, spacing) * rng.uniform(0.8, 1.2, count)
    logits = rng.normal(0, 0.3, (count, classes))
    logits[cell, surface % classes] += 3
    # A map is ordered neither by depth nor by place, but neighbours were mostly seeded together.
    blocks = cell // 64
    order = np.argsort(rng.permutation(blocks.max() + 1)[blocks], kind="stable")
    arrays = (means, radii, rng.uniform(0.35, 0.95, count), _room_color(means, surface), logits)
    return Room(*(torch.from_numpy(array[order]).float() for array in arrays), intrinsics)


def _room_depth(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth along the rays (x, y, 1) and which of the room's six surfaces is met; the last is a ball."""
    with np.errstate(divide="ignore"):
        walls = [np.where(x > 0, 2.4 / x, np.inf), np.where(x < 0, -2.2 / x, np.inf)]
        walls += [np.where(y > 0, 1.3 / y, np.inf), np.where(y < 0, -1.2 / y, np.inf), np.full_like(x, 4.5)]
    center, radius = np.array([-0.5, 0.4, 2.6]), 0.6
    a, b = x * x + y * y + 1, x * center[0] + y * center[1] + center[2]
    root = b * b - a * (center @ center - radius**2)
    ball = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    distances = np.stack([*walls, ball])
    return distances.min(0), distances.argmin(0)


def _room_color(points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    palette = np.array(
        [[0.8, 0.3, 0.3], [0.3, 0.7, 0.3], [0.6, 0.5, 0.4], [0.9, 0.9, 0.8], [0.4, 0.5, 0.8], [0.9, 0.7, 0.2]]
    )
    x, y, z = points.T
    coarse = 0.15 * np.sin(6 * x + 2 * z) * np.sin(8 * y + 3 * z)
    fine = 0.08 * np.sin(29 * x - 13 * y) + 0.08 * np.sin(21 * z + 17 * y)
    return np.clip(palette[surface] + (coarse + fine)[:, None], 0, 1)
