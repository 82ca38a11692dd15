"""Stage 4: the semantic Gaussian map from the keyframes (MSGS-SLAM 3.4), made and refined submap by submap.

At any time no more than one submap is in work. A recording of the usual length is one submap.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...formats.errors import InputError
from ..depth.fields import DepthFields
from ..geometry.posed_depth import PosedDepth, overlaps
from ..render.gaussian_map import GaussianMap
from ..run.files import CALIBRATION, DEPTH_FIELDS, EXPOSURE, FIGURES, MAP, TRAJECTORY
from ..run.outcome import spread_sample
from ..run.stages import StageContext
from ..system.machine import submap_count, submap_size
from ..types import Trajectory
from .measure import ViewFigures, mean_figures
from .move_map import interpolate_rows, move_trajectory
from .state import OptimisedMap
from .submap_tasks import (
    AGREED,
    JOINED,
    MADE,
    REFINED,
    STEPS,
    SubmapTask,
    measure_submap,
    merge_results,
)
from .submaps import Submap, divide
from .views import survey, with_rigid_panoramas

_MEASURED = 16
"""Evenly spread: to draw all of 46 and compare them takes a seventh of the time that it takes to make the map."""


def run(context: StageContext) -> dict[str, Any]:
    """The optimised map; poses and exposures refined with it."""
    return MappingStage(context).run()


class MappingStage:
    """The stage: `run` is the order of its work."""

    def __init__(self, context: StageContext) -> None:
        self.context = with_rigid_panoramas(context)
        self.trajectory = context.run.load(TRAJECTORY, "tracking")
        self.kept, _ = self.trajectory.split(context.config.mapping.hold_out)

    def run(self) -> dict[str, Any]:
        """Make the map and write it; returns the figures."""
        self.find_classes()
        self.divide()
        work = SubmapWork(self.context, self.submaps, self.trajectory, self.fields, self.class_ids)
        work.bring_to(MADE, JOINED, REFINED, AGREED)
        keyframes, held_out = work.measure()
        self.result = work.whole()  # last: it is the largest thing there is
        self.save(work)
        return self.save_figures(keyframes, held_out)

    def find_classes(self) -> None:
        """Find the label of each class channel; raises InputError where no keyframe has a depth."""
        run, kept = self.context.run, self.kept
        if not kept:
            raise InputError(
                f"{run.root}: no keyframe is left to map (mapping.hold_out = {self.context.config.mapping.hold_out}). "
                "Hold out fewer frames: --set mapping.hold_out=0"
            )
        self.class_ids, with_depth = survey(run, kept)
        without = len(kept) - with_depth
        if without == len(kept):
            raise InputError(
                f"{run.root}: none of the {without} keyframes has a depth, so nothing can be mapped. Look at the "
                "warnings of the proxy stage, or give depth with --depth files:FOLDER"
            )
        if without:
            self.context.warn(f"{without} of {len(kept)} keyframes have no proxy depth: only their colours are used")

    def divide(self) -> None:
        """Divide the keyframes into submaps."""
        run, ids = self.context.run, np.array(self.kept)
        self.fields = run.load(DEPTH_FIELDS, "tracking")
        size = submap_size(self.context.config, run.load(CALIBRATION).intrinsics)
        if submap_count(len(ids), size) == 1:  # what they share need not be known
            self.submaps = [Submap.whole(ids)]
        else:
            self.submaps = divide(ids, overlaps(self._depths()), size)

    def _depths(self) -> Iterator[PosedDepth]:
        """The keyframes with their proxy depths, one at a time."""
        run, camera = self.context.run, self.context.run.load(CALIBRATION).intrinsics
        poses = dict(zip(self.trajectory.frame_ids.tolist(), self.trajectory.cam_from_world, strict=True))
        for i in self.kept:
            if (maps := run.find_proxy(i)) is None:
                nothing = np.zeros((camera.height, camera.width), np.float32)
                yield PosedDepth(camera, poses[i], nothing, nothing)
            else:
                height, width = maps.depth.shape
                depth = self.fields.in_world(i, maps).depth
                yield PosedDepth(camera.resized(width, height), poses[i], depth, maps.confidence)

    def save(self, work: "SubmapWork") -> None:
        """Write the map, poses and exposures."""
        log_gains, offsets = work.exposure
        self.context.save(MAP, self.result.gaussian_map)
        self.context.save(TRAJECTORY, work.moved)
        self.context.save(EXPOSURE, {"frame_ids": work.ids, "log_gains": log_gains, "offsets": offsets})

    def save_figures(self, keyframes: Sequence[ViewFigures], held_out: Sequence[ViewFigures]) -> dict[str, Any]:
        """Write the figures of keyframes and held-out frames, with the classes and the submaps."""
        image = self.context.run.load(CALIBRATION).intrinsics.at_most(self.context.config.mapping.max_side)
        figures = {
            "keyframes": len(self.kept),
            "gaussians": len(self.result.gaussian_map),
            "submaps": len(self.submaps),
            "iterations": self.result.iterations,
            "classes": len(self.class_ids),
            "psnr_pixels": max(image.width, image.height),  # on the long side; smaller images have more
            **mean_figures(keyframes, "keyframe"),
            **mean_figures(held_out, "held_out"),
        }
        several = self.submaps if len(self.submaps) > 1 else []  # one alone is all of the map
        rows = [{"own": s.own.tolist(), "border": s.border.tolist(), "beside": list(s.neighbours)} for s in several]
        self.context.save(FIGURES["mapping"], {**figures, "class_ids": list(self.class_ids), "submaps": rows})
        return figures


class SubmapWork:
    """The tasks of all submaps, and what they have come to: the last `kind` of result; of all keyframes the `ids` (N,)
    and exposures, and the trajectory as it has `moved` with them."""

    def __init__(
        self,
        context: StageContext,
        submaps: Sequence[Submap],
        trajectory: Trajectory,
        fields: DepthFields,
        class_ids: tuple[int, ...],
    ) -> None:
        self.context, self.trajectory, self.fields = context, trajectory, fields
        # Parts of another size, as of a run that goes on with other memory, are others.
        files, camera = context.snapshot / f"submaps_{len(submaps)}", context.run.load(CALIBRATION).intrinsics
        self.tasks = [
            SubmapTask(
                context.run, context.config, files, number, submap, trajectory.of_frames(submap.views),
                _only(fields, submap.views), class_ids, camera,
            )
            for number, submap in enumerate(submaps)
        ]  # fmt: skip

    def bring_to(self, *kinds: str) -> None:
        """Bring every submap from kind to kind of result, all to one before any to the next. One submap alone has
        nobody to join and to agree with: its first kind is the last."""
        kinds = kinds if len(self.tasks) > 1 else kinds[:1]
        for kind in kinds:
            self.context.each(STEPS[kind], self.tasks)
        self.kind, self._counts, results = kinds[-1], [], []
        for task in self.tasks:  # one map at a time is in memory
            result = task.load(self.kind, task.number)
            results.append(result.without_map)
            self._counts.append(len(result.gaussian_map))
        self.ids, self.cam_from_world, self.exposure = merge_results(results)
        self.moved = move_trajectory(self.trajectory, self.ids, self.cam_from_world)
        self._steps = sum(int(r.steps.sum()) for r in results)

    def whole(self) -> OptimisedMap:
        """The whole map; held once, with one part of it beside it."""
        whole: dict[str, Tensor] = {}
        for task, end, count in zip(self.tasks, np.cumsum(self._counts).tolist(), self._counts, strict=True):
            for name, part in vars(task.load(self.kind, task.number).gaussian_map).items():
                if name not in whole:
                    whole[name] = part.new_empty((sum(self._counts), *part.shape[1:]))
                whole[name][end - count : end] = part
        return OptimisedMap(GaussianMap(**whole), self.cam_from_world, *self.exposure, self._steps)

    def measure(self) -> tuple[list[ViewFigures], list[ViewFigures]]:
        """Figures of `_MEASURED` keyframes of each submap, and of the frames held out, each measured with the submap of
        the keyframe before it."""
        moved, ids = self.moved, self.ids
        times = moved.timestamps[np.isin(moved.frame_ids, ids)]
        _, held = moved.split(self.context.config.mapping.hold_out)
        before = ids[np.clip(np.searchsorted(ids, held) - 1, 0, None)]
        measuring = []
        for task in self.tasks:
            some = spread_sample(task.submap.own.tolist(), _MEASURED)
            wanted = np.append(some, np.array(held, np.int64)[np.isin(before, task.submap.own)])
            part = moved.of_frames(wanted)
            gains, offsets = (interpolate_rows(part.timestamps, times, a) for a in self.exposure)
            own, rows = np.isin(part.frame_ids, some), np.isin(ids, some)
            gains[own], offsets[own] = (a[rows] for a in self.exposure)  # others may be taken at the same time
            known = _only(self.fields, wanted)
            measuring.append(
                replace(task, trajectory=part, exposure=(gains, offsets), fields=known, measured=self.kind)
            )
        found = self.context.each(measure_submap, measuring)
        return [figures for own, _ in found for figures in own], [figures for _, others in found for figures in others]


def _only(fields: DepthFields, frame_ids: NDArray[np.int64]) -> DepthFields:
    wanted = {i: field for i in frame_ids.tolist() if (field := fields.of_frame.get(i)) is not None}
    return DepthFields(wanted) if wanted else fields  # one without any field means another thing
