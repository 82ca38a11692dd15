"""A world ready to be looked at: solids, their pictures with the light baked in, and their classes."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.world import pictures, textures
from tests.world.cast import SolidArrays, pack_solids
from tests.world.light import Light, bake_light
from tests.world.shapes import FACE_COUNT, Material, Solid

_PAINTERS: dict[str, textures.Painter] = {
    name: getattr(module, name)
    for module, names in (
        (textures, "plain plaster speckle wallpaper bricks tiles planks wood fabric foliage rug"),
        (pictures, "poster books door window cardboard glow beams"),
    )
    for name in names.split()
}
_EXPOSED_MEAN = 0.2


@dataclass(frozen=True)
class Atlas:
    """All pictures in one row of bytes, coded as 255 sqrt(linear light), each with its mip levels.

    codes (bytes,) uint8; levels (F, L, 3) int64 offset, height, width; level_count (F,); texel (F,) metres of level 0.
    """

    codes: NDArray[np.uint8]
    levels: NDArray[np.int64]
    level_count: NDArray[np.int64]
    texel: NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """What a layout hands over: solids, lights, class names and colours (class 0 is "none")."""

    solids: list[Solid]
    lights: list[Light]
    class_names: tuple[str, ...]
    class_colors: tuple[tuple[int, int, int], ...]


@dataclass(frozen=True)
class World:
    """A scene with exact truth. labels (S,) uint8: class of every solid, an index into class_names.

    gloss: the share of the light from above that a floor at z = 0 mirrors, of what falls straight onto it.
    """

    layout: str
    solids: SolidArrays
    atlas: Atlas
    labels: NDArray[np.uint8]
    class_names: tuple[str, ...]
    class_colors: tuple[tuple[int, int, int], ...]
    gloss: float = 0.0

    def without(self, name: str) -> World:
        """The world less the solids of one class."""
        kept = self.labels != self.class_names.index(name)
        arrays = {f.name: getattr(self.solids, f.name)[kept] for f in fields(self.solids)}
        return replace(self, solids=SolidArrays(**arrays), labels=self.labels[kept])


def build_world(layout: str, scene: Scene, seed: int, texel: float) -> World:
    """Paint every face, bake the light and pack everything for the caster."""
    arrays = pack_solids(scene.solids)
    # Small furniture is seen from near: its pictures are finer than those of walls.
    faces = [(s, f) for s in scene.solids for f in range(FACE_COUNT[s.shape])]
    painted = [_paint(s, f, i, seed, texel) for i, (s, f) in enumerate(faces)]
    albedo = np.array([p.mean(axis=(0, 1)) for p, _ in painted], np.float64)
    light = bake_light(scene.solids, arrays, scene.lights, albedo)
    gain = _EXPOSED_MEAN / _mean_brightness(faces, albedo, light)
    lit = [
        _lit(picture, shade * gain, s.face_material(f).emission)
        for (picture, _), shade, (s, f) in zip(painted, light, faces, strict=True)
    ]
    return World(
        layout=layout,
        solids=arrays,
        atlas=_pack_atlas(lit, [t for _, t in painted]),
        labels=np.array([scene.class_names.index(s.label) for s in scene.solids], np.uint8),
        class_names=scene.class_names,
        class_colors=scene.class_colors,
    )


def _paint(solid: Solid, face: int, index: int, seed: int, texel: float) -> tuple[NDArray[np.float32], float]:
    """(albedo (h, w, 3), texel in metres) of one face."""
    material: Material = solid.face_material(face)
    size = solid.face_size(face)
    own = texel * float(np.clip(np.sqrt(size[0] * size[1]) / 1.5, 0.5, 1.0))
    shape = max(2, round(size[0] / own)), max(2, round(size[1] / own))
    # A twin takes its picture from its kind and number alone, so that it repeats wherever it stands.
    key = [seed, zlib.crc32(material.kind.encode()), material.twin] if material.twin else [seed, 1, index]
    return _PAINTERS[material.kind](shape, own, material.color, np.random.default_rng(key)), own


def _mean_brightness(
    faces: list[tuple[Solid, int]], albedo: NDArray[np.float64], light: list[NDArray[np.float32]]
) -> float:
    """Mean leaving light over the area of everything that does not shine itself."""
    lit = [i for i, (s, f) in enumerate(faces) if s.face_material(f).emission == 0]
    areas = np.array([np.prod(faces[i][0].face_size(faces[i][1])) for i in lit])
    values = np.array([(albedo[i] * light[i].mean(axis=(0, 1))).mean() for i in lit])
    return float((areas * values).sum() / areas.sum())


def _lit(picture: NDArray[np.float32], light: NDArray[np.float32], emission: float) -> NDArray[np.uint8]:
    if emission > 0:
        leaving = picture * np.float32(emission)
    else:
        shade = cv2.resize(light, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_LINEAR)
        leaving = picture * shade.reshape(picture.shape)
    # A soft shoulder keeps the brightest places from burning out.
    leaving = np.where(leaving > 0.6, 0.6 + 0.4 * np.tanh((leaving - 0.6) / 0.4), leaving)
    return np.round(255 * np.sqrt(np.clip(leaving, 0, 1))).astype(np.uint8)


def _pack_atlas(pictures: list[NDArray[np.uint8]], texels: list[float]) -> Atlas:
    pyramids = [_pyramid(p) for p in pictures]
    counts = np.array([len(p) for p in pyramids], np.int64)
    levels = np.zeros((len(pyramids), int(counts.max()), 3), np.int64)
    offset = 0
    for i, pyramid in enumerate(pyramids):
        for k, level in enumerate(pyramid):
            levels[i, k] = offset, level.shape[0], level.shape[1]
            offset += level.size
    codes = np.concatenate([level.ravel() for pyramid in pyramids for level in pyramid])
    return Atlas(codes, levels, counts, np.array(texels, np.float64))


def _pyramid(picture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    levels = [picture]
    while min(levels[-1].shape[:2]) >= 4 and len(levels) < 8:
        h, w = levels[-1].shape[:2]
        levels.append(np.asarray(cv2.resize(levels[-1], (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.uint8))
    return levels
