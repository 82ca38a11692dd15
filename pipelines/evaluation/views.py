"""The map, or a splat file by any program, as a camera sees it: as plain arrays, and as images for people.

The renderer of runs knows balls only, and learns; `draw_splats` draws ellipsoids on the CPU and nothing else. Each is
projected to an ellipse by the linearised perspective of the original (EWA splatting), and blended from near to far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...formats.gaussians import GaussianCloud
from ...formats.mesh import TexturedMesh
from ..compute.raster import draw_faces
from ..outcome import Exposure, Outcome, labels_of_channels
from ..providers import class_colors
from ..render.api import render
from ..render.gaussian_map import GaussianMap, decided_channels
from ..render.inspection import median_depth
from ..render.rules import ALPHA_MAX, ALPHA_MIN, CUT_SIGMAS, TRANSMITTANCE_MIN
from ..system.jit import kernel
from ..types import VOID, Array, ClassTable, Intrinsics

_NEAR_SHARE = 0.01
"""Of the scene's size: what is nearer to the eye is not drawn."""
_LOW_PASS = 0.3
"""Pixels squared that the original adds to an ellipse. Balls are trained here without that, and drawn without."""
_WIDEST = 1.3
"""Times the half field of view: beyond it the linearised perspective is taken at its edge, as the original does."""

Picture = NDArray[np.uint8]

_SEEN = 0.5
"""Less coverage than this is no surface: it has neither depth nor label."""


@dataclass(frozen=True)
class MapView:
    """color (H, W, 3) float32 0..1; depth (H, W) float32, unit of the world, 0 = nothing; labels (H, W) uint8 or VOID;
    coverage (H, W) float32 0..1."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    labels: NDArray[np.uint8]
    coverage: NDArray[np.float32]

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
    """Draw the map from `cam_from_world` (4, 4). The depth is that of the surface at which half the light is lost."""
    m = gaussian_map
    pose = torch.as_tensor(cam_from_world, dtype=torch.float64, device=m.means.device)
    features = torch.cat([m.colors, m.class_logits], dim=1)
    drawn = render(m.means, m.radii, m.opacities, features, pose, intrinsics)
    depth = median_depth(m.means, m.radii, m.opacities, pose, intrinsics).cpu().numpy()
    coverage = drawn.silhouette.cpu().numpy()
    channels = decided_channels(drawn.features[..., 3:]).cpu().numpy()
    return MapView(
        color=drawn.features[..., :3].clamp(0, 1).cpu().numpy().astype(np.float32),
        depth=np.where(coverage >= _SEEN, depth, 0).astype(np.float32),
        labels=labels_of_channels(np.where(coverage >= _SEEN, channels, -1), label_of_channel),
        coverage=coverage.astype(np.float32),
    )


def render_outcome(outcome: Outcome, cam_from_world: NDArray[np.float64]) -> MapView:
    """The run's map at the size of its frames. Raises InputError for a run without a map."""
    return view_map(outcome.require_map(), outcome.label_of_channel, outcome.calibration.intrinsics, cam_from_world)


def _color_table(name: int) -> Picture:
    """(256, 3) RGB."""
    return np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], name), np.uint8).reshape(256, 3)[
        :, ::-1
    ]


_TURBO = _color_table(cv2.COLORMAP_TURBO)
_MAGMA = _color_table(cv2.COLORMAP_MAGMA)
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
    photo: Picture, labels: NDArray[np.uint8], colors: Sequence[tuple[int, int, int]], share: float = 0.55
) -> Picture:
    """(H, W, 3) the photo under its labels, with class borders drawn."""
    mixed = (1 - share) * photo + share * label_picture(labels, colors)
    edge = np.zeros(labels.shape, bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    mixed[edge] = 255
    return mixed.astype(np.uint8)


def sheet(rows: Sequence[Sequence[Picture]], titles: Sequence[str], width: int = 320) -> Picture:
    """Rows of pictures of one shape under their titles, each reduced to `width` pixels."""
    height = round(width * rows[0][0].shape[0] / rows[0][0].shape[1])
    lines = [_titles(titles, width)]
    for row in rows:
        resized = [np.asarray(cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA), np.uint8) for p in row]
        bordered = [np.pad(p, ((0, 4), (0, 4), (0, 0)), constant_values=255) for p in resized]
        lines.append(np.concatenate(bordered, axis=1))
    return np.concatenate(lines, axis=0)


def _titles(titles: Sequence[str], width: int) -> Picture:
    line = np.full((26, (width + 4) * len(titles), 3), 255, np.uint8)
    for i, title in enumerate(titles):
        at = (i * (width + 4) + 4, 18)
        cv2.putText(line, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA)
    return line


def class_colors_by_name(
    names: Sequence[str], colors: Sequence[tuple[int, int, int] | None], table: ClassTable
) -> list[tuple[int, int, int]]:
    """Display colours of the truth's classes: the run's for the same name, else the truth's own, else by the name."""
    known = {n.lower(): c for n, c in zip(table.names, table.colors, strict=True)}
    return [known.get(n.lower(), c or own) for n, c, own in zip(names, colors, class_colors(names), strict=True)]


@dataclass(frozen=True)
class SplatScene:
    """The view-independent part of a cloud: covariances (M, 3, 3), opacities (M,), and the middle (3,) and largest side
    of the box around most of it."""

    cloud: GaussianCloud
    covariances: NDArray[np.float64]
    opacities: NDArray[np.float64]
    middle: NDArray[np.float64]
    size: float

    @staticmethod
    def of(cloud: GaussianCloud) -> SplatScene:
        """Prepare a cloud of at least one Gaussian."""
        turn = Rotation.from_quat(cloud.quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()
        axes = turn * np.exp(cloud.log_scales.astype(np.float64))[:, None, :]
        low, high = np.quantile(cloud.means, (0.05, 0.95), axis=0)
        opacities = 1 / (1 + np.exp(-cloud.opacity_logits.astype(np.float64)))
        return SplatScene(
            cloud, axes @ axes.transpose(0, 2, 1), opacities, (low + high) / 2, max(float((high - low).max()), 1e-6)
        )

    @property
    def low_pass(self) -> float:
        """Variance that is added on the image, in square pixels; 0 for isotropic Gaussians."""
        return _LOW_PASS if np.ptp(self.cloud.log_scales, axis=1).max() > 1e-4 else 0.0


def draw_splats(scene: SplatScene, camera: Intrinsics, cam_from_world: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(H, W, 3) colours over black, seen from `cam_from_world` (4, 4)."""
    rotation = cam_from_world[:3, :3]
    x, y, z = (scene.cloud.means.astype(np.float64) @ rotation.T + cam_from_world[:3, 3]).T
    seen = np.flatnonzero(z > _NEAR_SHARE * scene.size)
    seen = seen[np.argsort(z[seen], kind="stable")]
    x, y, z = x[seen], y[seen], z[seen]
    limits = _WIDEST * camera.width / 2 / camera.fx, _WIDEST * camera.height / 2 / camera.fy
    slopes = [np.clip(v / z, -limit, limit) for v, limit in zip((x, y), limits, strict=True)]
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = camera.fx / z, camera.fy / z
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -camera.fx * slopes[0] / z, -camera.fy * slopes[1] / z
    way = jacobian @ rotation
    ellipse = way @ scene.covariances[seen] @ way.transpose(0, 2, 1)
    a, b, c = ellipse[:, 0, 0] + scene.low_pass, ellipse[:, 0, 1], ellipse[:, 1, 1] + scene.low_pass
    determinant = np.maximum(a * c - b * b, 1e-12)
    opacity = scene.opacities[seen]
    reach = np.minimum(np.sqrt(2 * np.log(np.maximum(opacity / ALPHA_MIN, 1))), CUT_SIGMAS)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inverse = np.column_stack([c, -b, a]) / determinant[:, None]
    table = np.column_stack([u, v, inverse, reach * np.sqrt(a), reach * np.sqrt(c), reach**2, opacity])
    image = np.zeros((camera.height, camera.width, 3))
    _blend(table, scene.cloud.colors[seen].astype(np.float64), image, np.ones(image.shape[:2]))
    return np.round(255 * image.clip(0, 1)).astype(np.uint8)


@kernel
def _blend(table, colors, image, left):  # type: ignore[no-untyped-def]
    """Adds every ellipse (u, v, inverse covariance, half sides, reach squared, opacity) to the pixels that it covers;
    left: the light that reaches each pixel still."""
    height, width = left.shape
    for g in range(len(table)):
        u, v, xx, xy, yy, half_x, half_y, most, opacity = table[g]
        first_row, last_row = max(int(np.ceil(v - half_y - 0.5)), 0), min(int(np.floor(v + half_y - 0.5)), height - 1)
        first, last = max(int(np.ceil(u - half_x - 0.5)), 0), min(int(np.floor(u + half_x - 0.5)), width - 1)
        for row in range(first_row, last_row + 1):
            dy = row + 0.5 - v
            for column in range(first, last + 1):
                dx = column + 0.5 - u
                distance = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
                before = left[row, column]
                if distance > most or before < TRANSMITTANCE_MIN:
                    continue
                alpha = min(opacity * np.exp(-0.5 * distance), ALPHA_MAX)
                for k in range(3):
                    image[row, column, k] += before * alpha * colors[g, k]
                left[row, column] = before * (1 - alpha)


def mesh_picture(mesh: TexturedMesh, cam_from_world: Array, camera: Intrinsics) -> Picture:
    """Draw a mesh with its texture, four samples a pixel, on white; `cam_from_world` (4, 4) is from the mesh's axes."""
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    faces = mesh.corner_vertex[mesh.faces].astype(np.int32)
    drawn = draw_faces(mesh.vertices, faces, cam_from_world, fine)
    seen, (height, width) = drawn.face >= 0, mesh.texture.shape[:2]
    place = np.einsum("nk,nkc->nc", drawn.shares[seen], mesh.corner_uv[mesh.faces[drawn.face[seen]]])
    texel = (place * (width, height)).astype(np.int64).clip(0, (width - 1, height - 1))
    shown = np.full((*seen.shape, 3), 255, np.uint8)
    shown[seen] = mesh.texture[texel[:, 1], texel[:, 0]]
    return np.asarray(cv2.resize(shown, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)
