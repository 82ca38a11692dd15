"""Triangle meshes with a texture: OBJ + MTL + PNG, and GLB."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .atomic import write_text
from .glb import Part, write_primitive
from .images import jpeg_bytes, write_rgb

_UNLIT = "KHR_materials_unlit"
_LINEAR, _MIPMAPPED, _CLAMPED = 9729, 9987, 33071


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


def write_textured_obj(path: Path, mesh: TexturedMesh, class_names: tuple[str, ...] = ()) -> list[Path]:
    """The OBJ, its material and its image beside it, of the same stem; a group a class (of each face's first
    vertex). The same mesh gives the same bytes. Raises InputError when the disk refuses.
    """
    path = Path(path)
    material, picture = path.with_suffix(".mtl"), path.with_suffix(".png")
    write_rgb(picture, mesh.texture)
    shown = "Ka 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\n"  # the photographs hold the light already
    write_text(material, f"newmtl photographs\n{shown}map_Kd {picture.name}\n")
    names = [name.replace(" ", "_") for name in class_names]
    lines = [f"mtllib {material.name}", "usemtl photographs"]
    lines += ["v {:.6g} {:.6g} {:.6g}".format(*row) for row in mesh.vertices.tolist()]
    lines += [f"vt {u:.7f} {1 - v:.7f}" for u, v in mesh.corner_uv.tolist()]
    of_face = mesh.labels[mesh.corner_vertex[mesh.faces[:, 0]]]
    for label in np.unique(of_face):
        lines.append(f"g {names[label] if label < len(names) else 'unknown'}")
        faces = mesh.faces[of_face == label]
        pairs = np.stack([mesh.corner_vertex[faces], faces], axis=2).reshape(-1, 6) + 1
        lines += ["f {}/{} {}/{} {}/{}".format(*row) for row in pairs.tolist()]
    write_text(path, "\n".join(lines) + "\n")
    return [path, material, picture]


def write_textured_glb(path: Path, mesh: TexturedMesh, class_names: tuple[str, ...] = ()) -> None:
    """A GLB with the texture as a JPEG, shown as it is (KHR_materials_unlit), labels as attribute _LABEL.

    glTF wants y up: the caller turns the vertices. The same mesh gives the same bytes. Raises InputError when the disk
    refuses.
    """
    parts = [
        Part.of("POSITION", mesh.vertices[mesh.corner_vertex]),
        Part.of("TEXCOORD_0", mesh.corner_uv),
        Part.of("_LABEL", mesh.labels[mesh.corner_vertex].astype(np.float32)),
        Part.of("", mesh.faces.reshape(-1).astype(np.uint32)),
    ]
    shown = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}
    extras = {
        "materials": [{"pbrMetallicRoughness": shown, "extensions": {_UNLIT: {}}}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPPED, "wrapS": _CLAMPED, "wrapT": _CLAMPED}],
        "images": [{"bufferView": len(parts), "mimeType": "image/jpeg"}],
    }
    picture = jpeg_bytes(mesh.texture)
    write_primitive(path, parts, {"material": 0}, class_names, {"name": "mesh"}, extras, [_UNLIT], picture)
