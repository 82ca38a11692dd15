"""Stage 2: depth, its reliability, and classes of the keyframes."""

from typing import Any

import cv2
import numpy as np

from ...formats.errors import InputError
from ..depth.completion.fill import SURE
from ..depth.files import NO_DEPTH
from ..depth.fused import DepthScale, measure_scale
from ..depth.stereo.provider import MultiviewDepth
from ..masks.moving import find_moving
from ..providers import dump_state, error_of
from ..run.files import CLASSES, DESCRIPTORS, FIGURES, FRAME_SCALES, LEFT_OUT, PROXY_MAPS
from ..run.stages import StageContext
from ..system.progress import log
from ..types import VOID, Frame
from .reference import ReferenceScale, reference_scale, scale_figures
from .tasks import (
    ProxyWork,
    find_moving_in,
    in_frames,
    make_depths,
    make_maps,
    precompute_depth,
    precompute_labels,
)

_MOSTLY_GOOD = 0.45
"""Share of reliable pixels below which depth is a guess in large parts: of five recordings three have less (0.34 to
0.44), two more (0.51, 0.85)."""


def run(context: StageContext) -> dict[str, Any]:
    """Provide maps of every keyframe (every frame without a backbone, or on request)."""
    return ProxyStage(context).run()


class ProxyStage:
    """The stage's steps; the frames, their cameras and the providers are in `work`."""

    def __init__(self, context: StageContext) -> None:
        self.context, self.warn, self.work = context, context.warn, ProxyWork(context)
        self.frames = self._frames_to_do()

    def run(self) -> dict[str, Any]:
        """Do the stage; its key figures."""
        work, frames = self.work, self.frames
        log.info("proxy: depth by %s, classes by %s", work.depths.name, work.semantics.name)
        self._warn_of_missing()
        self._compute_depths()
        self._warn_of_empty()
        scale = measure_scale(work.sequence, frames, work.computed_depth)
        moving = self._leave_out_moving(scale)
        reference = reference_scale(work, frames, scale)
        self._compute_maps(scale, reference)
        figures = self._figures() | scale_figures(work.depths, scale, reference) | moving
        self._warn_of_focal(figures.get("network_focal_px"))
        self._warn_of_guesses(figures["reliable_pixels"], figures.get("completed_error", 0.0))
        self.context.save(FIGURES["proxy"], figures)
        return figures

    def _frames_to_do(self) -> list[Frame]:
        sequence, is_paper = self.work.sequence, self.context.config.run.method == "paper"
        if (is_paper and self.work.depths.metric) or sequence.backbone is None:
            return sequence.frames
        if is_paper:
            self.warn(f"--method paper: {self.work.depths.name} knows only keyframes, the other frames get no maps")
        return self.work.posed(sequence.frames)

    def _warn_of_missing(self) -> None:
        """Warn of frames without a map."""
        for kind, provider in (("depth", self.work.depths), ("label", self.work.semantics)):
            missing = provider.missing(self.frames)
            if len(missing) == len(self.frames):
                name = missing[0].name
                raise InputError(f"{provider.name}: no {kind} map is named like any keyframe, for example {name}")
            if missing:
                self.warn(
                    f"{len(missing)} of {len(self.frames)} frames have no {kind} map, the first is {missing[0].name}"
                )

    def _compute_depths(self) -> None:
        """Compute the depth of every frame and store it in the snapshot."""
        in_frames(self.work, precompute_depth, self.frames)
        self.work.depths.fit(self.frames)
        in_frames(self.work, make_depths, self.frames, depths=dump_state(self.work.depths))

    def _warn_of_empty(self) -> None:
        """Of depth files in which nothing is known. Raises InputError where that is so of all keyframes."""
        if not self.work.depths.name.startswith("files:"):
            return
        missing = {f.id for f in self.work.depths.missing(self.frames)}
        read = [f for f in self.frames if f.id not in missing]
        empty = [f for f in read if not (self.work.computed_depth(f).depth > 0).any()]
        if read and len(empty) == len(read):
            raise InputError(f"{self.work.depths.name}: of the keyframes {NO_DEPTH}")
        if empty:
            self.warn(
                f"{len(empty)} of {len(read)} depth files hold no depth (every value is 0, 65535, negative, infinite "
                f"or NaN), the first is that of {empty[0].name}: depth of these frames is unknown"
            )

    def _compute_maps(self, scale: DepthScale, reference: ReferenceScale | None) -> None:
        """Compute labels and the stored maps of every frame, in metres where there is a `reference`."""
        context, semantics = self.context, self.work.semantics
        in_frames(self.work, precompute_labels, self.frames)
        semantics.fit(self.frames, lambda frame: scale.in_backbone_unit(self.work.depth(frame)))
        for message in semantics.warnings():
            self.warn(message)
        context.save(CLASSES, semantics.classes())
        metres = reference.factor if reference else 1.0
        made = in_frames(self.work, make_maps, self.frames, scale=scale, metres=metres, semantics=dump_state(semantics))
        if descriptors := {i: descriptor for part in made for i, descriptor in part.items()}:
            context.save(DESCRIPTORS, descriptors)
        scales = scale.of_frame.items()
        rows = [{"frame_id": i, "scale": round(s, 6), "spread": round(scale.spread_in[i], 6)} for i, s in scales]
        context.save(FRAME_SCALES, rows)

    def _warn_of_focal(self, network_focal: float | None) -> None:
        """Warn where the depth network sees quite another focal length than the calibration has."""
        calibration = self.work.sequence.calibration
        focal = calibration.intrinsics.fx
        if network_focal is None or calibration.origin == "given" or abs(network_focal / focal - 1) < 0.15:
            return
        self.warn(
            f"the depth network sees a focal length of {network_focal:.0f} pixels, the calibration "
            f"({calibration.origin}) says {focal:.0f} +- {calibration.focal_sd:.0f}: give --intrinsics if you know the "
            "camera"
        )

    def _warn_of_guesses(self, reliable: float, error: float) -> None:
        """Warn where most of the depth is filled in: an image of the map does not show it."""
        if self.work.depths.name == MultiviewDepth.name and reliable < _MOSTLY_GOOD:
            self.warn(
                f"only {reliable:.0%} of the pixels have a depth that is good to 4%; elsewhere (bare walls, plain "
                f"floors) it is filled in from around them and expected to be off by {error:.0%} on average. Film "
                "closer and with more texture in view, or let a depth network help: `msgs-slam models pull --best`"
            )

    def _leave_out_moving(self, scale: DepthScale) -> dict[str, float | int]:
        """Store masks of what moved; return in how many frames, and how much of those."""
        config = self.context.config
        if config.proxy.moving != "auto" or config.run.method == "paper":
            return {}
        posed = self.work.posed(self.frames)
        seen = in_frames(self.work, find_moving_in, posed, scale=scale)
        first = {k: moved for part in seen for k, moved in part.items()}
        found = find_moving(*self.work.moving_views(posed, scale), self.context.progress, first)
        full = self.work.sequence.calibration.intrinsics
        for k, moved in found.items():
            shown = cv2.resize(moved.astype(np.float32), (full.width, full.height), interpolation=cv2.INTER_LINEAR)
            self.context.save(LEFT_OUT, shown > 0.5, posed[k].name)
        share = round(float(np.mean([m.mean() for m in found.values()])), 4) if found else 0.0
        return {"moving_frames": len(found), "moving_share": share} if found else {}

    def _figures(self) -> dict[str, Any]:
        """Summarise the stage for the report."""
        sizes, reliable, void = [], [], []
        invalid, error, completed = 0, 0.0, 0
        for frame in self.frames:
            path, depth = PROXY_MAPS.path(self.context.folder, frame.id), self.work.depth(frame)
            invalid += depth.invalid
            if self.work.depths.name == MultiviewDepth.name:
                unsure = depth.confidence[(depth.confidence > 0) & (depth.confidence < SURE)]
                expected = error_of(unsure)
                error, completed = error + float(expected.sum(dtype=np.float64)), completed + len(expected)
            maps = PROXY_MAPS.read(path)
            sizes.append(path.stat().st_size)
            reliable.append(float((maps.confidence > 0.35).mean()))
            void.append(float((maps.labels == VOID).mean()))
        if invalid:
            self.warn(f"{invalid} depth values were NaN, infinite or negative; they count as unknown")
        depths, semantics = self.work.depths, self.work.semantics
        return {
            "depth": depths.name,
            "semantics": semantics.name,
            "metric": depths.metric,
            "frames": len(self.frames),
            "classes": len(semantics.classes()),
            "reliable_pixels": round(float(np.mean(reliable)), 4),
            "void_pixels": round(float(np.mean(void)), 4),
            "kilobytes_a_frame": round(float(np.mean(sizes)) / 1000, 1),
            "invalid_depth_values": invalid,
            **({"completed_error": round(error / completed, 4)} if completed else {}),
            **depths.figures(),
            **semantics.figures(),
        }
