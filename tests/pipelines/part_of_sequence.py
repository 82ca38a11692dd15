"""Some frames of a data set."""

from collections.abc import Iterable
from dataclasses import replace

from msgs_slam.formats.datasets import Dataset


def part_of(sequence: Dataset, indices: Iterable[int]) -> Dataset:
    """The sequence of these frames only; one whose pictures, depths and labels are files."""
    keep = list(indices)
    paths = {n: tuple(getattr(sequence, n)[i] for i in keep) for n in ("image_paths", "depth_paths", "label_paths")}
    poses = None if sequence.world_from_cam is None else sequence.world_from_cam[keep]
    names = tuple(sequence.names[i] for i in keep)
    times = None if sequence.timestamps is None else sequence.timestamps[keep]
    return replace(sequence, names=names, timestamps=times, world_from_cam=poses, **paths)
