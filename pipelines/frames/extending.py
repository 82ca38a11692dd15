"""The world of a run that was extended stays where it was."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.sparse_model import SparseModel
from ..run.before import Before
from ..sfm.given import agreement
from ..types import Frame


def in_world_of(before: Before, model: SparseModel, frames: Sequence[Frame]) -> SparseModel:
    """The model moved, turned and scaled to where its keyframes were before; as it is where none tells that."""
    poses = before.poses_of([frames[i] for i in model.frame_ids.tolist()])
    known = np.isfinite(poses).all(axis=(1, 2))
    agreed = agreement(model.cam_from_world[known], poses[known])
    return model if agreed is None else model.moved(agreed.move)
