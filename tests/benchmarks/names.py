"""Measures names: a network by itself, its frames fused in the world, the map, and the mesh.

    python tests/benchmarks/names.py --work RUNS                          every recording, all defaults
    python tests/benchmarks/names.py --work RUNS whiteroom --json rows.json
    python tests/benchmarks/names.py --work RUNS --semantics onnx:CARD.toml --set mapping.max_side=320

Needs a segmentation network: `msgs-slam models pull` before, or --semantics. Runs lie in RUNS and are taken up again by
a second call; RUNS/NAME_names.png shows frame, network alone, fused labels, map, mesh and truth side by side.

Every column is compared with the truth at the same pixels of the same keyframes, over the classes that both sides know
(the class maps that `evaluate` uses); pixels of other true classes are left out. The boundary F-score is that of the
pixels where the common class changes: within 2 and within 6 pixels of a picture 640 wide; what lies that near to a
class that the network does not know is left out. The mesh is looked up at the surface that the map shows.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
from numpy.typing import NDArray
from proxy import TimedProgress
from scipy.spatial import cKDTree

from msgs_slam.formats.datasets import Dataset, open_sequence
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import read_mesh_ply
from msgs_slam.pipelines.config import ProxyConfig
from msgs_slam.pipelines.evaluation.labels import ClassMap, Matching, count_labels, match_classes, read_class_map, score
from msgs_slam.pipelines.evaluation.truth import match_truth
from msgs_slam.pipelines.evaluation.views import Picture, label_picture, render_outcome
from msgs_slam.pipelines.geometry.camera import resample_nearest, unproject_depth
from msgs_slam.pipelines.networks.session import Network
from msgs_slam.pipelines.providers import class_colors
from msgs_slam.pipelines.proxy.selection import choose_semantics
from msgs_slam.pipelines.reconstruct import reconstruct
from msgs_slam.pipelines.run.files import PROXY_MAPS
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome
from msgs_slam.pipelines.run.settings import load_config
from msgs_slam.pipelines.scene.world import FIRST, WORLD
from msgs_slam.pipelines.sfm.lens import FramePixels
from msgs_slam.pipelines.types import VOID, ClassTable
from tests.network_labels import network_labels

DATA = ROOT.parent / "shared" / "data"
SOURCES = {
    "whiteroom": (DATA / "whiteroom" / "video.mp4", DATA / "whiteroom"),
    "whiteroom_2": (DATA / "whiteroom_2" / "video.mp4", DATA / "whiteroom_2"),
    "staircase": (DATA / "staircase" / "video.mp4", DATA / "staircase"),
    "replica": (DATA / "replica_office0" / "rgb", DATA / "replica_office0"),
    "kitchen": (DATA / "videos" / "kitchen_640x480_30fps.mp4", None),
}
OWN_MAPS = {"staircase": Path(__file__).with_name("staircase.toml")}
"""Class maps of recordings for which none comes with the program."""
KINDS = ("network", "fused", "map", "mesh")
TOLERANCES = (2, 6)
SHEET_ROWS = 6


@dataclass
class Tally:
    """Confusion (T, C + 1) of one kind of labels, and its boundary pixels by tolerance: hit, all; ours, theirs."""

    confusion: NDArray[np.int64]
    edges: dict[int, NDArray[np.int64]] = field(default_factory=lambda: {t: np.zeros(4, np.int64) for t in TOLERANCES})

    def add(self, labels: NDArray[np.uint8], truth: NDArray[np.uint8], matching: Matching) -> None:
        """labels, truth (h, w): indices into the classes that `matching` joins."""
        classes, true_classes = len(matching.of_ours), len(matching.of_truth)
        self.confusion += count_labels(labels, truth, classes, true_classes)
        ours = np.append(matching.of_ours, np.full(256 - classes, -1))[labels]
        theirs = np.append(matching.of_truth, np.full(256 - true_classes, -1))[truth]
        for tolerance in TOLERANCES:
            reach = max(1, round(tolerance * truth.shape[1] / 640))
            countable = ~_near(theirs < 0, reach)
            mine, true = _changes(ours) & countable, _changes(theirs) & countable
            counts = [(mine & _near(true, reach)).sum(), mine.sum(), (true & _near(mine, reach)).sum(), true.sum()]
            self.edges[tolerance] += np.array(counts)

    def row(self, matching: Matching) -> dict[str, Any]:
        """Figures in per cent."""
        found = score(matching.joined(self.confusion))
        if found is None:
            return {}
        by_name = dict(zip(matching.names, found.class_recall, strict=True))
        iou = {n: round(100 * float(v), 1) for n, v in zip(matching.names, found.class_iou, strict=True) if v == v}
        row = {"miou": round(100 * found.mean_iou, 1), "pixels": round(100 * found.pixel_accuracy, 1)}
        row |= {f"{n} recall": round(100 * float(by_name[n]), 1) for n in ("wall", "floor") if n in by_name}
        return row | {f"boundary F {t}": round(100 * _f_score(c), 1) for t, c in self.edges.items()} | {"iou": iou}


def _changes(labels: NDArray) -> NDArray[np.bool_]:
    out = np.zeros(labels.shape, bool)
    out[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    out[1:] |= labels[1:] != labels[:-1]
    return out


def _near(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(mask.astype(np.uint8), disc) > 0


def _f_score(counts: NDArray[np.int64]) -> float:
    precision, recall = counts[0] / max(counts[1], 1), counts[2] / max(counts[3], 1)
    return float(2 * precision * recall / max(precision + recall, 1e-9))


class Labelled:
    """The labels of a finished run's keyframes by kind, all as indices into the run's classes."""

    def __init__(self, run: RunFolder, semantics: str) -> None:
        self.outcome = load_outcome(run)
        card = choose_semantics(ProxyConfig(semantics=semantics)).card
        if card is None:
            raise SystemExit("no segmentation network is here: msgs-slam models pull, or --semantics onnx:CARD.toml")
        self._network = Network(card, 2, "cpu")
        index = {n: i for i, n in enumerate(self.outcome.classes.names)}
        # A name that the run has dropped as noise is one of its own here: wrong, but not nothing.
        self.names = (*index, *(n for n in card.labels if n not in index))
        place = {n: i for i, n in enumerate(self.names)}
        self._of_network = np.array([*(place[n] for n in card.labels), VOID], np.uint8)
        mesh = read_mesh_ply(run.stage("export") / "mesh.ply")
        world = run.find(WORLD) or FIRST
        vertices = world.exported_from_run.inverse().apply(mesh.vertices.astype(np.float64))
        self._mesh, self._mesh_labels = cKDTree(vertices), mesh.labels

    def kinds(self, frame_id: int) -> dict[str, NDArray[np.uint8]]:
        """(H, W) labels at the size of the frame."""
        outcome = self.outcome
        frame = outcome.frames[outcome.frame_row(frame_id)]
        image = outcome.run.image(frame)
        height, width = image.shape[:2]
        output = self._network.run(image, self._network.box(width, height))["output"]
        pose = outcome.trajectory.cam_from_world[outcome.frame_row(frame_id)]
        view = render_outcome(outcome, pose)
        return {
            "network": self._of_network[network_labels(self._network, output, width, height)[0]],
            "fused": resample_nearest(outcome.run.load(PROXY_MAPS, of=frame_id).labels, height, width),
            "map": view.labels,
            "mesh": self._at_surface(view.depth, pose),
        }

    def _at_surface(self, depth: NDArray[np.float32], cam_from_world: NDArray[np.float64]) -> NDArray[np.uint8]:
        world_from_cam = np.linalg.inv(cam_from_world)
        points = unproject_depth(depth, self.outcome.calibration.intrinsics) @ world_from_cam[:3, :3].T
        near = 0.03 * np.median(depth[depth > 0])
        distance, vertex = self._mesh.query(points + world_from_cam[:3, 3], distance_upper_bound=near)
        known = np.isfinite(distance) & (depth > 0)
        return np.where(known, np.append(self._mesh_labels, VOID)[vertex], VOID).astype(np.uint8)


def measure(labelled: Labelled, truth: Dataset, own_map: ClassMap | None) -> dict[str, dict[str, Any]]:
    """Figures by kind over the keyframes with true labels."""
    outcome = labelled.outcome
    matching = match_classes(labelled.names, outcome.vocabulary, truth.class_names, own_map)
    if matching is None:
        raise SystemExit(f"no class map joins {', '.join(labelled.names)} with {', '.join(truth.class_names)}")
    shape = (len(truth.class_names), len(labelled.names) + 1)
    tallies = {kind: Tally(np.zeros(shape, np.int64)) for kind in KINDS}
    for frame_id, true in _true_labels(outcome, truth):
        for kind, labels in labelled.kinds(frame_id).items():
            tallies[kind].add(labels, true, matching)
    return {kind: tally.row(matching) for kind, tally in tallies.items()}


def _true_labels(outcome: Outcome, truth: Dataset) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    matched = match_truth(outcome.frames, outcome.source_is_folder, truth)
    pixels = FramePixels(outcome.calibration)
    for frame_id in outcome.trajectory.frame_ids[outcome.trajectory.is_keyframe].tolist():
        index = int(matched.image[outcome.frame_row(frame_id)])
        labels = truth.labels(index) if index >= 0 else None
        if labels is not None:
            yield frame_id, pixels.sample(labels)


# pictures -------------------------------------------------------------------------------------------------------


def write_sheet(labelled: Labelled, truth: Dataset | None, target: Path) -> None:
    """Frame, network, fused, map, mesh and truth of a few keyframes, names written into the larger areas."""
    outcome = labelled.outcome
    colors = [*outcome.classes.colors, *((90, 90, 90) for _ in labelled.names[len(outcome.classes) :])]
    true_of = dict(_true_labels(outcome, truth)) if truth is not None else {}
    keyframes = list(true_of) or outcome.trajectory.frame_ids[outcome.trajectory.is_keyframe].tolist()
    rows = []
    for frame_id in keyframes[:: max(1, len(keyframes) // SHEET_ROWS)][:SHEET_ROWS]:
        image = outcome.run.image(outcome.frames[outcome.frame_row(frame_id)])
        cells = [image, *(_named(v, labelled.names, colors) for v in labelled.kinds(frame_id).values())]
        if frame_id in true_of and truth is not None:
            spread = class_colors(truth.class_names)
            true_colors = [c.color or s for c, s in zip(truth.classes, spread, strict=True)]
            cells.append(_named(true_of[frame_id], truth.class_names, true_colors))
        rows.append(np.hstack([cv2.resize(c, (360, round(360 * c.shape[0] / c.shape[1]))) for c in cells]))
    write_rgb(target, np.vstack(rows).astype(np.uint8))


def _named(labels: NDArray[np.uint8], names: tuple[str, ...], colors: list[tuple[int, int, int]]) -> Picture:
    picture = np.ascontiguousarray(label_picture(labels, colors))
    for label in np.unique(labels[labels < len(names)]).tolist():
        count, pieces, stats, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
        for piece in range(1, count):
            if stats[piece, cv2.CC_STAT_AREA] > 0.004 * labels.size:
                inside = cv2.distanceTransform((pieces == piece).astype(np.uint8), cv2.DIST_L2, 3)
                y, x = np.unravel_index(inside.argmax(), inside.shape)
                at = (max(int(x) - 5 * len(names[label]), 0), int(y))
                for thickness, ink in ((4, (0, 0, 0)), (1, (255, 255, 255))):
                    cv2.putText(picture, names[label], at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, thickness, cv2.LINE_AA)
    return picture


def classes_of(table: ClassTable) -> str:
    """The names of a run, for the table."""
    return ", ".join(table.names)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=f"of {', '.join(SOURCES)}; all without")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--semantics", default="auto")
    parser.add_argument("--set", action="append", default=[], dest="settings", metavar="KEY=VALUE")
    arguments = parser.parse_args()
    rows: dict[str, Any] = {}
    for name in arguments.cases or SOURCES:
        source, truth_path = SOURCES[name]
        run, progress = RunFolder(arguments.work / f"{name}.msgs"), TimedProgress()
        settings = [f"proxy.semantics={arguments.semantics}", *arguments.settings]
        reconstruct(source, run, load_config(overrides=settings), progress)
        labelled = Labelled(run, arguments.semantics)
        keyframes = int(labelled.outcome.trajectory.is_keyframe.sum())
        spent = sum(progress.cpu_seconds.get(k, 0.0) for k in ("network", "regions", "names", "classes"))
        truth = open_sequence(truth_path) if truth_path else None
        rows[name] = {
            "classes": classes_of(labelled.outcome.classes),
            "cpu seconds a keyframe": round(spent / keyframes, 2),
        }
        if truth is not None:
            own_map = read_class_map(OWN_MAPS[name]) if name in OWN_MAPS else None
            rows[name] |= measure(labelled, truth, own_map)
        write_sheet(labelled, truth, arguments.work / f"{name}_names.png")
        print(name, json.dumps(rows[name], indent=1), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
