"""The camera's calibration as the user gives it."""

from __future__ import annotations

from pathlib import Path

from ...formats.datasets.camera import Camera
from ...formats.datasets.intrinsics_json import read_intrinsics_json
from ...formats.errors import InputError
from ...formats.reading import home_expanded, reaching
from ...formats.textfile import read_rows

_HOW = "give fx,fy,cx,cy[,k1,k2,p1,p2] in pixels of the source, or a file that holds them"
_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
}


def read_intrinsics(text: str, width: int, height: int) -> Camera:
    """The camera of a width x height source from `frames.intrinsics`.

    `text` is `fx,fy,cx,cy[,k1,k2,p1,p2]` or the name of a file: JSON (fx, fy, cx, cy, width, height, distortion,
    pixel_centre), COLMAP's cameras.txt, or the same numbers as text. Numbers are in pixels of the source with COLMAP's
    convention, the centre of the first pixel at (0.5, 0.5): for a principal point from OpenCV or ROS add 0.5 to cx and
    cy, or say "pixel_centre": "integer" in the JSON. Raises InputError where it is none of these or cannot belong
    to the source.
    """
    numbers = _numbers(text.replace(",", " ").split())
    if numbers is not None:
        return _from_numbers(numbers, width, height, f"intrinsics {text}")
    path = Path(text)
    with reaching(path):
        path = home_expanded(path)
        if not path.is_file():
            raise InputError(f"intrinsics {text!r} are neither numbers nor an existing file: {_HOW}")
    return _fit_to_source(_from_file(path, width, height), width, height, path)


def _from_file(path: Path, width: int, height: int) -> Camera:
    if path.suffix.lower() == ".json":
        camera, _ = read_intrinsics_json(path, integer_centres=False)
        return camera
    rows = read_rows(path)
    if rows and len(rows[0]) > 4 and rows[0][1].isupper():
        return _from_colmap(rows[0], path)
    numbers = _numbers([word for row in rows for word in row])
    if numbers is None:
        raise InputError(f"{path} holds no camera: {_HOW} (JSON, COLMAP's cameras.txt or plain numbers)")
    if len(numbers) == 9:
        fx, skew, cx, zero, fy, cy, *last_row = numbers
        if (skew, zero, *last_row) != (0, 0, 0, 0, 1):
            raise InputError(f"{path} holds nine numbers that are no calibration matrix: {_HOW}")
        numbers = [fx, fy, cx, cy]
    return _from_numbers(numbers, width, height, str(path))


def _from_colmap(row: list[str], path: Path) -> Camera:
    model = row[1]
    if model not in _PARAMETERS:
        raise InputError(
            f"{path}: the camera model {model} is not supported ({', '.join(_PARAMETERS)} are): undistort the images "
            "first, for example with `colmap image_undistorter`"
        )
    names, numbers = _PARAMETERS[model].split(), _numbers(row[2:])
    if numbers is None or len(numbers) != 2 + len(names):
        raise InputError(f"{path}: a {model} camera has width, height and {len(names)} parameters: check its line")
    named = dict(zip(names, numbers[2:], strict=True))
    focal = named.get("f", 0.0)
    fisheye = model == "OPENCV_FISHEYE"
    distortion = tuple(named.get(name, 0.0) for name in (("k1 k2 k3 k4" if fisheye else "k1 k2 p1 p2").split()))
    if not all(1 <= side <= 1e6 for side in numbers[:2]):
        raise InputError(f"{path}: a camera of {numbers[0]:g}x{numbers[1]:g} pixels: check its line")
    return Camera(
        int(numbers[0]), int(numbers[1]), named.get("fx", focal), named.get("fy", focal), named["cx"], named["cy"],
        distortion, fisheye,
    )  # fmt: skip


def _from_numbers(numbers: list[float], width: int, height: int, where: str) -> Camera:
    if len(numbers) not in (4, 5, 6, 8):
        raise InputError(f"{where}: {len(numbers)} numbers: {_HOW}")
    distortion = (*numbers[4:], 0.0, 0.0, 0.0, 0.0)[:4]
    fx, fy, cx, cy = numbers[:4]
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{where}: the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} source: give it in "
            "pixels of the source, in the order fx,fy,cx,cy"
        )
    return Camera(width, height, fx, fy, cx, cy, distortion)


def _fit_to_source(camera: Camera, width: int, height: int, path: Path) -> Camera:
    try:
        return camera.resized(width, height)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _numbers(words: list[str]) -> list[float] | None:
    try:
        return [float(word) for word in words] or None
    except ValueError:
        return None
