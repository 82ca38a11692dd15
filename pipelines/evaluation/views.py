"""The map as a camera sees it: as plain arrays, and as images for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.glb import ClassMesh
from ..providers import class_colors
from ..render.api import median_depth, render
from ..render.gaussian_map import GaussianMap, decided_channels
from ..run.outcome import Exposure, Outcome, labels_of_channels, spread_sample
from ..system.raster import draw_faces
from ..types import VOID, Array, ClassTable, Intrinsics

Picture = NDArray[np.uint8]

_LABELS_SHARE = 0.7
_SEEN = 0.5
"""Less coverage than this is no surface: it has neither depth nor label."""


@dataclass(frozen=True)
class MapView:
    """color (H, W, 3) float32 0..1; depth (H, W) float32, unit of the world, 0 = nothing; labels (H, W) uint8 or VOID;
    coverage and certainty (H, W) float32 0..1: how sure the class is, beside the surest in the view."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    labels: NDArray[np.uint8]
    coverage: NDArray[np.float32]
    certainty: NDArray[np.float32]

    def exposed(self, exposure: Exposure | None, time: float) -> NDArray[np.uint8]:
        """(H, W, 3) image of the moment, with the exposure that the run found for it."""
        color = self.color if exposure is None else exposure.apply(self.color, time)
        return np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)


@torch.no_grad()
def view_map(
    gaussian_map: GaussianMap,
    label_of_channel: NDArray[np.uint8],
    intrinsics: Intrinsics,
    cam_from_world: NDArray[np.float64],
) -> MapView:
    """Draw the map from `cam_from_world` (4, 4). The depth is that of the surface at which half the light is lost; a
    label is the class with the largest blended logit."""
    m = gaussian_map
    pose = torch.as_tensor(cam_from_world, dtype=torch.float64, device=m.means.device)
    features = torch.cat([m.colors, m.class_logits], dim=1)
    drawn = render(m.means, m.radii, m.opacities, features, pose, intrinsics)
    depth = median_depth(m, pose, intrinsics).cpu().numpy()
    coverage = drawn.silhouette.cpu().numpy()
    solid = coverage >= _SEEN
    channels = decided_channels(drawn.features[..., 3:]).cpu().numpy()
    probable = torch.softmax(drawn.features[..., 3:], -1).amax(-1) if len(label_of_channel) else drawn.silhouette
    certainty = (probable / probable.max().clamp(min=1e-6)).cpu().numpy()
    return MapView(
        color=drawn.features[..., :3].clamp(0, 1).cpu().numpy().astype(np.float32),
        depth=np.where(solid, depth, 0).astype(np.float32),
        labels=labels_of_channels(np.where(solid, channels, -1), label_of_channel),
        coverage=coverage.astype(np.float32),
        certainty=certainty.astype(np.float32),
    )


def render_outcome(outcome: Outcome, cam_from_world: NDArray[np.float64]) -> MapView:
    """The run's map at the size of its frames. Raises InputError for a run without a map."""
    return view_map(outcome.require_map(), outcome.label_of_channel, outcome.calibration.intrinsics, cam_from_world)


def _color_table(name: int) -> Picture:
    """(256, 3) RGB."""
    return np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], name), np.uint8)[:, 0, ::-1]


_TURBO, _MAGMA = _color_table(cv2.COLORMAP_TURBO), _color_table(cv2.COLORMAP_MAGMA)
_VOID_COLOR = (40, 40, 40)


def depth_picture(depth: NDArray, nearest: float, farthest: float) -> Picture:
    """(H, W, 3): near is red, far blue, by inverse depth; unknown is dark grey."""
    known = depth > 0
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=known)
    share = (inverse - 1 / farthest) / max(1 / nearest - 1 / farthest, 1e-12)
    picture = _TURBO[np.clip(share * 255, 0, 255).astype(np.uint8)]
    return np.where(known[..., None], picture, np.uint8(40)).astype(np.uint8)


def depth_range(depth: NDArray) -> tuple[float, float]:
    """(nearest, farthest) of most pixels; (1, 2) where nothing is known."""
    known = depth[depth > 0]
    if known.size == 0:
        return 1.0, 2.0
    low, high = np.quantile(known, (0.02, 0.98))
    return float(low), float(max(high, 1.01 * low))


def common_depth_range(outcome: Outcome) -> tuple[float, float]:
    """Find one range for all pictures of a run, so that their colours compare, from a few of its views."""
    t = outcome.trajectory
    poses = spread_sample(list(t.cam_from_world[t.is_posed]), 5)
    ranges = [depth_range(render_outcome(outcome, pose).depth) for pose in poses]
    return min(r[0] for r in ranges), max(r[1] for r in ranges)


def error_picture(error: NDArray, known: NDArray[np.bool_], largest: float) -> Picture:
    """(H, W, 3): no error is black, `largest` and more pale yellow; unknown is dark blue-grey."""
    picture = _MAGMA[np.clip(error / largest * 255, 0, 255).astype(np.uint8)]
    return np.where(known[..., None], picture, np.array([30, 40, 60], np.uint8)).astype(np.uint8)


def label_picture(labels: NDArray[np.uint8], colors: Sequence[tuple[int, int, int]]) -> Picture:
    """(H, W, 3) in the classes' colours; void and unknown classes are dark grey."""
    table = np.full((256, 3), _VOID_COLOR, np.uint8)
    table[: len(colors)] = np.array(colors, np.uint8).reshape(-1, 3)
    table[VOID] = _VOID_COLOR
    return table[labels]


def labels_on_photo(
    photo: Picture,
    labels: NDArray[np.uint8],
    colors: Sequence[tuple[int, int, int]],
    certainty: NDArray[np.float32],
) -> Picture:
    """(H, W, 3) the photo under its labels, paler where these are less sure (H, W), with class borders drawn."""
    share = (_LABELS_SHARE * certainty)[..., None]
    mixed = (1 - share) * photo + share * label_picture(labels, colors)
    edge = np.zeros(labels.shape, bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    mixed[edge] = 255
    return mixed.astype(np.uint8)


def sheet(rows: Sequence[Sequence[Picture]], titles: Sequence[str], width: int = 320) -> Picture:
    """Rows of pictures of one shape under their titles, each reduced to `width` pixels."""
    height = round(width * rows[0][0].shape[0] / rows[0][0].shape[1])
    head = np.full((26, (width + 4) * len(titles), 3), 255, np.uint8)
    for i, title in enumerate(titles):
        at = (i * (width + 4) + 4, 18)
        cv2.putText(head, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
    lines = [head]
    for row in rows:
        resized = [np.asarray(cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA), np.uint8) for p in row]
        bordered = [np.pad(p, ((0, 4), (0, 4), (0, 0)), constant_values=255) for p in resized]
        lines.append(np.concatenate(bordered, axis=1))
    return np.concatenate(lines, axis=0)


def class_colors_by_name(
    names: Sequence[str], colors: Sequence[tuple[int, int, int] | None], table: ClassTable
) -> list[tuple[int, int, int]]:
    """Display colours of the truth's classes: the run's for the same name, else the truth's own, else by the name."""
    known = {n.lower(): c for n, c in zip(table.names, table.colors, strict=True)}
    return [known.get(n.lower(), c or own) for n, c, own in zip(names, colors, class_colors(names), strict=True)]


def mesh_picture(mesh: ClassMesh, cam_from_world: Array, camera: Intrinsics) -> Picture:
    """Draw a mesh with its texture, or the colours of its vertices, four samples a pixel, on white; `cam_from_world`
    (4, 4) is from the mesh's axes."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    faces = mesh.corner_vertex[mesh.faces].astype(np.int32)
    drawn = draw_faces(mesh.vertices, faces, cam_from_world, fine)
    seen, (height, width) = drawn.face >= 0, mesh.texture.shape[:2]
    corners, shown = mesh.faces[drawn.face[seen]], np.full((*seen.shape, 3), 255, np.uint8)
    values = mesh.corner_uv if mesh.texture.size else mesh.colors[mesh.corner_vertex]
    found = np.einsum("nk,nkc->nc", drawn.shares[seen], values[corners])
    if mesh.texture.size:
        column, row = (found * (width, height)).astype(np.int64).clip(0, (width - 1, height - 1)).T
        found = mesh.texture[row, column]
    shown[seen] = found
    return np.asarray(cv2.resize(shown, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)
