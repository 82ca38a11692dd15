"""A splat file by any program, drawn on the CPU: Gaussians of any shape, as their trainers draw them.

The run's own renderer knows balls only, and learns; this one draws ellipsoids and nothing else. Each is projected to an
ellipse by the linearised perspective of the original (EWA splatting), and blended from near to far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...formats.gaussians import GaussianCloud
from ..render.reference import ALPHA_MAX, ALPHA_MIN, CUT_SIGMAS, TRANSMITTANCE_MIN
from ..system.jit import kernel
from ..types import Intrinsics

_NEAR_SHARE = 0.01
"""Of the scene's size: what is nearer to the eye is not drawn."""
_LOW_PASS = 0.3
"""Pixels squared that the original adds to an ellipse. Balls are trained here without that, and drawn without."""
_WIDEST = 1.3
"""Times the half field of view: beyond it the linearised perspective is taken at its edge, as the original does."""


@dataclass(frozen=True)
class SplatScene:
    """The view-independent part of a cloud: covariances (M, 3, 3), opacities (M,), and the middle (3,) and largest side
    of the box around most of it."""

    cloud: GaussianCloud
    covariances: NDArray[np.float64]
    opacities: NDArray[np.float64]
    middle: NDArray[np.float64]
    size: float

    @staticmethod
    def of(cloud: GaussianCloud) -> SplatScene:
        """Prepare a cloud of at least one Gaussian."""
        turn = Rotation.from_quat(cloud.quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()
        axes = turn * np.exp(cloud.log_scales.astype(np.float64))[:, None, :]
        low, high = np.quantile(cloud.means, (0.05, 0.95), axis=0)
        opacities = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
        return SplatScene(
            cloud, axes @ axes.transpose(0, 2, 1), opacities, (low + high) / 2, max(float((high - low).max()), 1e-6)
        )

    @property
    def low_pass(self) -> float:
        """Variance that is added on the image, in square pixels; 0 for isotropic Gaussians."""
        return _LOW_PASS if np.ptp(self.cloud.log_scales, axis=1).max() > 1e-4 else 0.0


def draw_splats(scene: SplatScene, camera: Intrinsics, cam_from_world: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(H, W, 3) colours over black, seen from `cam_from_world` (4, 4)."""
    rotation = cam_from_world[:3, :3]
    x, y, z = (scene.cloud.means.astype(np.float64) @ rotation.T + cam_from_world[:3, 3]).T
    seen = np.flatnonzero(z > _NEAR_SHARE * scene.size)
    seen = seen[np.argsort(z[seen], kind="stable")]
    x, y, z = x[seen], y[seen], z[seen]
    limits = _WIDEST * camera.width / 2 / camera.fx, _WIDEST * camera.height / 2 / camera.fy
    slopes = [np.clip(v / z, -limit, limit) for v, limit in zip((x, y), limits, strict=True)]
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = camera.fx / z, camera.fy / z
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -camera.fx * slopes[0] / z, -camera.fy * slopes[1] / z
    way = jacobian @ rotation
    ellipse = way @ scene.covariances[seen] @ way.transpose(0, 2, 1)
    a, b, c = ellipse[:, 0, 0] + scene.low_pass, ellipse[:, 0, 1], ellipse[:, 1, 1] + scene.low_pass
    determinant = np.maximum(a * c - b * b, 1e-12)
    opacity = scene.opacities[seen]
    reach = np.minimum(np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_MIN, 1))), CUT_SIGMAS)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inverse = np.column_stack([c, -b, a]) / determinant[:, None]
    table = np.column_stack([u, v, inverse, reach * np.sqrt(a), reach * np.sqrt(c), reach**2, opacity])
    image = np.zeros((camera.height, camera.width, 3))
    _blend(table, scene.cloud.colors[seen].astype(np.float64), image, np.ones(image.shape[:2]))
    return np.round(255 * image.clip(0, 1)).astype(np.uint8)


@kernel
def _blend(table, colors, image, left):  # type: ignore[no-untyped-def]
    """Adds every ellipse (u, v, inverse covariance, half sides, reach squared, opacity) to the pixels that it covers;
    left: the light that reaches each pixel still."""
    height, width = left.shape
    for g in range(len(table)):
        u, v, xx, xy, yy, half_x, half_y, most, opacity = table[g]
        first_row, last_row = max(int(np.ceil(v - half_y - 0.5)), 0), min(int(np.floor(v + half_y - 0.5)), height - 1)
        first, last = max(int(np.ceil(u - half_x - 0.5)), 0), min(int(np.floor(u + half_x - 0.5)), width - 1)
        for row in range(first_row, last_row + 1):
            dy = row + 0.5 - v
            for column in range(first, last + 1):
                dx = column + 0.5 - u
                distance = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
                before = left[row, column]
                if distance > most or before < TRANSMITTANCE_MIN:
                    continue
                alpha = min(opacity * np.exp(-0.5 * distance), ALPHA_MAX)
                for k in range(3):
                    image[row, column, k] += before * alpha * colors[g, k]
                left[row, column] = before * (1 - alpha)
