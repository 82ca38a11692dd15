"""What grows with the length of a walk: single functions on synthetic input of any number of keyframes.

    python tests/benchmarks/growth.py [COUNT ...] [--only NAME ...]          counts of keyframes, default 155 600 2400

The keyframes walk through the building of `worlds/building.py`, whose surfaces are planes here: depth, points and
observations follow from the poses, no picture is drawn. Seconds on one thread and the peak of what Python and numpy
allocate while the function runs (tracemalloc). `power` is that of the count between the last two columns: 1 is linear.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import sys
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.align import fit_fields
from msgs_slam.pipelines.depth.fields import contradicted
from msgs_slam.pipelines.depth.stereo.consistency import choose_neighbours, sweep_range
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import pixel_centers, project
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth, neighbours
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.sfm.bundle import adjust_bundle
from msgs_slam.pipelines.sfm.features import GlobalDescriptors, far_apart, loop_pairs, unit
from msgs_slam.pipelines.tracking.adjust import make_bundle
from msgs_slam.pipelines.tracking.links import loop_candidates
from msgs_slam.pipelines.tracking.state import TrackState
from msgs_slam.pipelines.types import Intrinsics
from tests.benchmarks.worlds.building import HEIGHT, LENGTH, ROOM_WIDTH, Walk, module_at

CAMERA = Intrinsics(320, 240, 272.0, 272.0, 160.0, 120.0)
SMALL = CAMERA.resized(80, 60)
POINTS = 600
"""On the surfaces of each module."""


@dataclass(frozen=True)
class Synthetic:
    """`count` keyframes a tenth of a metre apart, and what the functions take."""

    count: int

    @cached_property
    def poses(self) -> NDArray[np.float64]:
        times = np.arange(self.count) * 0.2
        return se3.inverse(Walk(self.count * 0.2).poses(times))

    @cached_property
    def views(self) -> list[PosedDepth]:
        return [PosedDepth(SMALL, p, d := _depth_of(p), np.ones_like(d)) for p in self.poses]

    @cached_property
    def model(self) -> SparseModel:
        rng = np.random.default_rng(0)
        modules = range(-1, module_at(float(se3.inverse(self.poses[-1])[0, 3])) + 2)
        points = np.concatenate([_surface_points(rng, m) for m in modules])
        own = np.repeat(np.array(modules), POINTS)
        frame, point, xy = [], [], []
        for k, pose in enumerate(self.poses):
            here = module_at(float(se3.inverse(pose)[0, 3]))
            near = np.flatnonzero(own == here)
            pixels, z = project(points[near] @ pose[:3, :3].T + pose[:3, 3], CAMERA)
            seen = (z > 0.3) & ((pixels > 0) & (pixels < (CAMERA.width, CAMERA.height))).all(1)
            seen &= rng.random(len(seen)) < 0.8
            frame.append(np.full(int(seen.sum()), k))
            point.append(near[seen])
            xy.append(pixels[seen] + rng.normal(0, 0.3, (int(seen.sum()), 2)))
        together = (np.concatenate(x) for x in (frame, point, xy))
        colors = np.zeros((len(points), 3), np.uint8)
        return SparseModel(np.arange(self.count), self.poses, points, colors, *together)

    @cached_property
    def looks(self) -> NDArray[np.float32]:
        """Descriptors of which neighbours are alike."""
        steps = np.random.default_rng(1).standard_normal((self.count + 20, 1024)).astype(np.float32)
        walk = np.cumsum(steps, 0)
        return np.tile(unit(walk[20:] - walk[:-20]), 8).astype(np.float32) / np.float32(8**0.5)


def _depth_of(cam_from_world: NDArray[np.float64]) -> NDArray[np.float32]:
    """(H, W) distance along z to the walls, floor, ceiling and the end wall of the module around a camera."""
    world_from_cam = se3.inverse(cam_from_world)
    xy = (pixel_centers(SMALL.width, SMALL.height) - (SMALL.cx, SMALL.cy)) / (SMALL.fx, SMALL.fy)
    rays = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], 2) @ world_from_cam[:3, :3].T
    center = world_from_cam[:3, 3]
    low = np.array([module_at(center[0]) * LENGTH, -ROOM_WIDTH / 2, 0.0])
    high = low + np.array([LENGTH, ROOM_WIDTH, HEIGHT])
    with np.errstate(divide="ignore"):
        exits = np.where(rays > 0, (high - center) / rays, (low - center) / rays)
    return np.clip(np.abs(exits).min(2), 0.2, 20).astype(np.float32)


def _surface_points(rng: np.random.Generator, number: int) -> NDArray[np.float64]:
    points = rng.random((POINTS, 3)) * (LENGTH, ROOM_WIDTH, HEIGHT) + (number * LENGTH, -ROOM_WIDTH / 2, 0)
    flat = rng.integers(0, 4, POINTS)
    points[flat == 0, 1], points[flat == 1, 1] = -ROOM_WIDTH / 2, ROOM_WIDTH / 2
    points[flat == 2, 2] = 0
    points[flat == 3, 0] = (number + 1) * LENGTH
    return points


def _stereo(s: Synthetic) -> None:
    for index in range(0, s.count, max(s.count // 60, 1)):  # every keyframe costs the same
        sweep_range(s.model, index, choose_neighbours(s.model, CAMERA, index, 6, 8.0))


def _loops_by_look(s: Synthetic) -> None:
    loop_pairs(GlobalDescriptors((s.looks,)), far_apart(s.count, 9), 4)


def _loop_candidates(s: Synthetic) -> None:
    loop_candidates(TrackState.from_backbone(s.model, 0.5), GlobalDescriptors((s.looks,)), ())


def _bundle(s: Synthetic) -> None:
    state = TrackState.from_backbone(s.model, 0.5)
    adjust_bundle(make_bundle(state, list(state.keyframes)), CAMERA, 2)


def _segments(s: Synthetic) -> None:
    state = TrackState.from_backbone(s.model, 0.5)
    for k in range(s.count):
        for point in state.sightings[k].point[:1]:
            state.segment_of_point(int(point), k)


def _fields(s: Synthetic) -> None:
    fit_fields(s.views, {})


CASES: dict[str, tuple[str, Callable[[Synthetic], Any]]] = {
    "which views see the same (three times a mapping)": ("views", lambda s: neighbours(s.views)),
    "depth that others see through": ("views", lambda s: list(contradicted(s.views))),
    "depth fields, tracking": ("views", _fields),
    "stereo: views to match, of 60 keyframes": ("model", _stereo),
    "loops by look, frames": ("looks", _loops_by_look),
    "loops by look, tracking": ("looks model", _loop_candidates),
    "the segment of a point, a frame each": ("model", _segments),
    "bundle adjustment, two steps": ("model", _bundle),
}


def measure(case: str, count: int) -> tuple[float, float]:
    """Seconds, and the peak of what is allocated in MB (a second run, tracing is slow)."""
    needs, run = CASES[case]
    synthetic = Synthetic(count)
    for name in needs.split():
        getattr(synthetic, name)
    started = time.perf_counter()
    run(synthetic)
    seconds = time.perf_counter() - started
    tracemalloc.start()
    run(synthetic)
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return seconds, peak


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("counts", nargs="*", type=int, default=[155, 600, 2400])
    parser.add_argument("--only", nargs="*", default=[])
    counts = (arguments := parser.parse_args()).counts
    chosen = [c for c in CASES if not arguments.only or any(word in c for word in arguments.only)]
    for case in chosen:
        measure(case, 12)  # compiled
    print("| | " + " | ".join(f"{n}: s, MB" for n in counts) + " | power |\n|" + " --- |" * (len(counts) + 2))
    for case in chosen:
        rows = [measure(case, n) for n in counts]
        power = np.log(rows[-1][0] / rows[-2][0]) / np.log(counts[-1] / counts[-2]) if len(rows) > 1 else np.nan
        print(f"| {case} | " + " | ".join(f"{t:.2f}, {mb:.0f}" for t, mb in rows) + f" | {power:.2f} |", flush=True)


if __name__ == "__main__":
    main()
