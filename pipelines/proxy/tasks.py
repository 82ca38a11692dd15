"""A proxy stage as tasks over ranges of its frames: networks, depths, what moved, maps."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..depth.fused import DepthScale
from ..geometry.camera import resample_nearest
from ..geometry.sequence import Sequence, resize_area
from ..geometry.voxels import to_lab
from ..masks.moving import SIDE, MovingView, find_moving_once
from ..providers import DepthEstimate, DepthProvider, LabelEstimate, SemanticsProvider, load_state
from ..run.files import BACKBONE, CALIBRATION, FRAMES, LEFT_OUT, PROXY_MAPS
from ..run.stages import Chunk, StageContext, in_chunks
from ..source.recording import open_recording
from ..system.parallel import map_lookahead
from ..system.progress import Progress
from ..system.values import load_value, save_value
from ..types import Frame, Intrinsics, ProxyMaps, any_of
from .maps import compact, reliability
from .selection import ProviderContext, open_depth, open_semantics

R = TypeVar("R")


class ProxyWork:
    """The common ground of the stage and its tasks: the frames and their cameras, the providers, and the depths
    computed so far."""

    def __init__(self, context: StageContext) -> None:
        self.context, self.sequence = context, load_sequence(context)

    @cached_property
    def depths(self) -> DepthProvider:
        """Opened when it is first asked for."""
        return open_depth(self._around)

    @cached_property
    def semantics(self) -> SemanticsProvider:
        """Opened when it is first asked for."""
        return open_semantics(self._around)

    @cached_property
    def _around(self) -> ProviderContext:
        """What the providers are made from."""
        context, config = self.context, self.context.config
        recording = open_recording(context.source, config.run.format)
        return ProviderContext(
            context.source, self.sequence, config.proxy, lambda name: context.snapshot / name, context.threads,
            context.device, context.progress, recording, config.frames.people != "keep", config.run.method != "paper",
        )  # fmt: skip

    def posed(self, frames: list[Frame]) -> list[Frame]:
        """Select the frames that have a pose."""
        return [f for f in frames if f.id in self.sequence.cam_from_world]

    def depth(self, frame: Frame) -> DepthEstimate:
        """Unknown where something moved, once that has been looked for."""
        found = self.computed_depth(frame)
        moved = self.context.find(LEFT_OUT, frame.name)
        if moved is None:
            return found
        height, width = found.depth.shape
        return found.without(cv2.resize(moved.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0)

    def computed_depth(self, frame: Frame) -> DepthEstimate:
        """Load the depth that `make_depths` has left."""
        found: DepthEstimate = load_value(self._depth_path(frame))
        return found

    def save_depth(self, frame: Frame) -> None:
        """Depth of what the frame shows of the scene, to the snapshot; what is there stays."""
        if not (path := self._depth_path(frame)).exists():
            save_value(path, self.depths.estimate(frame).without(self.sequence.left_out(frame)))

    def _depth_path(self, frame: Frame) -> Path:
        return self.context.snapshot / "depth" / f"{frame.id:06d}.npz"

    def labels(self, frame: Frame, seen: DepthEstimate) -> LabelEstimate:
        """Estimate the labels of what the frame shows of the scene; `seen` in the unit of the backbone."""
        return self.semantics.estimate(frame, seen).without(self.sequence.left_out(frame))

    def moving_views(
        self, posed: list[Frame], scale: DepthScale
    ) -> tuple[NDArray[np.float64], Callable[[int], MovingView], Intrinsics]:
        """Inputs of `find_moving`: poses, views, and their camera."""
        sequence, camera = self.sequence, self.sequence.intrinsics.at_most(SIDE)

        def view(k: int) -> MovingView:
            seen = scale.in_backbone_unit(self.computed_depth(posed[k]))
            sure = reliability(seen.depth, seen.confidence)
            depth, trust = (resample_nearest(a, camera.height, camera.width) for a in (seen.depth, sure))
            lab = to_lab(resize_area(sequence.image(posed[k]), camera.width, camera.height))
            return MovingView(depth, trust, lab, sequence.cam_from_world[posed[k].id])

        return np.array([sequence.cam_from_world[f.id] for f in posed]).reshape(-1, 4, 4), view, camera


def load_sequence(context: StageContext) -> Sequence:
    """The frames, and what is known of their cameras."""
    calibration = context.run.load(CALIBRATION)
    camera = calibration.intrinsics.at_most(context.config.proxy.max_side)
    run = context.run

    def left_out(frame: Frame) -> NDArray[np.bool_] | None:
        """Return the pixels that any earlier step masks out."""
        return any_of((run.find(LEFT_OUT, of=frame.name), context.find(LEFT_OUT, frame.name)))

    return Sequence(run.load(FRAMES), calibration, camera, run.find(BACKBONE), run.image, left_out)


def in_frames(opened: ProxyWork, work: Callable[[Chunk, Progress], R], frames: list[Frame], **known: Any) -> list[R]:
    """Do a task on ranges of the frames; returns its results in order."""
    ids = np.array([f.id for f in frames], np.int64)
    return in_chunks(opened.context, work, len(frames), opened, frame_ids=ids, **known)


def _opened(task: Chunk, progress: Progress) -> tuple[ProxyWork, list[Frame]]:
    """What the task works with, and all frames that the stage is about."""
    work = task.opened or ProxyWork(task.context(progress))
    wanted = set(task.known["frame_ids"].tolist())
    return work, [f for f in work.sequence.frames if f.id in wanted]


def precompute_depth(task: Chunk, progress: Progress) -> None:
    """Run the slow passes of the depth provider over single frames."""
    work, frames = _opened(task, progress)
    work.depths.precompute(frames[task.first : task.last])


def make_depths(task: Chunk, progress: Progress) -> None:
    """The depths of the frames."""
    work, frames = _opened(task, progress)
    load_state(work.depths, task.known["depths"])
    done = map_lookahead(work.save_depth, frames[task.first : task.last], work.context.threads)
    for _ in progress.track(done, "depth", len(task.numbers)):
        pass


def find_moving_in(task: Chunk, progress: Progress) -> dict[int, NDArray[np.bool_]]:
    """The first round of `find_moving` over the frames."""
    work, frames = _opened(task, progress)
    return find_moving_once(task.numbers, *work.moving_views(frames, task.known["scale"]), progress)


def precompute_labels(task: Chunk, progress: Progress) -> None:
    """Run the network for labels over single frames."""
    work, frames = _opened(task, progress)
    work.semantics.precompute(frames[task.first : task.last])


def make_maps(task: Chunk, progress: Progress) -> dict[int, NDArray[np.float32]]:
    """Labels and reliability of the frames; known["metres"] turns the provider's depth into that of the maps. Returns
    what a network says of how frames look, by id."""
    work, frames = _opened(task, progress)
    load_state(work.semantics, task.known["semantics"])
    scale, metres = task.known["scale"], np.float32(task.known["metres"])

    def make(frame: Frame) -> tuple[int, NDArray[np.float32] | None]:
        depth = work.depth(frame)
        labels = work.labels(frame, scale.in_backbone_unit(depth))
        if not PROXY_MAPS.path(work.context.folder, frame.id).exists():
            u = reliability(depth.depth, depth.confidence)
            scaled = (depth.depth * metres).astype(np.float32)
            maps = compact(ProxyMaps(scaled, u, labels.labels, labels.confidence))
            work.context.save(PROXY_MAPS, maps, frame.id)
        return frame.id, labels.descriptor

    made = map_lookahead(make, frames[task.first : task.last], work.context.threads)
    found = progress.track(made, "classes", len(task.numbers))
    return {frame_id: descriptor for frame_id, descriptor in found if descriptor is not None}
