"""The picked frames with their cameras, as providers see them, and images resized."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Calibration, Frame, Intrinsics
from .sparse_model import SparseModel


@dataclass(frozen=True)
class Sequence:
    """All picked frames with their camera at map size, and what structure from motion knows of them."""

    frames: list[Frame]
    calibration: Calibration
    intrinsics: Intrinsics
    backbone: SparseModel | None
    read_image: Callable[[Frame], NDArray[np.uint8]]
    read_left_out: Callable[[Frame], NDArray[np.bool_] | None] = lambda frame: None

    @cached_property
    def cam_from_world(self) -> dict[int, NDArray[np.float64]]:
        """Frame id → (4, 4) of the backbone's keyframes."""
        if self.backbone is None:
            return {}
        return dict(zip(self.backbone.frame_ids.tolist(), self.backbone.cam_from_world, strict=True))

    def image(self, frame: Frame) -> NDArray[np.uint8]:
        """(h, w, 3) RGB at map size."""
        return resize_area(self.read_image(frame), self.intrinsics.width, self.intrinsics.height)

    def left_out(self, frame: Frame, width: int = 0, height: int = 0) -> NDArray[np.bool_] | None:
        """(h, w) at map size, or another: the pixels that show anything which is no part of the scene; None where all
        of the frame is scene."""
        full = self.read_left_out(frame)
        if full is None:
            return None
        size = width or self.intrinsics.width, height or self.intrinsics.height
        return np.asarray(cv2.resize(full.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0)


def resize_area(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """(H, W, ...) → (height, width, ...) by averaging."""
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def resample_linear(array: NDArray[np.float32], height: int, width: int) -> NDArray[np.float32]:
    """(H, W, C) → (height, width, C) by linear interpolation between the centres of the pixels."""
    out = cv2.resize(np.ascontiguousarray(array), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(out, np.float32).reshape(height, width, array.shape[-1])
