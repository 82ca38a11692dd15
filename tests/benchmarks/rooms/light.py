"""Light and pictures of a room: soft light baked into the vertices, pictures by ray casting, with exact depth.

Needs `embreex` (`pip install embreex`).
"""

import math
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .surfaces import Surfaces
from .textures import linear

_CELL, _RAYS, _BOUNCES = 0.09, 40, 3
_LONGEST_EDGE = 0.3
_SUB = np.array([[0, 0], [-0.33, 0.17], [0.25, -0.33], [0.3, 0.33]])
"""Places of the rays in a pixel."""
_LEVELS = 9
_WEAR = np.array([0.008, 0.032, 0.13], np.float32)
"""Metres between the places of a worn wall's three sizes of unevenness."""
Array = NDArray[np.float32]


class LitRoom:
    """The triangles with their light; casts rays. Where it is not `lit` it can `cast`, `measure` and find distances."""

    def __init__(self, surfaces: Surfaces, lit: bool = True) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        columns = [np.concatenate(c) for c in zip(*surfaces.parts, strict=True)]
        points, normals, places, material, label = _halved(columns)
        flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        area = np.linalg.norm(flat, axis=1)
        good = area > 1e-12
        flat, area = flat[good] / area[good, None], area[good]
        points, normals, places = points[good], normals[good], places[good]
        self.points, self.places, self.flat = (np.ascontiguousarray(a, np.float32) for a in (points, places, flat))
        self.material, self.label = material[good].astype(np.int32), label[good].astype(np.int32) % 256
        self.thing = label[good].astype(np.int32) // 256
        self.normals = _repaired(normals, flat)
        self.scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self.scene, self.points)
        a, b = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
        spread = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / np.maximum(area, 1e-14)
        self.density = np.sqrt(spread).astype(np.float32)
        self.rgb = np.array([m.rgb for m in surfaces.materials], np.float32)
        self.emission = np.array([m.emission for m in surfaces.materials], np.float32)
        self.gloss = np.array([m.gloss for m in surfaces.materials], np.float32)
        self.wear = np.array([m.wear for m in surfaces.materials], np.float32)
        self.lights = surfaces.lights
        if lit:
            self._store_textures(surfaces)
            self.light = self._bake()

    def _store_textures(self, surfaces: Surfaces) -> None:
        """Textures with all their smaller levels in one array; the mean colour of each material."""
        index: dict[int, int] = {}
        values, offsets, means, place = [], [], [], 0
        for texture in surfaces.textures:
            if id(texture) in index:
                continue
            index[id(texture)] = len(offsets)
            image, places = linear(texture), []
            means.append(np.clip(image.reshape(-1, 3).mean(0), 0, 0.85))
            for _ in range(_LEVELS):
                places.append(place)
                values.append(image.reshape(-1))
                place += image.size
                side = image.shape[0] // 2
                if side:
                    image = image.reshape(side, 2, side, 2, 3).mean((1, 3)).astype(np.float32)
            offsets.append(places)
        number = [-1 if m.texture < 0 else index[id(surfaces.textures[m.texture])] for m in surfaces.materials]
        self.texture = np.array(number, np.int64)
        self.offsets = np.array(offsets or [[0] * _LEVELS], np.int64)
        self.texels = np.concatenate(values) if values else np.zeros(3, np.float32)
        self.albedo = np.clip(self.rgb, 0, 0.85)
        for k, n in enumerate(number):
            if n >= 0:
                self.albedo[k] = means[n]

    def cast(self, origins: Array, directions: Array) -> dict[str, Any]:
        """What rays (N, 3) hit: primID, u, v, tfar."""
        origins = np.ascontiguousarray(np.broadcast_to(origins.astype(np.float32), directions.shape))
        directions = np.ascontiguousarray(directions, np.float32)
        found: dict[str, Any] = self.scene.run(origins, directions, query="INTERSECT", output=True)
        return found

    def distance(self, origin: NDArray, directions: NDArray) -> NDArray:
        """(N,) metres to what is hit; 1000 where nothing is."""
        hit = self.cast(np.asarray(origin), directions)
        return np.where(hit["primID"] >= 0, hit["tfar"], 1e3)

    def photograph(
        self, world_from_cam: NDArray, width: int, height: int, focal: float, rays: int = 3
    ) -> tuple[Array, Array, NDArray[np.uint8]]:
        """(h, w, 3) linear light, (h, w) depth (0: nothing) and (h, w) class (255: nothing) from a pose (x right, y
        down, z forward), or from one of each ray and row (rays, h, 4, 4)."""
        ways, origins, length = _rays(world_from_cam, width, height, focal, rays)
        hit = self.cast(origins, ways)
        color = self._color(hit, ways, focal)
        self._add_mirrored(color, hit, origins, ways, focal)
        mean = color.reshape(rays, height, width, 3).mean(0)
        return mean, *self._first_hit(hit, length, (height, width))

    def measure(
        self, world_from_cam: NDArray, width: int, height: int, focal: float
    ) -> tuple[Array, NDArray[np.uint8]]:
        """Depth and class alone of `photograph`."""
        ways, origins, length = _rays(world_from_cam, width, height, focal, 1)
        return self._first_hit(self.cast(origins, ways), length, (height, width))

    def things(self, world_from_cam: NDArray, width: int, height: int, focal: float) -> NDArray[np.uint16]:
        """(h, w) number of the thing that is seen; 0 for walls, floors, ceilings, windows and doors."""
        ways, origins, _ = _rays(world_from_cam, width, height, focal, 1)
        hit = self.cast(origins, ways)["primID"]
        return np.where(hit >= 0, self.thing[np.maximum(hit, 0)], 0).reshape(height, width).astype(np.uint16)

    def _first_hit(
        self, hit: dict[str, Any], length: NDArray, size: tuple[int, int]
    ) -> tuple[Array, NDArray[np.uint8]]:
        first = size[0] * size[1]
        one = hit["primID"][:first]
        depth = np.where(one >= 0, hit["tfar"][:first] / length[:first], 0).astype(np.float32)
        seen = np.where(one >= 0, self.label[np.maximum(one, 0)], 255).astype(np.uint8)
        return depth.reshape(size), seen.reshape(size)

    def _color(self, hit: dict[str, Any], ways: Array, focal: float) -> Array:
        out = np.zeros((len(ways), 3), np.float32)
        u, v, t = (np.ascontiguousarray(hit[k], np.float32) for k in ("u", "v", "tfar"))
        _shade(
            np.ascontiguousarray(hit["primID"], np.int32), u, v, t, ways, self.flat, self.places, self.light,
            self.material, self.rgb, self.texture, self.emission, self.density, self.texels, self.offsets, focal,
            self.points, self.wear, out,
        )  # fmt: skip
        return out

    def _add_mirrored(self, color: Array, hit: dict[str, Any], origins: Array, ways: Array, focal: float) -> None:
        """What is seen in glossy floors and glass, more at a glancing angle (Schlick)."""
        prim = np.asarray(hit["primID"])
        gloss = np.where(prim >= 0, self.gloss[self.material[np.maximum(prim, 0)]], 0)
        at = np.flatnonzero(gloss > 0)
        if len(at) == 0:
            return
        normal = self.flat[prim[at]]
        facing = (normal * ways[at]).sum(1, keepdims=True)
        mirrored = np.ascontiguousarray(ways[at] - 2 * facing * normal, np.float32)
        start = origins[at] + ways[at] * np.asarray(hit["tfar"])[at, None] + mirrored * np.float32(1e-3)
        share = gloss[at, None] + (1 - gloss[at, None]) * (1 - np.abs(facing)) ** 5
        share = np.minimum(share, 0.6).astype(np.float32)
        color[at] = color[at] * (1 - share) + share * self._color(self.cast(start, mirrored), mirrored, focal)

    # light ------------------------------------------------------------------------------------------------------

    def _bake(self) -> Array:
        """(2, F, 3, 3) light that falls on the corners of both sides: gathered for clusters of like places and
        normals, passed on a few times, smoothed."""
        rng = np.random.default_rng(1)
        corners, normals = self.points.reshape(-1, 3), self.normals.reshape(-1, 3)
        face = np.repeat(np.arange(len(self.points)), 3)
        inside = corners + (np.repeat(self.points.mean(1), 3, 0) - corners) * 0.03
        first, cluster = _clusters(corners, normals)
        at = _Places(inside[first], normals[first], self.flat[face[first]], self.material[face[first]])
        direct, hits, hidden = self._gathered(at, cluster.reshape(-1, 3), rng)
        count, albedo = len(first), self.albedo[at.material]
        ambient, light, sent = 0.02 * direct.mean(), direct.copy(), np.zeros((2 * count + 1, 3), np.float32)
        for _ in range(_BOUNCES):
            sent[:-1] = (np.transpose(light, (1, 0, 2)) * albedo[:, None]).reshape(-1, 3)
            for side in (0, 1):
                light[side] = direct[side] + sent[hits[side]].mean(1) + ambient
        return _smoothed(light, hidden, at, corners, normals)

    def _gathered(self, at: "_Places", clusters: NDArray, rng: np.random.Generator) -> tuple[Array, NDArray, NDArray]:
        """Of both sides of the places: light straight from lights (2, K, 3); the cluster and side that each ray hits
        (2, K, R), -1 for none; whether it is inside of something."""
        count = len(at.point)
        direct, hits = np.zeros((2, count, 3), np.float32), np.empty((2, count, _RAYS), np.int32)
        hidden = np.zeros((2, count), bool)
        for side in (0, 1):
            normal, flat = at.normal * (1 - 2 * side), at.flat * (1 - 2 * side)
            ways = _around(normal, rng)
            start = (at.point + 1e-3 * flat).astype(np.float32)
            hit = self.cast(np.repeat(start, _RAYS, 0), ways)
            prim = np.maximum(hit["primID"], 0)
            corner = np.where(hit["u"] > 0.5, 1, np.where(hit["v"] > 0.5, 2, 0))
            back = (self.flat[prim] * ways).sum(1) > 0
            found = np.where(hit["primID"] >= 0, clusters[prim, corner] * 2 + back, -1)
            hits[side] = found.reshape(count, _RAYS)
            near = (hit["primID"] >= 0) & (hit["tfar"] < 0.02)
            hidden[side] = near.reshape(count, _RAYS).mean(1) > 0.6
            for light in self.lights:
                direct[side] += self._from_light(start, normal, light, rng)
        return direct, hits, hidden

    def _from_light(self, start: Array, normal: Array, light: tuple, rng: np.random.Generator) -> Array:
        corner, a, b, radiance = light
        n, count = 9, len(start)
        area = np.linalg.norm(np.cross(a, b))
        facing, jitter, i = np.cross(a, b) / area, rng.random((count, n, 2)), np.arange(n)
        place = corner + ((i % 3 + jitter[..., 0]) / 3)[..., None] * a + ((i // 3 + jitter[..., 1]) / 3)[..., None] * b
        way = place - start[:, None]
        squared = (way * way).sum(-1)
        far = np.sqrt(squared)
        way = way / far[..., None]
        here, there = (way * normal[:, None]).sum(-1), np.abs((way * facing).sum(-1))
        good, value = (here > 0) & (there > 0), np.zeros((count, n), np.float32)
        if good.any():
            origins = np.ascontiguousarray(np.broadcast_to(start[:, None], way.shape)[good], np.float32)
            ways, until = np.ascontiguousarray(way[good], np.float32), (far[good] * 0.998 - 3e-3).astype(np.float32)
            free = self.scene.run(origins, ways, until, query="OCCLUDED") != 0
            value[good] = (here * there / np.maximum(squared, 0.02))[good] * free
        return (value.mean(1) * area / np.pi)[:, None] * radiance.astype(np.float32)


def _rays(world_from_cam: NDArray, width: int, height: int, focal: float, rays: int) -> tuple[Array, Array, NDArray]:
    """Of each ray of each pixel (rays * h * w): direction, origin, and length of what has depth 1."""
    v, u = np.mgrid[0:height, 0:width] + 0.5
    x = [(u + a - width / 2) / focal for a, _ in _SUB[:rays]]
    y = [(v + b - height / 2) / focal for _, b in _SUB[:rays]]
    ways = np.stack([np.stack([a, b, np.ones_like(a)], -1) for a, b in zip(x, y, strict=True)])
    length = np.linalg.norm(ways, axis=-1, keepdims=True)
    poses = np.broadcast_to(world_from_cam, (rays, height, 4, 4))
    turned = (ways / length) @ poses[..., :3, :3].swapaxes(-1, -2)
    origins = np.broadcast_to(poses[:, :, None, :3, 3], ways.shape).astype(np.float32)
    return np.ascontiguousarray(turned, np.float32).reshape(-1, 3), origins.reshape(-1, 3), length.reshape(-1)


class _Places:
    """Where light is gathered: points, their normals, the normals of their triangles, their materials."""

    def __init__(self, point: Array, normal: Array, flat: Array, material: NDArray[np.int32]) -> None:
        self.point, self.normal, self.flat, self.material = point, normal, flat, material


def _clusters(corners: Array, normals: Array) -> tuple[NDArray, NDArray]:
    """The first corner of each cluster, and the cluster of each corner."""
    rough = np.round(normals * 1.5).astype(int)
    height = (corners * rough).sum(1) / np.maximum(np.linalg.norm(rough, axis=1), 1e-9)
    keys = np.concatenate([np.round(corners / _CELL), rough, np.round(height / (_CELL * 0.5))[:, None]], 1).astype(int)
    keys -= keys.min(0)
    _, first, cluster = np.unique(
        np.ravel_multi_index(tuple(keys.T), tuple(keys.max(0) + 1)), return_index=True, return_inverse=True
    )
    return first, cluster


def _around(normal: Array, rng: np.random.Generator) -> Array:
    """(K * R, 3) rays from each place, cosine-distributed around its normal."""
    count, side, i = len(normal), math.ceil(math.sqrt(_RAYS)), np.arange(_RAYS)
    u = ((i % side) + rng.random((count, _RAYS))) / side
    v = ((i // side) + rng.random((count, _RAYS))) / math.ceil(_RAYS / side)
    radius, angle = np.sqrt(np.minimum(v, 1)), 2 * np.pi * u
    helper = np.where(np.abs(normal[:, :1]) > 0.9, [[0, 1.0, 0]], [[1.0, 0, 0]])
    x = np.cross(normal, helper)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normal, x)
    flat = (radius * np.cos(angle))[..., None] * x[:, None] + (radius * np.sin(angle))[..., None] * y[:, None]
    ways = flat + np.sqrt(np.maximum(0, 1 - radius**2))[..., None] * normal[:, None]
    return np.ascontiguousarray(ways.reshape(-1, 3), np.float32)


def _smoothed(light: Array, hidden: NDArray, at: _Places, corners: Array, normals: Array) -> Array:
    keys = np.concatenate([at.point / _CELL, at.normal * 4], 1)
    tree = cKDTree(keys)
    far, near = tree.query(keys, k=min(12, len(keys)))
    weight = np.exp(-0.5 * (far / 1.3) ** 2)
    far, of_corner = tree.query(np.concatenate([corners / _CELL, normals * 4], 1), k=4)
    share = np.exp(-0.5 * (far / 0.7) ** 2) + 1e-9
    share /= share.sum(1, keepdims=True)
    sides = []
    for side in (0, 1):
        w = weight * np.where(hidden[side][near], 1e-3, 1)
        smooth = (light[side][near] * w[..., None]).sum(1) / w.sum(1)[:, None]
        sides.append((smooth[of_corner] * share[..., None]).sum(1).reshape(-1, 3, 3))
    return np.ascontiguousarray(np.stack(sides), np.float32)


def _halved(columns: list[NDArray]) -> list[NDArray]:
    """Triangles split until no edge is long; places, normals, materials and classes with them."""
    done: list[list[NDArray]] = []
    while len(columns[0]):
        points = columns[0]
        edges = np.stack([np.linalg.norm(points[:, (i + 1) % 3] - points[:, i], axis=1) for i in range(3)], 1)
        long = edges.max(1) > _LONGEST_EDGE
        done.append([c[~long] for c in columns])
        columns, start = [c[long] for c in columns], edges[long].argmax(1)
        row, end, other = np.arange(len(start)), (start + 1) % 3, (start + 2) % 3

        def halves(a: NDArray, row: NDArray = row, i: NDArray = start, j: NDArray = end, k: NDArray = other) -> NDArray:
            if a.ndim == 1:
                return np.concatenate([a, a])
            middle = (a[row, i] + a[row, j]) / 2
            first, second = (a[row, i], middle, a[row, k]), (middle, a[row, j], a[row, k])
            return np.concatenate([np.stack(first, 1), np.stack(second, 1)])

        columns = [halves(c) for c in columns]
    return [np.concatenate(parts) for parts in zip(*done, strict=True)]


def _repaired(normals: NDArray, flat: NDArray) -> NDArray[np.float32]:
    """Normals of length 1 on the side of their triangles."""
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), flat[:, None])
    against = (normals * flat[:, None]).sum(2) < 0
    normals = np.where((against.sum(1) >= 2)[:, None, None], -normals, normals)
    askew = (normals * flat[:, None]).sum(2) < 0.15
    return np.where(askew[..., None], flat[:, None], normals).astype(np.float32)


@numba.njit(cache=True, error_model="numpy")
def _fetch(texels: Array, start: int, side: int, u: float, v: float, out: Array) -> None:
    x, y = (u - math.floor(u)) * side - 0.5, (v - math.floor(v)) * side - 0.5
    left, top = math.floor(x), math.floor(y)
    fx, fy = x - left, y - top
    right, below = (left + 1) % side, (top + 1) % side
    left, top = left % side, top % side
    for c in range(3):
        a = texels[start + (top * side + left) * 3 + c] * (1 - fx) + texels[start + (top * side + right) * 3 + c] * fx
        b = texels[start + (below * side + left) * 3 + c] * (1 - fx)
        b += texels[start + (below * side + right) * 3 + c] * fx
        out[c] = a * (1 - fy) + b * fy


@numba.njit(cache=True, error_model="numpy")
def _unevenness(at: Array) -> float:
    """Smooth chance in -1..1 by place (3,), the same nowhere else."""
    x, y, z = math.floor(at[0]), math.floor(at[1]), math.floor(at[2])
    fx, fy, fz = at[0] - x, at[1] - y, at[2] - z
    fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    total = 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        h = np.uint32((x + i) * 73856093 ^ (y + j) * 19349663 ^ (z + k) * 83492791)
        h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x45D9F3B))
        h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x45D9F3B))
        h ^= h >> np.uint32(16)
        weight = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
        total += weight * (np.float64(h) / 2147483648.0 - 1)
    return total


@numba.njit(cache=True, error_model="numpy")
def _shade(
    prim, bu, bv, far, ways, flat, places, light, material, rgb, texture, emission, density, texels, offsets, focal,
    points, wear, out,
):  # type: ignore[no-untyped-def]  # fmt: skip
    """Colour (N, 3) of what rays hit: texture or colour times the light on that side, and what it gives off."""
    fine, coarse = np.zeros(3, np.float32), np.zeros(3, np.float32)
    for i in range(len(prim)):
        p = prim[i]
        if p < 0:
            continue
        m, a, b = material[p], bu[i], bv[i]
        c = 1 - a - b
        facing = flat[p, 0] * ways[i, 0] + flat[p, 1] * ways[i, 1] + flat[p, 2] * ways[i, 2]
        side = 1 if facing > 0 else 0
        k = texture[m]
        if k >= 0:
            u = places[p, 0, 0] * c + places[p, 1, 0] * a + places[p, 2, 0] * b
            v = places[p, 0, 1] * c + places[p, 1, 1] * a + places[p, 2, 1] * b
            foot = far[i] / focal * 0.6 / math.sqrt(max(abs(facing), 0.05)) * density[p]
            level = min(max(math.log2(max(foot * 256.0, 1e-6)), 0.0), 8.0)
            low = int(level)
            high = min(low + 1, 8)
            _fetch(texels, offsets[k, low], 256 >> low, u, v, fine)
            _fetch(texels, offsets[k, high], 256 >> high, u, v, coarse)
        worn = 1.0
        if wear[m] > 0:
            foot = far[i] / focal / math.sqrt(max(abs(facing), 0.05))
            at = points[p, 0] * c + points[p, 1] * a + points[p, 2] * b
            for size in _WEAR:
                worn += wear[m] * min(max(size / (2 * foot) - 0.5, 0.0), 1.0) * _unevenness(at / size)
        for n in range(3):
            tone = rgb[m, n]
            if k >= 0:
                tone = (fine[n] + (level - low) * (coarse[n] - fine[n])) * worn
            lit = light[side, p, 0, n] * c + light[side, p, 1, n] * a + light[side, p, 2, n] * b
            out[i, n] = min(tone * (lit + emission[m, n]), 4.0)
