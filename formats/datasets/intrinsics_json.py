"""Intrinsics in a JSON file, as several data sets spell them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import InputError
from ..jsonfile import number, optional_number, read_json_object
from .camera import Camera, distortion_names


def read_intrinsics_json(path: Path, *, integer_centres: bool) -> tuple[Camera, float | None]:
    """The camera, and raw depth units per metre where the file says so.

    Understands w/width, h/height, fx, fy, cx, cy, distortion (a list, or k1, k2, p1, p2, k3) and depth_scale/scale,
    at the top or under "camera"; beside a model or camera_model with FISHEYE in its name, k1 to k4 are the fisheye's. A
    key pixel_centre that begins with "integer" or "half" says which number the first
    pixel's centre has; `integer_centres` is for files without that key.
    """
    top = read_json_object(path)
    table = top["camera"] if isinstance(top.get("camera"), dict) else top
    camera = camera_from_table(table, path, integer_centres=integer_centres)
    scale = optional_number(table, path, "depth_scale", "scale")
    if scale is not None and not scale > 0:
        raise InputError(f"{path}: depth_scale is {scale:g}, expected raw units a metre: correct it")
    return camera, scale


def camera_from_table(table: dict[str, Any], path: Path, *, integer_centres: bool) -> Camera:
    """The camera in a table of the keys that `read_intrinsics_json` understands. Raises InputError as that does."""
    said = str(table.get("pixel_centre", "integer" if integer_centres else "half")).lower()
    if not said.startswith(("integer", "half")):
        raise InputError(f"{path}: pixel_centre is {said!r}, expected it to begin with 'integer' or 'half'")
    shift = 0.5 if said.startswith("integer") else 0.0
    fisheye = "FISHEYE" in str(table.get("camera_model", table.get("model", ""))).upper()
    return Camera(
        int(number(table, path, "w", "width")),
        int(number(table, path, "h", "height")),
        number(table, path, "fx", "fl_x"),
        number(table, path, "fy", "fl_y"),
        number(table, path, "cx", "ppx") + shift,
        number(table, path, "cy", "ppy") + shift,
        _distortion(table, path, distortion_names(fisheye)),
        fisheye,
    )


def _distortion(table: dict, path: Path, names: tuple[str, ...]) -> tuple[float, ...]:
    values = table.get("distortion")
    if values is None:
        return _trimmed([optional_number(table, path, name) or 0.0 for name in names])
    is_numbers = isinstance(values, list) and all(isinstance(v, int | float) for v in values)
    found = coefficients(values, names) if is_numbers else None
    if found is None:
        usual = f"up to {min(len(names), 5)}: {', '.join(names[:5])}" + (", or 8 with k4, k5, k6" if names[5:] else "")
        raise InputError(f"{path}: distortion is {str(values)[:80]}, expected {usual}")
    return found


def coefficients(values: list[float], names: tuple[str, ...]) -> tuple[float, ...] | None:
    """Distortion coefficients of a list in OpenCV's order, as `Camera` has them; None for a list of another length, or
    with thin prism or tilt coefficients (the 9th to 14th) that are not zero."""
    if any(values[len(names) :]) or len(values) not in (*range(1, min(len(names), 5) + 1), 8, 12, 14):
        return None
    found = tuple(float(v) for v in values[: len(names)])
    return (*found, 0.0, 0.0, 0.0)[: max(4, len(found))] if len(found) <= 5 else _trimmed(list(found))


def _trimmed(values: list[float]) -> tuple[float, ...]:
    """Without trailing zeros that another lens model would have: 4, 5 or 8 coefficients."""
    padded = (*values, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)[:8]
    return padded if any(padded[5:]) else padded[:5] if padded[4] else padded[:4]
