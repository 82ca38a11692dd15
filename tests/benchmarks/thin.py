"""Depth of thin bars and gaps: a made stairwell with exact depth, of the proxies, the map and the mesh.

    python tests/benchmarks/thin.py --work DIR                     everything, own poses, embedded depth
    python tests/benchmarks/thin.py --work DIR --proxy --sheet     the proxies alone, and pictures to look at

Depths are compared after one scale for the whole clip. "gap": pixels that lie between two bars and are none; "filled":
those of them whose depth is nearer than the truth by a tenth; "bars lost": pixels of bars whose depth is a tenth
farther; "edges": within four pixels of a step of depth. A clip or run that is in DIR already is taken up again.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.evaluation.views import render_outcome
from msgs_slam.pipelines.geometry.camera import resample_nearest
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import FRAMES, PROXY_MAPS
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.benchmarks.worlds.stairwell import BAR
from tests.world import ClipOptions, make_world, write_sequence

OPTIONS = ClipOptions(frames=40, width=400, height=300, laps=0.5, noise=1.0)
_GAP = 0.045
"""Of the picture's width: as far apart are bars between which there is a gap."""
Depths = Iterator[tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]]
"""Depth, weight, true depth and the bars of each keyframe, all (H, W)."""


def proxy_depths(run: RunFolder, truth: Dataset) -> Depths:
    """Of the proxy stage, weighted by its reliability."""
    for frame in run.load(FRAMES):
        if run.holds(PROXY_MAPS, of=frame.id):
            maps = run.load(PROXY_MAPS, of=frame.id)
            yield maps.depth, maps.confidence, *_true(truth, frame.source_index, *maps.depth.shape)


def map_depths(run: RunFolder, truth: Dataset) -> Depths:
    """Of the map, seen from the keyframes."""
    outcome = load_outcome(run)
    index = {f.id: f.source_index for f in outcome.frames}
    poses = outcome.trajectory
    for frame_id, pose in zip(poses.frame_ids.tolist(), poses.cam_from_world, strict=True):
        if run.holds(PROXY_MAPS, of=frame_id):
            depth = render_outcome(outcome, pose).depth
            yield depth, np.ones_like(depth), *_true(truth, index[frame_id], *depth.shape)


def _true(truth: Dataset, index: int, height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    depth, labels = truth.depth(index), truth.labels(index)
    assert depth is not None
    assert labels is not None
    return resample_nearest(depth, height, width), resample_nearest(labels, height, width) == BAR


def between(bars: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) pixels with bars left and right of them."""
    reach = np.ones((1, round(_GAP * bars.shape[1]) | 1), np.uint8)
    return np.asarray((cv2.morphologyEx(bars.astype(np.uint8), cv2.MORPH_CLOSE, reach) > 0) & ~bars)


def measure(depths: Depths) -> dict[str, float]:
    """One row; lengths in centimetres, shares in per cent."""
    columns: list[NDArray] = []
    for depth, weight, true, bars in depths:
        square = np.ones((9, 9), np.uint8)
        steps = cv2.dilate(true, square) > 1.08 * cv2.erode(true, square)
        columns.append(np.stack([depth, weight, true, bars, between(bars), steps], -1)[(true > 0) & (depth > 0)])
    depth, weight, true, bars, gap, steps = np.concatenate(columns).T
    bars, gap, steps = bars > 0, gap > 0, steps > 0
    depth = depth * np.median(true / depth)
    error = np.abs(depth - true)
    row = {
        "depth L1 cm": 100 * error.mean(),
        "weighted": 100 * (error * weight).sum() / weight.sum(),
        "at edges": 100 * error[steps].mean(),
        "gaps filled %": 100 * (depth[gap] < 0.9 * true[gap]).mean(),
        "bars lost %": 100 * (depth[bars] > 1.1 * true[bars]).mean(),
    }
    return {name: round(float(value), 2) for name, value in row.items()}


def write_sheet(depths: Depths, target: Path) -> None:
    """Truth and depth of a few keyframes side by side, near red."""
    rows = []
    for depth, _, true, _ in list(depths)[::9]:
        low, high = 1 / true.max(), 1 / true[true > 0].min()
        pair = np.hstack([true, depth * np.median(true[depth > 0] / depth[depth > 0])])
        share = np.clip((1 / np.maximum(pair, 1e-6) - low) / (high - low), 0, 1)
        rows.append(cv2.applyColorMap(np.uint8(255 * share), cv2.COLORMAP_TURBO))
    cv2.imwrite(str(target), np.vstack(rows))


def main() -> None:
    """Make the clip, reconstruct, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the clip and the run")
    parser.add_argument("--proxy", action="store_true", help="stop after the proxies")
    parser.add_argument("--sheet", action="store_true", help="write pictures into --work")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="section.key=value")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    clip = arguments.work / "stairwell"
    if not (clip / "classes.json").exists():
        write_sequence(clip, make_world("stairwell", texel=0.008), OPTIONS)
    run, config = RunFolder(arguments.work / "stairwell.msgs"), load_config(overrides=arguments.overrides)
    reconstruct(clip / "rgb", run, config, SilentProgress(), "proxy" if arguments.proxy else "export")
    truth = open_sequence(clip)
    rows = {"proxies": measure(proxy_depths(run, truth))}
    if arguments.sheet:
        write_sheet(proxy_depths(run, truth), arguments.work / "proxies.png")
    if not arguments.proxy:
        rows["map"] = measure(map_depths(run, truth))
        found = evaluate_outcome(load_outcome(run), truth)
        rows["evaluation"] = {k: found[k] for k in ("trajectory", "images", "depth", "mesh")}
        if arguments.sheet:
            write_sheet(map_depths(run, truth), arguments.work / "map.png")
    for name, row in rows.items():
        print(f"{name:10}", "  ".join(f"{key} {value}" for key, value in row.items()), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
