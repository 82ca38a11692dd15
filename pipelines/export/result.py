"""What the run has to export: the newest map, trajectory and points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from formats.errors import InputError
from pipelines.gaussians.map import GaussianMap
from pipelines.mapping.load import load_class_ids
from pipelines.run_folder import RunFolder
from pipelines.types import Calibration, ClassTable, Frame, SparseModel, Trajectory


@dataclass(frozen=True)
class Result:
    """`class_ids`: the label, an index into `classes`, of each class channel of the map."""

    frames: dict[int, Frame]
    calibration: Calibration
    trajectory: Trajectory
    sparse: SparseModel
    gaussian_map: GaussianMap
    class_ids: tuple[int, ...]
    classes: ClassTable

    @staticmethod
    def load(run: RunFolder) -> Result:
        """The result of the global adjustment, or of mapping where that is the last stage done."""
        stage = newest_stage(run)
        with_points = stage if (run.stage(stage) / "sparse.npz").exists() else "tracking"
        return Result(
            {f.id: f for f in run.load_frames()},
            run.load_calibration(),
            run.load_trajectory(stage),
            run.load_sparse(with_points),
            run.load_map(stage),
            load_class_ids(run),
            run.load_classes(),
        )

    @property
    def keyframe_poses(self) -> dict[int, NDArray[np.float64]]:
        """cam_from_world (4, 4) of every keyframe, by frame id."""
        rows = np.flatnonzero(self.trajectory.is_keyframe)
        return {int(self.trajectory.frame_ids[r]): self.trajectory.cam_from_world[r] for r in rows}

    @property
    def class_probabilities(self) -> NDArray[np.float32]:
        """(M, number of classes) of every Gaussian; classes without a channel are 0."""
        out = np.zeros((len(self.gaussian_map), len(self.classes)), np.float32)
        if self.class_ids:
            out[:, list(self.class_ids)] = torch.softmax(self.gaussian_map.class_logits, dim=1).numpy()
        return out


def newest_stage(run: RunFolder) -> str:
    """The last stage that left a map. Raises InputError where there is none yet."""
    for stage in ("global_ba", "mapping"):
        folder = run.stage(stage)
        if (folder / "map.safetensors").exists() and (folder / "trajectory.npz").exists():
            return stage
    raise InputError(f"{run.root} has no map to export yet. Finish it first: msgs-slam resume {run.root}")
