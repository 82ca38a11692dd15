"""Loading of views from the run folder: the frames that make the map, and those that only measure it."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..config import MappingConfig
from ..depth.fields import DepthFields, contradicted
from ..geometry.posed_depth import PosedDepth
from ..run.files import CALIBRATION, DEPTH_FIELDS, FRAMES
from ..run.folder import RunFolder
from ..run.stages import StageContext
from ..system.machine import VIEWS_SHARE, room_on
from ..system.parallel import LruSequence
from ..types import Frame, Intrinsics, ProxyMaps, Trajectory
from .division import split_frames
from .views import View, make_view, occurring_classes

_COMPARED_ROOM = 60e6
"""Bytes of depths and trust that are kept while each view is compared with some others, mostly those beside it."""


@dataclass(frozen=True)
class MappingInput:
    """views: keyframes that make the map; held_out: frames that only measure it; class_ids: label of each channel."""

    views: Sequence[View]
    held_out: Sequence[View]
    class_ids: tuple[int, ...]


def load_views(
    run: RunFolder,
    trajectory: Trajectory,
    settings: MappingConfig,
    device: torch.device | str = "cpu",
    fields: DepthFields | None = None,
    memory: float = math.inf,
    class_ids: tuple[int, ...] | None = None,
) -> MappingInput:
    """The keyframes of `trajectory` with images and proxies, in order.

    A quarter of `memory`, bytes, or of the GPU's free memory where the views are on one, is for views; the rest is
    read again when it is visited. Depths are in the unit of the world by `fields`, those of tracking unless
    others are given; what other views see through is unknown. Without `class_ids` the channels are the classes that
    occur.
    """
    frames = {f.id: f for f in run.load(FRAMES)}
    full = run.load(CALIBRATION).intrinsics
    intrinsics = full.at_most(settings.max_side)
    fields = fields or run.load(DEPTH_FIELDS, "tracking")
    kept, measured = split_frames(trajectory, settings.hold_out)
    channels = survey(run, kept)[0] if class_ids is None else class_ids
    poses = dict(zip(trajectory.frame_ids.tolist(), trajectory.cam_from_world, strict=True))

    def load(frame_id: int) -> View:
        frame = frames[frame_id]
        maps = run.find_proxy(frame_id)
        scaled = None if maps is None else fields.in_world(frame_id, maps)
        return load_view(run, frame, intrinsics, poses[frame_id], scaled, channels, device)

    memory = room_on(device, memory)

    def streamed(ids: list[int], room: float) -> LruSequence[View]:
        return LruSequence(len(ids), lambda n: load(ids[n]), lambda v: v.nbytes, room)

    views = without_contradicted_depth(streamed(kept, VIEWS_SHARE * memory))
    return MappingInput(views, streamed(measured, VIEWS_SHARE * memory / 8), channels)


def with_rigid_panoramas(context: StageContext) -> StageContext:
    """The six sides of a panorama stay one camera: its settings refine no pose."""
    if context.run.load(CALIBRATION).directions == 1:
        return context
    mapping = replace(context.config.mapping, refine_poses=False)
    return replace(context, config=replace(context.config, mapping=mapping))


def survey(run: RunFolder, frame_ids: Iterable[int]) -> tuple[tuple[int, ...], int]:
    """(the label of each class channel of a map of these keyframes, how many of them have a depth), in one pass."""
    with_depth = 0

    def labels() -> Iterator[NDArray[np.uint8]]:
        nonlocal with_depth
        for maps in filter(None, map(run.find_proxy, frame_ids)):
            with_depth += bool((maps.depth > 0).any())
            yield maps.labels

    return occurring_classes(labels()), with_depth


def without_contradicted_depth(views: LruSequence[View]) -> LruSequence[View]:
    """The views, their depth unknown where others see through it."""

    def size_of(posed: PosedDepth) -> int:
        return posed.depth.nbytes + posed.trust.nbytes

    posed = LruSequence(len(views), lambda i: views[i].posed_depth(), size_of, _COMPARED_ROOM)
    wrong = [np.packbits(w) for w in contradicted(posed)]

    def masked(index: int, view: View) -> View:
        pixels = np.unpackbits(wrong[index], count=view.depth.numel()).reshape(view.depth.shape)
        return view.without_depth_at(torch.from_numpy(pixels > 0))

    return views.changed(masked)


def load_view(
    run: RunFolder,
    frame: Frame,
    intrinsics: Intrinsics,
    cam_from_world: NDArray[np.float64],
    maps: ProxyMaps | None,
    class_ids: tuple[int, ...],
    device: torch.device | str,
) -> View:
    """One frame as a view."""
    image, left_out = run.image(frame), run.left_out(frame)
    return make_view(frame.id, intrinsics, cam_from_world, image, maps, class_ids, device, left_out)
