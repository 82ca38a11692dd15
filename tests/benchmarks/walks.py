"""Poses of walks through made homes against their exact truth: is all of a walk in one place and at one scale, and is
it said where it is not?

    python -m tests.benchmarks.rooms walk DIR --set choose --rooms 6             makes the walks
    msgs-slam reconstruct DIR/walk/SEED/video.mp4 SEED.msgs --until tracking     or whole
    python tests/benchmarks/walks.py SEED.msgs=DIR/walk/SEED ...                 a line a run, and how many pass

"placed": share of the picked frames that have a position (in the result; in pieces beside it). Of each part, the result
first: its frames, the RMSE of its centres after Sim(3), also in per cent of the whole true path, and "thirds", the
scale of its last third over its first. "stretch": the largest ratio of the scales of two twelfths of the result;
"misplaced": share of the result that lies more than 5 % of the path from where it belongs after alignment of the most
that agrees. A walk passes where all is placed in one part, where the ATE is at most 1 % of the path, where the thirds
agree within 3 %, and where they do in every part (no silent factor).
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

ATE, THIRDS, MISPLACED = 0.01, 0.03, 0.05
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """Frames of a part, the RMSE of their centres in metres, its share of the path, and the scale of thirds."""

    frames: int
    ate: float
    of_path: float
    thirds: float

    @property
    def is_even(self) -> bool:
        """Of one scale."""
        return abs(np.log(self.thirds)) <= np.log1p(THIRDS)


@dataclass(frozen=True)
class Judged:
    """The picked frames, the parts, the result first, and what of the result has another scale or is elsewhere."""

    picked: int
    parts: list[Part]
    stretch: float
    misplaced: float
    warnings: list[str]

    @property
    def passes(self) -> tuple[bool, bool, bool, bool]:
        """All placed in one, ATE, scale of the result, scale within every part."""
        whole = self.parts[0]
        one = whole.frames == self.picked
        return one, whole.of_path <= ATE, whole.is_even, all(p.is_even for p in self.parts)


def judge(run: Path, truth: Path) -> Judged:
    """Compare a run with the truth of its walk."""
    folder, sequence, parts = RunFolder(run), open_sequence(truth), list[Part]()
    path = np.loadtxt(truth / "traj.txt").reshape(-1, 4, 4)[:, :3, 3]
    length = float(np.linalg.norm(np.diff(path[::6], axis=0), axis=1).sum())
    stage = "global_ba" if "global_ba" in folder.records else "tracking"
    for name in ("", *folder.pieces("tracking")):
        found = folder.load(TRAJECTORY, "tracking" if name else stage, piece=name)
        matched = match_by_time(found.timestamps, sequence)
        placed = found.is_posed & matched.has_pose
        pair = found.centers[placed], matched.world_from_cam[placed][:, :3, 3]
        error = absolute_error(*pair, with_scale=True).statistics.rmse
        parts.append(Part(int(placed.sum()), error, error / length, _thirds(*pair)))
        if not name:
            picked, stretch, misplaced = len(placed), local_scale(*pair), _misplaced(*pair, MISPLACED * length)
    said = [w for record in folder.records.values() for w in record.warnings]
    return Judged(picked, parts, stretch, misplaced, said)


def _thirds(ours: Array, theirs: Array) -> float:
    third = len(ours) // 3
    if third < 3:
        return 1.0  # too short to have two scales
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
    found, given = [], parser.parse_args()
    for case in given.cases:
        run, _, truth = case.partition("=")
        one = judge(Path(run), Path(truth))
        found.append(one.passes)
        placed = sum(p.frames for p in one.parts)
        rows = (f"{p.frames} ({100 * p.ate:.1f} cm, {p.of_path:.2%}, {p.thirds:.3f})" for p in one.parts)
        print(
            f"{Path(run).stem}: {placed} of {one.picked} placed in {len(one.parts)} parts; frames (ATE, of the path, "
            f"thirds): {', '.join(rows)}; stretch {one.stretch:.2f}, misplaced {one.misplaced:.0%}",
            flush=True,
        )
        for line in one.warnings if given.warnings else ():
            print(f"    {line}")
    whole, near, even, honest = np.array(found).sum(0)
    print(f"all in one {whole}, ATE {near}, one scale {even}, in every part {honest} of {len(found)}")


if __name__ == "__main__":
    main()
