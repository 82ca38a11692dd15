"""The viewer's measuring tape against a truth: random pairs of places of a finished run, error over stated deviation.

    python tests/benchmarks/tape.py RUN TRUTH [PAIRS]

A place is a random pixel of a random keyframe: the tape looks along it from the run's own pose, the truth along the
same line from the true one. Lengths are compared after one scale for the whole run: the unit's own error is left out.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.gaussians import GaussianCloud
from msgs_slam.pipelines.evaluation.truth import MatchedTruth, match_truth
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.geometry.tape import Touch, tape, touch
from msgs_slam.pipelines.outcome import Outcome, load_outcome, map_cloud
from msgs_slam.pipelines.run.folder import RunFolder

Array = NDArray[np.float64]


def place(outcome: Outcome, cloud: GaussianCloud, truth: MatchedTruth, rng: np.random.Generator) -> tuple[Touch, Array]:
    """What the tape finds at a random pixel, and the true place (3,)."""
    t, k, c = outcome.trajectory, outcome.calibration.intrinsics, truth.sequence.camera
    assert c is not None
    rows = np.flatnonzero(t.is_posed & t.is_keyframe & truth.has_pose & (truth.image >= 0))
    while True:
        row = int(rng.choice(rows))
        depth = truth.sequence.depth(int(truth.image[row]))
        assert depth is not None
        u, v = rng.uniform(8, k.width - 8), rng.uniform(8, k.height - 8)
        ray = np.array([(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0])
        x, y = (int(r * f + p) for r, f, p in ((ray[0], c.fx, c.cx), (ray[1], c.fy, c.cy)))
        x, y = x * depth.shape[1] // c.width, y * depth.shape[0] // c.height
        if not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]) or depth[y, x] <= 0:
            continue
        pose, unit = t.world_from_cam[row], ray / np.linalg.norm(ray)
        found = touch(cloud, pose[:3, 3], pose[:3, :3] @ unit, 1 / k.fx)
        if found is not None:
            return found, (truth.world_from_cam[row] @ np.append(depth[y, x] * ray, 1.0))[:3]


def main() -> None:
    """One line of figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("pairs", type=int, nargs="?", default=150)
    arguments = parser.parse_args()
    outcome, sequence = load_outcome(RunFolder(arguments.run), "cpu"), open_sequence(arguments.truth)
    truth = match_truth(outcome.frames, outcome.source_is_folder, sequence)
    both = outcome.trajectory.is_posed & truth.has_pose
    scale = align_points(outcome.trajectory.centers[both], truth.world_from_cam[both][:, :3, 3]).scale
    cloud, rng, rows = map_cloud(outcome), np.random.default_rng(0), []
    for _ in range(arguments.pairs):
        (a, true_a), (b, true_b) = (place(outcome, cloud, truth, rng) for _ in range(2))
        length, sd = tape(a, b)
        rows.append((scale * length, scale * sd, np.linalg.norm(true_a - true_b)))
    length, sd, true = np.array(rows).T
    error = np.abs(length - true)
    within = ", ".join(f"{np.mean(error < n * sd):.0%} within {n} sd" for n in (1, 2, 3))
    print(
        f"{arguments.run}: {len(rows)} distances, median {np.median(true):.2f} m; error median "
        f"{100 * np.median(error):.2f} cm, 90 % {100 * np.quantile(error, 0.9):.2f} cm; "
        f"stated sd median {100 * np.median(sd):.2f} cm; {within}"
    )


if __name__ == "__main__":
    main()
