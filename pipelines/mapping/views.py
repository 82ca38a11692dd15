"""Views of the mapping: a keyframe's image and proxies as tensors, full size and half, loaded from the run folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..config import MappingConfig
from ..depth.fields import DepthFields, contradicted
from ..geometry.camera import resize_depth, resize_maps
from ..geometry.posed_depth import PosedDepth
from ..run.files import CALIBRATION, DEPTH_FIELDS, FRAMES
from ..run.folder import RunFolder
from ..run.stages import StageContext
from ..system.machine import VIEWS_SHARE, room_on
from ..system.parallel import LruSequence
from ..types import VOID, Frame, Intrinsics, ProxyMaps, Trajectory


@dataclass(frozen=True)
class View:
    """A posed image with its proxies.

    cam_from_world (4, 4) float64, on the host wherever the others are; image (H, W, 3) uint8; depth (H, W) float32 in
    the world's unit, 0 = unknown; reliability U (H, W) uint8 0..255; channels (H, W) uint8: the class *channel* of each
    pixel, VOID where unknown; channel_confidence (H, W) uint8; scene (H, W) bool:
    False where the image shows what is no part of the scene, None where all of it is. Kept in bytes: a run has
    hundreds of views.
    """

    frame_id: int
    intrinsics: Intrinsics
    cam_from_world: Tensor
    image: Tensor
    depth: Tensor
    reliability: Tensor
    channels: Tensor
    channel_confidence: Tensor
    scene: Tensor | None = None

    @property
    def nbytes(self) -> int:
        """Memory of its tensors, in bytes."""
        tensors = (self.image, self.depth, self.reliability, self.channels, self.channel_confidence, self.scene)
        return sum(t.nbytes for t in tensors if t is not None)

    @property
    def colors(self) -> Tensor:
        """(H, W, 3) float32 in 0..1."""
        return self.image.float() / 255

    @property
    def trust(self) -> Tensor:
        """(H, W) float32 reliability U in 0..1, 0 where there is no depth."""
        return self.reliability.float() / 255 * (self.depth > 0)

    @property
    def label_weight(self) -> Tensor:
        """(H, W) float32 in 0..1."""
        return self.channel_confidence.float() / 255

    @property
    def shown(self) -> float:
        """Share of the image that shows the scene; above 0."""
        return 1.0 if self.scene is None else max(float(self.scene.float().mean()), 1e-6)

    def of_scene(self, values: Tensor, elsewhere: Tensor | float = 0.0) -> Tensor:
        """(H, W) or (H, W, channels) `values` where the image shows the scene."""
        if self.scene is None:
            return values
        scene = self.scene if values.ndim == 2 else self.scene[..., None]
        return torch.where(scene, values, elsewhere)

    def posed_depth(self) -> PosedDepth:
        """Return the depth, trust and pose as arrays, to compare other views with."""
        pose = self.cam_from_world.numpy()
        return PosedDepth(self.intrinsics, pose, self.depth.cpu().numpy(), self.trust.cpu().numpy())

    def without_depth_at(self, wrong: Tensor) -> View:
        """Return the view with unknown depth at the marked (H, W) pixels."""
        return replace(self, depth=torch.where(wrong.to(self.depth.device), 0.0, self.depth))


def make_view(
    frame_id: int,
    intrinsics: Intrinsics,
    cam_from_world: NDArray[np.float64],
    image: NDArray[np.uint8],
    maps: ProxyMaps | None,
    class_ids: tuple[int, ...],
    device: torch.device | str = "cpu",
    left_out: NDArray[np.bool_] | None = None,
) -> View:
    """A view of the size of `intrinsics`; `maps` None is a frame without proxies, `left_out`
    (any size) is what of it is no part of the scene."""
    width, height = intrinsics.width, intrinsics.height
    if image.shape[:2] != (height, width):
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
    if maps is None:
        nothing = np.zeros((height, width), np.float32)
        maps = ProxyMaps(nothing, nothing, np.full((height, width), VOID, np.uint8), nothing)
    maps = resize_maps(maps, height, width)
    arrays = (
        image,
        maps.depth.astype(np.float32),
        np.round(maps.confidence * 255).astype(np.uint8),
        channel_table(class_ids)[maps.labels],
        np.round(maps.label_confidence * 255).astype(np.uint8),
    )
    pose = torch.tensor(cam_from_world, dtype=torch.float64)  # a copy: workers get arrays to read only
    colors, depth, reliability, channels, confidence = (
        torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in arrays
    )
    scene = None
    if left_out is not None:
        shown = cv2.resize(left_out.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) == 0
        scene = torch.from_numpy(shown).to(device)
    return View(frame_id, intrinsics, pose, colors, depth, reliability, channels, confidence, scene=scene)


def channel_table(class_ids: tuple[int, ...]) -> NDArray[np.uint8]:
    """(256,) label → class channel; labels that have no channel become VOID."""
    table = np.full(256, VOID, np.uint8)
    table[list(class_ids)] = np.arange(len(class_ids), dtype=np.uint8)
    return table


def half_view(view: View) -> View:
    """The view at half the size: colours averaged, classes sampled, depth averaged where that is across no edge."""
    size = (max(view.intrinsics.width // 2, 1), max(view.intrinsics.height // 2, 1))
    image = cv2.resize(view.image.cpu().numpy(), size, interpolation=cv2.INTER_AREA)
    depth = resize_depth(view.depth.cpu().numpy(), size[1], size[0])

    def sampled(tensor: Tensor) -> Tensor:
        return tensor[1::2, 1::2][: size[1], : size[0]].contiguous()

    scene = view.scene
    if scene is not None:  # where all of what a pixel averages is
        shown = cv2.resize(scene.cpu().numpy().astype(np.float32), size, interpolation=cv2.INTER_AREA) == 1
        scene = torch.from_numpy(shown).to(scene.device)
    return replace(
        view,
        intrinsics=view.intrinsics.resized(*size),
        image=torch.from_numpy(image).to(view.image.device),
        depth=torch.from_numpy(depth).to(view.depth.device),
        reliability=sampled(view.reliability),
        channels=sampled(view.channels),
        channel_confidence=sampled(view.channel_confidence),
        scene=scene,
    )


def occurring_classes(all_labels: Iterable[NDArray[np.uint8]], least_share: float = 1e-5) -> tuple[int, ...]:
    """The classes that make up at least `least_share` of the labelled pixels, in order."""
    counts = np.zeros(256, np.int64)
    for labels in all_labels:
        counts += np.bincount(labels.reshape(-1), minlength=256)
    counts[VOID] = 0
    return tuple(int(i) for i in np.flatnonzero(counts > least_share * max(counts.sum(), 1)))


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
    kept, measured = trajectory.split(settings.hold_out)
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
