"""What a world is made of: boxes, spheres and standing cylinders with a material on every face.

World axes: z up, metres, the floor at z = 0. A face is a rectangle of texture coordinates (u, v) in 0..1, v downwards
as in an image, u to the right for somebody who looks at the outside of the solid.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

ROOM, BOX, SPHERE, CYLINDER = 0, 1, 2, 3
FACE_COUNT = {ROOM: 6, BOX: 6, SPHERE: 1, CYLINDER: 3}
RIGHT, LEFT, BACK, FRONT, TOP, BOTTOM = range(6)
"""Faces of a box by their outward normal: +x, -x, +y, -y, +z, -z. Of a cylinder: side, top, bottom."""


@dataclass(frozen=True)
class Material:
    """`kind` names a texture; `color` linear RGB 0..1; `emission` > 0 shines by itself and takes no shade."""

    kind: str
    color: tuple[float, float, float]
    emission: float = 0.0
    twin: int = 0
    """Equal non-zero twins of one kind have the same picture: for worlds that repeat themselves."""


@dataclass(frozen=True)
class Solid:
    """One convex solid. size: full extents (x, y, z) before `yaw` (radians about z); a sphere or cylinder uses x as
    its diameter. `faces` overrides the material of single faces. A ROOM is a box seen from inside."""

    shape: int
    label: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    material: Material
    yaw: float = 0.0
    faces: Mapping[int, Material] = field(default_factory=dict)

    def face_material(self, face: int) -> Material:
        """The material of one face."""
        return self.faces.get(face, self.material)

    def face_size(self, face: int) -> tuple[float, float]:
        """(height, width) of the face in metres, unrolled where it is round."""
        x, y, z = self.size
        if self.shape == SPHERE:
            return np.pi * x / 2, np.pi * x
        if self.shape == CYLINDER:
            return (z, np.pi * x) if face == 0 else (x, x)
        return {RIGHT: (z, y), LEFT: (z, y), BACK: (z, x), FRONT: (z, x)}.get(face, (y, x))


def box(
    label: str,
    center: tuple[float, float, float],
    size: tuple[float, float, float],
    material: Material,
    yaw: float = 0.0,
    faces: Mapping[int, Material] | None = None,
) -> Solid:
    """A box by its centre."""
    return Solid(BOX, label, center, size, material, yaw, faces or {})


def sphere(label: str, center: tuple[float, float, float], diameter: float, material: Material) -> Solid:
    """A ball."""
    return Solid(SPHERE, label, center, (diameter, diameter, diameter), material)


def cylinder(label: str, foot: tuple[float, float, float], diameter: float, height: float, material: Material) -> Solid:
    """A standing cylinder by the centre of its foot."""
    center = (foot[0], foot[1], foot[2] + height / 2)
    return Solid(CYLINDER, label, center, (diameter, diameter, height), material)


def turned(x: float, y: float, yaw: float, origin: tuple[float, float]) -> tuple[float, float]:
    """Floor point (x, y) of a piece of furniture that stands at `origin`, turned by `yaw`."""
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return origin[0] + c * x - s * y, origin[1] + s * x + c * y
