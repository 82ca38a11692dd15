"""Trajectories as text: TUM lines and 4x4 matrices."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .atomic import write_text
from .errors import InputError
from .textfile import read_rows, read_table

_ROTATION_TOLERANCE = 0.05
"""Largest departure of R^T R from the identity that is taken for rounding or drift rather than for another format."""

_LARGEST_ENTRY = 2.0

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes x right, y down, z forward from those of graphics (y up, z backward); its own inverse."""

FARTHEST = 1e9
"""No camera is farther from the origin, whatever the unit: beyond, float32 and the squares of lengths break."""


def nearest_rotation(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find the rotations (..., 3, 3) closest to the given matrices in the Frobenius norm (orthogonal Procrustes).

    Raises ValueError where a matrix is singular or not finite.
    """
    if not np.isfinite(matrices).all():
        raise ValueError("nearest_rotation: got a matrix with a value that is not finite")
    u, s, vt = np.linalg.svd(matrices)
    if matrices.size and (s[..., -1] < 1e-9).any():
        raise ValueError("nearest_rotation: got a singular matrix")
    # The sign goes to the direction of least stretch, so that the result turns and does not mirror.
    sign = np.sign(np.linalg.det(u @ vt))
    u = u.copy()
    u[..., -1] *= sign[..., None]
    return u @ vt


def write_tum(path: Path, timestamps: NDArray[np.float64], world_from_cam: NDArray[np.float64], note: str = "") -> None:
    """Write `timestamp tx ty tz qx qy qz qw` lines: camera centres and orientations in the world; `note` as comments.

    timestamps (N,) seconds, world_from_cam (N, 4, 4). Raises ValueError for other shapes, InputError when the disk
    refuses. The sign of a quaternion is chosen so that qw >= 0.
    """
    n = len(timestamps)
    if world_from_cam.shape != (n, 4, 4):
        raise ValueError(f"write_tum: got {n} timestamps and poses of shape {world_from_cam.shape}")
    lines = [f"# {line}" for line in (*note.splitlines(), "timestamp tx ty tz qx qy qz qw")]
    if n:
        from scipy.spatial.transform import Rotation  # slow to import, and few files need it

        quat_xyzw = Rotation.from_matrix(world_from_cam[:, :3, :3]).as_quat(canonical=True)
        for time, t, q in zip(timestamps, world_from_cam[:, :3, 3], quat_xyzw, strict=True):
            lines.append(f"{time:.9f} " + " ".join(f"{value:.9f}" for value in (*t, *q)))
    write_text(path, "\n".join(lines) + "\n")


def poses_from_quaternions(
    quat_xyzw: NDArray[np.float64], translations: NDArray[np.float64], name: str
) -> NDArray[np.float64]:
    """Return (N, 4, 4) rigid transforms of quaternions (N, 4) and translations (N, 3) as the file `name` has them.

    A pose that is not finite, or whose quaternion is all zeros, as lost tracking is written, becomes all NaN. Raises
    InputError where a quaternion is so far from length 1 that it is none.
    """
    known = np.isfinite(quat_xyzw).all(axis=1) & np.isfinite(translations).all(axis=1) & quat_xyzw.any(axis=1)
    length = np.linalg.norm(quat_xyzw, axis=1)
    bad = known & ~((np.abs(length - 1) <= _ROTATION_TOLERANCE) & _is_within_reach(translations))
    if bad.any():
        raise _no_pose(quat_xyzw, translations, int(np.argmax(bad)), name)
    poses = np.full((len(quat_xyzw), 4, 4), np.nan)
    if known.any():
        from scipy.spatial.transform import Rotation

        poses[known] = np.eye(4)
        poses[known, :3, :3] = Rotation.from_quat(quat_xyzw[known]).as_matrix()
        poses[known, :3, 3] = translations[known]
    return poses


def _no_pose(quat_xyzw: NDArray[np.float64], translations: NDArray[np.float64], row: int, name: str) -> InputError:
    return InputError(
        f"{name}: pose {row + 1} is no rigid transform (quaternion of length {np.linalg.norm(quat_xyzw[row]):.3g}, "
        f"position {np.array2string(translations[row], precision=3)}): remove it, or correct the order of the columns"
    )


def _is_within_reach(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether each of (N, 3) is finite and within `FARTHEST`."""
    return np.asarray((np.abs(positions) <= FARTHEST).all(axis=1))


def read_tum(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read (N,) timestamps in file order and (N, 4, 4) world_from_cam of a TUM file, without rows that are not finite.

    Raises InputError for a row of other than 8 numbers, a pose that is none, or where most rows are not finite.
    """
    rows = read_rows(path)
    for i, row in enumerate(rows):
        if len(row) != 8:
            raise InputError(f"{path}: row {i + 1} has {len(row)} numbers, a TUM trajectory has 8 (t, xyz, quat xyzw)")
    table = read_table(path, 8)
    poses = poses_from_quaternions(table[:, 4:], table[:, 1:4], str(path))
    known = np.isfinite(table[:, 0]) & np.isfinite(poses).all(axis=(1, 2))
    if 2 * known.sum() < len(known):
        raise _no_pose(table[:, 4:], table[:, 1:4], int(np.argmin(known)), str(path))
    return table[known, 0], poses[known]


def read_matrices(path: Path) -> NDArray[np.float64]:
    """Read (N, 4, 4) world_from_cam of a file of row-major matrices: 16 or 12 numbers a line, or 4 lines for each
    matrix.

    Rotations are projected to the nearest true ones. A matrix that is not finite (a frame without a pose, as ScanNet
    writes it) comes back all NaN. Raises InputError for anything else that is no rigid transform.
    """
    rows = read_rows(path)
    width = len(rows[0]) if rows else 0
    if width == 4 and len(rows) % 4 == 0:
        stacked = read_table(path, 4).reshape(-1, 4, 4)
    elif width == 16:
        stacked = read_table(path, 16).reshape(-1, 4, 4)
    elif width == 12:
        top = read_table(path, 12).reshape(-1, 3, 4)
        stacked = np.concatenate([top, np.tile([[[0.0, 0, 0, 1]]], (len(top), 1, 1))], axis=1)
    else:
        raise InputError(f"{path}: {len(rows)} rows of {width} numbers are no 4x4 matrices: expected 16, 12 or 4 x 4")
    return clean_poses(stacked, str(path))


def clean_poses(matrices: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """Return the rigid transforms (N, 4, 4) with exact rotations; matrices that are not finite become all NaN.

    Raises InputError, with `name` for the file, where the rotation part is no rotation within a few percent, so that
    a scaled, mirrored or transposed-with-translation matrix is not taken for a pose.
    """
    result = np.full_like(matrices, np.nan)
    known = np.isfinite(matrices).all(axis=(1, 2))
    rotations = matrices[known, :3, :3].clip(-_LARGEST_ENTRY, _LARGEST_ENTRY)
    off = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max(axis=(1, 2), initial=0)
    # Told by what is good, for NaN is neither: products of huge numbers overflow.
    good = (off <= _ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0) & _is_within_reach(matrices[known, :3, 3])
    bad = ~(good & (np.abs(matrices[known, 3] - [0, 0, 0, 1]).max(axis=1, initial=0) <= 1e-4))
    if bad.any():
        index = int(np.flatnonzero(known)[np.argmax(bad)])
        raise InputError(
            f"{name}: matrix {index + 1} is no rigid transform (rotation part off by {off[np.argmax(bad)]:.2g}): "
            "expected camera-to-world, row by row, with a last row of 0 0 0 1"
        )
    result[known] = matrices[known]
    result[known, :3, :3] = nearest_rotation(rotations)
    result[known, 3] = [0, 0, 0, 1]
    return result
