"""Poses of walks through made homes against their exact truth: is all of a walk in one place and at one scale, and is
it said where it is not?

    python -m tests.benchmarks.rooms walk DIR --set choose --rooms 6             makes the walks
    msgs-slam reconstruct DIR/walk/SEED/video.mp4 SEED.msgs --until tracking     or whole
    python tests/benchmarks/walks.py SEED.msgs=DIR/walk/SEED ...                 a line a run, and how many pass

"placed": share of the picked frames that have a position (in the result; in pieces beside it). ATE: RMSE of the
result's centres after Sim(3), also in per cent of the true path. "thirds": scale of the result's last third over its
first. "stretch": the largest ratio of the scales of two twelfths of it. A walk passes where all is placed, where the
ATE is at most 1 % of the path, where the thirds agree within 3 %. "false": seconds of the result that lie more than
5 % of the path from where they belong after alignment of the most that agrees, which no warning would excuse.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
from numpy.typing import NDArray
from poses import local_scale

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.evaluation.truth import absolute_error, match_by_time
from msgs_slam.pipelines.geometry.se3 import align_points
from msgs_slam.pipelines.run.files import TRAJECTORY
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.types import Trajectory

ATE, THIRDS, MISPLACED = 0.01, 0.03, 0.05
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Judged:
    """Shares of the picked frames in the result and in its pieces; of the result: ATE in metres and
    over the path, scale of thirds and stretches, and the share of its frames that is somewhere else."""

    picked: int
    placed: float
    in_pieces: float
    ate: float
    of_path: float
    thirds: float
    stretch: float
    misplaced: float
    pieces: list[tuple[int, float]]
    warnings: list[str]

    @property
    def passes(self) -> tuple[bool, bool, bool]:
        """All placed, ATE, scale."""
        return self.placed > 0.999, self.of_path <= ATE, abs(np.log(self.thirds)) <= np.log1p(THIRDS)


def judge(run: Path, truth: Path) -> Judged:
    """Compare a run with the truth of its walk."""
    folder = RunFolder(run)
    outcome = load_outcome(folder)
    sequence = open_sequence(truth)
    path = np.loadtxt(truth / "traj.txt").reshape(-1, 4, 4)[:, :3, 3]
    length = float(np.linalg.norm(np.diff(path[::6], axis=0), axis=1).sum())
    matched = match_by_time(outcome.trajectory.timestamps, sequence)
    true = matched.world_from_cam[:, :3, 3]
    whole = outcome.trajectory
    placed = whole.is_posed & matched.has_pose
    ours, theirs = whole.centers[placed], true[placed]
    error = absolute_error(ours, theirs, with_scale=True)
    pieces: list[tuple[int, float]] = []
    for name in folder.pieces("tracking"):
        piece: Trajectory = folder.load(TRAJECTORY, "tracking", piece=name)
        theirs_of = match_by_time(piece.timestamps, sequence).world_from_cam[piece.is_posed][:, :3, 3]
        apart = absolute_error(piece.centers[piece.is_posed], theirs_of, with_scale=True)
        pieces.append((int(piece.is_posed.sum()), apart.statistics.rmse))
    return Judged(
        picked=len(placed),
        placed=float(whole.is_posed.mean()),
        in_pieces=sum(n for n, _ in pieces) / len(placed),
        ate=error.statistics.rmse,
        of_path=error.statistics.rmse / length,
        thirds=_thirds(ours, theirs),
        stretch=local_scale(ours, theirs),
        misplaced=_misplaced(ours, theirs, MISPLACED * length),
        pieces=pieces,
        warnings=[w for record in folder.records.values() for w in record.warnings],
    )


def _thirds(ours: Array, theirs: Array) -> float:
    third = len(ours) // 3
    first, last = (align_points(ours[s], theirs[s]).scale for s in (slice(0, third), slice(len(ours) - third, None)))
    return last / first


def _misplaced(ours: Array, theirs: Array, far: float) -> float:
    """Share of the frames farther than `far` from the truth by the alignment, of those by stretches of a sixth, that
    has fewest."""
    step = max(len(ours) // 6, 3)
    stretches = [slice(k, k + step) for k in range(0, len(ours) - step + 1, max(step // 2, 1))]
    off = [np.linalg.norm(align_points(ours[s], theirs[s]).apply(ours) - theirs, axis=1) > far for s in stretches]
    return float(min(o.mean() for o in off))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="+", metavar="RUN.msgs=TRUTH")
    parser.add_argument("--warnings", action="store_true", help="print what each run says")
    found = []
    given = parser.parse_args()
    for case in given.cases:
        run, _, truth = case.partition("=")
        one = judge(Path(run), Path(truth))
        found.append(one.passes)
        parts = ", ".join(f"{n} frames {100 * e:.1f} cm" for n, e in one.pieces) or "none"
        print(
            f"{Path(run).stem}: {one.picked} picked, placed {one.placed:.1%} (in "
            f"pieces {one.in_pieces:.1%}); ATE {100 * one.ate:.1f} cm, {one.of_path:.2%}; thirds {one.thirds:.3f}, "
            f"stretch {one.stretch:.2f}; misplaced {one.misplaced:.0%}; pieces: {parts}",
            flush=True,
        )
        for line in one.warnings if given.warnings else ():
            print(f"    {line}")
    placed, near, even = np.array(found).sum(0)
    print(f"all placed {placed}, ATE {near}, scale {even} of {len(found)}")


if __name__ == "__main__":
    main()
