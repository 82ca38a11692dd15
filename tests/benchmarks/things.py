"""Things against exact ones: how many of a room's objects the mesh has as one, whatever they are called.

    python tests/benchmarks/things.py RUN=TRUTH [RUN=TRUTH ...]           things of a run's mesh as it was exported
    python tests/benchmarks/things.py RUN=TRUTH --again                   found anew in its mesh
    python tests/benchmarks/things.py RUN=TRUTH --classes                 connected faces of one class: the simplest way
    python tests/benchmarks/things.py RUN=TRUTH --sheet DIR               the mesh from above: classes, things, truth

RUN is a finished run, TRUTH a folder of made rooms (`python -m tests.benchmarks.rooms video DIR`) or of Replica, with
the number of the thing that each pixel shows; of a data set with classes alone, connected faces of one stand for one.
The frames with truth tell it each vertex that they see, and a face is of the thing that two of its vertices are of; no
alignment is needed. Walls, floors and ceilings are no things; faces of windows, doors and what has no name, and things
of less than 100 faces, count neither for nor against. AP as ScanNet has it, without classes: surest things first, each
may find one true thing by intersection over union of the faces' areas.
"""

# ruff: noqa: E402 (the packages are found only once the path is set)

import argparse
import json
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.formats.datasets import open_sequence
from msgs_slam.formats.images import write_rgb
from msgs_slam.formats.ply import MeshArrays, read_mesh_ply, read_mesh_things
from msgs_slam.pipelines.evaluation.truth import match_outcome
from msgs_slam.pipelines.evaluation.views import render_outcome
from msgs_slam.pipelines.export.inventory import THINGS
from msgs_slam.pipelines.export.surface import components
from msgs_slam.pipelines.export.things import STRUCTURE, find_things
from msgs_slam.pipelines.geometry.posed_depth import PosedDepth
from msgs_slam.pipelines.run.folder import RunFolder
from msgs_slam.pipelines.run.outcome import Outcome, load_outcome
from msgs_slam.pipelines.scene.world import FIRST, WORLD, World
from msgs_slam.pipelines.sfm.lens import FramePixels
from msgs_slam.pipelines.types import VOID

NO_THING, IGNORED = 0, -1
LEAST_FACES = 100
THRESHOLDS = (0.25, 0.5)
_TOLERANCE = 0.03
_NO_THINGS, _PARTS = ("wall", "floor", "ceiling"), ("window", "door", "undefined", "panel", "pillar", "blinds", "none")
"""Names of what is no thing, and of what counts neither way."""
_SIDE = 700


class Truth:
    """Numbers of things in the images of a data set: 0 none, -1 neither; where it has classes alone (`by_class`), those
    that are things, from 1."""

    def __init__(self, folder: Path) -> None:
        self.sequence = open_sequence(folder)
        self.made, self.replica = folder / "things", folder / "semantic_instance"
        self.by_class = not (self.made.exists() or self.replica.exists())
        self.of_class = np.full(256, IGNORED)
        names = [name.lower() for name in self.sequence.class_names]
        self.of_class[: len(names)] = [_kind(name, number + 1) for number, name in enumerate(names)]
        if self.replica.exists():
            objects = json.loads((folder / "info_semantic.json").read_text())["objects"]
            named = {o["id"]: o["class_name"] for o in objects}
            self.of_instance = np.array([_kind(named.get(n, "undefined"), n) for n in range(256)])

    def image(self, index: int) -> NDArray[np.int64]:
        """(H, W) of one image."""
        name = f"{Path(self.sequence.names[index]).stem}.png"
        if self.replica.exists():
            return np.asarray(self.of_instance[cv2.imread(str(self.replica / name), cv2.IMREAD_UNCHANGED)])
        kinds = self.of_class[self.sequence.labels(index)]
        if self.by_class:
            return np.asarray(kinds)
        found = cv2.imread(str(self.made / name), cv2.IMREAD_UNCHANGED).astype(np.int64)
        return np.where((kinds == IGNORED) & (found == NO_THING), IGNORED, found)


def _kind(name: str, number: int) -> int:
    return NO_THING if name in _NO_THINGS else IGNORED if name in _PARTS else number


def true_things(outcome: Outcome, world: World, mesh: MeshArrays, truth: Truth) -> NDArray[np.int64]:
    """(F,) number of the true thing of each face."""
    matched, pixels = match_outcome(outcome, truth.sequence), FramePixels(outcome.calibration)
    points = world.exported_from_run.inverse().apply(mesh.vertices.astype(np.float64))
    votes: dict[int, NDArray[np.int32]] = {}
    for row in np.flatnonzero((matched.image >= 0) & outcome.trajectory.is_posed).tolist():
        shown = pixels.sample((truth.image(int(matched.image[row])) + 1).astype(np.uint16)).astype(np.int64) - 1
        pose = outcome.trajectory.cam_from_world[row]
        depth = render_outcome(outcome, pose).depth
        view = PosedDepth(outcome.calibration.intrinsics.resized(*depth.shape[::-1]), pose, depth, np.ones_like(depth))
        xy, z, inside = view.seen(points)
        at = np.flatnonzero(inside)
        column, line = xy[at].astype(int).T
        near = np.abs(depth[line, column] - z[at]) < _TOLERANCE * z[at]
        at, column, line = at[near], column[near], line[near]
        scale = shown.shape[0] / depth.shape[0]
        said = shown[(line * scale).astype(int), (column * scale).astype(int)]
        for number in np.unique(said).tolist():
            votes.setdefault(number, np.zeros(len(points), np.int32))[at[said == number]] += 1
    numbers = np.array(sorted(votes))
    table = np.stack([votes[n] for n in numbers.tolist()])
    of_vertex = np.where(table.max(axis=0) > 0, numbers[table.argmax(axis=0)], IGNORED)
    a, b, c = of_vertex[mesh.faces].T
    of_face = np.where(a == b, a, np.where((b == c) | (a == c), c, IGNORED))
    if truth.by_class:
        own = (a == b) & (b == c) & (of_face > 0)
        edges = np.concatenate([mesh.faces[own][:, :2], mesh.faces[own][:, 1:]])
        part = components(edges, len(mesh.vertices))[mesh.faces[:, 0]] + 1
        of_face = np.where(own, part, np.where(of_face > 0, IGNORED, of_face))
    return of_face


def found_anew(mesh: MeshArrays, names: tuple[str, ...], is_upright: bool) -> tuple[NDArray[np.int64], NDArray]:
    """What `find_things` finds: number from 1 of each face, 0 for none, and sureness."""
    a, b, c = (find_things(mesh, names, is_upright) + 1)[mesh.faces].T
    of_face = np.where((a == b) | (a == c), a, np.where(b == c, b, 0))
    return of_face, np.bincount(of_face)[1:].astype(float)


def exported(run: RunFolder, mesh: MeshArrays) -> tuple[NDArray[np.int64], NDArray]:
    """What the run's export holds: number from 1 of each face, 0 for none, and sureness."""
    table = THINGS.read(run.file("export", THINGS.name))
    place = np.zeros(1 + max((t.number for t in table), default=0), np.int64)
    place[[t.number for t in table]] = np.arange(len(table)) + 1
    a, b, c = place[read_mesh_things(run.file("export", "mesh.ply"))][mesh.faces].T
    return np.where((a == b) | (a == c), a, np.where(b == c, b, 0)), np.array([t.sure for t in table])


def by_classes(mesh: MeshArrays, names: tuple[str, ...]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Connected faces of one class that is no structure: number from 1 of each face, 0 for none, and sureness."""
    structure = [i for i, n in enumerate(names) if n in STRUCTURE] + [VOID]
    a, b, c = mesh.labels[mesh.faces].T
    own = (a == b) & (b == c) & ~np.isin(a, structure)
    edges = np.concatenate([mesh.faces[own][:, :2], mesh.faces[own][:, 1:]])
    part = components(edges, len(mesh.vertices))[mesh.faces[:, 0]]
    number, counts = np.unique(np.where(own, part, -1), return_inverse=True, return_counts=True)[1:]
    wanted = (counts >= LEAST_FACES) & (np.arange(len(counts)) >= (~own).any())
    place = np.where(wanted, np.cumsum(wanted), 0)
    return place[number], counts[wanted].astype(float)


def precision(mine: NDArray, sure: NDArray, true: NDArray, area: NDArray) -> dict[str, float]:
    """AP by threshold, in per cent, of numbers (F,) from 1 with `sure` (N,) against true ones, and counts of both."""
    counts = {n: int((true == n).sum()) for n in np.unique(true).tolist() if n > NO_THING}
    numbers = [n for n, faces in counts.items() if faces >= LEAST_FACES]
    ignored = (true == IGNORED) | np.isin(true, [n for n in counts if n not in numbers])
    size = {n: area[true == n].sum() for n in numbers}
    found = {}
    for threshold in THRESHOLDS:
        taken: set[int] = set()
        hits = []
        for number in np.argsort(-sure, kind="stable").tolist():
            inside = mine == number + 1
            whole, shared = area[inside].sum(), np.zeros(len(numbers))
            beside = area[inside & ignored].sum()
            for k, n in enumerate(numbers):
                both = area[inside & (true == n)].sum()
                shared[k] = both / (whole - beside + size[n] - both) if n not in taken else 0
            best = int(shared.argmax()) if numbers else 0
            is_hit = bool(numbers) and shared[best] >= threshold
            if not is_hit and beside >= 0.5 * whole:
                continue
            hits.append(is_hit)
            taken |= {numbers[best]} if is_hit else set()
        found[f"AP{100 * threshold:.0f}"] = round(100 * average_precision(np.array(hits, bool), len(numbers)), 1)
        found[f"found {100 * threshold:.0f}"] = int(sum(hits))
    return found | {"things": len(sure), "true": len(numbers)}


def average_precision(hits: NDArray[np.bool_], count: int) -> float:
    """Area under the curve of precision, made to fall, over recall."""
    if not count or not len(hits):
        return 0.0
    right = np.cumsum(hits)
    best = np.maximum.accumulate((right / np.arange(1, len(hits) + 1))[::-1])[::-1]
    return float(best[hits].sum() / count)


def write_sheet(mesh: MeshArrays, columns: list[NDArray], target: Path) -> None:
    """The mesh from above without its ceiling: colours, then each column of numbers (F,) in colours by chance."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    low, high = np.quantile(middle, 0.005, axis=0), np.quantile(middle, 0.995, axis=0)
    keep = np.flatnonzero(middle[:, 2] < low[2] + 0.8 * (high[2] - low[2]))
    keep = keep[np.argsort(middle[keep, 2], kind="stable")]
    scale = _SIDE / (high - low)[:2].max()
    size = np.ceil((high - low)[:2] * scale).astype(int) + 1
    x, y = np.clip(((middle[keep, :2] - low[:2]) * scale).astype(int), 0, size - 1).T
    paint = np.random.default_rng(3).integers(60, 255, (70_000, 3)).astype(np.uint8)
    paint[0], paint[-1] = (40, 40, 40), (15, 15, 15)
    cells = []
    for colors in [mesh.colors[mesh.faces[:, 0]], *(paint[np.where(c > 0, c % 60_000 + 1, c)] for c in columns)]:
        cell = np.zeros((size[1], size[0], 3), np.uint8)
        cell[size[1] - 1 - y, x] = colors[keep]
        cells.append(cv2.morphologyEx(cell, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)))
    write_rgb(target, np.hstack(cells))


def main() -> None:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", metavar="RUN=TRUTH")
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--classes", action="store_true")
    parser.add_argument("--sheet", type=Path, metavar="DIR")
    arguments = parser.parse_args()
    rows = []
    for pair in arguments.pairs:
        folder, _, truth = pair.partition("=")
        outcome = load_outcome(RunFolder(Path(folder)))
        world = outcome.run.find(WORLD) or FIRST
        mesh = read_mesh_ply(outcome.run.file("export", "mesh.ply"))
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        true = true_things(outcome, world, mesh, Truth(Path(truth)))
        begin = time.process_time()
        if arguments.classes:
            mine, sure = by_classes(mesh, outcome.classes.names)
        elif not arguments.again:
            mine, sure = exported(outcome.run, mesh)
        else:
            mine, sure = found_anew(mesh, outcome.classes.names, world.axes == "up")
        rows.append(precision(mine, sure, true, area) | {"CPU s": round(time.process_time() - begin, 1)})
        print(f"{Path(folder).stem}:", "  ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
        if arguments.sheet:
            write_sheet(
                mesh,
                [mesh.labels[mesh.faces[:, 0]].astype(int) + 1, mine, true],
                arguments.sheet / f"{Path(folder).stem}_things.png",
            )
    print("mean:", "  ".join(f"{k} {np.mean([row[k] for row in rows]):.1f}" for k in rows[0]))


if __name__ == "__main__":
    main()
