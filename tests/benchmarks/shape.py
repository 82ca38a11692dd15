"""The shape and not only the picture: depth of proxies, map and mesh against truth, by confidence and by place.

    python tests/benchmarks/shape.py RUN=TRUTH [RUN=TRUTH ...]          one row a run, and a table by confidence
    python tests/benchmarks/shape.py RUN=TRUTH --map --mesh             the map's depth and the mesh too, where they are
    python tests/benchmarks/shape.py RUN=TRUTH --sheet DIR              pictures of the worst keyframes
    python tests/benchmarks/shape.py all --recordings WORK             recordings, or their NAMEs, run first, in WORK

RUN is a run folder with the proxy stage done, TRUTH a data set with depth, or a folder of `shared/data/real`, whose
depth lies on its pictures. Depths of a run are compared after one scale (the median), every third pixel of the
keyframes with truth. "off": wrong by more than 5 %. "sure": reliability 0.5 or more; these are off after a scale of
their own, for where few pixels are sure the others' errors would be theirs. "plain": the third of the pixels with
least contrast around them; "edges": within four pixels of a step of the true depth; "else": neither. "AUSE": area
between the share that is off among the surest pixels and the least that any order could have, in per cent.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
from numpy.typing import NDArray
from poses import REAL
from tracking import write_video

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.images import read_depth_png
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.evaluation.truth import match_truth
from msgs_slam.pipelines.evaluation.views import render_outcome
from msgs_slam.pipelines.geometry.camera import resample_nearest
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import CALIBRATION, FRAMES, PROXY_MAPS
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.sfm.lens import FramePixels
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Frame

DATA = ROOT.parent / "shared" / "data"
VIDEOS = {
    "kitchen": (DATA / "videos" / "kitchen_640x480_30fps.mp4", DATA / "kitchen"),
    **{name: (DATA / name / "video.mp4", DATA / name) for name in ("whiteroom", "whiteroom_2", "staircase")},
}
BINS = (0.0, 0.05, 0.15, 0.3, 0.5, 0.8, 1.01)
SURE, OFF = 0.5, 0.05
_STEP, _AROUND = 1.08, 9
_CONTRAST = 7


@dataclass(frozen=True)
class View:
    """A keyframe's depth, reliability, true depth (0 = unknown), all (h, w), and its picture (h, w, 3)."""

    depth: NDArray[np.float32]
    reliability: NDArray[np.float32]
    truth: NDArray[np.float32]
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class Pixels:
    """Of all pixels that are compared, (P,): depth, reliability, true depth, contrast around, near a step of depth."""

    depth: NDArray
    reliability: NDArray
    truth: NDArray
    contrast: NDArray
    at_step: NDArray


def true_depths(run: RunFolder, truth: Path) -> dict[int, NDArray[np.float32]]:
    """True depth of the run's frames that have any, by id, as their undistorted pictures would show it."""
    frames, pixels = run.load(FRAMES), FramePixels(run.load(CALIBRATION))
    if (truth / "intrinsics.txt").exists():
        files = sorted((truth / "depth").iterdir())
        depths = {f.id: read_depth_png(files[f.source_index]).astype(np.float32) / 1000 for f in frames}
    else:
        sequence = open_sequence(truth)
        by_name = all(f.name for f in frames) and len({f.name for f in frames}) == len(frames)
        matched = match_truth(frames, by_name, sequence)
        depths = {f.id: sequence.depth(int(k)) for f, k in zip(frames, matched.image, strict=True) if k >= 0}
    return {i: pixels.sample(d) for i, d in depths.items() if d is not None}


def run_recordings(names: list[str], work: Path) -> list[str]:
    """Run recordings until proxy, where they are not yet; return RUN=TRUTH of each."""
    pairs = []
    for name in names or [*REAL, *VIDEOS]:
        source, truth = VIDEOS.get(name, (work / f"{name}.mp4", DATA / "real" / name))
        if name in REAL and not source.exists():
            write_video(source, truth / "rgb", REAL[name])
        run = RunFolder(work / f"{name}.msgs")
        reconstruct(source, run, load_config(), SilentProgress(), "proxy")
        pairs.append(f"{run.root}={truth}")
    return pairs


def proxy_views(run: RunFolder, truths: dict[int, NDArray[np.float32]]) -> Iterator[View]:
    """The proxies of the keyframes with truth."""
    for frame in run.load(FRAMES):
        if frame.id in truths and run.holds(PROXY_MAPS, of=frame.id):
            maps = run.load(PROXY_MAPS, of=frame.id)
            yield make_view(run, frame, maps.depth, maps.confidence, truths[frame.id])


def map_views(run: RunFolder, truths: dict[int, NDArray[np.float32]]) -> Iterator[View]:
    """The map's depth at the same keyframes, by the proxies' reliability."""
    outcome = load_outcome(run)
    poses = dict(zip(outcome.trajectory.frame_ids.tolist(), outcome.trajectory.cam_from_world, strict=True))
    for frame in run.load(FRAMES):
        if frame.id in truths and frame.id in poses and run.holds(PROXY_MAPS, of=frame.id):
            depth = render_outcome(outcome, poses[frame.id]).depth
            height, width = depth.shape
            trust = resample_nearest(run.load(PROXY_MAPS, of=frame.id).confidence, height, width)
            yield make_view(run, frame, depth, trust, truths[frame.id])


def make_view(run: RunFolder, frame: Frame, depth: NDArray, trust: NDArray, truth: NDArray) -> View:
    """Truth and picture at the depth's size."""
    height, width = depth.shape
    image = cv2.resize(run.image(frame), (width, height), interpolation=cv2.INTER_AREA)
    return View(depth, trust, resample_nearest(truth.astype(np.float32), height, width), np.asarray(image, np.uint8))


def gather(views: list[View]) -> Pixels:
    """Every third pixel with truth and depth."""
    columns = []
    for v in views:
        grey = cv2.cvtColor(v.image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        mean, square = (cv2.blur(g, (_CONTRAST, _CONTRAST)) for g in (grey, grey**2))
        known, size = v.truth > 0, np.ones((_AROUND, _AROUND), np.uint8)
        far = cv2.dilate(np.where(known, v.truth, 0), size)
        near = cv2.erode(np.where(known, v.truth, np.float32(1e6)), size)
        stack = np.stack([v.depth, v.reliability, v.truth, square - mean**2, far > _STEP * near], axis=-1)
        columns.append(stack[known & (v.depth > 0)][::3])
    return Pixels(*np.concatenate(columns).T)


def measure(p: Pixels) -> dict[str, float]:
    """One row: lengths in centimetres, shares in per cent."""
    error, off = errors(p)
    sure, plain, at_step = p.reliability >= SURE, p.contrast <= np.quantile(p.contrast, 1 / 3), p.at_step > 0
    among_sure = Pixels(*(values[sure] for values in vars(p).values()))
    row = {
        "L1": 100 * error.mean(),
        "of median %": 100 * error.mean() / np.median(p.truth),
        "off %": 100 * off.mean(),
        "sure %": 100 * sure.mean(),
        "sure off %": 100 * errors(among_sure)[1].mean() if sure.any() else np.nan,
        "AUSE %": 100 * sparsification(off, p.reliability),
        "plain L1": 100 * error[plain & ~at_step].mean(),
        "edges L1": 100 * error[at_step].mean(),
        "else L1": 100 * error[~plain & ~at_step].mean(),
    }
    return {name: round(float(value), 2) for name, value in row.items()}


def errors(p: Pixels) -> tuple[NDArray, NDArray]:
    """(P,) |depth - truth| in metres after one scale, and whether that is more than 5 %."""
    error = np.abs(p.depth * np.median(p.truth / p.depth) - p.truth)
    return error, error > OFF * p.truth


def by_confidence(p: Pixels) -> list[dict[str, float]]:
    """Of each bin of reliability: its share of the pixels, how many are off, its share of all error."""
    error, off = errors(p)
    rows = []
    for low, high in pairwise(BINS):
        inside = (p.reliability >= low) & (p.reliability < high)
        if inside.any():
            shares = (inside.mean(), off[inside].mean(), error[inside].sum() / error.sum())
            pixels, wrong, part = (round(100 * float(share), 1) for share in shares)
            rows.append({"from": low, "pixels %": pixels, "off %": wrong, "of L1 %": part})
    return rows


def sparsification(off: NDArray, reliability: NDArray) -> float:
    """Mean over all shares of the surest pixels: how many of them are off, less how many would be in the best order."""
    count = np.arange(1, len(off) + 1)
    found = np.cumsum(off[np.argsort(-reliability, kind="stable")]) / count
    return float((found - np.cumsum(np.sort(off)) / count).mean())


def write_sheet(views: list[View], target: Path, count: int = 4) -> None:
    """Picture, truth, depth, error (red too far, blue too near, full by 30 %) of the keyframes with most error."""
    both = gather(views)
    scale = np.median(both.truth / both.depth)

    def signed(v: View) -> NDArray:
        both = (v.truth > 0) & (v.depth > 0)
        return np.where(both, np.log(np.where(both, v.depth * scale, 1) / np.where(both, v.truth, 1)), 0)

    rows = []
    for v in sorted(views, key=lambda v: -float(np.abs(signed(v)).mean()))[:count]:
        e = np.clip(signed(v) / 0.3, -1, 1)[..., None]
        error = 255 * np.where(e > 0, 1 - e * [0, 1, 1], 1 + e * [1, 1, 0])
        near = 1 / np.quantile(v.truth[v.truth > 0], 0.02)
        pair = [np.clip(255 / near / np.maximum(d, 1e-3), 0, 255) for d in (v.truth, v.depth * scale)]
        turbo = [cv2.cvtColor(cv2.applyColorMap(np.uint8(d), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB) for d in pair]
        rows.append(np.hstack([v.image, *turbo, error.astype(np.uint8)]))
    cv2.imwrite(str(target), cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", metavar="RUN=TRUTH | NAME")
    parser.add_argument("--recordings", type=Path, metavar="WORK", help="run recordings of these names first")
    parser.add_argument("--map", action="store_true", help="the map's depth as well")
    parser.add_argument("--mesh", action="store_true", help="the mesh's F-score and PSNR by `evaluate` as well")
    parser.add_argument("--sheet", type=Path, metavar="DIR")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found: dict[str, dict] = {}
    names = [] if arguments.pairs == ["all"] else arguments.pairs
    for pair in run_recordings(names, arguments.recordings) if arguments.recordings else arguments.pairs:
        folder, _, truth = pair.partition("=")
        run, name = RunFolder(Path(folder)), Path(folder).stem
        truths = true_depths(run, Path(truth))
        kinds = {"proxy": proxy_views, **({"map": map_views} if arguments.map else {})}
        for kind, views_of in kinds.items():
            views = list(views_of(run, truths))
            pixels = gather(views)
            found[f"{name} {kind}"] = {**measure(pixels), "bins": by_confidence(pixels)}
            print(f"{name} {kind}:", "  ".join(f"{k} {v}" for k, v in measure(pixels).items()), flush=True)
            for row in by_confidence(pixels):
                print("    ", "  ".join(f"{k} {v}" for k, v in row.items()))
            if arguments.sheet:
                write_sheet(views, arguments.sheet / f"{name}_{kind}.png")
        if arguments.mesh:
            cells = evaluate_outcome(load_outcome(run), open_sequence(Path(truth)))
            found[f"{name} evaluation"] = {k: cells[k] for k in ("images", "depth", "labels", "mesh")}
            print(f"{name} evaluation:", json.dumps(found[f"{name} evaluation"])[:2000], flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
