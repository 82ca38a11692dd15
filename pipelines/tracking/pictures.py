"""Grey images and features of frames, the last few kept in memory."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...formats.images import to_grey
from ..config import FramesConfig
from ..frames.learned import open_learned, picture_features
from ..run.files import CALIBRATION, FEATURES, FRAMES, VOCABULARY
from ..run.folder import RunFolder
from ..sfm.features import global_descriptor
from ..sfm.rolling import Shutter
from ..types import Features, ProxyMaps

_COMPARED_TOGETHER = 64


def load_shutter(run: RunFolder) -> Shutter:
    """Load the readout and the times of a run's frames."""
    return Shutter(run.load(CALIBRATION).readout, np.array([f.timestamp for f in run.load(FRAMES)]))


class Pictures:
    """Everything tracking looks up by frame id, and the camera. Memory does not grow with the number of frames, and by
    16 KB with each keyframe that is compared with another frame."""

    def __init__(self, run: RunFolder, settings: FramesConfig, kept: int = 12) -> None:
        self.run, self.settings = run, settings
        self.vocabulary = run.load(VOCABULARY)
        self.frames = {f.id: f for f in run.load(FRAMES)}
        self.intrinsics = run.load(CALIBRATION).intrinsics
        self._learned = open_learned(settings)
        self._grey = lru_cache(kept)(lambda i: to_grey(self.color(i)))
        self._left_out = lru_cache(kept)(lambda i: run.left_out(self.frames[i]))
        self._features = lru_cache(4 * kept)(self._load_features)
        # 64 x 128 numbers each. All are asked for again and again in order: of a part of them none would ever be there.
        self._descriptors: dict[int, NDArray[np.float16]] = {}

    def color(self, frame_id: int) -> NDArray[np.uint8]:
        """(H, W, 3) RGB."""
        return self.run.image(self.frames[frame_id])

    def grey(self, frame_id: int) -> NDArray[np.uint8]:
        """Return a frame in grey (H, W)."""
        return self._grey(frame_id)

    def left_out(self, frame_id: int) -> NDArray[np.bool_] | None:
        """(H, W) what is no part of the scene; None where all of it is."""
        return self._left_out(frame_id)

    def is_scene(self, frame_id: int, xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(Q,) whether pixels (Q, 2) show the scene; also where they are not finite."""
        left_out = self.left_out(frame_id)
        if left_out is None:
            return np.ones(len(xy), bool)
        column, row = np.nan_to_num(xy, nan=-1.0).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < left_out.shape[1]) & (row < left_out.shape[0])
        return ~(inside & left_out[np.where(inside, row, 0), np.where(inside, column, 0)])

    def features(self, frame_id: int) -> Features:
        """Features: those that structure from motion had, of other frames new ones."""
        return self._features(frame_id)

    def _load_features(self, frame_id: int) -> Features:
        kept = self.run.find(FEATURES, of=frame_id)
        if kept is not None:
            return kept
        return picture_features(self.color(frame_id), self.left_out(frame_id), self.settings, self._learned)

    def descriptor(self, frame_id: int) -> NDArray[np.float32]:
        """Compute the global descriptor (D,) of a frame, for retrieval."""
        return global_descriptor(self.features(frame_id), self.vocabulary)

    def descriptors(self, keyframes: Sequence[int]) -> NDArray[np.float16]:
        """Return the global descriptors (K, D) of keyframes, which are kept."""
        for k in keyframes:
            if k not in self._descriptors:
                self._descriptors[k] = self.descriptor(k).astype(np.float16)
        return np.array([self._descriptors[k] for k in keyframes]).reshape(len(keyframes), -1)

    def similarities(self, descriptors: NDArray[np.floating], keyframes: Sequence[int]) -> NDArray[np.float32]:
        """Compute how alike frames of global descriptors (F, D) look to keyframes: (F, K), by chance 0."""
        ours, out = descriptors.astype(np.float32), np.empty((len(descriptors), len(keyframes)), np.float32)
        for first in range(0, len(keyframes), _COMPARED_TOGETHER):
            some = slice(first, first + _COMPARED_TOGETHER)
            out[:, some] = ours @ self.descriptors(keyframes[some]).astype(np.float32).T
        return out

    def proxy(self, frame_id: int) -> ProxyMaps | None:
        """Proxy maps where the frame has any."""
        return self.run.find_proxy(frame_id)
