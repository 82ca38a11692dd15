"""GLB: glTF's document and its one buffer in a file; labelled meshes in it, with vertex colours or with a texture."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .image_tags import light_of_srgb
from .images import decode_rgb, jpeg_bytes
from .ply import MeshBlocks
from .reading import parsing, read_bytes

_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"|u1": 5121, "<u4": 5125, "<f4": 5126}
_VERTICES, _INDICES = 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_LINEAR, _MIPMAPPED, _CLAMPED = 9729, 9987, 33071
UNLIT = "KHR_materials_unlit"
LABEL = "_LABEL"
"""Attribute of the class numbers."""


def material(unlit: bool = True, **more: Any) -> dict[str, Any]:
    """Describe a surface seen from both sides that does not shine; `unlit`: its colours hold the light already."""
    shown = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1, **more}, "doubleSided": True}
    return {**shown, "extensions": {UNLIT: {}}} if unlit else shown


def linear(colors: NDArray[Any]) -> NDArray[np.float32]:
    """Convert sRGB colours in 0..1 to linear light, as glTF wants COLOR_0 (2.0, 3.9.2); beyond 0..1 they are cut."""
    return light_of_srgb(np.clip(colors, 0, 1).astype(np.float32))


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

    def accessor(self) -> dict[str, Any]:
        """Describe it for the document, but for its buffer view."""
        return {
            "componentType": _COMPONENTS[self.dtype], "count": self.count, "type": _KINDS[self.width], **self.more,
        }  # fmt: skip


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
    for view, part in zip(views, parts, strict=False):
        view["target"] = _VERTICES if part.name else _INDICES
    attributes = {part.name: i for i, part in enumerate(parts) if part.name}
    indices = {"indices": len(attributes)} if len(attributes) < len(parts) else {}  # they are the last
    whole = {"attributes": attributes, **indices, **primitive}
    document = glb_document(
        {"extensionsUsed": list(extensions)} if extensions else {},
        {"primitives": [whole], **name, "extras": {"classes": list(class_names)}},
        name,
        extras or {},
        [{"bufferView": i, **part.accessor()} for i, part in enumerate(parts)],
        views if picture else views[: len(parts)],
        starts[-1],
    )
    write_glb(path, document, parts, picture)


def glb_document(
    extensions: dict[str, Any],
    mesh: dict[str, Any],
    node: dict[str, Any],
    extras: dict[str, Any],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    length: int,
) -> dict[str, Any]:
    """Return the document of a scene of one mesh in one node, over a buffer of `length` bytes."""
    return {
        "asset": {"version": "2.0", "generator": "msgs-slam"},
        **extensions,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [mesh],
        **extras,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": length}],
    }


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


def write_mesh_glb(
    path: Path, mesh: MeshBlocks, class_names: tuple[str, ...] = (), gltf_from_world: NDArray[np.float64] | None = None
) -> None:
    """Write an unlit GLB with vertex colours, the labels as vertex attribute _LABEL, class names in the mesh's extras.

    gltf_from_world (3, 3) turns the vertices: glTF wants y up. Errors as `write_mesh_ply`, ValueError for no faces.
    """
    if not mesh.face_count:
        raise ValueError("write_mesh_glb: glTF has no way to store a mesh without faces")
    turn = np.eye(3) if gltf_from_world is None else gltf_from_world.T

    def positions() -> Iterator[NDArray[np.float32]]:
        return ((points @ turn).astype(np.float32) for points, _, _ in mesh.vertices() if len(points))

    ends = np.array([(points.min(0), points.max(0)) for points in positions()])
    box = {"min": ends[:, 0].min(0).tolist(), "max": ends[:, 1].max(0).tolist()}
    colors = (linear(colors / 255) for _, colors, _ in mesh.vertices())
    parts = [
        Part("POSITION", mesh.vertex_count, 3, "<f4", positions(), box),
        Part("COLOR_0", mesh.vertex_count, 3, "<f4", colors),
        # glTF wants every vertex at a multiple of 4 bytes: a float per label instead of a byte
        Part(LABEL, mesh.vertex_count, 1, "<f4", (labels for _, _, labels in mesh.vertices())),
        Part("", 3 * mesh.face_count, 1, "<u4", mesh.faces()),
    ]
    primitive, extras = {"mode": 4, "material": 0}, {"materials": [material()]}
    write_primitive(path, parts, primitive, class_names, {"name": "mesh"}, extras, [UNLIT])


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """vertices (V, 3) float32, labels (V,) uint8 (255 = no class), texture (H, W, 3) uint8.

    corner_vertex (K,) int64 and corner_uv (K, 2) float32: a vertex has as many corners as charts meet there; u to the
    right and v downwards from the texture's top left, 0..1. faces (F, 3) int32 are corners.
    """

    vertices: NDArray[np.float32]
    labels: NDArray[np.uint8]
    corner_vertex: NDArray[np.int64]
    corner_uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    texture: NDArray[np.uint8]

    def __post_init__(self) -> None:
        v, k = len(self.vertices), len(self.corner_vertex)
        expected = {"vertices": (v, 3), "labels": (v,), "corner_uv": (k, 2), "faces": (len(self.faces), 3)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"TexturedMesh: {name}: got shape {getattr(self, name).shape}, expected {shape}")
        if not len(self.faces):
            raise ValueError("TexturedMesh: it has no faces")
        for name, indices, most in (("corner", self.faces, k), ("vertex", self.corner_vertex, v)):
            if not 0 <= indices.min() <= indices.max() < most:
                raise ValueError(f"TexturedMesh: a {name} is outside the {most} there are")


def write_textured_glb(path: Path, mesh: TexturedMesh, class_names: tuple[str, ...] = ()) -> None:
    """Write a GLB with the texture as a JPEG, shown as it is (KHR_materials_unlit), labels as attribute _LABEL.

    glTF wants y up: the caller turns the vertices. The same mesh gives the same bytes. Raises InputError when the disk
    refuses.
    """
    parts = [
        Part.of("POSITION", mesh.vertices[mesh.corner_vertex]),
        Part.of("TEXCOORD_0", mesh.corner_uv),
        Part.of(LABEL, mesh.labels[mesh.corner_vertex].astype(np.float32)),
        Part.of("", mesh.faces.reshape(-1).astype(np.uint32)),
    ]
    extras = {
        "materials": [material(baseColorTexture={"index": 0})],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPPED, "wrapS": _CLAMPED, "wrapT": _CLAMPED}],
        "images": [{"bufferView": len(parts), "mimeType": "image/jpeg"}],
    }
    picture = jpeg_bytes(mesh.texture)
    write_primitive(path, parts, {"material": 0}, class_names, {"name": "mesh"}, extras, [UNLIT], picture)


def read_textured_glb(path: Path) -> TexturedMesh | None:
    """Read a mesh by `write_textured_glb`, every corner a vertex of its own; None where it has no texture, as those by
    `write_mesh_glb`. Raises InputError for another file."""
    data = read_bytes(path)
    with parsing(path, "mesh", "export it again"):
        document, binary = _document_and_buffer(data)
        if "textures" not in document:
            return None
        parts = [binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in document["bufferViews"]]
        places, uv, labels = (np.frombuffer(part, "<f4") for part in parts[:3])
        faces = np.frombuffer(parts[3], "<u4").reshape(-1, 3).astype(np.int32)
        own = np.arange(len(labels))
        picture = decode_rgb(parts[4], str(path))
        return TexturedMesh(places.reshape(-1, 3), labels.astype(np.uint8), own, uv.reshape(-1, 2), faces, picture)


def _document_and_buffer(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, _, length, kind = struct.unpack_from("<4s4I", data)
    after = 20 + length
    binary_length, binary_kind = struct.unpack_from("<II", data, after)
    if (magic, version, kind, binary_kind) != (b"glTF", 2, _JSON, _BINARY):
        raise ValueError("it is no GLB of version 2, of a document and its bytes")
    return json.loads(data[20:after]), data[after + 8 : after + 8 + binary_length]
