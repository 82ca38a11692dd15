"""Up and the floor of finished runs against the truth: degrees and centimetres, by every witness.

    python tests/benchmarks/upright.py RUN.msgs=TRUTH[:x,y,z] ...

TRUTH is a data set with poses; x,y,z is up in its world (default: z). The floor is judged where the truth has depth:
the height, in the exported world, of the true surface at the bottom.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.evaluation.metrics import true_surface
from msgs_slam.pipelines.evaluation.truth import absolute_error, match_truth
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.scene.world import find_upright, upright_world


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="RUN=TRUTH[:x,y,z]")
    for case in parser.parse_args().cases:
        run, _, rest = case.partition("=")
        truth, _, up = rest.partition(":")
        judge(Path(run), Path(truth), np.array([float(v) for v in (up or "0,0,1").split(",")]))


def judge(run: Path, truth: Path, true_up: np.ndarray) -> None:
    """One line for up, one for the floor."""
    outcome = load_outcome(RunFolder(run))
    matched = match_truth(outcome.frames, outcome.source_is_folder, open_sequence(truth))
    usable = outcome.trajectory.is_posed & matched.has_pose
    truth_from_run = absolute_error(
        outcome.trajectory.centers[usable], matched.world_from_cam[usable][:, :3, 3], with_scale=True
    ).alignment
    # Rotations tell the axes better than the centres of a short path do.
    turns = matched.world_from_cam[usable][:, :3, :3] @ outcome.trajectory.cam_from_world[usable][:, :3, :3]
    up_in_run = Rotation.from_matrix(turns).mean().inv().apply(true_up / np.linalg.norm(true_up))
    began = time.process_time()
    found = find_upright(outcome)
    seconds = time.process_time() - began
    off = np.degrees(np.arccos(np.clip(found.up @ up_in_run, -1, 1)))
    print(f"{run.name}: up {off:.2f} degrees off, told by {found.source or 'nothing'}, {seconds:.1f} s CPU", end="")
    print("".join(f"; {name} {degrees} from it" for name, degrees in found.disagreement_deg.items()))
    world = upright_world(outcome, found)
    points, _ = true_surface(matched)
    if len(points) and world.has_floor:
        in_run = truth_from_run.inverse().apply(points)
        heights = world.exported_from_run.apply(in_run)[:, 2] * truth_from_run.scale
        low = heights[heights < np.quantile(heights, 0.002) + 0.3]
        counts, edges = np.histogram(low, bins=np.arange(low.min(), low.max() + 0.01, 0.01))
        level = edges[counts.argmax()] + 0.005
        print(
            f"    the true floor lies at {100 * level:+.1f} cm, {100 * np.std(low[abs(low - level) < 0.1]):.1f} cm sd"
        )


if __name__ == "__main__":
    main()
