"""GLB: glTF's document and its one buffer in a file."""

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

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Numbers in a row of each kind."""
FLOAT = 5126
_KINDS = {width: kind for kind, width in WIDTHS.items()}
_COMPONENTS = {"|u1": 5121, "<u4": 5125, "<f4": FLOAT}
_VERTICES, _INDICES = 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
UNLIT = "KHR_materials_unlit"


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
