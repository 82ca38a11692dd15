"""The Gaussians of a splat file as plain arrays, whoever wrote it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .trajectory import FARTHEST

_LARGEST_LOG = 20.0
"""exp of it is half a `FARTHEST`: the squares that make a covariance still fit into float32."""


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """M Gaussians with the raw parameters of the original 3D Gaussian splatting.

    means (M, 3); log_scales (M, 3) logarithms of the standard deviations along the own axes; quat_wxyz (M, 4) turning
    own axes into the world; opacity_logits (M,); colors (M, 3) RGB seen from everywhere, 0..1 for what a screen can
    show; all float32. class_ids (M,) uint8 and class_probs (M, C) float32, None where the file has none. View-dependent
    colour is not kept.
    """

    means: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    quat_wxyz: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    colors: NDArray[np.float32]
    class_ids: NDArray[np.uint8] | None = None
    class_probs: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        m = len(self.means)
        expected: dict[str, tuple[int, ...]] = {
            "means": (m, 3),
            "log_scales": (m, 3),
            "quat_wxyz": (m, 4),
            "opacity_logits": (m,),
            "colors": (m, 3),
        }
        if self.class_ids is not None:
            expected["class_ids"] = (m,)
        if self.class_probs is not None:
            expected["class_probs"] = (m, self.class_probs.shape[-1])
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"GaussianCloud: {name}: got shape {getattr(self, name).shape}, expected {shape}")
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"GaussianCloud: {name} holds a value that is not finite")
        if m and not (self.log_scales.max() < _LARGEST_LOG and np.abs(self.means).max() < FARTHEST):
            raise ValueError("GaussianCloud: a Gaussian is too large or too far away to be drawn")

    def __len__(self) -> int:
        return len(self.means)

    def only(self, rows: NDArray) -> GaussianCloud:
        """Select Gaussians by a mask (M,) or by indices."""
        chosen: dict[str, Any] = {name: None if a is None else a[rows] for name, a in vars(self).items()}
        return GaussianCloud(**chosen)


def isotropic_cloud(
    means: NDArray[np.float32],
    log_radii: NDArray[np.float32],
    opacity_logits: NDArray[np.float32],
    colors: NDArray[np.float32],
    class_probs: NDArray[np.float32] | None = None,
) -> GaussianCloud:
    """Return a cloud of balls: log_radii (M,) on all three axes, no rotation, class ids from the largest
    probability."""
    m = len(means)
    quat_wxyz = np.zeros((m, 4), dtype=np.float32)
    quat_wxyz[:, 0] = 1
    ids = None
    if class_probs is not None:
        if not 0 < class_probs.shape[1] <= 255:
            raise ValueError(f"isotropic_cloud: got {class_probs.shape[1]} classes, expected 1 to 255")
        ids = class_probs.argmax(axis=1).astype(np.uint8)
        class_probs = class_probs.astype(np.float32, copy=False)
    return GaussianCloud(
        means=means.astype(np.float32, copy=False),
        log_scales=np.repeat(log_radii.astype(np.float32, copy=False)[:, None], 3, axis=1),
        quat_wxyz=quat_wxyz,
        opacity_logits=opacity_logits.astype(np.float32, copy=False),
        colors=colors.astype(np.float32, copy=False),
        class_ids=ids,
        class_probs=class_probs,
    )
