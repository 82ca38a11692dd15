"""A flight through a map by keyframes: recorded in the viewer, kept as JSON, drawn by `render`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from ...formats.errors import InputError
from ...formats.textfile import number, read_json_object

Array = NDArray[np.float64]

FORMAT = "msgs-slam camera path 1"
EXPORTED, RUN, SPLATS = "exported", "run", "splats"
"""Worlds of a path: that of the exported files, that of a run without an export, and that of a splat file."""
_LIMITS = {"fps": (0.1, 240.0), "seconds_per_keyframe": (0.05, 600.0), "fov_degrees": (1.0, 170.0)}
_MAX_KEYFRAMES, _MAX_IMAGES = 1000, 100_000
_AGAIN = "correct it, or record the path again in `msgs-slam view`"


@dataclass(frozen=True)
class Keyframe:
    """world_from_cam (4, 4), x right, y down, z forward; fov: from top to bottom, in degrees."""

    world_from_cam: Array
    fov: float


@dataclass(frozen=True)
class CameraPath:
    """Keyframes in `world`, one of EXPORTED, RUN and SPLATS, the same time apart; fps: images per second."""

    keyframes: tuple[Keyframe, ...]
    fps: float = 30.0
    seconds_per_keyframe: float = 2.0
    world: str = EXPORTED

    def flight(self, fps: float | None = None) -> tuple[Array, Array]:
        """(N, 4, 4) world_from_cam and (N,) fields of view in degrees, at `fps` (None: the path's) images per second.

        Positions follow a Catmull-Rom spline, rotations the shortest arc. Needs at least two keyframes.
        """
        known = np.arange(len(self.keyframes))
        at = np.linspace(0, known[-1], self.image_count(fps))
        keys = np.stack([k.world_from_cam for k in self.keyframes])
        centers = keys[:, :3, 3]
        poses = np.tile(np.eye(4), (len(at), 1, 1))
        poses[:, :3, :3] = Slerp(known, Rotation.from_matrix(keys[:, :3, :3]))(at).as_matrix()
        # Central differences as tangents make a cubic Hermite spline a Catmull-Rom spline.
        poses[:, :3, 3] = CubicHermiteSpline(known, centers, np.gradient(centers, axis=0))(at)
        return poses, np.interp(at, known, [k.fov for k in self.keyframes])

    def image_count(self, fps: float | None = None) -> int:
        """The number of images of the flight, both ends included."""
        return max(2, round((len(self.keyframes) - 1) * self.seconds_per_keyframe * (fps or self.fps)) + 1)

    def to_json(self) -> str:
        """The text of its file; `read_camera_path` is the inverse."""
        rows = []
        for key in self.keyframes:
            wxyz = Rotation.from_matrix(key.world_from_cam[:3, :3]).as_quat()[[3, 0, 1, 2]]
            rows.append(
                {
                    "position": np.round(key.world_from_cam[:3, 3], 6).tolist(),
                    "rotation_wxyz": np.round(wxyz, 8).tolist(),
                    "fov_degrees": round(key.fov, 4),
                }
            )
        value = {"format": FORMAT, "world": self.world, "fps": self.fps}
        value |= {"seconds_per_keyframe": self.seconds_per_keyframe, "keyframes": rows}
        return json.dumps(value, indent=1, allow_nan=False) + "\n"


def read_camera_path(path: Path, fps: float | None = None) -> CameraPath:
    """Read what `CameraPath.to_json` wrote, or a person by hand; `fps` replaces the file's images per second.

    Raises InputError, with the entry that is wrong, for anything that cannot be flown along.
    """
    value = read_json_object(path)
    if value.get("format") != FORMAT:
        found = str(value.get("format"))[:40]
        raise InputError(f"{path} is no camera path: its format is {found!r}, expected {FORMAT!r}. {_capital(_AGAIN)}")
    if (world := value.get("world")) not in (worlds := (EXPORTED, RUN, SPLATS)):
        raise InputError(f"{path}: world is {str(world)[:40]!r}, expected {' or '.join(map(repr, worlds))}: {_AGAIN}")
    rows = value.get("keyframes")
    if not isinstance(rows, list) or not 2 <= len(rows) <= _MAX_KEYFRAMES:
        count = len(rows) if isinstance(rows, list) else "no list of"
        raise InputError(f"{path} has {count} keyframes, expected 2 to {_MAX_KEYFRAMES}: {_AGAIN}")
    keyframes = tuple(_keyframe(path, i, row) for i, row in enumerate(rows, 1))
    rate, seconds = fps or _limited(value, path, "fps"), _limited(value, path, "seconds_per_keyframe")
    found_path = CameraPath(keyframes, rate, seconds, str(world))
    if (count := found_path.image_count()) > _MAX_IMAGES:
        raise InputError(
            f"{path}: the flight has {count:,} images, at most {_MAX_IMAGES:,}: "
            "lower fps or seconds_per_keyframe, or split the path"
        )
    return found_path


def _keyframe(path: Path, index: int, row: Any) -> Keyframe:
    where = f"{path}: keyframe {index}"
    if not isinstance(row, dict):
        raise InputError(f"{where} is {str(row)[:40]!r}, expected an object in braces: {_AGAIN}")
    position, wxyz = (_vector(where, row, name, n) for name, n in (("position", 3), ("rotation_wxyz", 4)))
    if not 0.9 < np.linalg.norm(wxyz) < 1.1:
        raise InputError(f"{where}: rotation_wxyz is no unit quaternion (w, x, y, z): {_AGAIN}")
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = Rotation.from_quat(wxyz[[1, 2, 3, 0]]).as_matrix()
    world_from_cam[:3, 3] = position
    return Keyframe(world_from_cam, _limited(row, Path(where), "fov_degrees"))


def _vector(where: str, row: dict[str, Any], name: str, length: int) -> Array:
    value = row.get(name)
    if not isinstance(value, list) or len(value) != length or not all(type(v) in (int, float) for v in value):
        raise InputError(f"{where}: {name} is {str(value)[:60]!r}, expected {length} numbers: {_AGAIN}")
    return np.array(value, np.float64)


def _limited(table: dict[str, Any], path: Path, name: str) -> float:
    value, (low, high) = number(table, path, name), _LIMITS[name]
    if not low <= value <= high:
        raise InputError(f"{path}: {name} is {value:g}, expected {low:g} to {high:g}: {_AGAIN}")
    return value


def _capital(text: str) -> str:
    return text[0].upper() + text[1:]
