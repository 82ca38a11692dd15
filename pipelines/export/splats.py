"""The map as splat files, upright in their viewers."""

from dataclasses import replace

import numpy as np

from ...formats.gaussians import GaussianCloud
from ...formats.glb import write_gaussian_glb
from ...formats.ply import write_gaussian_ply
from ...formats.sog import write_sog
from ...formats.spz import write_spz
from ..run.target import Target
from ..system.parallel import LruSequence
from .scene import ExportScene

_PART = 1 << 17
"""Gaussians of a part that is written at a time: a cloud takes more memory than the map it is of."""


def write_splat_ply(scene: ExportScene, target: Target) -> None:
    """Write the map as splat PLYs in its own colours and in those of the classes; the probabilities are in the first
    only."""
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
