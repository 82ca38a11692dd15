"""Depth at the sweep's size brought to the size of the proxy maps, with its edges put where the image has them."""

import numpy as np
from numpy.typing import NDArray

from ...providers import DepthEstimate
from ...system.jit import kernel

_COLOR_SD = 10.0
_SURFACE = 0.05


def upsample_depth(
    depth: NDArray[np.float32], confidence: NDArray[np.float32], image: NDArray[np.uint8]
) -> DepthEstimate:
    """(h, w) depth and confidence to the size of the image (H, W, 3).

    Each pixel joins the coarse neighbour whose colour is most like its own (a selection: depth is never averaged
    across an edge), then interpolates among the neighbours on that one's surface.
    """
    height, width = image.shape[:2]
    if depth.shape == (height, width):
        return DepthEstimate(depth, confidence)
    coarse = _coarse_colors(image, depth.shape[0], depth.shape[1])
    out_depth = np.empty((height, width), np.float32)
    out_confidence = np.empty((height, width), np.float32)
    _upsample(depth, confidence, image, coarse, out_depth, out_confidence)
    return DepthEstimate(out_depth, out_confidence)


def _coarse_colors(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.float32]:
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)


@kernel
def _upsample(
    depth: NDArray[np.float32],
    confidence: NDArray[np.float32],
    image: NDArray[np.uint8],
    coarse: NDArray[np.float32],
    out_depth: NDArray[np.float32],
    out_confidence: NDArray[np.float32],
) -> None:
    rows, columns = depth.shape
    height, width = out_depth.shape
    for y in range(height):
        py = (y + 0.5) * rows / height - 0.5
        iy = int(np.floor(py))
        for x in range(width):
            px = (x + 0.5) * columns / width - 0.5
            ix = int(np.floor(px))
            best, at_y, at_x = -1.0, 0, 0
            for j in range(iy - 0, iy + 2):
                for i in range(ix - 0, ix + 2):
                    cy, cx = min(max(j, 0), rows - 1), min(max(i, 0), columns - 1)
                    if depth[cy, cx] <= 0:
                        continue
                    difference = 0.0
                    for c in range(3):
                        difference += (np.float64(image[y, x, c]) - coarse[cy, cx, c]) ** 2
                    near = (1 - min(abs(py - j), 1.0)) * (1 - min(abs(px - i), 1.0))
                    weight = np.exp(-difference / (2 * _COLOR_SD * _COLOR_SD)) * (near + 0.05)
                    if weight > best:
                        best, at_y, at_x = weight, cy, cx
            if best < 0:
                out_depth[y, x] = 0
                out_confidence[y, x] = 0
                continue
            reference = depth[at_y, at_x]
            total, inverse, sure = 0.0, 0.0, 0.0
            for j in range(iy, iy + 2):
                for i in range(ix, ix + 2):
                    cy, cx = min(max(j, 0), rows - 1), min(max(i, 0), columns - 1)
                    d = depth[cy, cx]
                    if d <= 0 or abs(d - reference) > _SURFACE * reference:
                        continue
                    weight = (1 - min(abs(py - j), 1.0)) * (1 - min(abs(px - i), 1.0)) + 1e-3
                    total += weight
                    inverse += weight / d
                    sure += weight * confidence[cy, cx]
            out_depth[y, x] = total / inverse
            out_confidence[y, x] = sure / total
