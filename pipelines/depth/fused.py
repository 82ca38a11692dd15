"""Learned and multi-view depth together: the network's shape, brought to the depths that the geometry is sure of and
to what the network itself says of the same places in other keyframes."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import project, resize_depth
from ..geometry.sequence import Sequence
from ..providers import DepthEstimate, DepthProvider, error_of
from ..system.parallel import LruCache
from ..types import Frame
from .align import SAMPLES_ACROSS, Anchors, FieldModel, fit_fields, kept_views, keyframe_anchors, posed_small
from .completion.fill import SURE
from .fields import DepthFields, FieldGrid, Prior
from .stereo.provider import MultiviewDepth

_OF_NETWORK = FieldModel(Prior(FieldGrid(13, 17), node_sd=0.06, step_sd=0.05), pair_sd=0.02, share=1.0)
"""Each sample counts whole: the error of a network is smooth, and the solver is told how smooth."""
_BLUR, _STEP = 1 / 150, 1.1
"""Half of the width over which a network blurs a step of depth, as a part of the longer side; how large a step is."""
_GUESS = 0.1
"""The relative error of the geometry's depth counts as this at most."""
_UNKNOWN_SPREAD = 0.05
_REACH, _EVIDENCE = 1 / 12, 0.05
"""How far the sure depths tell how good the bent network is, as a part of the longer side, and the share of pixels from
which they do."""
_CARRIED = 6.0
"""Far from there it is off by this times the square of what it was off before: errors of a good network differ from
keyframe to keyframe, those of a poor one are alike (measured: 0.065 → 0.025, 0.13 → 0.08, 0.15 → 0.11, 0.19 → 0.20)."""
_AGREE = 3.0
"""Standard deviations beyond which one of the two is taken to be quite wrong."""
_STRAYS = 1.7
"""It is taken to be the network where that is expected to be off by so many times more."""
_LEARNED_CONFIDENCE, _TRUSTED_SPREAD = 0.7, 0.05
_KEPT = 32


class FusedDepth(DepthProvider):
    """Depth in the learned provider's unit (metres): the learned one, its steps sharpened, times a smooth field of each
    keyframe; the fields are found for all keyframes together. With it goes the multi-view depth, each by its error."""

    shared_state = ("_learned", "_stereo", "_scale", "_fields")

    def __init__(self, learned: DepthProvider, stereo: MultiviewDepth, sequence: Sequence) -> None:
        self._learned, self._stereo, self._sequence = learned, stereo, sequence
        self.name = f"{learned.name}+multiview"
        self.metric = learned.metric
        self._scale = DepthScale({})
        self._fields = DepthFields({})
        self._small = LruCache(self._at_stereo_size, _KEPT)

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames that neither knows."""
        return [f for f in self._learned.missing(frames) if f in self._stereo.missing(frames)]

    def precompute(self, frames: list[Frame]) -> None:
        """Run the passes of both providers on these frames."""
        self._learned.precompute(frames)
        self._stereo.precompute(frames)

    def fit(self, frames: list[Frame]) -> None:
        """Both providers' passes, the scale between them, and the fields of the learned depths."""
        self._learned.fit(frames)
        self._stereo.fit(frames)
        self._scale = measure_scale(self._sequence, frames, self._learned.estimate)
        model, camera, poses = self._sequence.backbone, self._sequence.intrinsics, self._sequence.cam_from_world
        unknown = {f.id for p in (self._learned, self._stereo) for f in p.missing(frames)}
        known = [f for f in frames if f.id not in unknown]
        views = kept_views(len(known), lambda n: posed_small(self._sharpened(known[n]), camera, poses[known[n].id]))
        rows = {int(f): k for k, f in enumerate(model.frame_ids)} if model is not None else {}
        anchors = {}
        for n, frame in enumerate(known):
            assert model is not None, "the stereo has one"
            points = keyframe_anchors(model, rows[frame.id], self._sequence.calibration.intrinsics, views[n].intrinsics)
            anchors[n] = points.and_also(self._sure_depths(frame, views[n].intrinsics.width))
        grid = _OF_NETWORK.prior.grid
        fields = fit_fields(views, anchors, how=_OF_NETWORK).reshape(-1, grid.rows, grid.columns)
        self._fields = DepthFields({f.id: field for f, field in zip(known, fields, strict=True)})

    def _sure_depths(self, frame: Frame, width: int) -> Anchors:
        """What the geometry is sure of, at pixels of a view of the width."""
        found = self._stereo.evidence(frame)
        sure = DepthEstimate(np.where(found.confidence >= SURE, found.depth, np.float32(0)), found.confidence)
        view = posed_small(sure, self._stereo.camera, np.eye(4))
        xy, depth, confidence = view.grid(SAMPLES_ACROSS)
        return Anchors(xy * (width / view.intrinsics.width), depth, error_of(confidence))

    def _sharpened(self, frame: Frame) -> DepthEstimate:
        """The learned depth in the unit of the backbone, its steps sharpened; of known confidence everywhere."""
        depth = sharpen_steps(self._learned.estimate(frame).depth)
        depth /= np.float32(self._scale.of_frame.get(frame.id, self._scale.value))
        return DepthEstimate(depth, (depth > 0).astype(np.float32))

    def _apply_scale_field(self, frame: Frame) -> NDArray[np.float32]:
        """(H, W) the learned depth in the unit of the backbone, by the frame's field if it has one."""
        depth = self._sharpened(frame).depth
        return depth * self._fields.scales(frame.id, *depth.shape) if frame.id in self._fields.of_frame else depth

    def _at_stereo_size(self, frame: Frame) -> NDArray[np.float32]:
        """The same at the size that the stereo matches."""
        return resize_depth(self._apply_scale_field(frame), self._stereo.camera.height, self._stereo.camera.width)

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Fuse the learned depth of a frame with its stereo depth."""
        bent = self._apply_scale_field(frame)
        if frame.id in self._fields.of_frame:
            own, agreed = self._small(frame), self._stereo.agreed(frame, self._small)
            change = np.divide(agreed, own, out=np.ones_like(own), where=own > 0)
            bent *= cv2.resize(change, bent.shape[::-1], interpolation=cv2.INTER_LINEAR)
        found = fuse_with_stereo(bent, self._learned.estimate(frame), self._stereo.estimate(frame))
        return replace(found, depth=found.depth * np.float32(self._scale.value))

    def figures(self) -> dict[str, Any]:
        """Return the figures of learned and stereo depth together."""
        return {**self._learned.figures(), **self._stereo.figures()}


def sharpen_steps(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) depth whose blurred steps are steps again: near one, each pixel takes the nearest or farthest depth around
    it, whichever is closer to its own in inverse depth."""
    reach = max(1, round(max(depth.shape) * _BLUR))
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    near = cv2.dilate(inverse, around)
    far = cv2.erode(np.where(depth > 0, inverse, np.float32(np.inf)), around)
    side = np.where(near - inverse < inverse - far, near, far)
    sharp = np.where(near / _STEP > far, side, inverse)
    return np.divide(1, sharp, out=np.zeros_like(depth), where=depth > 0)


def fuse_with_stereo(bent: NDArray[np.float32], learned: DepthEstimate, geometry: DepthEstimate) -> DepthEstimate:
    """One frame's depth from the bent depth of the network, in the unit of the geometry, and what the geometry says:
    their mean by their variances where they agree, and where not, the likelier one.

    Args:
        bent: (h, w) depth by the network, 0 = unknown.
        learned: as the network gave it.
        geometry: depth by several views.
    """
    known = (bent > 0) & (geometry.depth > 0)
    sure = known & (geometry.confidence >= SURE)
    log_geometry = np.log(np.where(known, geometry.depth, 1))
    off = log_geometry - np.log(np.where(known, bent, 1))
    spread = _spread(off, log_geometry - np.log(np.where(known & (learned.depth > 0), learned.depth, 1)), sure)
    error = error_of(geometry.confidence)
    variance = np.minimum(error, _GUESS) ** 2
    agree = np.where(known, np.exp(-(off**2) / (2 * _AGREE**2 * (spread**2 + variance))), 0)
    strays = known & (spread > _STRAYS * error)
    share = agree * spread**2 / (spread**2 + variance) + (1 - agree) * strays
    depth = np.where(bent > 0, bent * np.exp(share * off), geometry.depth).astype(np.float32)
    trust = np.maximum(_LEARNED_CONFIDENCE * np.exp(-((spread / _TRUSTED_SPREAD) ** 2)), 0.1) * learned.confidence
    trust = np.where(sure, agree * np.maximum(geometry.confidence, trust) + (1 - agree) * SURE * trust, trust)
    confidence = np.where(bent > 0, trust, geometry.confidence).astype(np.float32)
    return DepthEstimate(depth, confidence, learned.invalid, learned.normals)


def _spread(off: NDArray[np.floating], raw: NDArray[np.floating], sure: NDArray[np.bool_]) -> NDArray[np.floating]:
    """(h, w) relative standard deviation of the bent network's depth."""
    if not sure.any():
        return np.full(off.shape, _UNKNOWN_SPREAD)
    near = float(np.quantile(np.abs(off[sure]), 0.84)) / 1.4
    far = _CARRIED * (float(np.quantile(np.abs(raw[sure] - np.median(raw[sure])), 0.84)) / 1.4) ** 2
    size = (max(1, off.shape[1] // 4), max(1, off.shape[0] // 4))
    mass = cv2.resize(sure.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    mass = cv2.GaussianBlur(mass, (0, 0), max(size) * _REACH, borderType=cv2.BORDER_REFLECT)
    mass = cv2.resize(mass, off.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.sqrt((mass * near**2 + _EVIDENCE * far**2) / (mass + _EVIDENCE))


_MIN_POINTS = 20


@dataclass(frozen=True)
class DepthScale:
    """Depth over the depth of the backbone's points: of each frame, and their median over the run.

    spread_in: how far, relatively and robustly, a frame's own points stray from its scale.
    """

    of_frame: dict[int, float]
    spread_in: dict[int, float] = field(default_factory=dict)

    @property
    def value(self) -> float:
        """The scale of the run; 1 where nothing is known."""
        return float(np.median(list(self.of_frame.values()))) if self.of_frame else 1.0

    def in_backbone_unit(self, estimate: DepthEstimate) -> DepthEstimate:
        """Convert a depth to the unit of the backbone's poses."""
        return replace(estimate, depth=(estimate.depth / np.float32(self.value)).astype(np.float32))

    @property
    def spread(self) -> float:
        """Relative standard deviation over the frames, robust."""
        values = np.array(list(self.of_frame.values()))
        return 1.4826 * float(np.median(np.abs(values / self.value - 1))) if len(values) else 0.0


def measure_scale(sequence: Sequence, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> DepthScale:
    """Compare the depth of every frame with the points it observes; frames with too few points do not count."""
    of_frame, spread_in = {}, {}
    for frame in frames:
        if frame.id in sequence.cam_from_world:
            depth, z = depth_at_points(sequence, frame, depth_of(frame).depth)
            if len(z) >= _MIN_POINTS:
                of_frame[frame.id] = float(np.median(depth / z))
                spread_in[frame.id] = 1.4826 * float(np.median(np.abs(depth / z / of_frame[frame.id] - 1)))
    return DepthScale(of_frame, spread_in)


def depth_at_points(
    sequence: Sequence, frame: Frame, depth: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(Q,) values of a depth image (h, w) where the backbone's points are seen, without unknown ones, and (Q,) the
    depths of those points in the backbone's unit; nothing for a frame without a pose."""
    model, camera = sequence.backbone, sequence.intrinsics
    if model is None or frame.id not in sequence.cam_from_world:
        return np.empty(0), np.empty(0)
    index = int(np.flatnonzero(model.frame_ids == frame.id)[0])
    points = model.points_in_world[model.obs_point[model.observations_of(index)]]
    cam_from_world = model.cam_from_world[index]
    xy, z = project(points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3], camera)
    ok = (z > 0) & (xy > 0).all(1) & (xy < [camera.width, camera.height]).all(1)
    column, row = np.floor(np.where(ok[:, None], xy, 0)).astype(np.int64).T
    seen = depth[row, column].astype(np.float64)
    ok &= seen > 0
    return seen[ok], z[ok]
