"""Trajectories as text: TUM lines and 4x4 matrices."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .atomic import write_text
from .errors import InputError
from .textfile import Fields, numbers_in, read_fields, read_rows

_ROTATION_TOLERANCE = 0.05
"""Largest departure of R^T R from the identity that is taken for rounding or drift rather than for another format."""

_LARGEST_ENTRY = 2.0
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_BEFORE_AXIS = ("", "t", "p", "pos", "position", "poseposition", "translation", "prsr")
_BEFORE_TURN = ("q", "rot", "quat", "orientation", "poseorientation", "rotation", "qrs")
_TIME, _NAME = ("timestamp", "time", "t", "seconds"), ("name", "filename", "image", "imagename", "file", "label")
_COUNT = ("frame", "frameid", "framenumber")
_LARGEST_COUNT = 1e12

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
        row = int(np.argmax(bad))
        raise InputError(
            f"{name}: pose {row + 1} is no rigid transform (quaternion of length {length[row]:.3g}, position "
            f"{np.array2string(translations[row], precision=3)}): remove it, or correct the order of the columns"
        )
    poses = np.full((len(quat_xyzw), 4, 4), np.nan)
    if known.any():
        from scipy.spatial.transform import Rotation

        poses[known] = np.eye(4)
        poses[known, :3, :3] = Rotation.from_quat(quat_xyzw[known]).as_matrix()
        poses[known, :3, 3] = translations[known]
    return poses


def _is_within_reach(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether each of (N, 3) is finite and within `FARTHEST`."""
    return np.asarray((np.abs(positions) <= FARTHEST).all(axis=1))


@dataclass(frozen=True)
class PoseFile:
    """N poses: world_from_cam (N, 4, 4), camera axes x right, y down, z forward; names (N) of their images, as
    the file has them, () where it has none; times (N,) in seconds, None where it has none; `is_metric`: whether
    files of its kind always are in metres; `lost`: how many poses of the file are not finite, and here NaN."""

    kind: str
    world_from_cam: NDArray[np.float64]
    names: tuple[str, ...] = ()
    times: NDArray[np.float64] | None = None
    is_metric: bool = False
    lost: int = 0

    def __len__(self) -> int:
        return len(self.world_from_cam)


def read_trajectory(path: Path) -> PoseFile:
    """Read the poses of a text table: by its headings where they name position and quaternion, else TUM lines (with
    RTAB-Map's ninth column, the node's id, or without), or matrices as `read_matrices` does.

    Raises InputError for anything else, a pose that is no rigid transform, and angles in place of a rotation.
    """
    table = read_fields(path)
    if not table.rows:
        raise InputError(f"{path} holds no numbers: check that it was written completely")
    width, chosen = len(table.rows[0]), _chosen_columns(table, path)
    if chosen is None and width not in (8, 9):
        return PoseFile("a file of matrices", read_matrices(path))
    columns = chosen or list(range(1, 8))
    for i, row in enumerate(table.rows if chosen is None else ()):
        if len(row) not in (8, 9) or (len(row) == 9 and not row[8].isdecimal()):
            raise InputError(f"{path}: row {i + 1} has {len(row)} numbers, a TUM trajectory has 8 (t, xyz, quat xyzw)")
    values = numbers_in(table.rows, columns, path)
    poses = poses_from_quaternions(values[:, 3:], values[:, :3], str(path))
    if (named := table.column(*_NAME)) is not None:
        return PoseFile("a table of poses", poses, tuple(row[named] for row in table.rows))
    if (counted := table.column(*_COUNT)) is not None:
        numbers = numbers_in(table.rows, [counted], path)[:, 0]
        poses[~(np.abs(numbers) < _LARGEST_COUNT)] = np.nan
        names = tuple(f"{int(n):06d}" if abs(n) < _LARGEST_COUNT else f"row {k + 1}" for k, n in enumerate(numbers))
        return PoseFile("Stray Scanner's poses", poses, names, is_metric=True)
    timed = table.column(*_TIME) if chosen else 0
    if timed is None:
        return PoseFile("a table of poses", poses)
    times = numbers_in(table.rows, [timed], path)[:, 0]
    largest = np.abs(times[np.isfinite(times)]).max(initial=0)  # tells milli-, micro- and nanoseconds since 1970
    times *= next((unit for unit, least in ((1e-9, 1e17), (1e-6, 1e14), (1e-3, 1e11)) if largest > least), 1.0)
    poses[~np.isfinite(times)] = np.nan
    return PoseFile("a TUM trajectory", poses, times=times)


def _chosen_columns(table: Fields, path: Path) -> list[int] | None:
    """The columns of x, y, z, qx, qy, qz, qw by their headings; None where these name neither."""
    found = [table.column(*(f"{before}{axis}" for before in _BEFORE_AXIS)) for axis in "xyz"]
    found += [table.column(*(f"{before}{axis}" for before in _BEFORE_TURN)) for axis in "xyzw"]
    missing = [name for name, column in zip(_POSE, found, strict=True) if column is None]
    if missing and table.column("heading", "yaw", "omega") is not None and table.column("pitch", "phi") is not None:
        raise InputError(
            f"{path} states rotations as angles ({', '.join(table.headings[:8])}, ...), as RealityScan and Metashape "
            "write them, each in another order: export the cameras there in COLMAP's format and give its folder"
        )
    if len(missing) > 3 and len(table.rows[0]) in (4, 8, 9, 12, 16):
        return None
    if missing and table.headings:
        raise InputError(f"{path}: no column {missing[0]}: a table of poses has {', '.join(_POSE)}")
    return None if missing else [column for column in found if column is not None]


def read_tum(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read (N,) timestamps in file order and (N, 4, 4) world_from_cam of a TUM file, without rows that are not finite.

    Raises InputError for a row of other than 8 numbers, a pose that is none, or where most rows are not finite.
    """
    found = read_trajectory(path)
    if found.times is None:
        raise InputError(f"{path} is no TUM trajectory, which has 8 numbers a row (t, xyz, quat xyzw)")
    known = np.asarray(np.isfinite(found.world_from_cam).all(axis=(1, 2)))
    if 2 * known.sum() < len(known):
        raise InputError(
            f"{path}: pose {int(np.argmin(known)) + 1} is no rigid transform (not finite, or a quaternion of length "
            "0), and so are most: export it again"
        )
    return found.times[known], found.world_from_cam[known]


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


def read_matrices(path: Path) -> NDArray[np.float64]:
    """Read (N, 4, 4) world_from_cam of a file of row-major matrices: 16 or 12 numbers a line, or 4 lines for each
    matrix.

    Rotations are projected to the nearest true ones. A matrix that is not finite (a frame without a pose, as ScanNet
    writes it) comes back all NaN. Raises InputError for anything else that is no rigid transform.
    """
    rows = read_rows(path)
    width = len(rows[0]) if rows else 0
    if width not in (4, 12, 16) or (width == 4 and len(rows) % 4):
        raise InputError(f"{path}: {len(rows)} rows of {width} numbers are no 4x4 matrices: expected 16, 12 or 4 x 4")
    values = numbers_in(rows, range(width), path)
    if width == 12:
        values = np.hstack([values, np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))])
    return clean_poses(values.reshape(-1, 4, 4), str(path))


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
