"""A recording in a world: the camera, its walk, and what it gets wrong on purpose."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.types import Intrinsics
from tests.world.build import Scene, World, build_world
from tests.world.cast import render_rays
from tests.world.paths import room_walk
from tests.world.room import furnished_room

LAYOUTS: dict[str, Callable[[bool], Scene]] = {"room": furnished_room}
Path = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Laps (N,) -> world_from_cam (N, 4, 4)."""
WALKS: dict[str, Path] = {"room": room_walk}
GLOSSES: dict[str, float] = {}
"""Of the floor, where it mirrors. `tests/benchmarks/worlds/` adds layouts to all three tables."""

ROWS = 4
"""Of a rolling shutter are taken at once."""


@dataclass(frozen=True)
class ClipOptions:
    """How a clip is taken.

    laps: length of the walk; a little over 1 passes over its beginning again. k1: radial distortion of the lens.
    exposure_swing: relative change of the exposure, up and down. noise: standard deviation in grey levels.
    shutter: open part of the frame time, 0 = no motion blur. focal: pixels, 0 = 0.85 of the width. readout: part of the
    frame time by which the last row is taken later than the first, 0 = all at once; a frame's pose and time are those
    of its middle.
    """

    frames: int = 60
    width: int = 320
    height: int = 240
    fps: float = 10.0
    laps: float = 1.08
    focal: float = 0.0
    k1: float = 0.0
    exposure_swing: float = 0.0
    noise: float = 0.0
    shutter: float = 0.0
    readout: float = 0.0
    supersampling: int = 2
    seed: int = 0

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera, but for its distortion."""
        focal = self.focal or 0.85 * self.width
        return Intrinsics(self.width, self.height, focal, focal, self.width / 2, self.height / 2)


@dataclass(frozen=True)
class WorldFrame:
    """rgb (H, W, 3) uint8; depth (H, W) float32 z in metres; labels (H, W) uint8 index into the world's classes
    (0 = nothing); world_from_cam (4, 4); timestamp in seconds. Depth and labels hold at the pixel centres."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    labels: NDArray[np.uint8]
    world_from_cam: NDArray[np.float64]
    timestamp: float


def make_world(layout: str = "room", seed: int = 0, texel: float = 0.005, blank_walls: bool = False) -> World:
    """A synthetic world with exact truth: "room" (furnished, one table to walk round), or a benchmark's world.

    texel: metres per texture pixel on walls. The same arguments give the same bytes.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout is one of {', '.join(LAYOUTS)}; got {layout!r}")
    world = build_world(layout, LAYOUTS[layout](blank_walls), seed, texel)
    return replace(world, gloss=GLOSSES.get(layout, world.gloss))


def walk(world: World, steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4, 4) world_from_cam at `steps` (N,) laps along the world's closed walk."""
    return WALKS[world.layout](steps)


def render_frame(world: World, options: ClipOptions, index: int) -> WorldFrame:
    """Frame `index` of the clip."""
    step = options.laps / max(options.frames - 1, 1)
    blurs = 5 if options.shutter > 0 else 1
    offsets = options.shutter * (np.arange(blurs) - (blurs - 1) / 2) / blurs
    middle = blurs // 2
    path = partial(walk, world)
    color, depth, solid_at = render_rolling(world, options, path, index * step, step)
    for offset in np.delete(offsets, middle):
        color = color + render_rolling(world, options, path, (index + offset) * step, step)[0]
    labels = np.append(world.labels, np.uint8(0))[solid_at]
    rgb = develop((color / np.float32(blurs)).astype(np.float32), options, index)
    return WorldFrame(rgb, depth, labels, path(np.array([index * step]))[0], index / options.fps)


def render_rolling(
    world: World, options: ClipOptions, path: Path, at: float, step: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """As `render_view`, from where the path is `at` the middle of the frame and goes on by `step` until the next; a few
    rows at a time are taken at once."""
    band = ROWS if options.readout > 0 else options.height
    firsts = np.arange(0, options.height, band)
    late = options.readout * ((firsts + band / 2) / options.height - 0.5) * step
    views = [
        render_view(world, options, pose, slice(first, first + band))
        for first, pose in zip(firsts, path(at + late), strict=True)
    ]
    color, depth, solid_at = (np.concatenate(parts) for parts in zip(*views, strict=True))
    return color, depth, solid_at


def render_view(
    world: World, options: ClipOptions, world_from_cam: NDArray[np.float64], rows: slice = slice(None)
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """color (H, W, 3) linear light, depth (H, W) z, solid (H, W) index or -1, as seen from one pose; of some `rows`."""
    color, depth, solid_at = _cast(world, options, world_from_cam, rows)
    floor = np.append(world.labels == world.class_names.index("floor"), False)[solid_at]
    if world.gloss > 0 and floor.any():
        # The mirror image is what a camera on the other side of the floor would see if there were none.
        upside_down = np.diag([1.0, 1.0, -1.0, 1.0])
        seen, _, _ = _cast(world.without("floor"), options, upside_down @ world_from_cam, rows)
        rays = np.concatenate([_rays(options)[0][rows], np.ones((*depth.shape, 1))], -1)
        steepness = -(rays @ world_from_cam[2, :3]) / np.linalg.norm(rays, axis=-1)
        share = world.gloss + (1 - world.gloss) * (1 - np.clip(steepness, 0, 1)) ** 5  # Schlick's
        color = np.where(floor[..., None], color + share[..., None].astype(np.float32) * (seen - color), color)
    return color, depth, solid_at


def _cast(
    world: World, options: ClipOptions, world_from_cam: NDArray[np.float64], rows: slice
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    centers, samples = (rays[rows] for rays in _rays(options))
    h, w = centers.shape[:2]
    color, depth = np.zeros((h, w, 3), np.float32), np.zeros((h, w), np.float32)
    solid_at = np.empty((h, w), np.int32)
    pixel = 1 / (options.intrinsics.fx * options.supersampling)
    a, solids = world.atlas, world.solids
    render_rays(
        np.ascontiguousarray(world_from_cam), centers, samples, pixel, *solids.arguments, solids.first_face,
        a.codes, a.levels, a.level_count, a.texel, color, depth, solid_at,
    )  # fmt: skip
    return color, depth, solid_at


@lru_cache(maxsize=4)
def _rays(options: ClipOptions) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normalised coordinates of pixel centres (H, W, 2) and of the colour samples (H, W, n, 2), lens included."""
    n = options.supersampling
    k = options.intrinsics
    v, u = np.meshgrid(np.arange(options.height), np.arange(options.width), indexing="ij")
    inner = (np.arange(n) + 0.5) / n
    dv, du = (x.ravel() for x in np.meshgrid(inner, inner, indexing="ij"))
    pixels = np.stack([u[..., None] + du, v[..., None] + dv], axis=-1)
    centers = np.stack([u + 0.5, v + 0.5], axis=-1)
    center_xy, sub_xy = (_undistorted((p - (k.cx, k.cy)) / (k.fx, k.fy), options.k1) for p in (centers, pixels))
    return center_xy, sub_xy


def _undistorted(distorted: NDArray[np.float64], k1: float) -> NDArray[np.float64]:
    """Invert x_d = x (1 + k1 |x|^2) by fixed-point iteration; (..., 2)."""
    points = distorted.copy()
    for _ in range(20 if k1 else 0):
        points = distorted / (1 + k1 * (points**2).sum(axis=-1, keepdims=True))
    return points


def develop(color: NDArray[np.float32], options: ClipOptions, index: int) -> NDArray[np.uint8]:
    """Linear light to sRGB bytes, with the exposure and the noise of the options."""
    phase = 2 * np.pi * index / max(options.frames, 1)
    exposed = np.clip(color * (1 + options.exposure_swing * np.sin(3 * phase)), 0, 1)
    srgb = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * np.power(exposed, 1 / 2.4) - 0.055) * 255
    if options.noise > 0:
        srgb = srgb + options.noise * np.random.default_rng([options.seed, index]).standard_normal(srgb.shape)
    return np.clip(np.round(srgb), 0, 255).astype(np.uint8)
