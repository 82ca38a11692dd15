"""What each constant of stereo does when it is doubled and halved: proxies of whole recordings against truth.

    python tests/benchmarks/constants.py RUN=TRUTH [RUN=TRUTH ...] --work DIR [--only NAME] [--factors F ...]

RUN is a run folder with the frames stage done, TRUTH a data set with depth. A row is the depth of all keyframes with
one constant changed in a copy of the source, measured as `shape.py` does. Raw matches are kept in DIR: constants of
what follows the matching (`AFTER`) cost a second pass only. Stopped at any moment, the same command goes on where it
was: DIR is for one state of the code and one choice of runs.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from shape import gather, make_view, measure, true_depths

from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.proxy.maps import reliability
from msgs_slam.pipelines.proxy.selection import STEREO_PLANES
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, FRAMES
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress

DEPTH = Path("pipelines/depth")
AS_IT_IS = "as it is"
AFTER = {
    "agreeing depths": ("stereo/provider.py", "_TOLERANCE = 0.01", "0.01"),
    "sure from": ("completion/fill.py", "SURE = 0.3", "0.3"),
    "reach of smoothing": ("completion/fill.py", "_SMOOTH_REACH, _SMOOTH_SD = 3 / 80, 30.0", "3"),
    "colours of smoothing": ("completion/fill.py", "_SMOOTH_REACH, _SMOOTH_SD = 3 / 80, 30.0", "30.0"),
    "colours of near evidence": (
        "completion/fill.py",
        "_REACHES = ((1 / 16, 30.0, 1.0), (1 / 4, 60.0, 0.1))",
        "30.0",
    ),
    "colours of far evidence": (
        "completion/fill.py",
        "_REACHES = ((1 / 16, 30.0, 1.0), (1 / 4, 60.0, 0.1))",
        "60.0",
    ),
    "weight of far evidence": ("completion/fill.py", "_REACHES = ((1 / 16, 30.0, 1.0), (1 / 4, 60.0, 0.1))", "0.1"),
    "ridge of planes": ("completion/fill.py", "_RIDGE = 3e-4", "3e-4"),
    "faint variance": ("completion/fill.py", "_FAINT, _POWER = 5e-5, 0.25", "5e-5"),
    "power of contrast": ("completion/fill.py", "_FAINT, _POWER = 5e-5, 0.25", "0.25"),
    "power of evidence": ("completion/evidence.py", "_EVIDENCE_POWER = 2.5", "2.5"),
    "likeness to borrow": ("completion/evidence.py", "_LEAST = 0.5", "0.5"),
    "colours of borrowing": ("completion/fill.py", "_COLOR_SD = 3.0", "3.0"),
    "borrowed depths agree": ("completion/fill.py", "_AGREE = 0.02", "0.02"),
}
"""Name → file, its line, and the number in the line that is changed."""
WITHIN = {
    "angle of a pair": ("stereo/provider.py", "_BEST_ANGLE = 8.0", "8.0"),
    "ends of the range": ("stereo/provider.py", "_STOP = 0.02", "0.02"),
    "likeness in a window": ("stereo/window.py", "LIKENESS = 0.04", "0.04"),
    "floor of variance": ("stereo/window.py", "VARIANCE_FLOOR = 2e-5", "2e-5"),
    "small step": ("stereo/matching.py", "SMALL_STEP, JUMP, EDGE = 0.1, 1.2, 0.05", "0.1"),
    "jump": ("stereo/matching.py", "SMALL_STEP, JUMP, EDGE = 0.1, 1.2, 0.05", "1.2"),
    "edge of a jump": ("stereo/matching.py", "SMALL_STEP, JUMP, EDGE = 0.1, 1.2, 0.05", "0.05"),
    "stiffness": ("stereo/matching.py", "STIFFNESS = 0.01", "0.01"),
    "near margin": ("stereo/consistency.py", "_NEAR_MARGIN, _FAR_MARGIN = 0.45, 1.5", "0.45"),
    "far margin": ("stereo/consistency.py", "_NEAR_MARGIN, _FAR_MARGIN = 0.45, 1.5", "1.5"),
}


def variants(only: str, factors: list[float]) -> Iterator[tuple[str, tuple[str, str, str] | None, float]]:
    """Name, place and factor of every row."""
    yield AS_IT_IS, None, 1.0
    for name, place in (AFTER | WITHIN).items():
        if only in name:
            for factor in factors:
                yield f"{name} x {factor:g}", place, factor


def change(tree: Path, place: tuple[str, str, str], factor: float) -> None:
    """The line of the copied source with the number times the factor. ValueError if it is not as written here."""
    file, line, number = place
    path = tree / "msgs_slam" / DEPTH / file
    text = path.read_text()
    found = re.findall(pattern := rf"(?<![\d.]){re.escape(number)}(?![\d.])", line)
    if text.count(f"{line}\n") != 1 or len(found) != 1:
        raise ValueError(f"{file} has no line {line!r} with one {number}")
    changed = re.sub(pattern, repr(float(number) * factor), line)
    path.write_text(text.replace(f"{line}\n", f"{changed}\n"))


def copy_source(tree: Path) -> None:
    """The packages, and this folder's scripts, as they are found by a process of their own."""
    for name in ("pipelines", "formats"):
        shutil.copytree(ROOT / name, tree / "msgs_slam" / name, ignore=shutil.ignore_patterns("__pycache__"))
    (tree / "msgs_slam" / "__init__.py").touch()
    (tree / "tests/benchmarks").mkdir(parents=True)
    for name in ("constants.py", "shape.py"):
        shutil.copy(Path(__file__).with_name(name), tree / "tests/benchmarks" / name)


def measure_depth(folder: Path, truth: Path, matches: Path) -> dict[str, float]:
    """A row of `shape.py` for the depth that stereo estimates of the run's keyframes; raw matches are kept."""
    run, config = RunFolder(folder), load_config(None, []).proxy
    matches.mkdir(parents=True, exist_ok=True)
    calibration = run.load(CALIBRATION)
    camera = calibration.intrinsics.at_most(config.max_side)
    sequence = Sequence(run.load(FRAMES), calibration, camera, run.load(BACKBONE), run.image)
    stereo = MultiviewDepth(sequence, config.stereo_side, STEREO_PLANES, lambda: matches, 1, SilentProgress())
    stereo.precompute(sequence.frames)
    truths, views = true_depths(run, truth), []
    for frame in sequence.frames:
        if frame.id in truths and frame.id in sequence.cam_from_world:
            found = stereo.estimate(frame)
            trust = reliability(found.depth, found.confidence)
            views.append(make_view(run, frame, found.depth, trust, truths[frame.id]))
    return measure(gather(views))


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", metavar="RUN=TRUTH")
    parser.add_argument("--work", type=Path, required=True, metavar="DIR")
    parser.add_argument("--only", default="", help="the constants whose name holds this")
    parser.add_argument("--factors", type=float, nargs="+", default=[2.0, 0.5])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--matches", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    pairs = [(Path(run), Path(truth)) for run, _, truth in (p.partition("=") for p in arguments.pairs)]
    if arguments.matches:
        kept = arguments.work / arguments.matches
        print(json.dumps({run.stem: measure_depth(run, truth, kept / run.stem) for run, truth in pairs}))
        return
    arguments.work.mkdir(parents=True, exist_ok=True)
    table = arguments.json or arguments.work / "rows.json"
    rows = json.loads(table.read_text()) if table.exists() else {}
    for name, place, factor in variants(arguments.only, arguments.factors):
        if name not in rows:
            rows[name] = _in_copy(arguments, place, factor)
            table.write_text(json.dumps(rows, indent=1))
        for run, row in rows[name].items():
            print(f"{name:32} {run:12} " + "  ".join(f"{k} {row[k]}" for k in ("L1", "off %", "sure %", "sure off %")))


def _in_copy(arguments: argparse.Namespace, place: tuple[str, str, str] | None, factor: float) -> dict[str, dict]:
    tree = arguments.work / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    copy_source(tree)
    if place is not None:
        change(tree, place, factor)
    matches = "changed" if place in WITHIN.values() else "matches"
    shutil.rmtree(arguments.work / "changed", ignore_errors=True)
    command = [sys.executable, str(tree / "tests/benchmarks/constants.py"), *arguments.pairs]
    command += ["--work", str(arguments.work), "--matches", matches]
    environment = {**os.environ, "PYTHONPATH": str(tree.resolve())}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return dict(json.loads(done.stdout.splitlines()[-1]))


if __name__ == "__main__":
    main()
