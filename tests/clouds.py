"""Gaussians of all shapes and colours, for round trips through files."""

import numpy as np
from scipy.spatial.transform import Rotation

from msgs_slam.formats.splats import GaussianCloud


def random_cloud(count: int = 300, extent: float = 5.0, seed: int = 0) -> GaussianCloud:
    """Ellipsoids of four classes, in a cube of half this extent; their probabilities are not known."""
    rng = np.random.default_rng(seed)
    quat_xyzw = Rotation.random(count, rng=rng).as_quat() if count else np.zeros((0, 4))
    return GaussianCloud(
        means=rng.uniform(-extent, extent, (count, 3)).astype(np.float32),
        log_scales=rng.uniform(-8, 1, (count, 3)).astype(np.float32),
        quat_wxyz=quat_xyzw[:, [3, 0, 1, 2]].astype(np.float32),
        opacity_logits=rng.uniform(-4, 4, count).astype(np.float32),
        colors=rng.uniform(-0.1, 1.1, (count, 3)).astype(np.float32),
        class_ids=rng.integers(0, 4, count).astype(np.uint8),
    )
