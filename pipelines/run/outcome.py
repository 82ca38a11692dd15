"""Outcome of a run so far: of each result the one of the latest stage."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...formats.errors import InputError
from ...formats.splats import GaussianCloud, isotropic_cloud
from ..config import Config
from ..geometry.se3 import Similarity
from ..geometry.sparse_model import FrameObservations, SparseModel
from ..render.gaussian_map import GaussianMap
from ..system.machine import resolve_device
from ..types import VOID, Calibration, ClassTable, Frame, Metres, Trajectory
from .files import (
    CALIBRATION,
    CLASS_IDS,
    CLASSES,
    EVERY_FRAME,
    EXPOSURE,
    FIGURES,
    FRAME_OBSERVATIONS,
    FRAMES,
    MAP,
    METRES,
    SPARSE,
    SUBMAPS,
    TRAJECTORY,
)
from .folder import RunFolder
from .manifest import keyframe_psnr, piece_digest, recorded_config
from .reads import StageRecord, note_figures, watched

T = TypeVar("T")
_AT_ONCE = 1 << 16
"""Gaussians whose probabilities are copied at a time."""
_MAP_STAGES = ("global_ba", "mapping")
_POSE_STAGES = ("global_ba", "mapping", "tracking")


@dataclass(frozen=True)
class Exposure:
    """log_gains, offsets (N, 3) of the keyframes, in order of their times (N,)."""

    times: NDArray[np.float64]
    log_gains: NDArray[np.float32]
    offsets: NDArray[np.float32]

    def apply(self, color: NDArray[np.float32], time: float) -> NDArray[np.float32]:
        """(H, W, 3) colours 0..1 of the map as a camera at that time would have exposed them."""
        log_gain, offset = self._at(time)
        return np.clip(color * np.exp(log_gain) + offset, 0, 1)

    def remove(self, photo: NDArray[np.float32], time: float) -> NDArray[np.float32]:
        """(H, W, 3) the colours that a photo 0..1 of that time would have in the map: the inverse of `apply`."""
        log_gain, offset = self._at(time)
        return np.clip((photo - offset) * np.exp(-log_gain), 0, 1)

    def _at(self, time: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        log_gain, offset = (
            np.array([np.interp(time, self.times, a[:, k]) for k in range(3)], np.float32)
            for a in (self.log_gains, self.offsets)
        )
        return log_gain, offset


@dataclass(frozen=True)
class Outcome:
    """config: the settings that each finished stage was made with. map_stage is "" and gaussian_map None before mapping
    is done; label_of_channel (C,) takes a class channel of the map to its label. `metric`: whether the world's unit is
    the metre of the proxy depth. vocabulary: the classes that the network which labelled it knows, () without one.
    `move`: how all of it has been moved out of the run's own world. `metres`: how long the unit is, as far as the
    export could tell. `every`: poses of all images of the source, see EVERY_FRAME; None where only frames have one."""

    run: RunFolder
    records: Mapping[str, StageRecord]
    config: Config
    frames: list[Frame]
    calibration: Calibration
    pose_stage: str
    trajectory: Trajectory
    map_stage: str
    gaussian_map: GaussianMap | None
    classes: ClassTable
    label_of_channel: NDArray[np.uint8]
    exposure: Exposure | None
    metric: bool
    semantics: str
    vocabulary: tuple[str, ...]
    move: Similarity | None = None
    metres: Metres | None = None
    every: Trajectory | None = None

    @property
    def source_is_folder(self) -> bool:
        """Whether frames kept the names of the source's images."""
        source = Path(self.run.source.path)
        return source.is_dir() or (source.suffix == "" and not source.exists())

    @property
    def is_timed(self) -> bool:
        """Whether the frames have the source's times; else these count the frames."""
        return bool(self.records["frames"].figures.get("timed", True))

    @property
    def keyframe_psnr(self) -> float | None:
        """PSNR of the keyframes, dB, as `keyframe_psnr` finds it."""
        return keyframe_psnr(self.records)

    def require_map(self) -> GaussianMap:
        """The map. Raises InputError before mapping is done."""
        if self.gaussian_map is None:
            raise InputError(f"{self.run.root}: there is no map yet ({self.run.why_not_done('mapping')})")
        return self.gaussian_map

    def load_sparse(self) -> SparseModel | None:
        """Points and their observations as the last stage that has any left them."""
        for stage in (self.pose_stage, "tracking"):
            if (model := self.run.find(SPARSE, stage)) is not None:
                return model if self.move is None else model.moved(self.move)
        return None

    def load_observations(self, sparse: SparseModel) -> FrameObservations | None:
        """Load where frames that are no keyframes see the points of `sparse`, the run's own `load_sparse`; None where
        the run has kept nothing of it."""
        if (seen := self.run.find(FRAME_OBSERVATIONS)) is None:
            return None
        return seen.carried(self.run.load(SPARSE, "tracking"), sparse)

    def moved(self, other_from_run: Similarity) -> Outcome:
        """Transform cameras, map and points into another world. Raises ValueError where that has been done before."""
        if self.move is not None:
            raise ValueError("this outcome is no longer in the run's own world")
        return replace(
            self,
            trajectory=self.trajectory.moved(other_from_run.apply_to_poses),
            every=None if self.every is None else self.every.moved(other_from_run.apply_to_poses),
            gaussian_map=None if self.gaussian_map is None else self.gaussian_map.moved(other_from_run),
            move=other_from_run,
        )

    def pieces(self) -> list[Outcome]:
        """Load the disconnected components, each in a world of its own, largest first, as far as they are done."""
        return [load_outcome(piece) for piece in runs_of_pieces(self.run, self.records)]

    def frame_row(self, frame_id: int) -> int:
        """Row of a frame in the trajectory."""
        return int(np.flatnonzero(self.trajectory.frame_ids == frame_id)[0])


def runs_of_pieces(run: RunFolder, records: Mapping[str, StageRecord]) -> list[RunFolder]:
    """Find the runs of the disconnected components, largest first, whose tracking is done."""
    pieces = {name: run.piece(name) for name in run.pieces("tracking")}
    return [
        piece
        for name, piece in pieces.items()
        if piece.manifest_file.exists()
        and "tracking" in piece.records
        and piece.source.digest == piece_digest(records, name)  # not one of an earlier result
    ]


def load_outcome(run: RunFolder, device: str = "auto") -> Outcome:
    """Load the results of a run, its map on `device`. Raises InputError for a run whose tracking is not done."""
    records = run.records
    config = watched(recorded_config(records, run.settings()))
    note_figures(run.root, records)
    pose_stage = next((s for s in _POSE_STAGES if s in records), "")
    if not pose_stage:
        raise InputError(f"{run.root}: no camera poses yet ({run.why_not_done('tracking')})")
    trajectory = run.load(TRAJECTORY, pose_stage)
    map_stage = next((s for s in _MAP_STAGES if s in records), "")
    report = run.load(FIGURES["proxy"])
    return Outcome(
        run=run,
        records=records,
        config=config,
        frames=run.load(FRAMES),
        calibration=run.load(CALIBRATION),
        pose_stage=pose_stage,
        trajectory=trajectory,
        map_stage=map_stage,
        gaussian_map=run.load(MAP, map_stage).to(resolve_device(device)) if map_stage else None,
        classes=run.load(CLASSES),
        label_of_channel=np.array(run.load(CLASS_IDS) if map_stage else (), np.uint8),
        exposure=_load_exposure(run, map_stage, trajectory),
        metric=bool(report.get("metric", False)),
        semantics=str(report.get("semantics", "")),
        vocabulary=tuple(map(str, report.get("vocabulary", ()))),
        metres=run.find(METRES) if "export" in records else None,
        every=run.find(EVERY_FRAME) if pose_stage == "global_ba" else None,
    )


def maps_around(outcome: Outcome) -> Callable[[int], GaussianMap]:
    """Return a function from keyframe id to the part of the map it may see: of a map made in submaps its own and those
    beside it, so that a view of a long recording takes no longer than one of a short one."""
    whole, submaps = outcome.require_map(), outcome.run.load(SUBMAPS)
    number_of = {i: n for n, submap in enumerate(submaps) for i in submap["own"].tolist()}

    @functools.lru_cache(maxsize=1)
    def around(number: int | None) -> GaussianMap:
        if number is None:  # made whole
            return whole
        near = np.concatenate([submaps[n]["own"] for n in (number, *submaps[number]["beside"].tolist())])
        rows = np.isin(whole.anchor_frame_ids.cpu().numpy(), near)
        return whole.only(torch.from_numpy(rows).to(whole.means.device))

    return lambda frame_id: around(number_of.get(frame_id))


def map_cloud(outcome: Outcome, rows: Tensor | slice | None = None) -> GaussianCloud:
    """The map, or `rows` of it (a slice or (M,) bool), as a splat cloud, class probabilities in the order of the run's
    classes where it has any."""
    m, channels = outcome.require_map(), outcome.label_of_channel
    m = m if rows is None else m.only(rows)
    probabilities = None
    if len(channels):
        probabilities = np.zeros((len(m), len(outcome.classes)), np.float32)
        for start in range(0, len(m), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            probabilities[part, channels] = torch.softmax(m.class_logits[part], dim=1).cpu().numpy()
    means, log_radii, logits, colors = (x.cpu().numpy() for x in (m.means, m.log_radii, m.opacity_logits, m.colors))
    return isotropic_cloud(means, log_radii, logits, colors, probabilities)


def _load_exposure(run: RunFolder, map_stage: str, trajectory: Trajectory) -> Exposure | None:
    for stage in (map_stage, "mapping"):
        if map_stage and run.holds(EXPOSURE, stage):
            arrays = run.load(EXPOSURE, stage)
            time_of = dict(zip(trajectory.frame_ids.tolist(), trajectory.timestamps.tolist(), strict=True))
            times = np.array([time_of[int(i)] for i in arrays["frame_ids"]])
            order = np.argsort(times, kind="stable")
            return Exposure(times[order], arrays["log_gains"][order], arrays["offsets"][order])
    return None


def spread_sample(items: Sequence[T], limit: int) -> list[T]:
    """Return at most `limit` of the items, evenly spread, first and last among them."""
    chosen = np.unique(np.linspace(0, len(items) - 1, min(len(items), limit)).round().astype(int))
    return [items[i] for i in chosen]


def labels_of_channels(channels: NDArray, label_of_channel: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(...) labels of channels; VOID where a channel is negative."""
    return np.append(label_of_channel, np.uint8(VOID))[channels]
