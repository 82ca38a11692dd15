"""Files of the proxy stage that hold one frame each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from msgs_slam.formats.tensors import save_arrays
from msgs_slam.pipelines.run import layouts
from msgs_slam.pipelines.run.layouts import load_layout
from msgs_slam.pipelines.types import ProxyMaps


def proxy_path(folder: Path, frame_id: int) -> Path:
    """Return the path of a frame's proxy maps."""
    return folder / proxy_name(frame_id)


def proxy_name(frame_id: int) -> str:
    """Return the path of a frame's proxy maps inside the stage's folder."""
    return f"maps/{frame_id:06d}.npz"


def save_proxy_maps(path: Path, maps: ProxyMaps) -> None:
    """Half-precision inverse depth and 8-bit confidences: about 0.3 MB at 640 x 480.

    Inverse depth in half precision keeps 11 significant bits (0.05 %) at any distance.
    """
    # 65504 is the largest half; unknown depth stays 0.
    inverse = np.divide(1.0, maps.depth, out=np.zeros_like(maps.depth), where=maps.depth > 0)
    save_arrays(
        path,
        {
            "inverse_depth": np.clip(inverse, 0, 65504).astype(np.float16),
            "confidence": np.round(maps.confidence * 255).astype(np.uint8),
            "labels": maps.labels,
            "label_confidence": np.round(maps.label_confidence * 255).astype(np.uint8),
        },
    )


def load_proxy_maps(path: Path) -> ProxyMaps:
    """Inverse of `save_proxy_maps`, up to its rounding."""
    arrays = load_layout(path, layouts.PROXY_MAPS)
    inverse = arrays["inverse_depth"].astype(np.float32)
    return ProxyMaps(
        depth=np.divide(1.0, inverse, out=np.zeros_like(inverse), where=inverse > 0),
        confidence=arrays["confidence"].astype(np.float32) / np.float32(255),
        labels=arrays["labels"],
        label_confidence=arrays["label_confidence"].astype(np.float32) / np.float32(255),
    )
