"""The mesh's floors, walls and fronts straight: unsure depths move onto the planes of sure ones beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import unproject_depth
from ..geometry.posed_depth import PosedDepth
from ..geometry.resampling import resample_nearest
from ..geometry.voxels import VOXELS_PER_DEPTH, find, gather_depths, normals_in_cam, voxel_keys
from ..mapping.measure import DrawnView
from ..outcome import evenly
from .planes import NEAR, REACH, ROUGHLY_ALONG, Planes, find_planes

_SIDE = 200
_COMPARED = 24
"""Views whose median depth sets the size of a voxel."""
_STRETCH = 1.4
"""A depth changes by no larger factor: a plane seen from the side is far away a little beside."""


def planes_of(views: Sequence[DrawnView]) -> Planes:
    """The planes of what the views surely show."""
    some = (views[n].shown for n in evenly(range(len(views)), _COMPARED))
    seen = [float(np.median(v.depth[v.trust > 0])) for v in some if (v.trust > 0).any()]
    size = float(np.median(seen)) / VOXELS_PER_DEPTH if seen else 1.0
    return find_planes(gather_depths((_sure_part(view) for view in views), size))


def _sure_part(view: DrawnView) -> PosedDepth:
    shown, small = view.shown, view.shown.intrinsics.at_most(_SIDE)
    trust = shown.trust if view.unsure is None else np.where(view.unsure, 0, shown.trust).astype(np.float32)
    depth, trust = (resample_nearest(x, small.height, small.width) for x in (shown.depth, trust))
    return PosedDepth(small, shown.cam_from_world, depth, trust)


def straightened(view: DrawnView, planes: Planes) -> DrawnView:
    """Its unsure depths on the nearest plane that they lie along, along their rays; `unsure` is None then."""
    if view.unsure is None:
        return view
    shown = view.shown
    pixels = np.flatnonzero(view.unsure & (shown.depth > 0) & (shown.trust > 0))
    world_from_cam = np.linalg.inv(shown.cam_from_world)
    rays = unproject_depth(shown.depth, shown.intrinsics).reshape(-1, 3)[pixels] @ world_from_cam[:3, :3].T
    normals = _normals(shown).reshape(-1, 3)[pixels] @ world_from_cam[:3, :3].T
    factor, moved = np.ones(len(pixels)), np.full(len(pixels), REACH * planes.voxel)
    eye = world_from_cam[:3, 3]
    for normal, offset, cubes in zip(planes.normal, planes.offset, planes.cubes, strict=True):
        height, along = float(normal @ eye - offset), rays @ normal
        off = np.abs(height + along)
        fits = np.flatnonzero((off < moved) & (normals @ normal > ROUGHLY_ALONG) & (along < 0) & (height > 0))
        to = -height / along[fits]
        keys = voxel_keys(eye + to[:, None] * rays[fits], NEAR * planes.voxel)
        good = (np.maximum(to, 1 / to) < _STRETCH) & (find(cubes, keys) >= 0)
        factor[fits[good]], moved[fits[good]] = to[good], off[fits[good]]
    depth = shown.depth.copy()
    depth.ravel()[pixels] *= factor.astype(np.float32)
    return replace(view, shown=replace(shown, depth=depth), unsure=None)


def _normals(shown: PosedDepth) -> NDArray[np.float64]:
    """(H, W, 3) in the camera, over some pixels: a depth's noise tilts those between neighbours."""
    camera = shown.intrinsics
    small = camera.at_most(_SIDE)
    coarse = normals_in_cam(resample_nearest(shown.depth, small.height, small.width), small)
    return resample_nearest(coarse, camera.height, camera.width)
