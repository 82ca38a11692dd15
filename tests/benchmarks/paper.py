"""The paper's tables: its method as printed and ours, beside what it prints for itself and others.

    python tests/benchmarks/paper.py --work RUNS                             Replica office_0, then tables 7 to 10
    python tests/benchmarks/paper.py --work RUNS --data FOLDER --first 20    another sequence, its first frames
    python tests/benchmarks/paper.py --work RUNS --seeds 0,1,2,3,4 --ablation-frames 12
    python tests/benchmarks/paper.py --work RUNS --first -1 --seeds 0,1 --ablation-frames 5    tables 7 to 10 alone

Labels are the data set's, as in the paper. Depth is the true one with a network's kind of error, for the weights of
Metric3D-V2 are not part of this program: a smooth field of 6 % that changes slowly from frame to frame, a slow scale
of 3 % and one of 1 % a frame, depth steps blurred. What is finished in RUNS is not done again.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "benchmarks")]

import cv2
import numpy as np
from ablate import branch
from numpy.typing import NDArray

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.formats.textfile import read_json_object, write_json
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.paper import stages, uncertainty
from msgs_slam.pipelines.paper.uncertainty import PAPER, Constants
from msgs_slam.pipelines.reconstruct import all_stages, reconstruct
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress

OFFICE = ROOT.parent / "shared" / "data" / "replica_office0"
PRINTED = {
    "SplaTAM (RGB-D)": ("37.33", "0.961", "0.109", "0.518", "0.451*", "0.349*", "–", "2.13*"),
    "SGS-SLAM (RGB-D)": ("37.60", "0.961", "0.107", "0.331", "0.416*", "0.328*", "92.25", "2.11*"),
    "MonoGS (mono)": ("34.35", "0.921", "0.224", "29.45", "14.53*", "12.82*", "–", "0.51*"),
    "SNI-SLAM (RGB-D)": ("33.89", "0.962", "0.275", "1.095", "0.631*", "0.516*", "88.63", "2.94*"),
    "MSGS-SLAM": ("37.85", "0.964", "0.104", "0.415", "0.408*", "0.319*", "93.51", "2.05*"),
}
"""Of Replica office_0 in tables 1 and 3; with * the average over eight rooms in table 2. RTX 3090."""
COLUMNS = ("PSNR", "SSIM", "LPIPS", "depth L1, cm", "ATE rmse, cm", "ATE mean, cm", "mIoU, %", "frames/s")
HEAD = f"| | {' | '.join(COLUMNS)} |\n|{' --- |' * (len(COLUMNS) + 1)}"
PLACES = (
    (("images", "keyframes", "psnr"), 1, 2), (("images", "keyframes", "ssim"), 1, 3),
    (("images", "keyframes", "lpips"), 1, 3),
    (("depth", "scaled_l1"), 100, 2), (("trajectory", "sim3 all", "rmse"), 100, 2),
    (("trajectory", "sim3 all", "mean"), 100, 2), (("labels", "mean_iou"), 100, 2),
    (("cost", "frames per second"), 1, 2),
)  # fmt: skip
"""Where `evaluate` has them, the factor to the unit, digits."""
_NO_DEPTH = {"track_depth": 0.0, "map_depth": 0.0}
_NO_CLASSES = {"track_semantic": 0.0, "map_semantic": 0.0, "map_edge": 0.0}
ABLATIONS: dict[str, tuple[dict[str, float], tuple[str, ...]]] = {
    "all": ({}, ()),
    "without proxy depth (table 7)": (_NO_DEPTH, ("mapping.depth_weight=0.0",)),
    "without semantic loss (table 8)": (_NO_CLASSES, ()),
    "without semantic loops (table 9)": ({"t_loop": np.inf}, ()),
    "colour alone (table 10)": (_NO_DEPTH | _NO_CLASSES, ()),
}  # fmt: skip
"""Name → constants of the paper that change, and settings of both methods. A term that a method lacks has no row."""


def network_like(sequence: Dataset, folder: Path, count: int) -> Path:
    """Write the true depth with a network's kind of error, a 16-bit PNG in millimetres a frame."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    field, slow, keep = rng.normal(0, 1, (7, 9)), rng.normal(), np.sqrt(1 - 0.95**2)
    for i in range(count):
        depth = sequence.depth(i)
        assert depth is not None, "the data set has no depth to add an error to"
        field, slow = 0.95 * field + keep * rng.normal(0, 1, (7, 9)), 0.95 * slow + keep * rng.normal()
        error = cv2.resize(0.06 * field, depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
        noisy: NDArray = (
            cv2.GaussianBlur(depth, (0, 0), 2.5) * (1 + error) * (1 + 0.03 * slow) * (1 + 0.01 * rng.normal())
        )
        millimetres = np.where(depth > 0, np.clip(1000 * noisy, 1, 65534), 0).round().astype(np.uint16)
        cv2.imwrite(str(folder / f"{Path(sequence.names[i]).stem}.png"), millimetres)
    return folder


def measured(
    source: Path, run: RunFolder, config: Config, truth: Dataset, constants: Constants = PAPER
) -> dict[str, Any]:
    """Reconstruct with these constants of the paper, evaluate; what is done and unchanged is not done again."""
    stages.constants_of = uncertainty.constants_of = lambda config: constants  # in every stage of this process
    reconstruct(source, run, config, SilentProgress(), until="global_ba")
    file = run.root.with_suffix(".json")
    stamp = {name: record.content for name, record in run.records.items()}
    if not file.exists() or read_json_object(file)["stamp"] != stamp:
        write_json(file, {"stamp": stamp, "figures": evaluate_outcome(load_outcome(run), truth, SilentProgress())})
    return read_json_object(file)["figures"]


def values(figures: dict[str, Any]) -> list[float | None]:
    """Pick the table's columns, None where one cannot be had."""
    out: list[float | None] = []
    for path, factor, _ in PLACES:
        found: Any = figures
        for key in path:
            found = found.get(key) if isinstance(found, dict) else None
        out.append(factor * float(found) if isinstance(found, (int, float)) else None)
    return out


def row(name: str, runs: list[list[float | None]]) -> str:
    """One line of a table: means, with deviations over several runs."""
    cells = []
    for (_, _, digits), column in zip(PLACES, zip(*runs, strict=True), strict=True):
        known = [v for v in column if v is not None]
        spread = f" ± {np.std(known):.{digits}f}" if len(known) > 1 else ""
        cells.append(f"{np.mean(known):.{digits}f}{spread}" if known else "not had")
    return f"| {name} | {' | '.join(cells)} |"


def linked(sequence: Dataset, folder: Path, count: int) -> Path:
    """Make a folder of the first images."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in sequence.names[:count]:
        if not (folder / name).exists():
            (folder / name).symlink_to((sequence.root / "rgb" / name).resolve())
    return folder


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=OFFICE)
    parser.add_argument("--labels", default="semantic_class")
    parser.add_argument("--first", type=int, default=0, help="frames of the main table; 0 = all, -1 = leave it out")
    parser.add_argument("--seeds", default="0,1,2,3,4")
    parser.add_argument("--ablation-frames", type=int, default=12, help="of the other tables; 0 leaves them out")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="settings of every run")
    given = parser.parse_args()
    truth = open_sequence(given.data)
    camera = truth.camera
    assert camera is not None
    count = min(given.first, len(truth)) if given.first > 0 else len(truth)
    depth = network_like(truth, given.work / "depth", len(truth))
    known = [
        f"proxy.depth=files:{depth}", f"proxy.semantics=files:{given.data / given.labels}", "frames.rate=0",
        f"frames.intrinsics={camera.fx},{camera.fy},{camera.cx},{camera.cy}", "run.format=images", *given.set,
    ]  # fmt: skip
    methods = {"--method paper": "paper", "ours": "default"}
    print(f"{given.data.name}, {count} frames, true depth with a network's kind of error")
    if given.first >= 0:
        main_table(given, truth, methods, known, count)
    if given.ablation_frames:
        print(f"\nAblations, the first {given.ablation_frames} frames, seeds {given.seeds}\n\n{HEAD}", flush=True)
        ablations(given, truth, methods, known)


def main_table(
    given: argparse.Namespace, truth: Dataset, methods: dict[str, str], known: list[str], count: int
) -> None:
    """Print both methods on the first frames beside the printed figures."""
    print(f"\n{HEAD}", flush=True)
    source = linked(truth, given.work / f"first_{count}", count)
    for name, method in methods.items():
        config = load_config(None, [*known, f"run.method={method}"])
        found = measured(source, RunFolder(given.work / f"{method}_{count}.msgs"), config, truth)
        print(row(name, [values(found)]), flush=True)
    for name, cells in PRINTED.items():
        print(f"| {name}, as printed | {' | '.join(cells)} |")
    print("\nScanNet cannot be had here (its licence); neither can Metric3D-V2's weights.")


def ablations(given: argparse.Namespace, truth: Dataset, methods: dict[str, str], known: list[str]) -> None:
    """Print tables 7 to 10 of both methods; frames and proxies are made once."""
    source = linked(truth, given.work / f"first_{given.ablation_frames}", given.ablation_frames)
    seeds = given.seeds.split(",")
    for label, method in methods.items():
        base = RunFolder(given.work / f"base_{method}_{given.ablation_frames}.msgs")
        reconstruct(source, base, load_config(None, [*known, f"run.method={method}"]), SilentProgress(), until="proxy")
        for name, (changed, settings) in ABLATIONS.items():
            if method == "default" and name != "all" and not settings:
                continue
            runs = []
            for seed in seeds:
                overrides = [*known, *settings, f"run.method={method}", f"run.seed={seed}"]
                config = load_config(None, overrides)
                slug = "".join(c if c.isalnum() else "_" for c in f"{method}_{name}_{given.ablation_frames}_{seed}")
                run = RunFolder(given.work / f"{slug}.msgs")
                branch(base, run, ("frames", "proxy"), (all_stages(method), config))
                runs.append(values(measured(source, run, config, truth, replace(PAPER, **changed))))
            print(row(f"{label}, {name}", runs), flush=True)


if __name__ == "__main__":
    main()
