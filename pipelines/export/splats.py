"""The map as splat files, upright in their viewers, and as 3D Tiles 1.1, of which a viewer loads what it looks at, as
fine as the screen shows.

Tiles are a binary tree: the Gaussians are halved along the longest side until a tile is small enough; what is above
stands for its two halves with fewer, larger Gaussians (`merged`). The file format is that of `write_compressed_glb`.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import require_room
from ...formats.gps import ecef_from_enu
from ...formats.splats import (
    COMPRESSION,
    EXTENSION,
    GaussianCloud,
    isotropic_cloud,
    write_compressed_glb,
    write_gaussian_glb,
    write_gaussian_ply,
    write_sog,
    write_spz,
)
from ...formats.textfile import write_json
from ..run.target import Target
from ..scene.world import Z_UP_FROM_Y_DOWN
from ..system.parallel import LruSequence
from ..types import Array
from .scene import ExportScene

_PART = 1 << 17
"""Gaussians of a part that is written at a time: a cloud takes more memory than the map it is of."""
TILES, TILESET = "tiles", "tileset.json"
MAX_GAUSSIANS = 50_000
"""Gaussians of a tile: half a megabyte."""
_MIN_BYTES = 16
"""That a Gaussian takes with what stands for it in coarser tiles; 21 in the rooms measured."""
_COARSER = 1.25
"""By which the cells grow until a tile's Gaussians are few enough."""
_CELL = 3.0
"""Side of the smallest cells that become one Gaussian, in median radii."""
_REACH = 3.0
"""Standard deviations of a Gaussian that lie in the tile's box."""
_MAX_OPAQUE = 0.99
_WIDEST = 0.5
"""Radius to which a merged Gaussian may grow, in sides of its cell."""


def write_splat_ply(scene: ExportScene, target: Target) -> None:
    """Write the map as splat PLYs in its own colours, with probabilities, and in those of the classes."""
    outcome = scene.outcome
    starts, names = range(0, max(len(outcome.require_map()), 1), _PART), outcome.classes.names
    clouds = LruSequence(len(starts), lambda n: scene.cloud(slice(starts[n], starts[n] + _PART)), len, 0)
    colors = (np.array(outcome.classes.colors) / 255).astype(np.float32)

    def by_class(_: int, cloud: GaussianCloud) -> GaussianCloud:
        return cloud if cloud.class_ids is None else replace(cloud, colors=colors[cloud.class_ids], class_probs=None)

    write_gaussian_ply(target.path("point_cloud.ply"), clouds, names)
    write_gaussian_ply(target.path("point_cloud_semantic.ply"), clouds.changed(by_class), names)


def write_small(scene: ExportScene, target: Target) -> None:
    """Write the map's colours as SPZ: a tenth of the space of the PLY, without classes."""
    write_spz(target.path("point_cloud.spz"), scene.cloud())


def write_smallest(scene: ExportScene, target: Target) -> None:
    """Write the map's colours as SOG: a fifteenth of the space of the PLY, without classes; nothing of an empty map."""
    if len(cloud := scene.cloud()):
        write_sog(target.path("point_cloud.sog"), cloud)


def write_gltf(scene: ExportScene, target: Target) -> None:
    """Write the map as glTF with KHR_gaussian_splatting; nothing of an empty map."""
    if len(cloud := scene.cloud()):
        write_gaussian_glb(target.path("point_cloud.glb"), cloud, scene.outcome.classes.names)


def write_tiles(scene: ExportScene, target: Target) -> None:
    """Write tiles/ and in it, last, tileset.json; nothing where there are no Gaussians. Raises DiskFullError before
    anything is made where there is no room for it."""
    m = scene.outcome.require_map()
    if len(m) == 0:
        return
    require_room(target.folder / TILES, _MIN_BYTES * len(m))
    cloud = replace(scene.cloud(), class_ids=None, class_probs=None)
    root, _ = _write_tile(cloud, folder := target.path(TILES), "tile")
    root["refine"], root["transform"] = "REPLACE", _earth_from_tiles(scene).ravel(order="F").tolist()
    splats = [EXTENSION, COMPRESSION]
    document = {
        "asset": {"version": "1.1", "extras": {"generator": "msgs-slam"}},
        "extensionsUsed": ["3DTILES_content_gltf"],  # by which CesiumJS knows Gaussians before it loads any
        "extensions": {"3DTILES_content_gltf": {"extensionsUsed": splats, "extensionsRequired": splats}},
        "geometricError": float(2 * np.max(root["boundingVolume"]["box"][3:])),
        "root": root,
    }
    write_json(folder / TILESET, document)


def _write_tile(cloud: GaussianCloud, folder: Path, name: str) -> tuple[dict[str, Any], GaussianCloud]:
    """The tile of a cloud (x right, y down, z forward) as tileset.json has it, and what its own file holds."""
    children, held, error = [], cloud, 0.0
    if len(cloud) > MAX_GAUSSIANS:
        along = cloud.means[:, int(np.ptp(cloud.means, axis=0).argmax())]
        order = np.argsort(along, kind="stable")
        halves = [
            _write_tile(cloud.only(np.sort(rows)), folder, f"{name}{number}")
            for number, rows in enumerate(np.array_split(order, 2))
        ]
        children = [tile for tile, _ in halves]
        held, error = _fewer(joined_clouds([part for _, part in halves]), max(c["geometricError"] for c in children))
    write_compressed_glb(folder / f"{name}.glb", held)
    means, reach = held.means @ Z_UP_FROM_Y_DOWN.T, _REACH * np.exp(held.log_scales[:, :1].astype(np.float64))
    low, high = (means - reach).min(axis=0), (means + reach).max(axis=0)
    for child in children:
        box = np.array(child["boundingVolume"]["box"])
        center, half = box[:3], box[[3, 7, 11]]
        low, high = np.minimum(low, center - half), np.maximum(high, center + half)
    tile: dict[str, Any] = {
        "boundingVolume": {"box": [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]},
        "geometricError": error,
        "content": {"uri": f"{name}.glb"},
    }
    return (tile | {"children": children} if children else tile), held


def _fewer(cloud: GaussianCloud, least: float) -> tuple[GaussianCloud, float]:
    """At most `MAX_GAUSSIANS` Gaussians, and the side of the cells, more than `least`, that each became one of them."""
    side = max(_CELL * float(np.median(np.exp(cloud.log_scales[:, 0]))), _COARSER * least)
    while len(few := merged(cloud, side)) > MAX_GAUSSIANS:
        side *= _COARSER
    return few, side


def joined_clouds(clouds: list[GaussianCloud]) -> GaussianCloud:
    """All of them in one, of isotropic ones without classes."""
    columns = ("means", "log_scales", "opacity_logits", "colors")
    means, scales, logits, colors = (np.concatenate([getattr(c, name) for c in clouds]) for name in columns)
    return isotropic_cloud(means, scales[:, 0], logits, colors)


def merged(cloud: GaussianCloud, side: float) -> GaussianCloud:
    """One Gaussian in place of those in each cell of a grid of that side.

    Each counts by its opacity times its area: means of place and colour; the radius takes in how they are spread; as
    opaque as their areas together would cover the new one's.
    """
    radii = np.exp(cloud.log_scales[:, 0].astype(np.float64))
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    _, cell = np.unique(np.floor(cloud.means / side).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    weight = opacity * radii**2 + 1e-30
    total = np.bincount(cell, weight)

    def mean(values: NDArray) -> Array:
        columns = values.reshape(len(values), -1)
        return np.stack([np.bincount(cell, weight * column) / total for column in columns.T], 1)

    center = mean(cloud.means)
    apart = np.square(cloud.means - center[cell]).sum(1) / 2  # they lie side by side on a surface, in two directions
    # A radius that cannot be opaque enough grows, but not over the cells beside it.
    radius = np.sqrt(mean(np.square(radii) + apart)[:, 0])
    radius = np.maximum(radius, np.minimum(np.sqrt(total / _MAX_OPAQUE), _WIDEST * side))
    covered = np.clip(total / radius**2, 1e-3, _MAX_OPAQUE)
    logits, colors = np.log(covered / (1 - covered)).astype(np.float32), mean(cloud.colors).astype(np.float32)
    return isotropic_cloud(center.astype(np.float32), np.log(radius).astype(np.float32), logits, colors)


def _earth_from_tiles(scene: ExportScene) -> Array:
    """(4, 4) to the Earth's centre where GPS tells the place; else to metres, as far as they are known."""
    if scene.world.earth is not None:
        return ecef_from_enu(np.array(scene.world.earth.origin))
    return np.diag([*[scene.metres_per_unit] * 3, 1.0])
