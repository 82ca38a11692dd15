"""Similarity of a rendered image to a photograph (PSNR, SSIM, LPIPS), error of a rendered depth, and accuracy and
completeness of the exported mesh against the surface that the true depth shows."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...formats.errors import InputError, install_extra
from ...formats.reading import file_sha256
from ..geometry.posed_depth import PosedDepth
from ..geometry.voxels import voxel_keys
from ..networks.registry import Model, ModelStore
from ..networks.runtime import open_runtime
from ..run.files import MESH
from ..run.outcome import Outcome, spread_sample
from ..scene.world import FIRST, WORLD
from ..system.ssim import TAPS, similarity
from ..types import Intrinsics, require_shape
from .truth import AbsoluteError, MatchedTruth

Image = NDArray[np.uint8]
Measure = Callable[[Image, Image], float]
_INPUTS = ("image0", "image1")

SAMPLES = 200_000
VIEWS = 60
SLACK = 0.1
"""Metres that a point of the mesh may lie behind the true surface and still count as one the camera should see."""
CELL = 0.02

Points = NDArray[np.float64]


def psnr(image: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB of (H, W, 3) images in 0..255, over `mask` (H, W); inf for equal images.

    Raises ValueError for different shapes or an empty mask.
    """
    require_shape("image", image, truth.shape)
    squared = (image.astype(np.float64) - truth.astype(np.float64)) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        raise ValueError("psnr: no pixel to compare")
    error = float(squared.mean())
    return float("inf") if error == 0 else 10 * float(np.log10(255.0**2 / error))


def ssim(image: NDArray, truth: NDArray) -> float:
    """Mean structural similarity of (H, W, 3) images in 0..255 (Wang et al., TIP 2004), -1..1.

    Gaussian window of 11 pixels and sigma 1.5, population covariance, mean over channels and over the pixels whose
    window lies in the image. Raises ValueError for images smaller than the window.
    """
    require_shape("image", image, truth.shape)
    if min(image.shape[:2]) < TAPS:
        raise ValueError(f"ssim: images need at least {TAPS} pixels a side, got {image.shape[:2]}")
    a, b = (torch.from_numpy(x.astype(np.float64) / 255) for x in (image, truth))
    edge = TAPS // 2
    return float(similarity(a, b)[0][edge:-edge, edge:-edge].mean())


def open_lpips() -> Measure | str:
    """Open the learned perceptual distance on AlexNet's features (Zhang et al., CVPR 2018, version 0.1) of two images
    (H, W, 3) in 0..255, 0 = equal; or say why there is none: neither file nor package is here. Downloads nothing."""
    store = ModelStore.open()
    model = store.first_here("perceptual")
    return _by_package() if model is None else _by_file(store, model)


def _by_file(store: ModelStore, model: Model) -> Measure | str:
    """Raises InputError for a file of the right hash that onnxruntime cannot run."""
    path = store.path(model)
    if file_sha256(path) != model.sha256:
        return f"{path} is damaged: delete it, then msgs-slam models pull {model.name} --from FOLDER"
    runtime = open_runtime(path, [], torch.get_num_threads(), "cpu")
    if tuple(runtime.inputs) != _INPUTS or len(runtime.outputs) != 1:
        raise InputError(f"{path}: its inputs are {', '.join(runtime.inputs)}; another kind of file is needed")

    def distance(image: Image, truth: Image) -> float:
        found = runtime.run(list(runtime.outputs), dict(zip(_INPUTS, _scaled(image, truth), strict=True)))
        return float(found[0].item())

    return distance


def _by_package() -> Measure | str:
    try:
        import lpips
        from torchvision.models import AlexNet_Weights
    except ImportError:
        package = install_extra("lpips")
        return f"needs its package ({package}) or the model lpips-alex: msgs-slam models pull --from FOLDER"
    except RuntimeError as error:  # torchvision of another build than torch
        return f"the package lpips cannot be loaded: {error}"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / AlexNet_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[1]
    if not weights.exists():
        return f"AlexNet's weights are not in {weights.parent}: python -c \"import lpips; lpips.LPIPS(net='alex')\""
    model = lpips.LPIPS(net="alex", verbose=False).eval()

    @torch.no_grad()
    def distance(image: Image, truth: Image) -> float:
        return float(model(*map(torch.from_numpy, _scaled(image, truth))).item())

    return distance


def _scaled(image: Image, truth: Image) -> list[NDArray[np.float32]]:
    """(1, 3, H, W) of both in -1..1, as the network was trained. Raises ValueError for different shapes."""
    require_shape("image", image, truth.shape)
    return [np.ascontiguousarray((x.astype(np.float32) / 127.5 - 1).transpose(2, 0, 1)[None]) for x in (image, truth)]


@dataclass(frozen=True)
class DepthError:
    """metric_l1: mean |depth - truth| in metres as it is; scaled_l1: after one scale for the whole sequence;
    scale: that factor; valid_fraction: share of the pixels with truth where there is a depth at all; pixels: those
    compared."""

    metric_l1: float
    scaled_l1: float
    scale: float
    valid_fraction: float
    pixels: int


class DepthErrorSum:
    """Depth L1 over a sequence, frame by frame; its scale is the median of truth / depth of a sample of all pixels."""

    def __init__(self, samples_a_frame: int = 20000) -> None:
        self._samples_a_frame = samples_a_frame
        self._errors = 0.0
        self._compared = 0
        self._truths = 0
        self._samples: list[NDArray[np.float32]] = []

    def add(self, depth: NDArray[np.float32], truth: NDArray[np.float32]) -> None:
        """Add a frame, (H, W) `depth` in its world's unit and `truth` in metres, 0 = unknown."""
        require_shape("depth", depth, truth.shape)
        known = truth > 0
        both = known & (depth > 0) & np.isfinite(depth)
        self._truths += int(known.sum())
        self._compared += int(both.sum())
        self._errors += float(np.abs(depth[both].astype(np.float64) - truth[both]).sum())
        pairs = np.stack([depth[both], truth[both]], axis=1)
        # Every k-th pixel: even over the image, and the same on every run.
        self._samples.append(pairs[:: max(1, len(pairs) // self._samples_a_frame)])

    def l1(self, scale: float) -> list[float | None]:
        """Return the mean of |scale * depth - truth| of each added frame, over its sample; None where none is known."""
        return [float(np.abs(scale * s[:, 0] - s[:, 1]).mean()) if len(s) else None for s in self._samples]

    def result(self) -> DepthError | None:
        """None where no pixel could be compared."""
        if self._compared == 0:
            return None
        sample = np.concatenate(self._samples).astype(np.float64)
        scale = float(np.median(sample[:, 1] / sample[:, 0]))
        return DepthError(
            metric_l1=self._errors / self._compared,
            scaled_l1=float(np.abs(scale * sample[:, 0] - sample[:, 1]).mean()),
            scale=scale,
            valid_fraction=self._compared / self._truths,
            pixels=self._compared,
        )


@dataclass(frozen=True)
class SurfaceError:
    """accuracy: mean distance from the mesh to the truth; completeness: from the truth to the mesh, both in metres.
    precision, recall: shares of these distances below `threshold`; f_score their harmonic mean."""

    accuracy: float
    completeness: float
    precision: float
    recall: float
    f_score: float
    threshold: float


def surface_error(points: Points, true_points: Points, threshold: float = 0.05) -> SurfaceError:
    """Errors between two sampled surfaces (N, 3) and (M, 3) in metres. Raises ValueError where one is empty."""
    if len(points) == 0 or len(true_points) == 0:
        raise ValueError(f"nothing to compare: {len(points)} points against {len(true_points)}")
    to_truth = cKDTree(true_points).query(points)[0]
    to_mesh = cKDTree(points).query(true_points)[0]
    precision, recall = float((to_truth < threshold).mean()), float((to_mesh < threshold).mean())
    f_score = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return SurfaceError(float(to_truth.mean()), float(to_mesh.mean()), precision, recall, f_score, threshold)


def thinned(points: Points, cell: float) -> Points:
    """One point of every cell of a grid of `cell` metres: the first in the order of the cells."""
    return points[np.unique(voxel_keys(points, cell), return_index=True)[1]]


def mesh_cells(outcome: Outcome, matched: MatchedTruth, alignment: AbsoluteError | None) -> dict[str, Any]:
    """Accuracy, completeness and F-score, or why not."""
    if not outcome.run.has("export", MESH):
        return {"missing": "no mesh was exported"}
    if not matched.sequence.metric:
        return {"missing": "the truth's poses have no metric scale, its depth has"}
    if alignment is None:
        return {"missing": "the poses could not be aligned with the truth"}
    truth, views = true_surface(matched)
    if len(truth) == 0:
        return {"missing": "the truth has no depth, or no camera for it"}
    mesh = trimesh.load(outcome.run.file("export", MESH), force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not mesh.area > 0:
        return {"missing": "the mesh is empty"}
    world = outcome.run.find(WORLD) or FIRST
    points = np.asarray(trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])
    points = alignment.alignment.apply(world.exported_from_run.inverse().apply(points))
    points = points[np.any([sees(view, points) for view in views], axis=0)]
    if len(points) == 0:
        return {"missing": "no camera with true depth sees the mesh"}
    return {**asdict(surface_error(points, truth)), "points": len(points), "true points": len(truth)}


def sees(view: PosedDepth, points: Points) -> NDArray[np.bool_]:
    """(N,) whether a point lies in the image and no further than `SLACK` behind the depth seen there."""
    xy, z, seen = view.seen(points)
    column, row = xy[seen].astype(np.int64).T
    seen[seen] = (view.depth[row, column] > 0) & (z[seen] < view.depth[row, column] + SLACK)
    return seen


def true_surface(matched: MatchedTruth) -> tuple[NDArray[np.float64], list[PosedDepth]]:
    """Points of the true depth of up to `VIEWS` frames, thinned; and these depths.

    A lens with distortion is left out: its depth does not follow the pinhole that the points are made with.
    """
    sequence = matched.sequence
    if sequence.camera is None or sequence.camera.is_distorted or not sequence.has_depth:
        return np.zeros((0, 3)), []
    points, views = [], []
    for row in spread_sample(np.flatnonzero(matched.has_pose & (matched.image >= 0)).tolist(), VIEWS):
        if (depth := sequence.depth(int(matched.image[row]))) is None:
            continue
        k = sequence.camera.resized(depth.shape[1], depth.shape[0])
        camera = Intrinsics(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
        views.append(PosedDepth(camera, np.linalg.inv(matched.world_from_cam[row]), depth, np.ones_like(depth)))
        xy, z, _ = views[-1].grid(320)
        points.append(views[-1].in_world(xy, z))
    return (thinned(np.concatenate(points), CELL) if points else np.zeros((0, 3))), views
