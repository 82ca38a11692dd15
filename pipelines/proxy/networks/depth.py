"""Depth by a network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError
from pipelines.proxy.networks.session import Network
from pipelines.types import Intrinsics


def network_depth(
    network: Network, image: NDArray[np.uint8], intrinsics: Intrinsics
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None, int]:
    """(depth (h, w), confidence (h, w) or None, number of invalid values) of an RGB image with these intrinsics.

    A canonical depth becomes metres by the focal length of the picture as the network saw it: `z = d · f / f_canonical`
    (Metric3D, Yin et al., ICCV 2023). Values at the network's stops, NaN and negative ones are unknown.
    Raises InputError when the output is no image of depth.
    """
    card = network.card
    box = network.box(intrinsics.width, intrinsics.height)
    outputs = network.run(image, box)
    raw = _plane(network, outputs[0])
    broken = ~np.isfinite(raw) | (raw < 0)
    bad = broken | (raw <= card.valid[0]) | (raw >= card.valid[1])
    # Bilinear reading must not mix invalid values in: a pixel is known when all that it is made of is.
    depth = box.take(np.where(bad, 0, raw).astype(np.float32), card.align_corners)
    if bad.any():
        depth[box.take(bad.astype(np.float32), card.align_corners) > 1e-3] = 0
    if card.canonical_focal:
        scale_x, scale_y = box.scale
        depth *= np.float32((intrinsics.fx * scale_x + intrinsics.fy * scale_y) / 2 / card.canonical_focal)
    confidence = None
    if card.confidence:
        given = np.nan_to_num(_plane(network, outputs[1]), nan=0.0)
        confidence = box.take(np.clip(given, 0, 1), card.align_corners) * (depth > 0)
    return depth, confidence, int(broken.sum())


def _plane(network: Network, output: NDArray) -> NDArray[np.float32]:
    """(h', w') of an output that may carry a channel axis of length 1."""
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2 or min(plane.shape) < 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where an image of depth is expected")
    return plane.astype(np.float32)
