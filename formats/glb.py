"""GLB: glTF's document and its one buffer in a file; meshes in it, a node a class, with vertex colours or a texture."""

from __future__ import annotations

import itertools
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .image_tags import light_of_srgb, srgb_of
from .images import decode_rgb, jpeg_bytes
from .ply import normal_sums
from .reading import parsing, read_bytes

_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"|u1": 5121, "<u4": 5125, "<f4": 5126}
_VERTICES, _INDICES = 34962, 34963
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_LINEAR, _MIPMAPPED, _CLAMPED = 9729, 9987, 33071
UNLIT = "KHR_materials_unlit"
LABEL = "_LABEL"
"""Attribute of the class numbers."""
_UNNAMED, _HIDDEN = "unknown", "hidden"


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
) -> None:
    """Write a scene of one mesh that is one `primitive` of these parts, as `write_primitives` does; `name` of mesh and
    node."""
    write_primitives(path, [(name, parts)], primitive, class_names, extras, extensions)


def write_primitives(
    path: Path,
    nodes: Sequence[tuple[dict[str, Any], Sequence[Part]]],
    primitive: dict[str, Any],
    class_names: Sequence[str],
    extras: dict[str, Any] | None = None,
    extensions: Sequence[str] = (),
    picture: bytes = b"",
) -> None:
    """Write a scene of `nodes`, each a name and the parts of a mesh that is one `primitive`; class names in the meshes'
    extras, `extras` of the document; the bytes of a `picture` are in the buffer view after the parts. Raises ValueError
    where a part's blocks are not as long as it says, InputError when the disk refuses."""
    parts, meshes = [part for _, of_node in nodes for part in of_node], []
    starts = np.cumsum([0, *(part.nbytes for part in parts), len(picture)]).tolist()
    views: list[dict[str, Any]] = [{"buffer": 0, "byteOffset": a, "byteLength": b - a} for a, b in pairwise(starts)]
    for view, part in zip(views, parts, strict=False):
        view["target"] = _VERTICES if part.name else _INDICES
    rows = itertools.count()
    for name, of_node in nodes:
        row_of = {part.name: next(rows) for part in of_node}
        indices = {"indices": row_of.pop("")} if "" in row_of else {}
        whole = {"attributes": row_of, **indices, **primitive}
        meshes.append({"primitives": [whole], **name, "extras": {"classes": list(class_names)}})
    document = glb_document(
        {"extensionsUsed": list(extensions)} if extensions else {},
        meshes,
        [name for name, _ in nodes],
        extras or {},
        [{"bufferView": i, **part.accessor()} for i, part in enumerate(parts)],
        views if picture else views[: len(parts)],
        starts[-1],
    )
    write_glb(path, document, parts, picture)


def glb_document(
    extensions: dict[str, Any],
    meshes: Sequence[dict[str, Any]],
    nodes: Sequence[dict[str, Any]],
    extras: dict[str, Any],
    accessors: list[dict[str, Any]],
    views: list[dict[str, Any]],
    length: int,
) -> dict[str, Any]:
    """Return the document of a scene of meshes, each in a node of its own, over a buffer of `length` bytes."""
    return {
        "asset": {"version": "2.0", "generator": "msgs-slam"},
        **extensions,
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": [{"mesh": number, **node} for number, node in enumerate(nodes)],
        "meshes": list(meshes),
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


@dataclass(frozen=True, eq=False)
class ClassMesh:
    """vertices (V, 3) float32 with colors (V, 3) uint8; labels (F,) uint8 of the faces (255 = no class), which of them
    are `hidden`, seen by no keyframe, and numbers of their `things`, 0 for none; texture (H, W, 3) uint8, empty for the
    vertices' colours.

    corner_vertex (K,) int64 and corner_uv (K, 2) float32: a vertex has as many corners as charts meet there; u to the
    right and v downwards from the texture's top left, 0..1. faces (F, 3) int32 are corners.
    """

    vertices: NDArray[np.float32]
    colors: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    corner_vertex: NDArray[np.int64]
    corner_uv: NDArray[np.float32]
    faces: NDArray[np.int32]
    texture: NDArray[np.uint8]
    hidden: NDArray[np.bool_] | None = None
    things: NDArray[np.uint16] | None = None

    def __post_init__(self) -> None:
        v, k, f = len(self.vertices), len(self.corner_vertex), len(self.faces)
        if not f:
            raise ValueError("ClassMesh: it has no faces, and glTF has no way to store that")
        expected = {"vertices": (v, 3), "colors": (v, 3), "labels": (f,), "corner_uv": (k, 2), "faces": (f, 3)}
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"ClassMesh: {name}: got shape {getattr(self, name).shape}, expected {shape}")
        for name, indices, most in (("corner", self.faces, k), ("vertex", self.corner_vertex, v)):
            if not 0 <= indices.min() <= indices.max() < most:
                raise ValueError(f"ClassMesh: a {name} is outside the {most} there are")

    @property
    def normals(self) -> NDArray[np.float32]:
        """Return (V, 3) unit normals of the vertices: means over the faces around, by their areas."""
        total = normal_sums(self.vertices.astype(np.float64), self.corner_vertex[self.faces])
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.where(length > 0, total / np.maximum(length, 1e-300), [0, 0, 1]).astype(np.float32)


def write_mesh_glb(
    path: Path, mesh: ClassMesh, class_names: tuple[str, ...] = (), thing_names: Mapping[int, str] | None = None
) -> None:
    """Write a GLB with a node for each thing, its number in the node's extras, and for each class of all else, named
    after them, the class's number as attribute _LABEL, and another one for what of them is hidden; shown as it is
    (KHR_materials_unlit), with the texture as a JPEG or with vertex colours.

    glTF wants y up: the caller turns the vertices. The same mesh gives the same bytes. Raises InputError when the disk
    refuses.
    """
    normals = mesh.normals
    nodes: list[tuple[dict[str, Any], list[Part]]] = []
    kinds = mesh.labels.astype(np.int64)
    kinds += 0 if mesh.hidden is None else 256 * mesh.hidden
    kinds += 0 if mesh.things is None else 512 * mesh.things.astype(np.int64)
    for kind in np.unique(kinds).tolist():
        label, thing = kind % 256, kind // 512
        name = class_names[label] if label < len(class_names) else _UNNAMED
        name = (thing_names or {}).get(thing, name)
        corners, faces = np.unique(mesh.faces[kinds == kind], return_inverse=True)
        vertex = mesh.corner_vertex[corners]
        shown = Part.of("TEXCOORD_0", mesh.corner_uv[corners])
        if not mesh.texture.size:
            shown = Part.of("COLOR_0", linear(mesh.colors[vertex] / 255))
        parts = [
            Part.of("POSITION", mesh.vertices[vertex]),
            Part.of("NORMAL", normals[vertex]),
            shown,
            # glTF wants every vertex at a multiple of 4 bytes: a float per label instead of a byte
            Part.of(LABEL, np.full(len(corners), label, np.float32)),
            Part.of("", faces.reshape(-1).astype(np.uint32)),
        ]
        of_thing = {"extras": {"thing": thing}} if thing else {}
        nodes.append(({"name": f"{name}, {_HIDDEN}" if kind // 256 % 2 else name, **of_thing}, parts))
    if not mesh.texture.size:
        write_primitives(path, nodes, {"material": 0}, class_names, {"materials": [material()]}, [UNLIT])
        return
    extras = {
        "materials": [material(baseColorTexture={"index": 0})],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPPED, "wrapS": _CLAMPED, "wrapT": _CLAMPED}],
        "images": [{"bufferView": 5 * len(nodes), "mimeType": "image/jpeg"}],
    }
    write_primitives(path, nodes, {"material": 0}, class_names, extras, [UNLIT], jpeg_bytes(mesh.texture))


def read_mesh_glb(path: Path) -> ClassMesh:
    """Read a mesh by `write_mesh_glb`, every corner a vertex of its own. Raises InputError for another file."""
    data = read_bytes(path)
    with parsing(path, "mesh", "export it again"):
        document, binary = _document_and_buffer(data)
        parts = [binary[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in document["bufferViews"]]
        columns: list[list[NDArray[Any]]] = [[], [], [], [], []]
        of_node_things = [int(node.get("extras", {}).get("thing", 0)) for node in document["nodes"]]
        hidden_nodes = [str(node.get("name", "")).endswith(f", {_HIDDEN}") for node in document["nodes"]]
        for first in range(0, 5 * len(document["meshes"]), 5):
            of_node = [np.frombuffer(part, "<f4") for part in parts[first : first + 4]]
            of_node.append(np.frombuffer(parts[first + 4], "<u4") + sum(map(len, columns[3])))
            for column, values in zip(columns, of_node, strict=True):
                column.append(values)
        rows = [len(column) // 3 for column in columns[4]]
        places, _, shown, labels, faces = (np.concatenate(column) for column in columns)
        faces, count = faces.reshape(-1, 3).astype(np.int32), len(labels)
        has_texture = "textures" in document
        colors = np.zeros((count, 3), np.uint8) if has_texture else srgb_of(shown.reshape(-1, 3))
        uv = shown.reshape(-1, 2) if has_texture else np.zeros((count, 2), np.float32)
        picture = decode_rgb(parts[-1], str(path)) if has_texture else np.zeros((0, 0, 3), np.uint8)
        of_faces = labels[faces[:, 0]].astype(np.uint8)
        hidden, things = np.repeat(hidden_nodes, rows), np.repeat(np.array(of_node_things, np.uint16), rows)
        return ClassMesh(places.reshape(-1, 3), colors, of_faces, np.arange(count), uv, faces, picture, hidden, things)


def _document_and_buffer(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, _, length, kind = struct.unpack_from("<4s4I", data)
    after = 20 + length
    binary_length, binary_kind = struct.unpack_from("<II", data, after)
    if (magic, version, kind, binary_kind) != (b"glTF", 2, _JSON, _BINARY):
        raise ValueError("it is no GLB of version 2, of a document and its bytes")
    return json.loads(data[20:after]), data[after + 8 : after + 8 + binary_length]
