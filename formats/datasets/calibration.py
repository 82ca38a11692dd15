"""Intrinsics in files: our own JSON, OpenCV's YAML, XML and JSON, Kalibr's YAML, COLMAP's text and binary."""

import re
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from ..colmap import cameras_in
from ..errors import InputError
from ..reading import parsing, read_bytes
from ..textfile import is_number, number, optional_number, read_json, read_json_object, read_rows, read_text, read_xml
from .sequence import Camera, distortion_names

FORMATS = (
    "JSON (fx, fy, cx, cy, width, height, distortion), OpenCV's YAML, XML or JSON, Kalibr's camchain.yaml, COLMAP's "
    "cameras.txt or cameras.bin, a 3x3 matrix as text"
)
HOW_INTRINSICS = "give fx,fy,cx,cy[,k1,k2,p1,p2] in pixels of the source, or a file that holds them"
_PERSPECTIVE = ("", "none", "opencv", "pinhole", "plumb_bob", "radtan", "rational_polynomial")
_FISHEYE = ("equidistant", "fisheye")
_COLMAP_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV",
    "OPENCV_FISHEYE", "FULL_OPENCV",
)  # fmt: skip
_MAX_BYTES = 2_000_000
_MAX_YAML = 256_000
"""Characters, with room for the corners that OpenCV adds; the YAML reader takes two seconds for so many."""


def read_calibration_file(path: Path, size: tuple[int, int]) -> dict[str, Camera]:
    """Read the cameras of a file by their names there; of `size` (width, height) where it states none.

    Raises InputError for a file without any, a lens that is not supported, and coefficients that would be lost.
    """
    suffix = path.suffix.lower()
    data = read_bytes(path, _MAX_BYTES)
    with parsing(path, "calibration file", f"files that work: {FORMATS}"):
        if suffix == ".bin":
            return {str(i): _of_colmap(model, (w, h, *params), path) for i, model, w, h, params in cameras_in(data)}
        rows = read_rows(path) if suffix != ".json" else []
        words = [word for row in rows for word in row]
        if words and all(map(is_number, words)):
            return {"camera": camera_from_numbers([float(word) for word in words], size, str(path))}
        if suffix == ".txt" and rows and len(rows[0]) > 4 and rows[0][1].isupper():
            return {row[0]: _of_colmap(row[1], tuple(map(float, row[2:])), path) for row in rows}
        if suffix == ".json":
            table = read_json(path)
        else:
            text = read_text(path)
            table = _of_xml(read_xml(path, _MAX_BYTES)) if text.lstrip().startswith("<") else _of_yaml(text)
        found = _cameras_in(table, path, size) if isinstance(table, dict) else {}
    if not found:
        raise InputError(f"{path} holds no camera: files that work: {FORMATS}")
    return found


def camera_from_numbers(numbers: list[float], size: tuple[int, int], where: str) -> Camera:
    """Return the camera of images of `size` from fx, fy, cx, cy[, k1, k2, p1, p2] or the nine numbers of a calibration
    matrix; `where` they stand is for errors."""
    if len(numbers) == 9:
        fx, skew, cx, zero, fy, cy, *last_row = numbers
        if (skew, zero, *last_row) != (0, 0, 0, 0, 1):
            raise InputError(f"{where} holds nine numbers that are no calibration matrix: {HOW_INTRINSICS}")
        numbers = [fx, fy, cx, cy]
    if len(numbers) not in (4, 5, 6, 8):
        raise InputError(f"{where}: {len(numbers)} numbers: {HOW_INTRINSICS}")
    (width, height), (fx, fy, cx, cy, *lens) = size, numbers
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{where}: the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} source: give it in "
            "pixels of the source, in the order fx,fy,cx,cy"
        )
    return Camera(width, height, fx, fy, cx, cy, (*lens, 0.0, 0.0, 0.0, 0.0)[:4])


def _cameras_in(table: dict[str, Any], path: Path, size: tuple[int, int]) -> dict[str, Camera]:
    own = {str(key).lower(): value for key, value in table.items()}
    if "camera_matrix" in own:
        k = _numbers(own["camera_matrix"]) or []
        if len(k) != 9 or any((k[1], k[3], k[6], k[7])) or k[8] != 1:
            raise InputError(f"{path}: its camera_matrix is no calibration matrix without skew: calibrate again")
        sides: list[Any] = [own.get("image_width", size[0]), own.get("image_height", size[1])]
        model = "fisheye" if own.get("fisheye_model") else own.get("distortion_model", own.get("camera_model", ""))
        return {"camera": _counted_from_zero(own, path, [k[0], k[4], k[2], k[5]], sides, str(model), "_coefficients")}
    chain = {str(k): v for k, v in table.items() if isinstance(v, dict) and "intrinsics" in v and "resolution" in v}
    if chain:
        return {name: _of_kalibr(camera, path) for name, camera in chain.items()}
    inner: dict[str, Any] = own["camera"] if isinstance(own.get("camera"), dict) else own
    if not {"fx", "fl_x"} & inner.keys():
        return {}
    shown = {"w": inner.get("w", inner.get("width", size[0])), "h": inner.get("h", inner.get("height", size[1]))}
    return {"camera": camera_from_table({**inner, **shown}, path, integer_centres=False)}


def _of_kalibr(table: dict[str, Any], path: Path) -> Camera:
    kind = str(table.get("camera_model", "pinhole"))
    if kind != "pinhole":
        raise InputError(f"{path}: the camera model {kind} is not supported: undistort the images first")
    intrinsics, sides = _numbers(table["intrinsics"]) or [], _numbers(table["resolution"]) or []
    return _counted_from_zero(table, path, intrinsics, sides, str(table.get("distortion_model", "")), "_coeffs")


def _counted_from_zero(
    table: dict[str, Any], path: Path, intrinsics: list[float], sides: list[Any], model: str, ending: str
) -> Camera:
    """The camera of fx, fy, cx, cy, with the coefficients under distortion_coefficients or distortion_coeffs."""
    model = model.lower()
    if model not in (*_PERSPECTIVE, *_FISHEYE):
        raise InputError(f"{path}: the lens model {model} is not supported: undistort the images first")
    lens = _numbers(table.get(f"distortion{ending}"))
    other = [key for key in table if "dist" in key and key != "distortion_model" and any(_numbers(table[key]) or ())]
    if lens is None and other:
        raise InputError(f"{path}: its distortion under {other[0]!r} is not understood: undistort the images first")
    plain = dict(zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True)) | dict(zip("wh", sides, strict=True))
    return camera_from_table(
        {**plain, "model": "FISHEYE" if model in _FISHEYE else "", "distortion": lens}, path, integer_centres=True
    )


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the table in a YAML file, as OpenCV, Kalibr or EuRoC write it. Raises InputError for anything else."""
    text = read_text(path, _MAX_BYTES)
    with parsing(path, "YAML file", "unpack or export it again"):
        table = _of_yaml(text)
    if not isinstance(table, dict):
        raise InputError(f"{path} holds no table of keys and values: unpack or export it again")
    return table


def _of_yaml(text: str) -> Any:
    import yaml

    if len(text) > _MAX_YAML:
        raise ValueError(f"of {len(text):,} characters, more than a calibration has")

    class Loader(yaml.SafeLoader):
        """Reads a table with a tag, as OpenCV's matrices are, like any other; no aliases, which multiply."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("it has aliases")
            return super().compose_node(parent, index)

    Loader.add_multi_constructor("", lambda loader, _, node: loader.construct_mapping(node, deep=True))
    # OpenCV writes %YAML:1.0 where the standard has %YAML 1.0.
    return next(iter(yaml.load_all(re.sub(r"\A\s*%YAML[^\n]*\n", "", text), Loader)), None)


def _of_xml(element: Element) -> Any:
    """Tables and lists of numbers, as OpenCV writes them."""
    if len(element):
        return {child.tag: _of_xml(child) for child in element}
    words = (element.text or "").split()
    if not words or not all(map(is_number, words)):
        return " ".join(words).strip('"')
    return float(words[0]) if len(words) == 1 else [float(word) for word in words]


def _numbers(value: Any) -> list[float] | None:
    """The numbers of a list, or of a table with `data`; YAML calls 1e-5 a text."""
    value = value.get("data") if isinstance(value, dict) else value
    try:
        return [float(v) for v in value] or None if isinstance(value, list) else None
    except (TypeError, ValueError):
        return None


def _of_colmap(model: str | int, numbers: tuple[float, ...], path: Path) -> Camera:
    import pycolmap

    members = pycolmap.CameraModelId.__members__
    name = pycolmap.CameraModelId(model).name if isinstance(model, int) else model
    if name not in members:
        raise InputError(f"{path}: the camera model {name} is not supported: undistort the images first")
    expected = len(pycolmap.Camera.create_from_model_name(1, name, 1.0, 1, 1).params)
    if len(numbers) != 2 + expected or not all(1 <= side <= 1e6 for side in numbers[:2]):
        raise InputError(f"{path}: a {name} camera has width, height and {expected} parameters: check its line")
    camera, notes = camera_from_colmap(name, int(numbers[0]), int(numbers[1]), numbers[2:])
    if camera is None:
        raise InputError(f"{path}: {notes[0].partition(':')[0]}: undistort the images first, for example with `colmap "
                         "image_undistorter`")  # fmt: skip
    return camera


def camera_from_colmap(
    name: str, width: int, height: int, parameters: tuple[float, ...]
) -> tuple[Camera | None, tuple[str, ...]]:
    """Return the camera of a COLMAP model with its parameters; None and a note where OpenCV has no such lens."""
    if name not in _COLMAP_MODELS:
        return None, (f"COLMAP's camera model {name} is not supported: the model's intrinsics are not used",)
    has_one_focal = name.startswith(("SIMPLE_", "RADIAL"))
    fx, fy, cx, cy, *k = (parameters[0], *parameters) if has_one_focal else parameters
    k = k if any(k[5:]) else k[:5]
    distortion = (*k, *[0.0] * (4 - len(k)))
    return Camera(width, height, fx, fy, cx, cy, distortion, name.endswith("FISHEYE")), ()


def read_intrinsics_json(path: Path, *, integer_centres: bool) -> tuple[Camera, float | None]:
    """Read the camera, and raw depth units per metre where the file says so.

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
    """Return the camera in a table of the keys that `read_intrinsics_json` understands. Raises as that does."""
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
    """In OpenCV's order, as `Camera` has them; no thin prism or tilt coefficients (the 9th to 14th) but zeros."""
    values = table.get("distortion")
    if values is None:
        return _trimmed([optional_number(table, path, name) or 0.0 for name in names])
    most = min(len(names), 5)
    is_numbers = isinstance(values, list) and all(isinstance(v, int | float) for v in values)
    if not is_numbers or any(values[len(names) :]) or len(values) not in (*range(1, most + 1), 8, 12, 14):
        usual = f"up to {most}: {', '.join(names[:5])}" + (", or 8 with k4, k5, k6" if names[5:] else "")
        raise InputError(f"{path}: distortion is {str(values)[:80]}, expected {usual}")
    found = [float(v) for v in values[: len(names)]]
    return (*found, 0.0, 0.0, 0.0)[: max(4, len(found))] if len(found) <= 5 else _trimmed(found)


def _trimmed(values: list[float]) -> tuple[float, ...]:
    """Without trailing zeros that another lens model would have: 4, 5 or 8 coefficients."""
    padded = (*values, *[0.0] * 8)[:8]
    return padded if any(padded[5:]) else padded[:5] if padded[4] else padded[:4]
