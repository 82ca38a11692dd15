"""A linear segmentation head that is kept apart from the network which makes the features."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.reading import parsing, require_file

_BATCH_NORM_EPSILON = 1e-5
_MAX_BYTES = 1 << 28


@dataclass(frozen=True)
class LinearHead:
    """scores = features @ weight.T + bias; weight (C, F), bias (C,)."""

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]

    def scores(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., F) → (..., C)."""
        return (features @ self.weight.T + self.bias).astype(np.float32)


def load_linear_head(path: Path, classes: int) -> LinearHead:
    """The head of DINOv2's linear segmenters: batch norm, then a 1 x 1 convolution, folded into one matrix.

    Only tensors are read from the file, never code. Raises InputError for anything else than such a head.
    """
    size = require_file(path, _MAX_BYTES)
    with parsing(path, "linear segmentation head", "pull it again"):
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
        if size > _MAX_BYTES:
            raise ValueError(f"it unpacks to {size} bytes")
        stored = torch.load(path, map_location="cpu", weights_only=True)
        state = stored.get("state_dict", stored)
        parts = {k: state[f"decode_head.{k}"].double().numpy() for k in _KEYS}
        if not all(np.isfinite(part).all() for part in parts.values()) or not (parts["bn.running_var"] >= 0).all():
            raise ValueError("a weight is not finite")
    weight = parts["conv_seg.weight"].reshape(len(parts["conv_seg.weight"]), -1)
    features = weight.shape[1]
    if weight.shape[0] != classes or any(parts[k].shape != (features,) for k in _KEYS[:4]):
        raise InputError(f"{path}: a head for {weight.shape[0]} classes; the card names {classes}")
    gain = parts["bn.weight"] / np.sqrt(parts["bn.running_var"] + _BATCH_NORM_EPSILON)
    bias = parts["conv_seg.bias"] + weight @ (parts["bn.bias"] - gain * parts["bn.running_mean"])
    return LinearHead((weight * gain).astype(np.float32), bias.astype(np.float32))


_KEYS = ("bn.weight", "bn.bias", "bn.running_mean", "bn.running_var", "conv_seg.weight", "conv_seg.bias")
