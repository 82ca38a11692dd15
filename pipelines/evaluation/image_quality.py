"""Similarity of a rendered image to a photograph (PSNR, SSIM, LPIPS), and error of a rendered depth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.errors import InputError, install_extra
from ...formats.reading import file_sha256
from ..compute.ssim import TAPS, similarity
from ..networks.registry import Model, ModelStore
from ..networks.runtime import open_runtime
from ..types import require_shape

Image = NDArray[np.uint8]
Distance = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
_INPUTS = ("image0", "image1")


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


class Lpips:
    """Learned perceptual distance on AlexNet's features (Zhang et al., CVPR 2018, version 0.1); 0 = equal."""

    def __init__(self, distance: Distance) -> None:
        """`distance` compares two (1, 3, H, W) images in -1..1."""
        self._distance = distance

    def __call__(self, image: Image, truth: Image) -> float:
        """Of two (H, W, 3) images in 0..255. Raises ValueError for different shapes."""
        require_shape("image", image, truth.shape)
        return self._distance(_scaled(image), _scaled(truth))


def open_lpips() -> Lpips | str:
    """The measure, or why there is none: the file, or the package with its weights, is not here. Downloads nothing."""
    store = ModelStore.open()
    model = store.first_here("perceptual")
    return _by_package() if model is None else _by_file(store, model)


def _by_file(store: ModelStore, model: Model) -> Lpips | str:
    """Raises InputError for a file of the right hash that onnxruntime cannot run."""
    path = store.path(model)
    if file_sha256(path) != model.sha256:
        return f"{path} is damaged: delete it, then msgs-slam models pull {model.name} --from FOLDER"
    runtime = open_runtime(path, [], torch.get_num_threads(), "cpu")
    if tuple(runtime.inputs) != _INPUTS or len(runtime.outputs) != 1:
        raise InputError(f"{path}: its inputs are {', '.join(runtime.inputs)}; another kind of file is needed")

    def distance(image: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
        found = runtime.run(list(runtime.outputs), dict(zip(_INPUTS, (image, truth), strict=True)))
        return float(found[0].item())

    return Lpips(distance)


def _by_package() -> Lpips | str:
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
    def distance(image: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
        return float(model(torch.from_numpy(image), torch.from_numpy(truth)).item())

    return Lpips(distance)


def _scaled(image: Image) -> NDArray[np.float32]:
    """(1, 3, H, W) in -1..1, as the network was trained."""
    return np.ascontiguousarray((image.astype(np.float32) / 127.5 - 1).transpose(2, 0, 1)[None])


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
