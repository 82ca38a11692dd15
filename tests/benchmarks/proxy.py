"""Measures depth, its reliability, and labels of the proxy stage against truth.

    python tests/benchmarks/proxy.py --work RUNS                         the embedded providers, all sequences
    python tests/benchmarks/proxy.py --work RUNS replica --json rows.json
    python tests/benchmarks/proxy.py --work RUNS --fused                 a noisy network alone, fused, and without it
    python tests/benchmarks/proxy.py --work RUNS --labels                a real segmentation network on two videos
    python tests/benchmarks/proxy.py --work RUNS --sheets                pictures to look at, into RUNS

Runs lie in RUNS and are taken up again by a second call: picking frames is not repeated. Depths are compared after one
scale for the whole run (none where the depth is metric), over every pixel of every keyframe whose truth is known.
Errors are relative. Flicker is the share of pixels whose label changes to the next keyframe, where the reliable depths
of both say that they show the same place.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
from numpy.typing import NDArray
from tracking import write_noisy_depth

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.image_folder import natural_key
from msgs_slam.formats.images import read_depth_png
from msgs_slam.pipelines.geometry.camera import project, resample_nearest, unproject_depth
from msgs_slam.pipelines.proxy import selection
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import BACKBONE, CALIBRATION, CLASSES, FIGURES, FRAMES, PROXY_MAPS
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import VOID, Frame, ProxyMaps

DATA = ROOT.parent / "shared" / "data"
RELIABLE = 0.35


class TimedProgress(SilentProgress):
    """Adds up the seconds that each bar takes, by the clock and of the processor; work between its items counts to it.

    Where other work shares the machine, those of the processor over the number of its cores are the fair figure.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    def track(self, items: Iterable[Any], label: str, total: int | None = None) -> Iterator[Any]:
        """The items, and the time until the last of them is done."""
        started, cpu_started = time.monotonic(), time.process_time()
        yield from items
        self.seconds[label] = self.seconds.get(label, 0.0) + time.monotonic() - started
        self.cpu_seconds[label] = self.cpu_seconds.get(label, 0.0) + time.process_time() - cpu_started


@dataclass(frozen=True)
class Case:
    """A folder of pictures with true depth, by `suffix` in place of theirs, or the data set that has both."""

    pictures: Path
    depth: Path
    glob: str = "*"
    suffix: str = ".png"
    is_set: bool = False

    def truth(self, name: str, width: int, height: int) -> NDArray[np.float32]:
        """(h, w) metres of the picture `name`, 0 = unknown."""
        if self.is_set:
            sequence = open_sequence(self.depth)
            stored = sequence.depth(sequence.names.index(name))
            assert stored is not None
        else:
            stored = read_depth_png(self.depth / (name.split(".")[0] + self.suffix)).astype(np.float32) / 1000
            stored[stored > 60] = 0
        return resample_nearest(stored.astype(np.float32), height, width)


CASES = {
    "replica": Case(DATA / "replica_office0" / "rgb", DATA / "replica_office0" / "depth"),
    "whiteroom": Case(DATA / "whiteroom" / "rgb", DATA / "whiteroom" / "depth"),
    "kitchen": Case(DATA / "kitchen", DATA / "kitchen", "*.color.jpg", is_set=True),
}
VIDEOS = {
    "kitchen": DATA / "videos" / "kitchen_640x480_30fps.mp4",
    "bedroom": DATA / "videos" / "bedroom_848x364_58fps.mp4",
}


def pictures_of(name: str, work: Path, first: int) -> Path:
    """The folder to reconstruct: its `first` pictures (0 = all), colour only where depth lies among them."""
    case = CASES[name]
    if case.glob == "*" and not first:
        return case.pictures
    folder = work / f"{name}{first or ''}_pictures"
    folder.mkdir(exist_ok=True)
    for path in sorted(case.pictures.glob(case.glob), key=lambda p: natural_key(p.name))[: first or None]:
        if not (folder / path.name).exists():
            shutil.copy(path, folder / path.name)
    return folder


def run_proxy(source: Path, run: RunFolder, *settings: str) -> TimedProgress:
    """Bring the proxy stage up to date; the seconds of its passes, none when it was."""
    progress = TimedProgress()
    reconstruct(source, run, load_config(overrides=settings), progress, "proxy")
    return progress


def keyframes(run: RunFolder) -> list[Frame]:
    """The frames that have maps."""
    return [f for f in run.load(FRAMES) if run.holds(PROXY_MAPS, of=f.id)]


# depth ----------------------------------------------------------------------------------------------------------


def measure_depth(case: Case, run: RunFolder) -> dict[str, Any]:
    """Errors of all pixels with truth, by reliability."""
    ratios, reliabilities = [], []
    names = sorted((p.name for p in case.pictures.glob(case.glob)), key=natural_key)
    for frame in keyframes(run):
        maps = run.load(PROXY_MAPS, of=frame.id)
        truth = case.truth(names[frame.source_index], maps.depth.shape[1], maps.depth.shape[0])
        known = truth > 0
        ratio = np.where(maps.depth > 0, np.log(np.maximum(maps.depth, 1e-9) / np.where(known, truth, 1)), np.inf)
        # A seventh of the pixels is enough for medians and keeps the memory small.
        ratios.append(ratio[known][::7].astype(np.float32))
        reliabilities.append(maps.confidence[known][::7])
    ratio, u = np.concatenate(ratios), np.concatenate(reliabilities)
    metric = bool(run.load(FIGURES["proxy"])["metric"])
    scale = float(np.median(ratio[u > RELIABLE]))
    error = np.abs(np.expm1(ratio - (0 if metric else scale)))
    order = np.argsort(u, kind="stable")
    third = len(order) // 3
    top, bottom = float(np.median(error[order[-third:]])), float(np.median(error[order[:third]]))
    return {
        "keyframes": len(keyframes(run)),
        "metric": metric,
        "scale_error": round(float(np.expm1(scale)), 4) if metric else None,
        "reliable_share": round(float((u > RELIABLE).mean()), 4),
        "median_reliable": round(float(np.median(error[u > RELIABLE])), 5),
        "median_all": round(float(np.median(error)), 5),
        "mean_all": round(float(np.minimum(error, 1).mean()), 5),
        "within_2_percent": round(float((error < 0.02).mean()), 4),
        "top_third": round(top, 5),
        "bottom_third": round(bottom, 5),
        "top_over_bottom": round(top / bottom, 3),
    }


def run_scale(case: Case, run: RunFolder) -> float:
    """Depth of the maps over true depth, over the reliable pixels of all keyframes."""
    names = sorted((p.name for p in case.pictures.glob(case.glob)), key=natural_key)
    ratios = []
    for frame in keyframes(run):
        maps = run.load(PROXY_MAPS, of=frame.id)
        truth = case.truth(names[frame.source_index], maps.depth.shape[1], maps.depth.shape[0])
        use = (truth > 0) & (maps.confidence > RELIABLE)
        ratios.append((maps.depth[use] / truth[use])[::7])
    return float(np.median(np.concatenate(ratios)))


# labels ---------------------------------------------------------------------------------------------------------


def flicker(run: RunFolder, labels_of: dict[int, NDArray[np.uint8]] | None = None) -> float:
    """Share of pixels that change their label to the next keyframe, through reliable depth and the backbone's poses."""
    calibration, model = run.load(CALIBRATION), run.find(BACKBONE)
    assert model is not None
    report = run.load(FIGURES["proxy"])
    unit = report.get("metres_per_unit", 1.0)
    poses = dict(zip(model.frame_ids.tolist(), model.cam_from_world, strict=True))
    frames = [f for f in keyframes(run) if f.id in poses]
    changed = compared = 0
    for first, second in pairwise(frames):
        a, b = run.load(PROXY_MAPS, of=first.id), run.load(PROXY_MAPS, of=second.id)
        camera = calibration.intrinsics.at_most(max(a.depth.shape))
        second_from_first = poses[second.id] @ np.linalg.inv(poses[first.id])
        points = unproject_depth(a.depth / unit, camera) @ second_from_first[:3, :3].T + second_from_first[:3, 3]
        xy, z = project(points, camera)
        inside = (a.confidence > RELIABLE) & (z > 0) & (xy > 0).all(-1) & (xy < [camera.width, camera.height]).all(-1)
        column, row = np.floor(np.where(inside[..., None], xy, 0)).astype(int).transpose(2, 0, 1)
        there = b.depth[row, column] / unit
        same = inside & (b.confidence[row, column] > RELIABLE) & (np.abs(there / np.where(inside, z, 1) - 1) < 0.03)
        before, after = (m.labels if labels_of is None else labels_of[f.id] for m, f in ((a, first), (b, second)))
        both = same & (before != VOID) & (after[row, column] != VOID)
        compared += int(both.sum())
        changed += int((before != after[row, column])[both].sum())
    return round(changed / max(compared, 1), 5)


def measure_network(name: str, work: Path) -> dict[str, Any]:
    """DeepLab on a video: frames a second of the network alone, and its flicker before and after the votes."""
    from msgs_slam.pipelines.networks.card import read_card
    from msgs_slam.pipelines.networks.session import Network
    from tests.network_labels import network_labels

    card_file = write_deeplab_card(work)
    run = RunFolder(work / f"{name}_deeplab.msgs")
    # Depth only carries the votes here: half its size does.
    run_proxy(VIDEOS[name], run, f'proxy.semantics="onnx:{card_file}"', "proxy.stereo_side=160")
    network = Network(read_card(card_file), 2, "cpu")
    raw: dict[int, NDArray[np.uint8]] = {}
    seconds = cpu_seconds = 0.0
    for frame in keyframes(run):
        maps = run.load(PROXY_MAPS, of=frame.id)
        image = cv2.resize(run.image(frame), maps.depth.shape[::-1], interpolation=cv2.INTER_AREA)
        started, cpu_started = time.monotonic(), time.process_time()
        output = network.run(np.asarray(image, np.uint8), network.box(image.shape[1], image.shape[0]))["output"]
        ids, _ = network_labels(network, output, image.shape[1], image.shape[0])
        seconds += time.monotonic() - started
        cpu_seconds += time.process_time() - cpu_started
        raw[frame.id] = ids.astype(np.uint8)
    return {
        "keyframes": len(raw),
        "frames_a_second": round(len(raw) / seconds, 1),
        "cpu_seconds_a_frame": round(cpu_seconds / len(raw), 3),
        "classes": list(run.load(CLASSES).names),
        "flicker_network": flicker(run, raw),
        "flicker": flicker(run),
    }


def write_deeplab_card(work: Path) -> Path:
    """A card beside a copy of the network."""
    for file in ("deeplabv3_mnv2_voc.onnx", "coral_pascal_voc_segmentation_labels.txt"):
        shutil.copy(DATA / "models" / file, work / file)
    card = work / "deeplab.toml"
    card.write_text(
        'task = "segmentation"\nmodel = "deeplabv3_mnv2_voc.onnx"\ninput = "pixel_values"\nsize = [513, 513]\n'
        'output = "logits"\nalign_corners = true\nclasses = "coral_pascal_voc_segmentation_labels.txt"\n'
    )
    return card


# sheets ---------------------------------------------------------------------------------------------------------


def write_sheet(run: RunFolder, target: Path, count: int = 4) -> None:
    """Picture, depth, reliability and labels of a few keyframes."""
    frames = keyframes(run)
    colors = np.array([*run.load(CLASSES).colors], np.uint8)
    rows = []
    for frame in frames[:: max(1, len(frames) // count)][:count]:
        maps = run.load(PROXY_MAPS, of=frame.id)
        image = cv2.resize(run.image(frame), maps.depth.shape[::-1], interpolation=cv2.INTER_AREA)
        mixed = (image // 2 + colored_labels(maps, colors) // 2).astype(np.uint8)
        rows.append(np.concatenate([image, colored_depth(maps), grey(maps.confidence), mixed], 1))
    sheet = np.concatenate(rows)
    small = cv2.resize(sheet, (1900, round(sheet.shape[0] * 1900 / sheet.shape[1])), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), cv2.cvtColor(small, cv2.COLOR_RGB2BGR))


def colored_labels(maps: ProxyMaps, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, 3), void black."""
    table = np.zeros((256, 3), np.uint8)
    table[: len(colors)] = colors
    return table[maps.labels]


def colored_depth(maps: ProxyMaps) -> NDArray[np.uint8]:
    """(h, w, 3), near red, far blue."""
    known = maps.depth > 0
    low, high = np.percentile(1 / maps.depth[known], [2, 98]) if known.any() else (0.0, 1.0)
    share = np.where(known, (1 / np.maximum(maps.depth, 1e-9) - low) / (high - low), 0)
    drawn = cv2.applyColorMap(np.uint8(255 * np.clip(share, 0, 1)), cv2.COLORMAP_TURBO)
    return np.asarray(cv2.cvtColor(drawn, cv2.COLOR_BGR2RGB), np.uint8)


def grey(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(h, w, 3) of values in 0..1."""
    return np.repeat(np.uint8(255 * np.clip(values, 0, 1))[..., None], 3, 2)


# main -----------------------------------------------------------------------------------------------------------


def run_of(name: str, work: Path, first: int, suffix: str = "") -> RunFolder:
    """Where a sequence's run lies."""
    return RunFolder(work / f"{name}{first or ''}{suffix}.msgs")


def measure_embedded(name: str, work: Path, first: int) -> dict[str, Any]:
    """One row: the providers that need no weights."""
    run = run_of(name, work, first)
    progress = run_proxy(pictures_of(name, work, first), run)
    seconds = progress.seconds
    report = run.load(FIGURES["proxy"])
    row = {
        **measure_depth(CASES[name], run),
        "flicker": flicker(run),
        "kilobytes_a_frame": report["kilobytes_a_frame"],
    }
    if "stereo" in seconds:
        frames = row["keyframes"]
        row["stereo_seconds_a_frame"] = round((seconds["stereo"] + seconds["depth"]) / frames, 3)
        cpu = progress.cpu_seconds["stereo"] + progress.cpu_seconds["depth"]
        row["stereo_cpu_seconds_a_frame"] = round(cpu / frames, 3)
        row["seconds_a_frame"] = {k: round(v / frames, 3) for k, v in seconds.items()}
    return row


def measure_fused(name: str, work: Path, first: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """A network that is off by 6 % and 3 %: alone, fused, and what there is without it."""
    yield "multiview", measure_embedded(name, work, first)
    run, noisy = run_of(name, work, first, "_fused"), work / f"{name}_noisy"
    if not run.root.exists():
        shutil.copytree(run_of(name, work, first).root, run.root)
    write_noisy_depth(CASES[name].depth, noisy)
    for provider, spread in (("network", np.inf), ("network + multiview", -1.0)):
        selection.LEARNED_SPREAD = spread
        run_proxy(pictures_of(name, work, first), run, f'proxy.depth="files:{noisy}"')
        yield provider, measure_depth(CASES[name], run)


def print_rows(rows: list[dict[str, Any]]) -> None:
    """What is asked most, one line a row."""
    for row in rows:
        print("  ".join(f"{k} {v}" for k, v in row.items()), flush=True)


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", help="of replica, whiteroom, kitchen; with --labels kitchen, bedroom")
    parser.add_argument("--work", type=Path, required=True, help="folder for the runs")
    parser.add_argument("--first", type=int, default=0, help="only so many pictures of each sequence")
    parser.add_argument("--fused", action="store_true")
    parser.add_argument("--labels", action="store_true")
    parser.add_argument("--sheets", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    work: Path = arguments.work
    work.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for name in arguments.sequences or list(VIDEOS if arguments.labels else CASES):
        if arguments.labels:
            found = [("deeplab", measure_network(name, work))]
            run = RunFolder(work / f"{name}_deeplab.msgs")
        elif arguments.fused:
            found = list(measure_fused(name, work, arguments.first))
            run = run_of(name, work, arguments.first, "_fused")
        else:
            found = [("embedded", measure_embedded(name, work, arguments.first))]
            run = run_of(name, work, arguments.first)
        rows += [{"sequence": name, "provider": provider, **row} for provider, row in found]
        print_rows(rows[-len(found) :])
        if arguments.sheets:
            write_sheet(run, work / f"{run.root.stem}_sheet.jpg")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
