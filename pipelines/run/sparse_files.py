"""Keyframe poses and points with their observations, as one file."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from msgs_slam.formats.tensors import save_arrays
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.run import layouts
from msgs_slam.pipelines.run.layouts import load_layout, reading


def save_sparse_model(path: Path, model: SparseModel) -> None:
    """Write a sparse model as one npz."""
    save_arrays(path, {field.name: getattr(model, field.name) for field in fields(model)})


def load_sparse_model(path: Path) -> SparseModel:
    """Load what `save_sparse_model` wrote. Raises InputError for a damaged file."""
    arrays = load_layout(path, layouts.SPARSE_MODEL)
    with reading(path, "sparse model"):
        layouts.require_increasing("frame_ids", arrays["frame_ids"])
        layouts.require_rigid("the poses", arrays["cam_from_world"])
        layouts.require_indices("obs_frame", arrays["obs_frame"], len(arrays["frame_ids"]))
        layouts.require_indices("obs_point", arrays["obs_point"], len(arrays["points_in_world"]))
        return SparseModel(**arrays)
