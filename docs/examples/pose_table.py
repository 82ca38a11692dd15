"""Data set reader: pictures beside one CSV, `file,seconds,x,y,z,qw,qx,qy,qz`, with the camera in its head line."""

import csv
from pathlib import Path

import numpy as np

from msgs_slam.formats.datasets.sequence import Camera, Dataset
from msgs_slam.formats.reading import parsing, read_bytes
from msgs_slam.formats.trajectory import poses_from_quaternions

TABLE = "poses.csv"


def recognises(path: Path) -> bool:
    """Cheap, and sure: other readers are asked too."""
    return (path / TABLE).is_file()


def open_pose_table(path: Path) -> Dataset:
    """Raises InputError, by way of `parsing`, for a table that is not as described."""
    table = path / TABLE
    text = read_bytes(table, 50_000_000).decode("utf-8")
    with parsing(table, "pose table"):
        head, *lines = text.splitlines()
        width, height, fx, fy, cx, cy = (float(v) for v in head.removeprefix("# camera ").split())
        rows = list(csv.DictReader(lines))
        names = tuple(row["file"] for row in rows)
        times = np.array([float(row["seconds"]) for row in rows])
        centers = np.array([[float(row[k]) for k in ("x", "y", "z")] for row in rows])
        quat_xyzw = np.array([[float(row[k]) for k in ("qx", "qy", "qz", "qw")] for row in rows])
        camera = Camera(int(width), int(height), fx, fy, cx, cy)
    return Dataset(
        format="pose-table",
        root=path,
        names=names,
        timestamps=times,
        image_paths=tuple(path / name for name in names),
        camera=camera,
        world_from_cam=poses_from_quaternions(quat_xyzw, centers, str(table)),
    )
