"""The camera's calibration as the user gives it."""

from pathlib import Path

from ...formats.datasets.calibration import read_calibration_file
from ...formats.datasets.sequence import Camera
from ...formats.errors import InputError
from ...formats.reading import file_sha256, home_expanded, reaching
from ...formats.textfile import read_rows

_HOW = "give fx,fy,cx,cy[,k1,k2,p1,p2] in pixels of the source, or a file that holds them"
_MOST_NAMED = 8


def read_intrinsics(text: str, width: int, height: int) -> Camera:
    """The camera of a width x height source from `frames.intrinsics`.

    `text` is `fx,fy,cx,cy[,k1,k2,p1,p2]` or the name of a file with these numbers, a 3x3 matrix, or whatever
    `read_calibration_file` reads; `FILE#NAME` is one of its cameras. Numbers, and files that say nothing else, have
    COLMAP's convention, the centre of the first pixel at (0.5, 0.5); OpenCV, ROS and their kin count from (0, 0), which
    is settled here. Raises InputError where it is none of these, cannot belong to the source, or is one of several.
    """
    numbers = _numbers(text.replace(",", " ").split())
    if numbers is not None:
        return _from_numbers(numbers, width, height, f"intrinsics {text}")
    path, name = _named_file(text)
    return _fit_to_source(_from_file(path, name, width, height), width, height, path)


def intrinsics_inputs(text: str) -> dict[str, str]:
    """Return the digest of the file that `frames.intrinsics` names; {} for numbers and for none."""
    if not text or _numbers(text.replace(",", " ").split()) is not None:
        return {}
    return {"intrinsics": file_sha256(_named_file(text)[0])}


def _named_file(text: str) -> tuple[Path, str]:
    """The file of `FILE` or `FILE#NAME`, and the name. Raises InputError where there is no such file."""
    path, name = Path(text), ""
    with reaching(path):
        path = home_expanded(path)
        if not path.is_file() and "#" in text:
            beginning, _, name = text.rpartition("#")
            path = home_expanded(beginning)
        if not path.is_file():
            raise InputError(f"intrinsics {text!r} are neither numbers nor an existing file: {_HOW}")
    return path, name


def _from_file(path: Path, name: str, width: int, height: int) -> Camera:
    is_text = path.suffix.lower() not in (".json", ".bin")
    numbers = _numbers([word for row in read_rows(path) for word in row]) if is_text else None
    if numbers is None:
        return _one_of(read_calibration_file(path, (width, height)), name, path)
    if len(numbers) == 9:
        fx, skew, cx, zero, fy, cy, *last_row = numbers
        if (skew, zero, *last_row) != (0, 0, 0, 0, 1):
            raise InputError(f"{path} holds nine numbers that are no calibration matrix: {_HOW}")
        numbers = [fx, fy, cx, cy]
    return _from_numbers(numbers, width, height, str(path))


def _one_of(cameras: dict[str, Camera], name: str, path: Path) -> Camera:
    """The camera of a name, or the only one. Raises InputError where several differ and none is named."""
    if name in cameras:
        return cameras[name]
    if len(set(cameras.values())) == 1 and not name:
        return next(iter(cameras.values()))
    known = [f"{n} ({c.width}x{c.height}, fx {c.fx:.6g})" for n, c in cameras.items()]
    shown = ", ".join(known[:_MOST_NAMED]) + (", ..." if len(known) > _MOST_NAMED else "")
    found = f"no camera {name!r} but" if name else f"{len(known)} cameras that differ:"
    raise InputError(
        f"{path} holds {found} {shown}: name the one that took the images, --intrinsics '{path}#{next(iter(cameras))}'"
    )


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
