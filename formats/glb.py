"""GLB: glTF's document and its one buffer in a file; and Gaussians in one by KHR_gaussian_splatting (Khronos).

Of Gaussians it is a primitive of points whose attributes are POSITION and, prefixed with the extension's name, ROTATION
(x y z w), SCALE (standard deviations), OPACITY (0..1) and SH_DEGREE_0_COEF_0 (colour = 0.5 + 0.2821 * it). COLOR_0 is
for programs that do not know the extension: they show a cloud of coloured points. With
KHR_gaussian_splatting_compression_spz_2 (Khronos, draft) the attributes are an SPZ file of version 2 in a buffer view:
a tenth of the size, and all that CesiumJS draws.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .gaussians import GaussianCloud
from .ply import SH_C0
from .spz import spz_bytes

_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_BYTE, _FLOAT = 5121, 5126
_COMPONENTS = {"|u1": _BYTE, "<u4": 5125, "<f4": _FLOAT}
_VERTICES, _INDICES = 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
UNLIT = "KHR_materials_unlit"
EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
LABEL = "_LABEL"
"""Attribute of the class numbers."""
_PROPERTIES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
# glTF's y is up and its z comes towards the viewer; splats have x right, y down, z forward.
_FLIP = np.array([1, -1, -1], dtype=np.float32)


def material(unlit: bool = True, **more: Any) -> dict[str, Any]:
    """Describe a surface seen from both sides that does not shine; `unlit`: its colours hold the light already."""
    shown = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1, **more}, "doubleSided": True}
    return {**shown, "extensions": {UNLIT: {}}} if unlit else shown


def linear(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Convert sRGB colours in 0..1 to linear light, as glTF wants COLOR_0 (2.0, 3.9.2); beyond 0..1 they are cut."""
    srgb = np.clip(colors, 0, 1).astype(np.float32)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


@dataclass(frozen=True)
class Part:
    """An attribute of the vertices, or as the last and without a name the faces' corners: `count` rows of `width`
    numbers of a `dtype`, of which no more than one of the `blocks` needs to be in memory; `more` for its accessor."""

    name: str
    count: int
    width: int
    dtype: str
    blocks: Iterable[NDArray[Any]]
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Size in the file, in bytes."""
        return self.count * self.width * np.dtype(self.dtype).itemsize

    @staticmethod
    def of(name: str, array: NDArray[Any], **more: Any) -> Part:
        """Make a part from an array (count,) or (count, width): uint8, uint32, or float32 for every other type."""
        kept = np.ascontiguousarray(array, {"u1": "|u1", "u4": "<u4"}.get(array.dtype.str[1:], "<f4"))
        if name == "POSITION":
            more |= {"min": kept.min(axis=0).tolist(), "max": kept.max(axis=0).tolist()}
        return Part(name, len(kept), kept[:1].size, kept.dtype.str, [kept], more)


def write_primitive(
    path: Path,
    parts: Sequence[Part],
    primitive: dict[str, Any],
    class_names: Sequence[str],
    name: dict[str, str],
    extras: dict[str, Any] | None = None,
    extensions: Sequence[str] = (),
    picture: bytes = b"",
) -> None:
    """Write a scene of one mesh that is one `primitive` of these parts, class names in the mesh's extras; `name` of
    mesh and node, `extras` of the document; the bytes of a `picture` are in the buffer view after the parts. Raises
    ValueError where a part's blocks are not as long as it says, InputError when the disk refuses."""
    starts = np.cumsum([0, *(part.nbytes for part in parts), len(picture)]).tolist()
    views: list[dict[str, Any]] = [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in pairwise(starts)]
    accessors = []
    for i, part in enumerate(parts):
        views[i]["target"] = _VERTICES if part.name else _INDICES
        head = {"bufferView": i, "componentType": _COMPONENTS[part.dtype], "count": part.count}
        accessors.append({**head, "type": _KINDS[part.width], **part.more})
    attributes = {part.name: i for i, part in enumerate(parts) if part.name}
    indices = {"indices": len(attributes)} if len(attributes) < len(parts) else {}  # they are the last
    whole = {"attributes": attributes, **indices, **primitive}
    document = {
        "asset": {"version": "2.0", "generator": "msgs-slam"},
        **({"extensionsUsed": list(extensions)} if extensions else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **name}],
        "meshes": [{"primitives": [whole], **name, "extras": {"classes": list(class_names)}}],
        **(extras or {}),
        "accessors": accessors,
        "bufferViews": views if picture else views[: len(parts)],
        "buffers": [{"byteLength": starts[-1]}],
    }
    write_glb(path, document, parts, picture)


def write_glb(path: Path, document: dict[str, Any], parts: Sequence[Part], rest: bytes = b"") -> None:
    """Write the document, and as its one buffer the parts and then the `rest`; both chunks are padded to four bytes."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    length = document["buffers"][0]["byteLength"]
    padding = b"\0" * (-length % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + length + len(padding))
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as file:
        file.write(head + struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", length + len(padding), _BINARY))
        for part in parts:
            end = file.tell() + part.nbytes
            for block in part.blocks:
                file.write(np.ascontiguousarray(block, part.dtype).data)
            if file.tell() != end:
                raise ValueError(f"write_primitive: {part.name or 'faces'}: {file.tell() - end} bytes too many")
        file.write(rest + padding)


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the document and buffer of a file's bytes. Raises ValueError, or what comes of missing bytes and keys, for
    another file."""
    magic, version, _ = struct.unpack_from("<4sII", data)
    if magic != b"glTF" or version != 2:
        raise ValueError("it does not begin like a GLB of version 2")
    length, kind = struct.unpack_from("<II", data, 12)
    document = json.loads(data[20 : 20 + length])
    after = 20 + length
    binary_length, binary_kind = struct.unpack_from("<II", data, after)
    if (kind, binary_kind) != (_JSON, _BINARY):
        raise ValueError("its two parts are not the document and its bytes")
    return document, data[after + 8 : after + 8 + binary_length]


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
        arrays[LABEL] = cloud.class_ids.astype(np.float32)
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
    floats: dict[str, Any] = {"componentType": _FLOAT, "count": len(cloud)}
    accessors = {
        "POSITION": {**floats, "type": "VEC3", "min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()},
        "COLOR_0": {**floats, "type": "VEC4", "componentType": _BYTE, "normalized": True},
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
