"""How far a recording's own truth contradicts its pictures: below that, an error against it says nothing.

    python tests/benchmarks/truth_limit.py RUN.msgs=TRUTH ...

TRUTH is a data set with poses, or a file with a row of 16 numbers, world from camera, for each frame of the source. The
points of RUN's keyframes that four or more of them see are placed anew: from the run's poses, from the truth's, and
from the truth's with the arm from the tracked body to the camera, the focal length and a radial distortion that suit
it best. Pixels from where points are seen to where they then lie, medians: all, and by how many keyframes lie between a
point's first and last view.

With a true depth as well, a row of its own says what the mesh could reach: accuracy, completeness and F-score of the
true depth itself, each image put at the run's pose for it instead of the truth's, aligned as `evaluate` aligns meshes.
"""

import argparse
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.evaluation.evaluate import trajectory_cells
from msgs_slam.pipelines.evaluation.metrics import SurfaceError, surface_error, true_surface
from msgs_slam.pipelines.evaluation.truth import match_truth
from msgs_slam.pipelines.geometry import se3
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, FRAMES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.types import Intrinsics

Array = NDArray[np.float64]
POINTS, LEAST_VIEWS, ROUNDS, NOISE = 3000, 4, 4, 4.0
"""Points taken at most, views of each, rounds of their placing, and pixels beyond which a sight counts little."""
SPANS = (0, 10, 30, 80, 10**9)


class Sights:
    """Observations of a sample of points in the usable (K,) views: point and view (O,), pixels (O, 2)."""

    def __init__(self, run: RunFolder, usable: NDArray[np.bool_]) -> None:
        model = run.find(BACKBONE)
        order = np.argsort(model.obs_point, kind="stable")
        order = order[usable[model.obs_frame[order]]]
        point, view, xy = model.obs_point[order], model.obs_frame[order], model.obs_xy[order]
        often = np.flatnonzero(np.bincount(point) >= LEAST_VIEWS)
        kept = np.isin(point, np.random.default_rng(0).permutation(often)[:POINTS])
        self.point = np.unique(point[kept], return_inverse=True)[1]
        self.view, self.xy = view[kept], xy[kept]
        starts = np.searchsorted(self.point, np.arange(self.point[-1] + 2))
        spans = [np.ptp(self.view[a:b]) for a, b in pairwise(starts)]
        self.span = np.array(spans)[self.point]

    def errors(self, world_from_cam: Array, camera: Intrinsics, focal: float, radial: float) -> Array:
        """(O,) pixels to where each point lies that is nearest to its rays (in the limit, to its pixels)."""
        seen = (self.xy - [camera.cx, camera.cy]) / focal
        seen = seen * (1 + radial * (seen**2).sum(1, keepdims=True))
        poses = world_from_cam[self.view]
        rays = np.einsum("oij,oj->oi", poses[:, :3, :3], np.c_[seen, np.ones(len(seen))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        weight = np.ones(len(rays))
        for _ in range(ROUNDS):
            normal, right = np.zeros((self.point[-1] + 1, 3, 3)), np.zeros((self.point[-1] + 1, 3))
            weighed = across * weight[:, None, None]
            np.add.at(normal, self.point, weighed)
            np.add.at(right, self.point, np.einsum("oij,oj->oi", weighed, poses[:, :3, 3]))
            points = np.linalg.solve(normal + 1e-12 * np.eye(3), right[..., None])[..., 0]
            inside = np.einsum("oji,oj->oi", poses[:, :3, :3], points[self.point] - poses[:, :3, 3])
            depth = np.maximum(inside[:, 2], 1e-3)
            error = np.linalg.norm(inside[:, :2] / depth[:, None] - seen, axis=1) * focal
            weight = 1 / ((1 + (error / (NOISE / 2)) ** 2) * depth**2)
        return error


def true_poses(run: RunFolder, truth: Path) -> Array:
    """(K, 4, 4) world from camera of the run's keyframes that are placed in `frames`, NaN where there is no truth."""
    frames, placed = run.load(FRAMES), run.find(BACKBONE).frame_ids
    if truth.is_file():
        rows = np.loadtxt(truth).reshape(-1, 4, 4)
        poses = np.array([rows[f.source_index] for f in frames])[placed]
    else:
        outcome = load_outcome(run)
        poses = match_truth(outcome.frames, outcome.source_is_folder, open_sequence(truth)).world_from_cam[placed]
    known = np.isfinite(poses).all((1, 2))
    poses[known, :3, :3] = Rotation.from_matrix(poses[known, :3, :3]).as_matrix()
    return poses


def surface_limit(run: RunFolder, truth: Path) -> SurfaceError | None:
    """Errors of the true depth at the run's poses, by the scale and the alignment of the camera centres; None without
    true depth."""
    outcome = load_outcome(run)
    matched = match_truth(outcome.frames, outcome.source_is_folder, open_sequence(truth))
    surface, aligned = true_surface(matched)[0], trajectory_cells(outcome, matched)[1]
    if len(surface) == 0 or aligned is None:
        return None
    ours = np.linalg.inv(aligned.alignment.apply_to_poses(outcome.trajectory.cam_from_world))
    known = matched.has_pose[:, None, None]
    return surface_error(true_surface(replace(matched, world_from_cam=np.where(known, ours, np.nan)))[0], surface)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="RUN=TRUTH")
    print("| | all | " + " | ".join(f"from {a}" for a in SPANS[:-1]) + " keyframes |\n|" + " --- |" * (len(SPANS) + 1))
    for case in parser.parse_args().cases:
        folder, _, truth = case.partition("=")
        run = RunFolder(Path(folder))
        camera, poses = run.load(CALIBRATION).intrinsics, true_poses(run, Path(truth))
        sights = Sights(run, np.isfinite(poses).all((1, 2)))

        def errors(p: Array, sights=sights, camera=camera, poses=poses) -> Array:  # type: ignore[no-untyped-def]
            """Of the truth with a rotation vector, an arm, a factor of the focal length's logarithm, a distortion."""
            return sights.errors(poses @ se3.exp(p[[3, 4, 5, 0, 1, 2]]), camera, camera.fx * np.exp(p[6]), p[7])

        best = least_squares(lambda p: np.sqrt(np.log1p((errors(p) / NOISE) ** 2)), np.zeros(8), max_nfev=25).x
        ours = sights.errors(se3.inverse(run.find(BACKBONE).cam_from_world), camera, camera.fx, 0.0)
        for name, found in (("ours", ours), ("truth", errors(np.zeros(8))), ("truth, best arm and lens", errors(best))):
            shares = [found[(sights.span >= a) & (sights.span < b)] for a, b in pairwise(SPANS)]
            medians = [f"{np.median(s):.2f}" if len(s) else "" for s in (found, *shares)]
            print(f"| {run.root.name}: {name} | " + " | ".join(medians) + " |", flush=True)
        limit = None if Path(truth).is_file() else surface_limit(run, Path(truth))
        if limit:
            print(f"{run.root.name}: true depth at our poses: {100 * limit.accuracy:.2f} cm, "
                  f"{100 * limit.completeness:.2f} cm, F {100 * limit.f_score:.1f} %", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
