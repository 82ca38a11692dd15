"""A textured corner of a room with exact truth, seen by a camera with a lens."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.run.stages import StageContext
from msgs_slam.pipelines.system.progress import SilentProgress

WIDTH, HEIGHT = 320, 240
FOCAL = 280.0
WALK_FRAMES = 12
QUICK = ("run.threads=2", "frames.max_features=500", "frames.overlap=5")


@dataclass(frozen=True)
class Walk:
    """Images of a walk; centers (N, 3) in the world of the first camera."""

    folder: Path
    centers: NDArray[np.float64]
    focal: float
    k1: float


@cache
def _texture(seed: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    total = np.zeros((1024, 1024, 3), np.float32)
    for cells, weight in ((16, 1.0), (64, 1.0), (256, 0.8)):
        noise = rng.random((cells, cells, 3)).astype(np.float32)
        total += weight * cv2.resize(noise, (1024, 1024), interpolation=cv2.INTER_CUBIC)
    low, high = total.min(), total.max()
    return ((total - low) / (high - low) * 255).astype(np.uint8)


# Floor, wall ahead, wall to the left, as (normal, distance, two axes of the texture); lengths in metres.
_PLANES = (
    ((0.0, 1.0, 0.0), 1.2, (0, 2)),
    ((0.0, 0.0, 1.0), 4.0, (0, 1)),
    ((-1.0, 0.0, 0.0), 1.8, (1, 2)),
)


def render(
    center: NDArray, rotation: NDArray, focal: float = FOCAL, k1: float = 0.0, poster: bool = False
) -> NDArray[np.uint8]:
    """(H, W, 3) of the corner; `rotation` is world-from-camera, `k1` bends the rays as COLMAP's SIMPLE_RADIAL does.
    A `poster` on the wall ahead is blue."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    bent = np.stack([(x - WIDTH / 2) / focal, (y - HEIGHT / 2) / focal], axis=-1)
    straight = bent.copy()
    for _ in range(30):
        straight = bent / (1 + k1 * (straight**2).sum(-1, keepdims=True))
    rays = np.concatenate([straight, np.ones((HEIGHT, WIDTH, 1))], axis=-1) @ rotation.T
    image, nearest = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.full((HEIGHT, WIDTH), np.inf)
    for index, (normal, distance, axes) in enumerate(_PLANES):
        slope = rays @ np.array(normal)
        depth = np.where(slope > 1e-6, (distance - center @ np.array(normal)) / np.maximum(slope, 1e-6), np.inf)
        hit = (depth < nearest) & np.isfinite(depth)
        points = center + rays * np.where(hit, depth, 0)[..., None]
        u, v = ((points[..., a] * 160 + 400).astype(np.float32) for a in axes)
        colors = cv2.remap(_texture(index), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        if poster and index == 1:
            hangs = (np.abs(points[..., :2] - [0.3, 0.0]) < [0.8, 0.7]).all(-1)
            colors[hangs] = bluish(colors[hangs])
        image[hit], nearest[hit] = colors[hit], depth[hit]
    return image


def bluish(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (..., 3) that the stand-ins of the networks take for a person."""
    return (colors * np.array([0.2, 0.2, 0.5]) + np.array([0, 0, 127])).astype(np.uint8)


def turn(yaw: float, pitch: float = 0.0) -> NDArray[np.float64]:
    """World-from-camera rotation of a camera turned right by `yaw` and up by `pitch` (radians)."""
    return cv2.Rodrigues(np.array([0.0, yaw, 0.0]))[0] @ cv2.Rodrigues(np.array([pitch, 0.0, 0.0]))[0]


def sideways(count: int) -> Iterator[tuple[NDArray, NDArray]]:
    """An arc through the corner, looking into it."""
    for t in np.linspace(-1, 1, count):
        yield np.array([0.9 * t, 0.15 * np.sin(3 * t), 0.5 * t * t]), turn(-0.35 * t, 0.08 * np.cos(2 * t) - 0.25)


def write_walk(folder: Path, poses: Iterator[tuple[NDArray, NDArray]], focal: float = FOCAL, k1: float = 0.0) -> Walk:
    """Write the pictures of a walk as PNG."""
    centers, first = [], None
    for i, (center, rotation) in enumerate(poses):
        write_rgb(folder / f"view_{i:03d}.png", render(center, rotation, focal, k1))
        first = (center, rotation) if first is None else first
        centers.append(first[1].T @ (center - first[0]))
    return Walk(folder, np.array(centers), focal, k1)


@pytest.fixture(scope="session")
def bent_walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """A walk seen through a lens with barrel distortion."""
    return write_walk(tmp_path_factory.mktemp("bent"), sideways(WALK_FRAMES), k1=-0.06)


@pytest.fixture
def make_context(tmp_path: Path) -> Callable[..., StageContext]:
    """A context of the frames stage with an empty folder of its own."""

    def make(source: Path, *overrides: str, name: str = "run", progress: SilentProgress | None = None) -> StageContext:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        config = load_config(overrides=[*QUICK, *overrides])
        return StageContext(RunFolder(tmp_path), source, config, folder, progress or SilentProgress())

    return make
