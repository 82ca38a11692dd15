"""The map of a short stretch of a recording at true poses: what a setting does, in a minute instead of ten.

    python tests/benchmarks/mapping_stretch.py replica_office0 --first 16            8 keyframes from frame 16 on
    python tests/benchmarks/mapping_stretch.py replica_office0 --depth noisy --labels noisy --ablation
    python tests/benchmarks/mapping_stretch.py whiteroom --depth proxy_depth --set mapping.passes=20

--depth and --labels: a folder of the recording, or "noisy" for the truth with the noise of `mapping.py`. Every eighth
frame is held out. No loops, no own poses, no triangulated points: `mapping.py` measures the whole.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
import torch
from mapping import ABLATIONS, noisy_depth, noisy_labels
from numpy.typing import NDArray

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.pipelines.config import Config
from msgs_slam.pipelines.depth.align import fit_fields
from msgs_slam.pipelines.depth.fields import FINE, field_scales
from msgs_slam.pipelines.evaluation.labels import count_labels, score
from msgs_slam.pipelines.evaluation.metrics import DepthErrorSum, psnr, ssim
from msgs_slam.pipelines.evaluation.views import view_map
from msgs_slam.pipelines.mapping.optimise import optimise_map
from msgs_slam.pipelines.mapping.views import View, make_view, occurring_classes, without_contradicted_depth
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.system.parallel import LruSequence
from msgs_slam.pipelines.types import VOID, Intrinsics, ProxyMaps


@dataclass(frozen=True)
class Shot:
    """One frame of the stretch with what mapping is given and what is true."""

    index: int
    image: NDArray[np.uint8]
    maps: ProxyMaps
    true_depth: NDArray[np.float32]
    true_labels: NDArray[np.uint8]

    def view(self, sequence: Dataset, camera: Intrinsics, classes: tuple[int, ...]) -> View:
        """As mapping sees it, at its true pose."""
        return make_view(self.index, camera, pose_of(sequence, self.index), self.image, self.maps, classes)


def pose_of(sequence: Dataset, index: int) -> NDArray[np.float64]:
    """True cam_from_world (4, 4)."""
    assert sequence.world_from_cam is not None
    return np.linalg.inv(sequence.world_from_cam[index])


def load_shots(sequence: Dataset, camera: Intrinsics, indices: range, depth: str, labels: str) -> list[Shot]:
    """Frames with depth and labels of the given kinds, all of the camera's size."""
    rng, shots = np.random.default_rng(0), []
    size = (camera.width, camera.height)
    ids = np.full(256, VOID, np.uint8)
    ids[[c.id for c in sequence.classes]] = np.arange(len(sequence.classes))
    for i in indices:
        true_depth, true_labels = sequence.depth(i), sequence.labels(i)
        assert true_depth is not None
        assert true_labels is not None
        given: NDArray = true_depth
        confidence: NDArray = true_depth > 0
        classes = true_labels
        if depth == "noisy":
            given = noisy_depth(true_depth, rng)
        elif depth:
            given = _picture(sequence.root / depth, i, size) / np.float32(sequence.depth_per_metre)
            beside = sequence.root / depth.replace("depth", "conf")
            confidence = _picture(beside, i, size) / np.float32(255) if beside.is_dir() else given > 0
        if labels == "noisy":
            classes = noisy_labels(true_labels, rng)
        elif labels:
            classes = ids[_picture(sequence.root / labels, i, size)]
        known = (classes != VOID).astype(np.float32)
        maps = ProxyMaps(given.astype(np.float32), confidence.astype(np.float32), classes, known)
        shots.append(Shot(i, sequence.rgb(i), maps, true_depth, true_labels))
    return shots


def _picture(folder: Path, index: int, size: tuple[int, int]) -> NDArray:
    picture = cv2.imread(str(sorted(folder.glob("*.png"))[index]), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST)


def agreeing(views: list[View]) -> list[View]:
    """The views with depths that agree, as tracking's fields and mapping would make them; no points."""
    fields = fit_fields([v.posed_depth() for v in views], {}).reshape(-1, FINE.rows, FINE.columns)
    scales = [field_scales(f, *v.depth.shape) for f, v in zip(fields, views, strict=True)]
    scaled = [replace(v, depth=v.depth * torch.from_numpy(s)) for v, s in zip(views, scales, strict=True)]
    return list(without_contradicted_depth(LruSequence(len(scaled), scaled.__getitem__, lambda v: v.nbytes, math.inf)))


def measure(sequence: Dataset, shots: list[Shot], camera: Intrinsics, config: Config) -> dict[str, float]:
    """Map the stretch and compare it with the truth; depth in centimetres."""
    held_out = [s for n, s in enumerate(shots) if n % 8 == 4]
    used = [s for n, s in enumerate(shots) if n % 8 != 4]
    classes = occurring_classes([s.maps.labels for s in used])
    started = time.process_time()
    views = agreeing([s.view(sequence, camera, classes) for s in used])
    result = optimise_map(views, len(classes), config.mapping, 0)
    row: dict[str, float] = {"cpu seconds": time.process_time() - started, "gaussians": len(result.gaussian_map)}
    label_of = np.array([*classes, *[VOID] * (256 - len(classes))], np.uint8)
    depth, count = DepthErrorSum(), len(sequence.classes)
    shown, given = np.zeros((count, 257), np.int64), np.zeros((count, 257), np.int64)
    pictures: dict[str, list[tuple[float, float]]] = {"keyframe": [], "held out": []}
    for n, shot in enumerate([*used, *held_out]):
        own = n < len(used)
        pose = result.cam_from_world[n] if own else pose_of(sequence, shot.index)
        view = view_map(result.gaussian_map, label_of, camera, pose)
        color = view.color * np.exp(result.log_gains[n]) + result.offsets[n] if own else view.color
        picture = np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
        kind = "keyframe" if own else "held out"
        pictures[kind].append((psnr(picture, shot.image), ssim(picture, shot.image)))
        depth.add(view.depth, shot.true_depth)
        shown += count_labels(view.labels, shot.true_labels, 256, count)
        given += count_labels(shot.maps.labels, shot.true_labels, 256, count)
    for kind, values in pictures.items():
        row[f"{kind} psnr"], row[f"{kind} ssim"] = np.mean(values, axis=0).tolist()
    if (error := depth.result()) is not None:
        row["depth L1 cm"] = 100 * error.metric_l1
    row["mIoU"], row["input mIoU"] = _mean_iou(shown), _mean_iou(given)
    return row


def _mean_iou(counts: NDArray[np.int64]) -> float:
    """In per cent."""
    count = len(counts)
    found = score(np.concatenate([counts[:, :count], counts[:, count:].sum(1, keepdims=True)], axis=1))
    return float("nan") if found is None else 100 * found.mean_iou


def main() -> None:
    """Run the variants and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", help="folder below --data")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="the recordings")
    parser.add_argument("--depth", default="", help="noisy, or a folder; empty = the truth")
    parser.add_argument("--labels", default="", help="noisy, or a folder; empty = the truth")
    parser.add_argument("--first", type=int, default=0, help="first frame")
    parser.add_argument("--frames", type=int, default=9, help="frames, held-out ones among them")
    parser.add_argument("--ablation", action="store_true", help="one map for each switch of the method")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="section.key=value")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    sequence = open_sequence(arguments.data / arguments.recording)
    if sequence.camera is None or not sequence.has_depth or not sequence.has_labels:
        parser.error(f"{arguments.recording} has no camera, depth or labels to compare with")
    k = sequence.camera
    camera = Intrinsics(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
    indices = range(arguments.first, min(arguments.first + arguments.frames, len(sequence)))
    shots = load_shots(sequence, camera, indices, arguments.depth, arguments.labels)
    rows = []
    variants = {n: s for n, s in ABLATIONS.items() if all(x.startswith("mapping.") for x in s)}
    for name, switches in (variants if arguments.ablation else {"complete": ()}).items():
        config = load_config(None, ["mapping.min_iterations=0", *arguments.overrides, *switches])
        row = measure(sequence, shots, camera, config)
        rows.append({"variant": name, **row})
        print(f"{name:28}", "  ".join(f"{key} {value:.4g}" for key, value in row.items()), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
