"""Intrinsics in files of data sets and of other programs: our own JSON; ROS, Kalibr, EuRoC and ORB-SLAM (YAML),
OpenCV (YAML, XML), ARKit, Open3D, RealSense, Record3D, OpenDroneMap and Meshroom (JSON), Metashape (XML), COLMAP (text,
binary), KITTI and Middlebury (text)."""

import re
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from ..colmap import Array
from ..colmap_files import cameras_in
from ..errors import InputError
from ..reading import parsing, read_bytes
from ..textfile import is_number, number, optional_number, read_json, read_json_object, read_rows, read_text, read_xml
from .colmap import camera_from_colmap
from .sequence import Camera, distortion_names

FORMATS = (
    "JSON (fx, fy, cx, cy, width, height, distortion; or as of ARKit, Open3D, nerfstudio), YAML of ROS, Kalibr, EuRoC "
    "or ORB-SLAM, OpenCV's YAML or XML, Metashape's XML, Meshroom's cameras.sfm, OpenDroneMap's cameras.json, COLMAP's "
    "cameras.txt or cameras.bin, KITTI's calib.txt, a 3x3 matrix as text"
)
_MATRIX = ("camera_matrix", "cameramatrix", "k", "intrinsic_matrix", "intrinsicmatrix", "cameraintrinsics",
           "intrinsics", "intrinsic", "mtx")  # fmt: skip
_DISTORTION = ("distortion_coefficients", "distortion_coeffs", "distcoeffs", "dist_coeffs", "dist_coeff", "distortion",
               "coeffs", "dist", "d")  # fmt: skip
_SAYS_DISTORTION = re.compile(r"^(xi|alpha|beta|d\d*)$|dist(?!ance)|(?<!intrinsic)coeff|radial|tangential")
_MODEL = ("distortion_model", "camera_model", "camera_type", "model_type", "type", "model")
_PERSPECTIVE = ("", "none", "opencv", "full_opencv", "perspective", "pinhole", "plumb_bob", "radtan",
                "radial-tangential", "rational_polynomial", "simple_pinhole", "rectified", "camera")  # fmt: skip
_FISHEYE = ("equidistant", "equi", "fisheye", "opencv_fisheye", "kannala_brandt", "kannala_brandt4", "kannalabrandt8")
_PARTS = ("projection_parameters", "distortion_parameters")
_SIDES = (("width", "w", "image_width", "imagewidth"), ("height", "h", "image_height", "imageheight"))
_SIZE = ("resolution", "image_size", "imagesize", "size")
_KITTI = re.compile(r"^(P|K|cam|[PK]_|P_rect_)\d*$")
_MAX_DEPTH, _MAX_BYTES, _MAX_CAMERAS = 8, 2_000_000, 1000
_MAX_YAML = 256_000
"""Characters, with room for the corners that OpenCV adds; the YAML reader takes two seconds for so many."""


def read_calibration_file(path: Path, size: tuple[int, int]) -> dict[str, Camera]:
    """Read the cameras of a file by their names there; of `size` (width, height) where it states none.

    Raises InputError for a file without any, a lens that is not supported, and coefficients that would be lost.
    """
    suffix, found = path.suffix.lower(), dict[str, Camera]()
    data = read_bytes(path, _MAX_BYTES)
    with parsing(path, "calibration file", f"files that work: {FORMATS}"):
        if suffix == ".bin":
            return {str(i): _colmap(model, (w, h, *params), path) for i, model, w, h, params in cameras_in(data)}
        rows = read_rows(path) if suffix == ".txt" else []
        if rows and len(rows[0]) > 4 and rows[0][1].isupper():
            return {row[0]: _colmap(row[1], tuple(map(float, row[2:])), path) for row in rows}
        _collect(_tables(path, suffix), "", found, path, size)
    if not found:
        raise InputError(f"{path} holds no camera: files that work: {FORMATS}")
    return found


def _tables(path: Path, suffix: str) -> Any:
    """What a file of JSON, YAML, XML or of KITTI's lines holds, as lists and dicts."""
    if suffix in (".json", ".sfm"):
        return read_json(path)
    text = read_text(path)
    if text.lstrip().startswith("<"):
        return _plain(read_xml(path, _MAX_BYTES))
    return _of_kitti(text) or _of_yaml(text)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the table in a YAML file, as OpenCV, ROS or EuRoC write it. Raises InputError for anything else."""
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


def _plain(element: Element) -> Any:
    """Lists, dicts and numbers of XML as OpenCV writes it (`_` for each of a list, numbers between blanks), and
    Metashape, whose sizes are attributes."""
    if not len(element) and not element.attrib:
        return _number_or_text(element.text or "")
    if len(element) and all(child.tag == "_" for child in element):
        return [_plain(child) for child in element]
    found = {key: _number_or_text(text) for key, text in element.attrib.items()}
    counts = Counter[str]()
    for child in element:
        counts[child.tag] += 1
        found[child.tag if counts[child.tag] == 1 else f"{child.tag} {counts[child.tag]}"] = _plain(child)
    return found if len(element) or not (element.text or "").strip() else _number_or_text(element.text or "")


def _number_or_text(text: str) -> Any:
    words = text.split()
    if not words or not all(map(is_number, words)):
        return text.strip().strip('"')
    numbers = [float(word) for word in words]
    return numbers[0] if len(numbers) == 1 else numbers


def _of_kitti(text: str) -> dict[str, Any]:
    """A table for each camera of lines `P0: 12 numbers`, or `K_00: 9 numbers` beside D_00 and S_00, or `cam0=[a b c;
    ...]` beside width and height."""
    found: dict[str, list[float]] = {}
    for line in text.splitlines():
        name, _, numbers = line.replace("=", ":", 1).partition(":")
        words = numbers.strip().removeprefix("[").removesuffix("]").replace(",", " ").replace(";", " ").split()
        if words and all(map(is_number, words)):
            found[name.strip()] = [float(word) for word in words]
    sides: dict[str, Any] = {side: found[side][0] for side in ("width", "height") if side in found}
    cameras: dict[str, Any] = {}
    for key in (key for key in found if _KITTI.match(key)):
        size = found.get("S" + key[1:])
        lens: dict[str, Any] = (
            {"d": found[key.replace("K", "D")]} if key.startswith("K") and key.replace("K", "D") in found else {}
        )
        cameras[key] = {"k": found[key], **sides, **lens, **({"size": size} if size else {})}
    return cameras


def _colmap(model: str | int, numbers: tuple[float, ...], path: Path) -> Camera:
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


def _collect(value: Any, name: str, found: dict[str, Camera], path: Path, size: tuple[int, int]) -> None:
    """Add the cameras of a table and of the tables in it to those found, by the path of their keys."""
    if isinstance(value, list) and _numbers(value) is None:
        value = {str(i): inner for i, inner in enumerate(value)}
    if not isinstance(value, dict) or name.count("/") > _MAX_DEPTH or len(found) > _MAX_CAMERAS:
        return
    table = {str(key).removeprefix("Camera.").removeprefix("Camera1.").lower(): v for key, v in value.items()}
    for inner in [table.get(key) for key in (*_MATRIX, *_DISTORTION, *_PARTS)]:
        table |= inner if isinstance(inner, dict) and "data" not in inner else {}
    matrix = next((k for key in _MATRIX if (k := _matrix(_numbers(table.get(key)) or [])) is not None), None)
    if matrix is None and (rows := _rows_of_four(table.get("perframeintrinsiccoeffs"))) is not None:
        matrix = np.median(rows, axis=0).tolist()  # Record3D's, which change with the focus
    translated = next((camera for of in _PROGRAMS if (camera := of(table, path)) is not None), None)
    if translated is not None:
        found[name or "camera"] = translated
        return
    if matrix is not None or _first(table, ("fx", "fl_x")) is not None:
        found[name or "camera"] = _camera(table, matrix, path, size)
        return
    for key, inner in value.items():
        _collect(inner, f"{name}/{key}" if name else str(key), found, path, size)


def _camera(table: dict[str, Any], matrix: list[float] | None, path: Path, size: tuple[int, int]) -> Camera:
    model = next((m for key in _MODEL if (m := str(table.get(key) or "").lower()) not in _PERSPECTIVE), "")
    if model and model not in _FISHEYE and "fisheye" not in model:
        raise InputError(f"{path}: the lens model {model} is not supported: undistort the images first")
    width, height = _numbers(_first(table, _SIZE)) or [_first(table, names) for names in _SIDES]
    plain = {
        **{key: table[key] for key in (*distortion_names(bool(model)), "pixel_centre") if key in table},
        **(dict(zip(("fx", "fy", "cx", "cy"), matrix, strict=True)) if matrix else table),
        "w": size[0] if width is None else width, "h": size[1] if height is None else height,
        "model": "FISHEYE" if model else "", "distortion": _numbers(_first(table, _DISTORTION)),
    }  # fmt: skip
    lost = [
        key
        for key in table
        if _SAYS_DISTORTION.search(key) and any(_numbers(table[key]) or _numbers([table[key]]) or ())
    ]
    if plain["distortion"] is None and lost:
        raise InputError(f"{path}: its distortion under {lost[0]!r} is not understood: undistort the images first")
    return camera_from_table(plain, path, integer_centres=matrix is not None or path.suffix.lower() != ".json")


def _of_metashape(table: dict[str, Any], path: Path) -> Camera | None:
    """One focal length, the principal point seen from the middle of the image; p1 and p2 the other way round than
    OpenCV's. The first pixel's centre is at (0.5, 0.5)."""
    size = table.get("resolution")
    if not (isinstance(size, dict) or "projection" in table) or table.get("class") == "initial":
        return None
    table = {**size, **table} if isinstance(size, dict) else table
    if not {"f", "width", "height"} <= table.keys():
        return None
    kind = str(table.get("projection", table.get("type", "frame")))
    f, w, h = (number(table, path, key) for key in ("f", "width", "height"))
    cx, cy, k1, k2, k3, k4, p1, p2, b1, b2 = (
        optional_number(table, path, key) or 0.0 for key in ("cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")
    )
    if kind != "frame" or k4 or b2:
        what = f"projection {kind!r}" if kind != "frame" else "k4" if k4 else "b2"
        raise InputError(f"{path}: Metashape's {what} is not supported here: undistort the images there")
    return Camera(int(w), int(h), f + b1, f, w / 2 + cx, h / 2 + cy, _trimmed([k1, k2, p2, p1, k3]))


def _of_opendronemap(table: dict[str, Any], path: Path) -> Camera | None:
    """Lengths are fractions of the longer side, the principal point seen from the middle of the image."""
    kind = str(table.get("projection_type", "")).lower()
    if not kind or not {"width", "height"} <= table.keys():
        return None
    if kind not in ("perspective", "brown", "simple_radial", "radial", "fisheye_opencv"):
        raise InputError(f"{path}: OpenDroneMap's lens {kind!r} is not supported: undistort the images first")
    w, h = number(table, path, "width"), number(table, path, "height")
    fx = number(table, path, "focal_x", "focal")
    fy = optional_number(table, path, "focal_y") or fx
    cx, cy = (optional_number(table, path, key) or 0.0 for key in ("c_x", "c_y"))
    names = distortion_names(kind.startswith("fisheye"))[:5]
    lens = tuple(optional_number(table, path, name) or 0.0 for name in names)
    side = max(w, h)
    return Camera(
        int(w), int(h), fx * side, fy * side, w / 2 + cx * side, h / 2 + cy * side,
        lens if kind.startswith("fisheye") else _trimmed(list(lens)), kind.startswith("fisheye"),
    )  # fmt: skip


def _of_meshroom(table: dict[str, Any], path: Path) -> Camera | None:
    """All numbers are texts; the focal length is in millimetres of the sensor, the principal point in pixels seen from
    the middle of the image."""
    if not {"focallength", "sensorwidth", "width", "height"} <= table.keys():
        return None
    kind = str(table.get("type", table.get("distortiontype", ""))).lower()
    kind = kind if kind != "pinhole" else str(table.get("distortiontype", "")).lower().replace("none", "") or kind
    given = [float(v) for v in table.get("distortionparams") or ()]
    k = [*given, 0.0, 0.0, 0.0, 0.0, 0.0]
    lens = {
        "pinhole": [], "radial1": [k[0]], "radialk1": [k[0]], "radial3": [k[0], k[1], 0.0, 0.0, k[2]],
        "radialk3": [k[0], k[1], 0.0, 0.0, k[2]], "brown": [k[0], k[1], k[3], k[4], k[2]],
    }.get(kind)  # fmt: skip
    if lens is None:
        raise InputError(f"{path}: Meshroom's lens {kind!r} is not supported: export the undistorted images")
    w, h, mm, sensor = (float(table[key]) for key in ("width", "height", "focallength", "sensorwidth"))
    ratio = float(table.get("pixelratio") or 1)
    x, y = (float(v) for v in table.get("principalpoint") or (0, 0))
    f = mm / sensor * w
    return Camera(int(w), int(h), f, f / ratio, w / 2 + x, h / 2 + y, _trimmed(lens))


_PROGRAMS = (_of_metashape, _of_opendronemap, _of_meshroom)
"""Cameras of programs that count otherwise than OpenCV: from a table with keys in small letters; None for another's."""


def _matrix(numbers: list[float]) -> list[float] | None:
    """fx, fy, cx, cy of four numbers, or of a calibration matrix without skew, of 9, 12 or 16 numbers by rows or
    columns."""
    if len(numbers) == 4:
        return numbers
    if len(numbers) not in (9, 12, 16):
        return None
    across = 3 if len(numbers) == 9 else 4
    k = [numbers[i * across : i * across + 3] for i in range(3)]
    k = k if k[0][2] or k[1][2] else [list(column) for column in zip(*k, strict=True)]
    is_one = not any((k[0][1], k[1][0], k[2][0], k[2][1])) and k[2][2] == 1 and min(k[0][0], k[1][1]) > 0
    return [k[0][0], k[1][1], k[0][2], k[1][2]] if is_one else None


def _rows_of_four(value: Any) -> Array | None:
    rows = value if isinstance(value, list) else []
    is_so = rows and all(isinstance(r, list) and len(r) == 4 and _numbers(r) is not None for r in rows)
    return np.array(rows, np.float64) if is_so else None


def _first(table: dict[str, Any], keys: tuple[str, ...]) -> Any:
    return next((table[key] for key in keys if table.get(key) is not None), None)


def _numbers(value: Any) -> list[float] | None:
    """The numbers of a list, a list of lists, or a table with `data`; YAML calls 1e-5 a text."""
    value = value.get("data") if isinstance(value, dict) else value
    rows = value if isinstance(value, list) else []
    flat = [v for row in rows for v in (row if isinstance(row, list) else [row])]
    try:
        return [float(v) for v in flat] or None
    except (TypeError, ValueError):
        return None


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
    """Return the camera in a table of the keys that `read_intrinsics_json` understands. Raises InputError as that
    does."""
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
    """Return the distortion coefficients of a list in OpenCV's order, as `Camera` has them; None for a list of another
    length, or with thin prism or tilt coefficients (the 9th to 14th) that are not zero."""
    if any(values[len(names) :]) or len(values) not in (*range(1, min(len(names), 5) + 1), 8, 12, 14):
        return None
    found = tuple(float(v) for v in values[: len(names)])
    return (*found, 0.0, 0.0, 0.0)[: max(4, len(found))] if len(found) <= 5 else _trimmed(list(found))


def _trimmed(values: list[float]) -> tuple[float, ...]:
    """Without trailing zeros that another lens model would have: 4, 5 or 8 coefficients."""
    padded = (*values, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)[:8]
    return padded if any(padded[5:]) else padded[:5] if padded[4] else padded[:4]
