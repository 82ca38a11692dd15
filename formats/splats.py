"""Splat files of any program, by suffix; and Gaussians in a GLB by glTF's extension KHR_gaussian_splatting (Khronos).

A primitive of points whose attributes are POSITION and, prefixed with the extension's name, ROTATION (x y z w), SCALE
(standard deviations), OPACITY (0..1) and SH_DEGREE_0_COEF_0 (colour = 0.5 + 0.2821 * it). COLOR_0 is for programs that
do not know the extension: they show a cloud of coloured points. With KHR_gaussian_splatting_compression_spz_2 (Khronos,
draft) the attributes are an SPZ file of version 2 in a buffer view: a tenth of the size, and all that CesiumJS draws.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .gaussians import GaussianCloud, unit_quaternions
from .glb import FLOAT, UNLIT, WIDTHS, Part, glb_parts, linear, material, write_glb, write_primitive
from .ply import SH_C0, read_gaussian_ply
from .reading import parsing, read_bytes
from .spz import read_spz, read_spz_stream, spz_bytes

EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
_PROPERTIES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_LABEL = "_LABEL"
# glTF's y is up and its z comes towards the viewer; splats have x right, y down, z forward.
_FLIP = np.array([1, -1, -1], dtype=np.float32)
_MIN_OPACITY = 1e-4
_SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat_wxyz", "u1", 4)])
_SMALLEST_SCALE = 1e-9


def write_gaussian_glb(path: Path, cloud: GaussianCloud, class_names: tuple[str, ...] = ()) -> None:
    """Write a cloud, its class numbers as attribute _LABEL and their names in the mesh's extras.

    The cloud has x right, y down, z forward, as from a splat PLY; the file's y is up. Nothing is rounded. The same
    cloud gives the same bytes. Raises ValueError for an empty cloud, which glTF cannot hold, InputError when the disk
    refuses.
    """
    if len(cloud) == 0:
        raise ValueError("write_gaussian_glb: glTF has no way to store an empty cloud")
    opacity = (1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))).astype(np.float32)
    arrays: dict[str, NDArray[Any]] = {
        "POSITION": cloud.means * _FLIP,
        "COLOR_0": np.column_stack([linear(cloud.colors), opacity]),
        f"{EXTENSION}:ROTATION": cloud.quat_wxyz[:, [1, 2, 3, 0]] * np.append(_FLIP, np.float32(1)),
        f"{EXTENSION}:SCALE": np.exp(cloud.log_scales),
        f"{EXTENSION}:OPACITY": opacity,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": (cloud.colors - np.float32(0.5)) / np.float32(SH_C0),
    }
    if cloud.class_ids is not None:
        arrays[_LABEL] = cloud.class_ids.astype(np.float32)
    parts = [Part.of(name, array) for name, array in arrays.items()]
    primitive = {"mode": 0, "material": 0, "extensions": {EXTENSION: _PROPERTIES}}
    write_primitive(path, parts, primitive, class_names, {}, {"materials": [material()]}, [EXTENSION, UNLIT])


def write_compressed_glb(path: Path, cloud: GaussianCloud) -> None:
    """Write a cloud's colours as `write_gaussian_glb` does, compressed: rounded as SPZ rounds, without classes.

    Raises ValueError for an empty cloud or places that SPZ cannot hold, InputError when the disk refuses.
    """
    if len(cloud) == 0:
        raise ValueError("write_compressed_glb: glTF has no way to store an empty cloud")
    packed, means = spz_bytes(cloud, 2), cloud.means * _FLIP
    floats: dict[str, Any] = {"componentType": FLOAT, "count": len(cloud)}
    accessors = {
        "POSITION": {**floats, "type": "VEC3", "min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()},
        "COLOR_0": {**floats, "type": "VEC4", "componentType": 5121, "normalized": True},
        f"{EXTENSION}:SCALE": {**floats, "type": "VEC3"},
        f"{EXTENSION}:ROTATION": {**floats, "type": "VEC4"},
    }
    properties = {**_PROPERTIES, "extensions": {COMPRESSION: {"bufferView": 0}}}
    attributes = {name: number for number, name in enumerate(accessors)}
    document = {
        "asset": {"version": "2.0", "generator": "msgs-slam"},
        "extensionsUsed": [EXTENSION, COMPRESSION],
        "extensionsRequired": [EXTENSION, COMPRESSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": attributes, "extensions": {EXTENSION: properties}}]}],
        "accessors": list(accessors.values()),
        "bufferViews": [{"buffer": 0, "byteLength": len(packed)}],
        "buffers": [{"byteLength": len(packed)}],
    }
    write_glb(path, document, [], packed)


def read_gaussian_glb(path: Path) -> GaussianCloud:
    """Read the first primitive of Gaussians in a GLB by this or another program; higher harmonics are dropped.

    The transforms of nodes are not applied. Raises InputError when the file is missing or damaged, holds no Gaussians,
    or packs them (other extensions, quantised attributes).
    """
    data = read_bytes(path)
    with parsing(path, "GLB file with Gaussians", "export it again, uncompressed"):
        document, binary = glb_parts(data)
        primitives = [p for m in document.get("meshes", []) for p in m["primitives"]]
        found = next((p for p in primitives if EXTENSION in p.get("extensions", {})), None)
        if found is None:
            raise InputError(f"{path} holds no Gaussians ({EXTENSION}), but perhaps a mesh: give a splat file")
        splats = found["extensions"][EXTENSION]
        if COMPRESSION in splats.get("extensions", {}):
            view = document["bufferViews"][splats["extensions"][COMPRESSION]["bufferView"]]
            start, size = int(view.get("byteOffset", 0)), int(view["byteLength"])
            return read_spz_stream(io.BytesIO(binary[start : start + size]), size, path)
        arrays = {name: _accessor(document, binary, i) for name, i in found["attributes"].items() if name != "COLOR_0"}
        return _cloud(arrays)


def _accessor(document: dict[str, Any], binary: bytes, index: int) -> NDArray[np.float32]:
    accessor = document["accessors"][index]
    if accessor["componentType"] != FLOAT or "sparse" in accessor:
        raise ValueError("an attribute is packed")
    view = document["bufferViews"][accessor["bufferView"]]
    width, count = WIDTHS[accessor["type"]], int(accessor["count"])
    if view.get("byteStride", 4 * width) != 4 * width:
        raise ValueError("its attributes are interleaved")
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    return np.frombuffer(binary, "<f4", count * width, start).reshape(count, width).astype(np.float32)


def _cloud(arrays: dict[str, NDArray[np.float32]]) -> GaussianCloud:
    opacity = arrays[f"{EXTENSION}:OPACITY"][:, 0].astype(np.float64).clip(_MIN_OPACITY, 1 - _MIN_OPACITY)
    quat_xyzw = arrays[f"{EXTENSION}:ROTATION"] * np.append(_FLIP, np.float32(1))
    smallest = np.finfo(np.float32).tiny
    return GaussianCloud(
        means=arrays["POSITION"] * _FLIP,
        log_scales=np.log(np.maximum(arrays[f"{EXTENSION}:SCALE"], smallest)),
        quat_wxyz=unit_quaternions(quat_xyzw[:, [3, 0, 1, 2]]),
        opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        colors=arrays[f"{EXTENSION}:SH_DEGREE_0_COEF_0"] * np.float32(SH_C0) + np.float32(0.5),
        class_ids=arrays[_LABEL][:, 0].astype(np.uint8) if _LABEL in arrays else None,
    )


def read_gaussians(path: Path) -> GaussianCloud:
    """Read the Gaussians of a .ply, .spz, .splat or .glb file, by its suffix.

    Raises InputError for another suffix, a missing or damaged file, and values that are not finite.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind == ".ply":
        return read_gaussian_ply(path)
    if kind == ".spz":
        return read_spz(path)
    if kind == ".splat":
        return read_splat(path)
    if kind == ".glb":
        return read_gaussian_glb(path)
    raise InputError(f"{path} has an unsupported extension; expected .ply, .spz, .splat or .glb")


def read_splat(path: Path) -> GaussianCloud:
    """Read the Gaussians of a .splat file: 32 bytes each, without header, 8 bit colours and rotations.

    Raises InputError when the file is missing, its length is no multiple of 32, or a value is not finite.
    """
    data = read_bytes(path)
    if len(data) % _SPLAT_ROW.itemsize:
        raise InputError(f"{path} is no whole .splat file (32 bytes for each Gaussian): copy or export it again")
    with parsing(path, ".splat file"):
        return _read_rows(np.frombuffer(data, dtype=_SPLAT_ROW))


def _read_rows(rows: NDArray) -> GaussianCloud:
    opacity = (rows["rgba"][:, 3] / 255.0).clip(1e-4, 1 - 1e-4)
    return GaussianCloud(
        means=rows["mean"].astype(np.float32),
        log_scales=np.log(np.maximum(rows["scale"], _SMALLEST_SCALE)).astype(np.float32),
        quat_wxyz=unit_quaternions(rows["quat_wxyz"] / 128.0 - 1),
        opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        colors=(rows["rgba"][:, :3] / 255.0).astype(np.float32),
    )
