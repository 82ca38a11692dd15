"""Pixels of a view that show the two halves of something mirror-symmetric (MSGS-SLAM 3.1), and the pull between them.

Off: the planes found in replica pull at pairs that are not exact. 7 keyframes with true depth: 39.52 dB without, 39.42
with weight 0.05, 38.83 with 0.5; depth L1 0.761, 0.763, 0.819 cm. With noisy depth it is not measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from msgs_slam.pipelines.types import Intrinsics, MirrorPairs


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


def symmetry_loss(depth: Tensor, mirrors: Mirrors, unit: float) -> Tensor:
    """Mean over the pairs, weighed by their confidence: how far the second depth is from what the first one says."""
    expected = mirrors.gain * at(depth, mirrors.first) + mirrors.offset
    return (mirrors.confidence * (at(depth, mirrors.second) - expected).abs()).mean() / unit


def label_symmetry_loss(logits: Tensor, mirrors: Mirrors) -> Tensor:
    """Mean over the pairs, weighed by their confidence: the total variation between the two pixels' classes."""
    first, second = at(logits, mirrors.first).softmax(-1), at(logits, mirrors.second).softmax(-1)
    return (mirrors.confidence * (first - second).abs().sum(-1)).mean() / 2
