"""Depth from the video itself: multi-view stereo between the backbone's keyframes. Needs no learned weights.

First every keyframe gets a depth map of its own (plane sweep, semi-global smoothing, refinement); then each is
compared with those of its neighbours, which gives the fused depth and its confidence. Both passes go over the disk
and hold only a few frames at a time.
"""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ....formats.errors import InputError
from ...geometry.sequence import Sequence, resize_area
from ...geometry.sparse_model import SparseModel
from ...providers import DepthEstimate, confidence_of
from ...system.parallel import LruCache, map_lookahead
from ...system.progress import Progress
from ...system.values import load_value, save_value
from ...types import Frame, Intrinsics
from ..completion.evidence import (
    ASKED,
    LENDERS,
    CompletionInputs,
    HalfResKeyframe,
    build_inputs,
    invert,
    update_view_evidence,
)
from ..completion.fill import SURE, evidence_of, smooth_confidence
from ..completion.network import HALF, TWICE, complete, completed_keyframe, halved
from .consistency import choose_neighbours, fuse_depths, sweep_range
from .matching import StereoImages, match_planes
from .sweep import warps_to
from .volume import Bands
from .window import surface_contrast, upsample_depth

_CACHED_FRAMES = 48
_VIEWS, _FUSE_VIEWS = 12, 8
"""Keyframes that one is matched with, and those whose depths are compared. What lies beside a near thing is hidden from
half of the views."""
_RANGE_VIEWS = 6
"""Their points say how near and far to look."""
_CACHED_LENDERS = LENDERS + 4
"""What is kept of them at half the size. With no more of the fused depths each would be fused four to five times."""
_CACHED_CASES = 12
_BEST_ANGLE = 8.0
"""Degrees between the views of a pair."""
_STOP = 0.02
"""As a part of the range of inverse depths: so near to its ends nothing is a match."""
_TOLERANCE = 0.01
"""Relative difference between depths that agree."""


class MultiviewDepth:
    """Depth of the backbone's keyframes in the backbone's unit."""

    metric = False
    name = "multiview"
    shared_state = ()
    all_speak = False
    """Whether candidates are gathered for all pixels, as what is learned from wants them, or for half."""

    def __init__(
        self,
        sequence: Sequence,
        side: int,
        planes: int,
        folder: Callable[[], Path],
        threads: int,
        progress: Progress,
        device: str = "cpu",
    ) -> None:
        """side: of the images that are matched, pixels; planes: depths that are tried; `folder` gives a place for the
        maps between the passes; what compares pictures and depths runs on the `device`. InputError without a backbone
        of two keyframes."""
        if sequence.backbone is None or len(sequence.backbone.frame_ids) < 2:
            raise InputError(
                "depth from several views needs parallax, and structure from motion found none: the camera stands "
                "still or only turns. Move it sideways, or give depth with --depth files:FOLDER or --depth onnx:CARD"
            )
        self._sequence, self._planes, self._folder, self._progress = sequence, planes, folder, progress
        self._model: SparseModel = sequence.backbone
        self._index = {int(f): i for i, f in enumerate(self._model.frame_ids)}
        self._frame = {f.id: f for f in sequence.frames}
        self._bands, self._threads, self._device = Bands(threads), threads if device == "cpu" else 1, device
        self.camera: Intrinsics = sequence.calibration.intrinsics.at_most(side)
        self._grey = LruCache(self._read_grey, _CACHED_FRAMES)
        self._raw = LruCache(self._load_raw, _CACHED_FRAMES)
        self._fused = LruCache(self._fuse, _CACHED_FRAMES)
        self._small = LruCache(self._read_small, _CACHED_FRAMES)
        self._contrast = LruCache(self._measure_contrast, _CACHED_LENDERS)
        self._half = LruCache(self._halve, _CACHED_LENDERS)
        self.first_inputs = LruCache(self._first_inputs, _CACHED_CASES)
        self._completed = LruCache(self._complete_first, _CACHED_LENDERS)
        self._nearest = LruCache(self._choose_nearest, _CACHED_FRAMES)

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames that are no keyframes of the backbone."""
        return [f for f in frames if f.id not in self._index]

    # first pass -------------------------------------------------------------------------------------------------

    def fit(self, frames: list[Frame]) -> None:
        """Compute the raw depth of every keyframe; there is no joint step."""
        self.precompute(frames)

    def precompute(self, frames: list[Frame]) -> None:
        """A raw depth map of every keyframe, on disk."""
        known = [f for f in frames if f.id in self._index]
        for _ in self._progress.track(map_lookahead(self._compute_raw, known, self._threads), "stereo", len(known)):
            pass

    def _compute_raw(self, frame: Frame) -> None:
        if not (path := self._path(frame.id)).exists():
            save_value(path, self._sweep(self._index[frame.id]))

    def _sweep(self, index: int) -> NDArray[np.float32]:
        """(H, W) inverse depth of one keyframe from its neighbours alone; 0 where nothing matches."""
        camera = self.camera
        companions = self._neighbours(index, _VIEWS)
        limits = sweep_range(self._model, index, companions[:_RANGE_VIEWS])
        if len(companions) == 0 or limits is None:
            return np.zeros((camera.height, camera.width), np.float32)
        planes = np.linspace(1 / limits[1], 1 / limits[0], self._planes)
        given, cuda = (self._stereo_images(index, companions), planes), self._cuda
        inverse = match_planes(*given, self._bands) if cuda is None else cuda.match_planes(*given, self._device)
        left_out = self._grey(int(self._model.frame_ids[index]))[1]
        inverse = np.clip(inverse, planes[0], planes[-1]).astype(np.float32)
        unknown = at_stops(inverse, planes)
        return np.where(unknown if left_out is None else unknown | left_out, np.float32(0), inverse)

    def _stereo_images(self, index: int, others: NDArray[np.int64]) -> StereoImages:
        ids = self._model.frame_ids[others].tolist()
        image = self._grey(int(self._model.frame_ids[index]))[0]
        return StereoImages(image, np.stack([_blanked(*self._grey(i)) for i in ids]), self._warps(index, others))

    # second pass ------------------------------------------------------------------------------------------------

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Fused depth and its confidence; unknown everywhere for a frame that is no keyframe."""
        target = self._sequence.intrinsics
        if frame.id not in self._index:
            empty = np.zeros((target.height, target.width), np.float32)
            return DepthEstimate(empty, empty)
        return upsample_depth(*self._complete(self._index[frame.id]), self._sequence.image(frame))

    def _complete(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth and confidence of one keyframe at the size that is matched, completed where it is not sure itself."""
        (depth, confidence), inputs = self._fused(index), self.inputs(index)
        if inputs is None:
            return depth, np.minimum(confidence, SURE)
        small, error = complete(inputs, self._network_device)
        found = upsample_depth(small, confidence_of(error), self._small(index))
        # Of a match the network and the views' agreement both say how good it is.
        sure, trust = confidence >= SURE, found.confidence
        return np.where(sure, depth, found.depth), np.where(sure, np.sqrt(trust * confidence), trust)

    def inputs(self, index: int) -> CompletionInputs | None:
        """Gather what the completion of a keyframe's depth rests on, by its place in the backbone: other keyframes are
        asked again, completed. None with hardly any sure pixel."""
        first = self.first_inputs(index)
        if first is None:
            return None
        asked = self._lenders(index)[:ASKED]
        return update_view_evidence(first, [self._completed(j) for j in asked.tolist()], self._half_warps(index, asked))

    def _first_inputs(self, index: int) -> CompletionInputs | None:
        """Gather first-round inputs, from uncompleted neighbours."""
        lenders = self._lenders(index)
        lent = [self._half_warps(j, np.array([index]))[0] for j in lenders.tolist()]
        halves = [self._half(j) for j in lenders.tolist()]
        return build_inputs(self._half(index), halves, lent, self._half_warps(index, lenders[:ASKED]), self.all_speak)

    def _complete_first(self, index: int) -> HalfResKeyframe:
        inputs = self.first_inputs(index)
        return self._half(index) if inputs is None else completed_keyframe(inputs, self._network_device)

    def _half_warps(self, index: int, others: NDArray[np.int64]) -> list[NDArray[np.float64]]:
        return [HALF @ warp @ TWICE for warp in self._warps(index, others)]

    def _halve(self, index: int) -> HalfResKeyframe:
        size = -(-self.camera.width // 2), -(-self.camera.height // 2)
        return halved(*self._fused(index), resize_area(self._small(index), *size), self._contrast(index))

    def evidence(self, frame: Frame) -> DepthEstimate:
        """Depths of a keyframe at the size that is matched, and how well other views bear them out; nothing is filled
        in."""
        return DepthEstimate(*self._fused(self._index[frame.id]))

    def agreed(self, frame: Frame, depth_of: Callable[[Frame], NDArray[np.float32]]) -> NDArray[np.float32]:
        """(h, w) mean of a depth that is given at the size that is matched, in the backbone's unit, and of its
        neighbours' where they agree with it."""
        index, own = self._index[frame.id], depth_of(frame)
        companions = self._neighbours(index, _FUSE_VIEWS)
        if len(companions) == 0:
            return own
        others = np.stack([depth_of(self._frame[int(i)]) for i in self._model.frame_ids[companions]])
        warps, back = self._warps(index, companions), self._rows_back(index, companions)
        return self._compare(own, others, warps, back, 2 * _TOLERANCE)[0]

    def _fuse(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Depth of one keyframe and those of its neighbours that agree, and its confidence."""
        companions = self._present(self._neighbours(index, _FUSE_VIEWS))
        depth = self._raw(index)
        if len(companions) == 0:
            return depth, np.where(depth > 0, 0.2, 0).astype(np.float32)
        others = np.stack([self._raw(int(j)) for j in companions])
        warps, back = self._warps(index, companions), self._rows_back(index, companions)
        fused, support, conflict = self._compare(depth, others, warps, back, _TOLERANCE)
        confidence = agreement(support, conflict) * evidence_of(self._contrast(index))
        return fused, smooth_confidence(confidence, self._small(index))

    def _compare(
        self,
        depth: NDArray[np.float32],
        others: NDArray[np.float32],
        warps: NDArray[np.float64],
        back: NDArray[np.float64],
        tolerance: float,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Compare as `fuse_depths` does, on the device."""
        given, cuda = (depth, others, warps, back, tolerance), self._cuda
        return fuse_depths(*given, self._bands) if cuda is None else cuda.fuse_depths(*given, self._device)

    def figures(self) -> dict[str, Any]:
        """The size that the images were matched at."""
        return {"stereo_size": [self.camera.width, self.camera.height]}

    # what both use ----------------------------------------------------------------------------------------------

    @property
    def _network_device(self) -> str:
        return "cpu" if self._cuda is None else self._device

    @cached_property
    def _cuda(self) -> ModuleType | None:
        """The same by kernels where the device takes them."""
        if self._device == "cpu":
            return None
        from . import cuda as card

        return card if card.takes_kernels_on(self._device) else None

    def _path(self, frame_id: int) -> Path:
        return self._folder() / f"{frame_id:06d}.npz"

    def _lenders(self, index: int) -> NDArray[np.int64]:
        """Return neighbours that have a depth map, the nearest first, of which both rounds ask the first `ASKED`."""
        return self._present(self._neighbours(index, LENDERS))

    def _present(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those that have a raw depth map."""
        return np.array([j for j in indices if self._path(int(self._model.frame_ids[j])).exists()], np.int64)

    def _neighbours(self, index: int, count: int) -> NDArray[np.int64]:
        return self._nearest(index)[:count]

    def _choose_nearest(self, index: int) -> NDArray[np.int64]:
        camera = self._sequence.calibration.intrinsics
        return choose_neighbours(self._model, camera, index, LENDERS, _BEST_ANGLE)

    def _warps(self, index: int, others: NDArray[np.int64]) -> NDArray[np.float64]:
        matrix, poses = self.camera.matrix, self._model.cam_from_world
        return warps_to(matrix, poses[index], [matrix] * len(others), [poses[j] for j in others])

    def _rows_back(self, index: int, others: NDArray[np.int64]) -> NDArray[np.float64]:
        """(N, 4) what gives this keyframe's z of the others' pixels, as `fuse_depths` wants it."""
        return np.array([self._warps(int(j), np.array([index]))[0][2] for j in others])

    def _measure_contrast(self, index: int) -> NDArray[np.float32]:
        return surface_contrast(self._grey(int(self._model.frame_ids[index]))[0])

    def _read_grey(self, frame_id: int) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
        rgb = self._sequence.read_image(self._frame[frame_id])
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        size = self.camera.width, self.camera.height
        small = resize_area(np.asarray(grey, np.uint8), *size)
        return small.astype(np.float32) / np.float32(255), self._sequence.left_out(self._frame[frame_id], *size)

    def _read_small(self, index: int) -> NDArray[np.uint8]:
        """(h, w, 3) RGB at the size that is matched."""
        image = self._sequence.image(self._frame[int(self._model.frame_ids[index])])
        return resize_area(image, self.camera.width, self.camera.height)

    def _load_raw(self, index: int) -> NDArray[np.float32]:
        return invert(load_value(self._path(int(self._model.frame_ids[index]))))


def _blanked(grey: NDArray[np.float32], left_out: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """Another view's picture with NaN where it shows no scene: no window that touches it is compared."""
    return grey if left_out is None else np.where(left_out, np.float32(np.nan), grey)


def at_stops(inverse: NDArray[np.float32], planes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where the sweep ended at its first or last planes: there a surface without texture ends, for no plane is better
    than the first, and all views agree on it."""
    place = (inverse - planes[0]) / (planes[-1] - planes[0])
    return np.asarray((place < _STOP) | (place > 1 - _STOP))


def agreement(support: NDArray[np.float32], conflict: NDArray[np.float32]) -> NDArray[np.float32]:
    """Confidence in [0, 1]: one agreeing view gives a half, four 0.8; views that look through count against."""
    return (support / (support + 1.0 + conflict)).astype(np.float32)
