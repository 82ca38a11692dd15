"""The map of a long recording as tiles, one a submap, each fine and coarse: a viewer loads what it looks at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from msgs_slam.formats.gaussian_ply import write_gaussian_ply
from msgs_slam.formats.gaussians import GaussianCloud, isotropic_cloud
from msgs_slam.formats.jsonfile import write_json
from msgs_slam.pipelines.export.writers import map_cloud
from msgs_slam.pipelines.outcome import Outcome

COARSE = 6.0
"""Side of the cells that each become one Gaussian of the coarse level, in median radii of the tile."""
_MOST_OPAQUE = 0.99


def write_tiles(outcome: Outcome, folder: Path) -> list[Path]:
    """submap_1/point_cloud.ply and coarse.ply and so on, and tiles.json, which says where each is; nothing for a map
    that was made whole."""
    submaps = outcome.run.load_submaps()
    if not submaps:
        return []
    anchors = outcome.require_map().anchor_frame_ids
    rows: list[dict[str, Any]] = []
    for number, submap in enumerate(submaps, 1):
        own = torch.isin(anchors, torch.as_tensor(submap["own"], device=anchors.device))
        tile, name = map_cloud(outcome, own), f"submap_{number}"
        if len(tile) == 0:
            continue
        simpler = coarse(tile)
        write_gaussian_ply(folder / name / "point_cloud.ply", tile, outcome.classes.names)
        write_gaussian_ply(folder / name / "coarse.ply", simpler, outcome.classes.names)
        low, high = tile.means.min(0).tolist(), tile.means.max(0).tolist()
        sizes = {"gaussians": len(tile), "coarse_gaussians": len(simpler)}
        rows.append({"folder": name, **sizes, "min": low, "max": high, "keyframes": submap["own"].tolist()})
    write_json(folder / "tiles.json", rows)
    return [folder / str(row["folder"]) for row in rows] + [folder / "tiles.json"]


def coarse(cloud: GaussianCloud) -> GaussianCloud:
    """One Gaussian in place of those in each cell of a grid.

    Each counts by its opacity times its area: means of place, colour and classes; the radius takes in how they are
    spread; as opaque as their areas together would cover the new one's.
    """
    radii = np.exp(cloud.log_scales.astype(np.float64).mean(1))
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
    side = COARSE * float(np.median(radii))
    _, cell = np.unique(np.floor(cloud.means / side).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    weight = opacity * radii**2 + 1e-30
    total = np.bincount(cell, weight)

    def mean(values: NDArray) -> NDArray[np.float64]:
        columns = values.reshape(len(values), -1)
        return np.stack([np.bincount(cell, weight * column) / total for column in columns.T], 1)

    center = mean(cloud.means)
    apart = np.square(cloud.means - center[cell]).sum(1) / 2  # they lie side by side on a surface, in two directions
    radius = np.sqrt(mean(np.square(radii) + apart)[:, 0])
    covered = np.clip(total / radius**2, 1e-3, _MOST_OPAQUE)
    classes = None if cloud.class_probs is None else mean(cloud.class_probs).astype(np.float32)
    logits, colors = np.log(covered / (1 - covered)).astype(np.float32), mean(cloud.colors).astype(np.float32)
    return isotropic_cloud(center.astype(np.float32), np.log(radius).astype(np.float32), logits, colors, classes)
