"""Pixels of a view that show the two halves of something mirror-symmetric (MSGS-SLAM 3.1), ready for the loss."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pipelines.types import Intrinsics, MirrorPairs


@dataclass(frozen=True)
class Mirrors:
    """K pairs of pixels: first and second (K, 2) int64 row and column; confidence (K,) 0..1.

    Depth at the second = gain * depth at the first + offset, (K,) each, in the unit of the view's depth.
    """

    first: Tensor
    second: Tensor
    confidence: Tensor
    gain: Tensor
    offset: Tensor

    @staticmethod
    def of(pairs: MirrorPairs, full: Intrinsics, intrinsics: Intrinsics, device: torch.device | str) -> Mirrors:
        """The pairs, found in frames of the size of `full`, in those of `intrinsics`."""
        scale = np.array([intrinsics.width / full.width, intrinsics.height / full.height])
        size = np.array([intrinsics.width, intrinsics.height])
        xy = np.floor(pairs.pairs.reshape(-1, 2, 2) * scale).astype(np.int64).clip(0, size - 1)
        tensors = (xy[:, 0, ::-1], xy[:, 1, ::-1], pairs.confidence, pairs.gain, pairs.offset)
        return Mirrors(*(torch.from_numpy(np.ascontiguousarray(t)).to(device) for t in tensors))

    def scaled(self, scale: Tensor) -> Mirrors:
        """The same pairs after the view's depth is multiplied by an (H, W) field."""
        first, second = at(scale, self.first), at(scale, self.second)
        return replace(self, gain=self.gain * second / first, offset=self.offset * second)

    def halved(self, height: int, width: int) -> Mirrors:
        """The same pairs in a picture of half the size, (height, width) pixels."""
        last = torch.tensor([height - 1, width - 1], device=self.first.device)
        return replace(self, first=torch.minimum(self.first // 2, last), second=torch.minimum(self.second // 2, last))


def at(image: Tensor, place: Tensor) -> Tensor:
    """(K, ...) the pixels of an (H, W, ...) image at (K, 2) rows and columns."""
    return image[place[:, 0], place[:, 1]]
