"""A walk through the made-up room with a 360° camera beside the same walk with a plain one; the truth is exact.

    python tests/benchmarks/panorama.py --out DIR --frames 30 --laps 0.5 --set mapping.passes=4
    python tests/benchmarks/panorama.py --out DIR --until tracking        # poses alone

ATE over the camera's places after Sim(3), and how much of the true surfaces that the walk sees has a surface of the
mesh, or a solid Gaussian, within 5 cm: by whether it is seen level, upwards or downwards.
"""

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from msgs_slam.formats.images import write_rgb
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.geometry.camera import CUBE, rig_of
from msgs_slam.pipelines.geometry.se3 import Similarity, align_points
from msgs_slam.pipelines.run.files import CALIBRATION, TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import WORLD
from tests.benchmarks.worlds.panorama import render_panorama
from tests.world.build import World
from tests.world.clip import ClipOptions, make_world, render_frame, render_view, walk

Array = NDArray[np.float64]
NEAR = 0.05
SIDE, EVERY = 48, 3


def film(out: Path, world: World, steps: Array, width: int) -> None:
    """Both clips as folders of pictures; what is there stays."""
    options = ClipOptions(len(steps), width // 3, width // 4, laps=float(steps[-1]))
    for i, pose in enumerate(walk(world, steps)):
        whole, plain = out / "sphere" / f"{i:04d}.jpg", out / "plain" / f"{i:04d}.jpg"
        if not whole.exists():
            write_rgb(whole, render_panorama(world, pose, width))
        if not plain.exists():
            write_rgb(plain, render_frame(world, options, i).rgb)


def reconstruct(source: Path, run: Path, more: list[str]) -> None:
    command = [sys.executable, "-m", "msgs_slam", "reconstruct", str(source), "--out", str(run), *more]
    subprocess.run(command, check=True)


def path_error(run: RunFolder, stage: str, truth: Array) -> tuple[Similarity, float, int]:
    """truth_from_run, root mean square error of the places in metres, and how many are posed."""
    trajectory = run.load(TRAJECTORY, stage)
    places = rig_of(run.load(CALIBRATION).directions, len(trajectory.frame_ids)).stations
    posed = trajectory.is_posed & (trajectory.frame_ids < places)
    found, true = trajectory.centers[posed], truth[trajectory.frame_ids[posed], :3, 3]
    move = align_points(found, true)
    return move, float(np.sqrt(((move.apply(found) - true) ** 2).sum(1).mean())), int(posed.sum())


def true_surfaces(world: World, poses: Array) -> tuple[Array, NDArray[np.int64]]:
    """(Q, 3) points that are seen from every third place, and in which of the six directions (Q,)."""
    options = ClipOptions(1, SIDE, SIDE, focal=SIDE / 2, supersampling=1)
    rows, columns = np.indices((SIDE, SIDE)) + 0.5
    rays = np.stack([2 * columns / SIDE - 1, 2 * rows / SIDE - 1, np.ones((SIDE, SIDE))], axis=-1)
    points, sides = [], []
    for pose in poses[::EVERY]:
        for side, rotation in enumerate(CUBE):
            view = pose.copy()
            view[:3, :3] = pose[:3, :3] @ rotation.T
            depth = render_view(world, options, view)[1]
            seen = depth > 0
            points.append(se3.transform(view, (rays * depth[..., None])[seen].astype(np.float64)))
            sides.append(np.full(int(seen.sum()), side))
    return np.concatenate(points), np.concatenate(sides)


def covered(points: Array, sides: NDArray[np.int64], found: Array) -> str:
    near = cKDTree(found).query(points, distance_upper_bound=NEAR)[0] < NEAR
    shares = {"level": near[sides < 4], "up": near[sides == 4], "down": near[sides == 5], "all": near}
    return ", ".join(f"{name} {100 * share.mean():.1f} %" for name, share in shares.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--laps", type=float, default=0.5)
    parser.add_argument("--width", type=int, default=960, help="of the panoramas")
    parser.add_argument("--until", default="export")
    parser.add_argument("--set", action="append", default=[])
    arguments = parser.parse_args()
    more = ["--until", arguments.until, *(f"--set={text}" for text in arguments.set)]
    world = make_world()
    steps = np.linspace(0, arguments.laps, arguments.frames)
    film(arguments.out, world, steps, arguments.width)
    truth = walk(world, steps)
    points, sides = true_surfaces(world, truth)
    for name, camera in (("plain", "perspective"), ("sphere", "equirectangular")):
        path = arguments.out / f"{name}.msgs"
        reconstruct(arguments.out / name, path, [*more, "--camera", camera])
        run = RunFolder(path)
        stages = ("tracking",) if arguments.until == "tracking" else ("tracking", "global_ba")
        for stage in stages:
            move, error, posed = path_error(run, stage, truth)
            print(f"{name}, {stage}: {posed} of {len(truth)} places, ATE {100 * error:.3f} cm", flush=True)
        if arguments.until == "export":
            outcome, exported = load_outcome(run), run.find(WORLD)
            assert exported is not None
            gaussians = outcome.require_map()
            solid = gaussians.means[gaussians.opacity_logits > 0].numpy().astype(np.float64)
            mesh = trimesh.load(run.file("export", "mesh.ply"), process=False)
            surface = exported.exported_from_run.inverse().apply(
                np.asarray(trimesh.sample.sample_surface_even(mesh, 400_000, seed=0)[0])
            )
            print(f"  mesh: {covered(points, sides, move.apply(surface))}")
            print(f"  map: {covered(points, sides, move.apply(solid))}", flush=True)


if __name__ == "__main__":
    main()
