"""LPIPS, through the package of its authors (the optional extra `lpips`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from msgs_slam.pipelines.types import require_shape

Image = NDArray[np.uint8]


class Lpips:
    """Learned perceptual distance on AlexNet's features (Zhang et al., CVPR 2018, version 0.1); 0 = equal."""

    def __init__(self, model: Any) -> None:
        self._model = model

    @torch.no_grad()
    def __call__(self, image: Image, truth: Image) -> float:
        """Of two (H, W, 3) pictures in 0..255. Raises ValueError for different shapes."""
        require_shape("image", image, truth.shape)
        return float(self._model(_scaled(image), _scaled(truth)).item())


def open_lpips() -> Lpips | str:
    """The measure, or why there is none: the package or its network's weights are not here. Downloads nothing."""
    try:
        import lpips
        from torchvision.models import AlexNet_Weights
    except ImportError:
        return "needs the extra: pip install 'msgs-slam[lpips]'"
    except RuntimeError as error:  # torchvision of another build than torch
        return f"the package lpips cannot be loaded: {error}"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / AlexNet_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[1]
    if not weights.exists():
        return f"AlexNet's weights are not in {weights.parent}: python -c \"import lpips; lpips.LPIPS(net='alex')\""
    return Lpips(lpips.LPIPS(net="alex", verbose=False).eval())


def _scaled(image: Image) -> torch.Tensor:
    """(1, 3, H, W) in -1..1, as the network was trained."""
    return torch.from_numpy(image.astype(np.float32) / 127.5 - 1).permute(2, 0, 1)[None]
