"""The work on one submap as tasks: made from its own frames, joined with what lies beside it, refined together with
that, agreed upon with whoever refined it too, measured.

A task reads the run and files of the tasks before it, and leaves one file, whole or not at all. Where that is there it
does nothing. So tasks of one kind may run in any order, on any machine that sees the run, and twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...formats.tensors import load_arrays, load_tensors, save_arrays, save_tensors
from ..config import Config
from ..depth.fields import DepthFields
from ..geometry.posed_depth import PosedDepth
from ..render.api import blending_weights, median_depth
from ..render.gaussian_map import GaussianMap
from ..run.folder import RunFolder
from ..system.machine import memory_room, resolve_device
from ..system.progress import Progress
from ..types import Intrinsics, Trajectory
from .measure import ViewFigures, measure_view
from .optimise import optimise_map
from .state import KEYS, Exposures, OptimisedMap
from .submaps import SeenExposures, Submap, common_exposure, nearest_seeing
from .views import MappingInput, View, load_views

MADE, JOINED, REFINED, AGREED = "made", "joined", "refined", "agreed"
_LABELS = {MADE: "mapping", REFINED: "refining"}
_ARRAYS = ("frame_ids", "cam_from_world", "log_gains", "offsets", "depths", "steps", "rows", "weights")
REFINING_SHARE, REFINING_RATE = 5 / 9, 0.9
"""Visits of each view once the maps are joined, as a share of those that made them, and the learning rates of the first
of them, which are higher the more submaps agree on a mean of what they say. Chosen on one walk through a kitchen in
thirds (made whole 27.5 dB, 9 visits): 2 visits from 0.3 26.9, from 0.9 27.0; 4 from 0.9 27.2, 5 27.3. Seen on another
kitchen and on one made-up walk."""
_DEPTH_SIDE = 160
"""Pixels on the long side of the depths by which Gaussians are given to views."""


@dataclass(frozen=True)
class SubmapTask:
    """What it takes to work on submap `number`: `trajectory` holds its views (to measure it: its own keyframes, and
    what is held out), `exposure` theirs, `fields` brings their depths into the world, `files` is the folder of all
    submaps' results; `measured`: kind of result."""

    run: RunFolder
    config: Config
    files: Path
    number: int
    submap: Submap
    trajectory: Trajectory
    fields: DepthFields
    class_ids: tuple[int, ...]
    camera: Intrinsics
    exposure: Exposures | None = None
    measured: str = AGREED

    @property
    def device(self) -> str:
        """ "cpu" or "cuda"."""
        return resolve_device(self.config.run.device)

    def file(self, kind: str, number: int | None = None) -> Path:
        """Name the file of a result of this submap, or of another one."""
        return self.files / f"{kind}_{self.number if number is None else number:04d}.safetensors"

    @property
    def exposures(self) -> Path:
        """File of the exposures of all views that it was made from."""
        return self.files / f"exposures_{self.number:04d}.npz"

    def load(self, kind: str, number: int) -> SubmapResult:
        """A result of any submap."""
        tensors = load_tensors(self.file(kind, number))
        arrays = {name: tensors.pop(name).numpy() for name in _ARRAYS}
        return SubmapResult(GaussianMap(**{n: t.to(self.device) for n, t in tensors.items()}), **arrays)

    def save(self, kind: str, result: SubmapResult) -> None:
        """One file; the snapshot of the work on it goes."""
        arrays = {name: torch.from_numpy(np.ascontiguousarray(getattr(result, name))) for name in _ARRAYS}
        save_tensors(self.file(kind), {**vars(result.gaussian_map), **arrays})
        self.file(f"{kind}_state").unlink(missing_ok=True)

    def views(self, trajectory: Trajectory, hold_out: int = 0) -> MappingInput:
        """The keyframes of a trajectory, and its frames held out."""
        settings = replace(self.config.mapping, hold_out=hold_out)
        memory = memory_room(self.config.run.memory_mb)
        return load_views(self.run, trajectory, settings, self.device, self.fields, memory, self.class_ids)


@dataclass(frozen=True)
class SubmapResult:
    """A map with its own keyframes: frame_ids (N,), cam_from_world (N, 4, 4), log_gains and offsets (N, 3), and depths
    (N, h, w) that it shows in them (0 where it shows none) as long as they are needed; steps (1,) of its making.

    Of a refined map, which has Gaussians of other submaps too: rows (M,) that they have in the joined map of whom they
    belong to, and weights (M,), how many pixels of the views each fills."""

    gaussian_map: GaussianMap
    frame_ids: NDArray[np.int64]
    cam_from_world: NDArray[np.float64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]
    depths: NDArray[np.float32]
    steps: NDArray[np.int64]
    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    weights: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def without_map(self) -> SubmapResult:
        """This result with no Gaussian."""
        return replace(self, gaussian_map=self.gaussian_map.only(torch.arange(0)))


def make_submap(task: SubmapTask, progress: Progress) -> None:
    """The map of its own and the bordering keyframes."""
    if not task.file(MADE).exists():
        given = task.views(task.trajectory)
        made = _optimise(task, given, progress, MADE)
        result = _result(task, made, given.views)
        ids = np.array([v.frame_id for v in given.views])
        save_arrays(task.exposures, {"frame_ids": ids, "log_gains": made.log_gains, "offsets": made.offsets})
        task.save(MADE, replace(result, depths=_depths(result, task.camera)) if task.submap.neighbours else result)


def join_submap(task: SubmapTask, progress: Progress) -> None:
    """The Gaussians that no submap beside it shows from nearer, each anchored at the view that sees it from nearest."""
    if task.file(JOINED).exists():
        return
    all_results = [task.load(MADE, n) for n in (task.number, *task.submap.neighbours)]
    views, ids = _posed(all_results, task.camera), np.concatenate([r.frame_ids for r in all_results])
    own = _in_common_exposure(task, all_results[0])
    m = own.gaussian_map
    best = nearest_seeing(m.means.cpu().double().numpy(), progress.track(views, "joining", len(views)))
    anchors = np.where(best >= 0, ids[best], m.anchor_frame_ids.cpu().numpy())
    task.save(JOINED, replace(own, gaussian_map=select_own(m, anchors, task.submap), depths=own.depths[:0]))


def _in_common_exposure(task: SubmapTask, result: SubmapResult) -> SubmapResult:
    """The same with the colours, and the exposures of its keyframes, that all submaps have in common."""
    seen = [SeenExposures(**load_arrays(path, own=True)) for path in sorted(task.files.glob("exposures_*.npz"))]
    log_gain, offset = (values[task.number] for values in common_exposure(seen))
    m = result.gaussian_map
    gain, shift = (torch.from_numpy(x).to(m.colors) for x in (np.exp(log_gain), offset))
    log_gains = (result.log_gains - log_gain).astype(np.float32)
    offsets = (result.offsets - offset * np.exp(log_gains)).astype(np.float32)
    colored = replace(m, colors=m.colors * gain + shift)
    return replace(result, gaussian_map=colored, log_gains=log_gains, offsets=offsets)


def refine_submap(task: SubmapTask, progress: Progress) -> None:
    """Its views visited again with all that they show, its own and what lies beside it; none comes or goes."""
    if task.file(REFINED).exists():
        return
    around = (task.number, *task.submap.neighbours)
    ids, poses, (gains, offsets) = merge_results([task.load(JOINED, n).without_map for n in around])
    rows = np.searchsorted(ids, task.trajectory.frame_ids)
    given = task.views(replace(task.trajectory, cam_from_world=poses[rows]))
    shown, places, weights = _shown(given.views, [task.load(JOINED, n).gaussian_map for n in around])
    refined = _optimise(task, given, progress, REFINED, shown, (gains[rows], offsets[rows]))
    task.save(REFINED, replace(_result(task, refined, given.views), rows=places, weights=weights))


def _shown(
    views: Iterable[View], maps: Sequence[GaussianMap]
) -> tuple[GaussianMap, NDArray[np.int64], NDArray[np.float32]]:
    """What the views show of the maps, as one: its Gaussians, their rows in the maps they are from (M,), and how many
    pixels each fills (M,). One map alone is all that they show."""
    whole, places = concatenate(maps), torch.cat([torch.arange(len(m)) for m in maps])
    weights = pixels_filled(whole, views) if len(maps) > 1 else torch.ones(len(whole), device=whole.means.device)
    shown = weights > 0
    return whole.only(shown), places[shown.cpu()].numpy(), weights[shown].cpu().numpy()


def average_overlap(task: SubmapTask, progress: Progress) -> None:
    """Each of its Gaussians as those who show it have refined it, on average, weighed by the pixels that it fills.

    So every view has its say about all that it shows, although no task has seen all views (consensus, as of models that
    are trained in parts: McMahan et al., "Communication-Efficient Learning of Deep Networks from Decentralized Data",
    2017). The keyframes are where its own refinement has put them.
    """
    if task.file(AGREED).exists():
        return
    agreed = task.load(JOINED, task.number).gaussian_map
    total = torch.zeros(len(agreed), device=agreed.means.device)
    for number in (*task.submap.neighbours, task.number):  # itself last: its keyframes are kept
        refined = task.load(REFINED, number)
        mine = np.isin(refined.gaussian_map.anchor_frame_ids.cpu().numpy(), task.submap.own)
        rows, weights = (torch.from_numpy(a[mine]).to(total.device) for a in (refined.rows, refined.weights))
        total[rows] += weights
        for key in (*KEYS, "class_logits"):
            values, said = getattr(agreed, key), getattr(refined.gaussian_map, key)[torch.from_numpy(mine)]
            share = (weights / total[rows]).reshape(-1, *[1] * (values.ndim - 1))
            values[rows] += share * (said - values[rows])
    task.save(AGREED, replace(refined, gaussian_map=agreed, rows=refined.rows[:0], weights=refined.weights[:0]))


STEPS: dict[str, Callable[[SubmapTask, Progress], None]] = {
    MADE: make_submap, JOINED: join_submap, REFINED: refine_submap, AGREED: average_overlap,
}  # fmt: skip
"""Which task leaves which kind of result; each needs those before it, of its own submap and those beside."""


def merge_results(results: Sequence[SubmapResult]) -> tuple[NDArray[np.int64], NDArray[np.float64], Exposures]:
    """Ids, poses and exposures of all their keyframes, by id."""
    ids = np.concatenate([r.frame_ids for r in results])
    order = np.argsort(ids)
    gains, offsets = np.concatenate([r.log_gains for r in results]), np.concatenate([r.offsets for r in results])
    return ids[order], np.concatenate([r.cam_from_world for r in results])[order], (gains[order], offsets[order])


def measure_submap(task: SubmapTask, progress: Progress) -> tuple[list[ViewFigures], list[ViewFigures]]:
    """Figures of its own keyframes and of the frames held out among those of its trajectory, where that puts them."""
    maps = [task.load(task.measured, n).gaussian_map for n in (task.number, *task.submap.neighbours)]
    given = task.views(task.trajectory, task.config.mapping.hold_out)
    rows = {int(i): row for row, i in enumerate(task.trajectory.frame_ids)}
    whole = concatenate(maps)
    log_gains, offsets = task.exposure or np.zeros((2, len(rows), 3), np.float32)

    def figures(view: View) -> ViewFigures:
        row = rows[view.frame_id]
        return measure_view(whole, view, task.trajectory.cam_from_world[row], log_gains[row], offsets[row])

    measured = [figures(v) for v in progress.track(given.views, "measuring", len(given.views))]
    return measured, [figures(v) for v in given.held_out]


def _optimise(
    task: SubmapTask, given: MappingInput, progress: Progress, kind: str,
    initial: GaussianMap | None = None, exposure: Exposures | None = None,
) -> OptimisedMap:  # fmt: skip
    """From a snapshot where there is one, which goes when the result is written."""
    settings, seed = replace(task.config.mapping, hold_out=0), task.config.run.seed
    visits, rate = REFINING_SHARE * settings.passes, REFINING_RATE if task.submap.neighbours else 1.0
    passes, rate = (None, 1.0) if initial is None else (visits, rate)
    of = f" submap {task.number + 1}" if task.submap.neighbours else ""
    return optimise_map(
        given.views, len(task.class_ids), settings, seed, initial, passes,
        progress=progress, snapshot=task.file(f"{kind}_state"), label=_LABELS[kind] + of,
        exposure=exposure, first_rate=rate,
    )  # fmt: skip


def _result(task: SubmapTask, optimised: OptimisedMap, views: Sequence[View]) -> SubmapResult:
    """What is the submap's own of a map of more; no depths yet."""
    ids, made = np.array([v.frame_id for v in views]), optimised
    own = np.isin(ids, task.submap.own)
    poses, gains, offsets = made.cam_from_world[own], made.log_gains[own], made.offsets[own]
    no_depths, steps = np.zeros((0, 1, 1), np.float32), np.array([made.iterations])
    return SubmapResult(made.gaussian_map, ids[own], poses, gains, offsets, no_depths, steps)


@torch.no_grad()
def _depths(result: SubmapResult, intrinsics: Intrinsics) -> NDArray[np.float32]:
    """(N, h, w) what the map shows in each of the keyframes."""
    m, camera = result.gaussian_map, intrinsics.at_most(_DEPTH_SIDE)
    poses = (torch.as_tensor(p, device=m.means.device) for p in result.cam_from_world)
    return np.stack([median_depth(m, p, camera).cpu().numpy() for p in poses])


def _posed(results: Iterable[SubmapResult], full: Intrinsics) -> list[PosedDepth]:
    """Every keyframe with the depth that its own map shows there."""
    camera = full.at_most(_DEPTH_SIDE)
    return [
        PosedDepth(camera, pose, depth, np.ones_like(depth))
        for result in results
        for pose, depth in zip(result.cam_from_world, result.depths, strict=True)
    ]


def select_own(gaussian_map: GaussianMap, anchors: NDArray[np.int64], submap: Submap) -> GaussianMap:
    """The Gaussians that are anchored (M,) at the submap's own keyframes."""
    kept = torch.from_numpy(np.isin(anchors, submap.own)).to(gaussian_map.means.device)
    anchored = replace(gaussian_map, anchor_frame_ids=torch.from_numpy(anchors).to(gaussian_map.means.device))
    return anchored.only(kept)


def pixels_filled(gaussian_map: GaussianMap, views: Iterable[View]) -> Tensor:
    """Count the pixels of these views that each Gaussian fills, (M,)."""
    m = gaussian_map
    filled = torch.zeros(len(m), device=m.means.device)
    for view in views:
        filled += blending_weights(m, view.cam_from_world, view.intrinsics)[0]
    return filled


def concatenate(maps: Iterable[GaussianMap]) -> GaussianMap:
    """One map of all, which are not held longer than they are needed where nobody else does."""
    parts = [dict(vars(m)) for m in maps]
    return GaussianMap(**{name: torch.cat([part.pop(name) for part in parts]) for name in list(parts[0])})
