"""Measures the map and the mesh on sequences with truth, and what each term of the method earns.

    python tests/benchmarks/mapping.py                          every case below
    python tests/benchmarks/mapping.py office_true whiteroom    some of them
    python tests/benchmarks/mapping.py --ablation office_noisy  the terms of the method switched off, one at a time
    python tests/benchmarks/mapping.py --longer office_true     the same map with twice the passes
    python tests/benchmarks/mapping.py --json rows.json --set mapping.passes=6

Poses are the run's own; every eighth frame is held out of the map. Rows are (case, measure, value); depth in metres.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.pipelines.evaluation.evaluate import evaluate_outcome
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.progress import SilentProgress
from tests.benchmarks.ablate import ABLATIONS as ARTICLE_ABLATIONS


@dataclass(frozen=True)
class Case:
    """One recording with one kind of proxies. "files" folders are below the recording, "made" ones are written."""

    recording: str
    source: str
    settings: tuple[str, ...] = ()
    depth: str = ""
    labels: str = ""
    noise: str = ""


CASES = {
    "office_true": Case("replica_office0", "rgb", (), "depth", "semantic_class"),
    "office_noisy": Case("replica_office0", "rgb", (), "depth", "semantic_class", "depth"),
    "office_noisy_labels": Case("replica_office0", "rgb", (), "depth", "semantic_class", "labels"),
    "office_embedded": Case("replica_office0", "rgb"),
    "kitchen": Case("kitchen", "../videos/kitchen_640x480_30fps.mp4"),
    "whiteroom": Case("whiteroom", "rgb", (), "proxy_depth", "labels"),
    "whiteroom_noisy_labels": Case("whiteroom", "rgb", (), "proxy_depth", "noisy_labels"),
    "whiteroom_embedded": Case("whiteroom", "video.mp4"),
}

ABLATIONS = {
    **ARTICLE_ABLATIONS,
}


def main() -> None:
    """Run the cases and print their rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="the recordings")
    parser.add_argument("--work", type=Path, help="keep the runs here, to go on from later")
    parser.add_argument("--ablation", action="store_true", help="one run for each switch of the method")
    parser.add_argument("--longer", action="store_true", help="also with twice the passes")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="section.key=value")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    if unknown := set(arguments.cases) - set(CASES):
        parser.error(f"no such case: {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    rows: list[tuple[str, str, float]] = []
    with tempfile.TemporaryDirectory() as scratch:
        work = arguments.work or Path(scratch)
        for name in arguments.cases:
            for variant, overrides in _variants(arguments.ablation, arguments.longer):
                label = f"{name} {variant}".strip()
                for measure, value in measure_case(
                    CASES[name], name, arguments.data, work, [*arguments.overrides, *overrides]
                ):
                    rows.append((label, measure, value))
                    print(f"{label:48} {measure:36} {value:12.5g}", flush=True)
    if arguments.json:
        arguments.json.write_text(
            json.dumps([dict(zip(("sequence", "measure", "value"), r, strict=True)) for r in rows], indent=1)
        )


def _variants(ablation: bool, longer: bool) -> list[tuple[str, tuple[str, ...]]]:
    if ablation:
        return list(ABLATIONS.items())
    twice = load_config().mapping.passes * 2
    return [("", ()), *([("twice the passes", (f"mapping.passes={twice}",))] if longer else [])]


def measure_case(case: Case, name: str, data: Path, work: Path, overrides: list[str]) -> Iterator[tuple[str, float]]:
    """(measure, value) of one case; what is up to date in its run folder is not made again."""
    recording = data / case.recording
    truth = open_sequence(recording)
    settings = [
        "mapping.hold_out=8",
        *proxy_settings(case, recording, work / f"{name}_proxies"),
        *case.settings,
        *overrides,
    ]
    if case.depth and truth.camera is not None:
        k = truth.camera
        settings.append(f"frames.intrinsics={k.fx},{k.fy},{k.cx},{k.cy}")
    run = RunFolder(work / f"{name}.msgs")
    started = time.monotonic()
    reconstruct(recording / case.source, run, load_config(None, settings), SilentProgress())
    yield "seconds", time.monotonic() - started
    records = run.records
    for stage in ("mapping", "global_ba", "export"):
        yield f"{stage} seconds", records[stage].seconds
        yield from _numbers(records[stage].figures, stage)
    result = evaluate_outcome(load_outcome(run), truth)
    for group in ("trajectory", "images", "depth", "labels", "mesh"):
        yield from _numbers(result[group], group)


def _numbers(value: Any, prefix: str) -> Iterator[tuple[str, float]]:
    """The numbers of nested cells, lists left out."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{prefix} {key}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield prefix, float(value)


def proxy_settings(case: Case, recording: Path, made: Path) -> list[str]:
    """Where the depth and the labels of the case come from; noisy ones are written to `made` first."""
    out = []
    if case.depth:
        depth = recording / case.depth
        out.append(f"proxy.depth=files:{_noisy_depth(depth, made / 'depth') if case.noise == 'depth' else depth}")
    if case.labels:
        labels = recording / case.labels
        out.append(
            f"proxy.semantics=files:{_noisy_labels(labels, made / 'labels') if case.noise == 'labels' else labels}"
        )
    return out


def _noisy_depth(source: Path, target: Path) -> Path:
    rng = np.random.default_rng(0)
    for path, picture in _pictures(source, target):
        cv2.imwrite(str(path), np.clip(noisy_depth(picture, rng), 0, 65534).astype(np.uint16))
    return target


def noisy_depth(depth: NDArray, rng: np.random.Generator) -> NDArray:
    """Times a smooth field of 6 % and a scale of 3 % a frame: a model of a depth network's error."""
    field = cv2.resize(rng.normal(0, 0.06, (7, 9)), depth.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return depth * (1 + field) * (1 + 0.03 * rng.normal())


def _noisy_labels(source: Path, target: Path) -> Path:
    rng = np.random.default_rng(0)
    for path, picture in _pictures(source, target):
        cv2.imwrite(str(path), noisy_labels(picture, rng))
    return target


def noisy_labels(labels: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Boundaries displaced by up to 3 pixels, and each region of another class in 5 % of the frames."""
    height, width = labels.shape
    shift = [cv2.resize(rng.uniform(-3, 3, (height // 12, width // 12)), (width, height)) for _ in range(2)]
    y, x = np.mgrid[:height, :width]
    noisy = labels[
        np.clip(y + shift[0], 0, height - 1).round().astype(int),
        np.clip(x + shift[1], 0, width - 1).round().astype(int),
    ]
    classes = np.unique(labels)
    count, regions = _regions(noisy)
    for region in range(count):
        if rng.random() < 0.05:
            noisy[regions == region] = rng.choice(classes)
    return noisy


def _regions(labels: NDArray[np.uint8]) -> tuple[int, NDArray[np.int32]]:
    """Number of connected regions of one class, and the region of every pixel."""
    out, count = np.zeros(labels.shape, np.int32), 0
    for value in np.unique(labels):
        found, regions = cv2.connectedComponents((labels == value).astype(np.uint8), connectivity=4)
        out = np.where(labels == value, regions - 1 + count, out)
        count += found - 1
    return count, out


def _pictures(source: Path, target: Path) -> Iterator[tuple[Path, NDArray]]:
    """(path to write, picture as it is stored) in the order of the names."""
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(source.glob("*.png")):
        yield target / path.name, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


if __name__ == "__main__":
    main()
