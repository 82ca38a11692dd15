"""Files of COLMAP projects: where their models are, whether they are whole, and what is read of them without COLMAP."""

import struct
from collections.abc import Iterator
from pathlib import Path

from .errors import InputError
from .reading import opened, parsing, read_bytes

# Parameters of each of COLMAP's camera models, in the order of the models' ids (SIMPLE_PINHOLE first).
_PARAMETER_COUNTS = dict(enumerate((3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)))
_CAMERA_HEAD_BYTES = 4 + 4 + 8 + 8
_IMAGE_HEAD_BYTES = 4 + 7 * 8 + 4
_POINT_HEAD_BYTES = 8 + 3 * 8 + 3 + 8
_POINT2D_BYTES = 8 + 8 + 8
_TRACK_ELEMENT_BYTES = 4 + 4

_MODEL_PLACES = ("sparse", "colmap/sparse", ".")
"""Where a project keeps its models, each in a folder of its own or one without."""


def model_suffix(folder: Path) -> str | None:
    """Return ".bin" or ".txt" when the folder holds a complete model of that kind, else None."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images", "points3D")):
            return suffix
    return None


def find_models(path: Path) -> list[Path]:
    """Return the folders of a project's models, that with most images first: a mapper leaves several where it could not
    connect all images. Of a folder that is a model itself, that folder; [] without any."""
    if model_suffix(path):
        return [path]
    for place in (path / name for name in _MODEL_PLACES):
        inside = sorted(place.iterdir()) if place.is_dir() else []
        found = [p for p in (place, *inside) if not p.name.startswith(".") and model_suffix(p)]
        if found:
            return sorted(found, key=_size_of_model, reverse=True)
    return []


def _size_of_model(folder: Path) -> int:
    """How many images it has, by its own word; 0 where it is damaged."""
    try:
        if model_suffix(folder) == ".txt":
            return len(names_in_text(folder / "images.txt"))
        with opened(folder / "images.bin") as file:
            return int.from_bytes(file.read(8), "little")
    except InputError:
        return 0


def names_in_text(path: Path) -> dict[str, str]:
    """Read the names in an images.txt by the images' ids, with their blanks: pycolmap reads a name up to its first."""
    names = {}
    with opened(path) as file:
        lines = (line.strip() for line in file)
        for line in lines:
            if line and not line.startswith(b"#"):
                words = line.split(maxsplit=9)
                if len(words) == 10:
                    names[words[0].decode("ascii", "replace")] = words[9].decode("utf-8", "surrogateescape")
                next(lines, None)  # its observations
    return names


def require_whole_files(folder: Path) -> None:
    """Walk through cameras.bin, images.bin and points3D.bin and check that each ends where its counts say.

    pycolmap trusts the counts: it reads on past the end of a truncated file, into wrong cameras or into as much
    memory as the machine has. Raises InputError naming the file.
    """
    for name, walk in (("cameras", _walk_cameras), ("images", _walk_images), ("points3D", _walk_points)):
        path = folder / f"{name}.bin"
        data = read_bytes(path)
        with parsing(path, "whole file of a COLMAP model"):
            if walk(data) != len(data):
                raise ValueError("it ends elsewhere than its counts say")


def _walk_cameras(data: bytes) -> int:
    return sum(_CAMERA_HEAD_BYTES + 8 * len(params) for *_, params in cameras_in(data)) + 8


def cameras_in(data: bytes) -> Iterator[tuple[int, int, int, int, tuple[float, ...]]]:
    """Read id, number of the model, width, height and parameters of each camera of a cameras.bin. Raises struct.error
    and KeyError for damage."""
    (count,) = struct.unpack_from("<Q", data, 0)
    at = 8
    for _ in range(count):
        head = struct.unpack_from("<IiQQ", data, at)
        params = struct.unpack_from(f"<{_PARAMETER_COUNTS[head[1]]}d", data, at + _CAMERA_HEAD_BYTES)
        at += _CAMERA_HEAD_BYTES + 8 * len(params)
        yield *head, params


def _walk_images(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data, 0)
    at = 8
    for _ in range(count):
        at = data.index(b"\0", at + _IMAGE_HEAD_BYTES) + 1
        (points,) = struct.unpack_from("<Q", data, at)
        at += 8 + _POINT2D_BYTES * points
    return at


def _walk_points(data: bytes) -> int:
    (count,) = struct.unpack_from("<Q", data, 0)
    at = 8
    for _ in range(count):
        (track,) = struct.unpack_from("<Q", data, at + _POINT_HEAD_BYTES)
        at += _POINT_HEAD_BYTES + 8 + _TRACK_ELEMENT_BYTES * track
    return at
