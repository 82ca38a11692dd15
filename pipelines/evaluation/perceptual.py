"""LPIPS: by the file `lpips-alex` in the models' cache, else by the package of its authors (the extra `lpips`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...formats.digest import file_sha256
from ...formats.errors import InputError
from ..networks.registry import Model, ModelStore
from ..networks.runtime import open_runtime
from ..types import require_shape

Image = NDArray[np.uint8]
Distance = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
_INPUTS = ("image0", "image1")


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
        return "needs the model lpips-alex (msgs-slam models pull --from FOLDER) or pip install 'msgs-slam[lpips]'"
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
