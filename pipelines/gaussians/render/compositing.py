"""Front-to-back compositing of projected isotropic Gaussians: MSGS-SLAM eq. (6)-(9), one autograd operation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor

from . import cards, reference


@dataclass(frozen=True)
class Composite:
    """features (H, W, C); depth_sum, depth_silhouette, silhouette (H, W).

    silhouette is 1 - T. depth_silhouette has the same values, and is what the depth sum is divided by: the gradient of
    the depth comes back apart from that of the silhouette.
    """

    features: Tensor
    depth_sum: Tensor
    depth_silhouette: Tensor
    silhouette: Tensor


def composite(
    u: Tensor,
    v: Tensor,
    sigma_px: Tensor,
    z: Tensor,
    opacity: Tensor,
    features: Tensor,
    width: int,
    height: int,
    backend: str | None = None,
    near: float = 0.0,
) -> Composite:
    """Blend M Gaussians into a width x height image; differentiable in the first six arguments.

    u, v, sigma_px (M,) pixels, pixel centres at half integers; z (M,) depth, ignored where <= near; opacity (M,) 0..1;
    features (M, C). backend: "reference", "cpu", "cuda" or None for the fastest that runs these tensors. Raises
    ValueError for wrong shapes, for NaN or infinity on the CPU (by the argument's name) and for an unknown backend.
    """
    arguments = {"u": u, "v": v, "sigma_px": sigma_px, "z": z, "opacity": opacity, "features": features}
    check_arguments(arguments, width, height)
    module = choose_backend(backend, u)
    return Composite(*module.composite(u, v, sigma_px, z, opacity, features, width, height, float(near)))


def check_arguments(arguments: dict[str, Tensor], width: int, height: int) -> None:
    """Raise ValueError, naming the argument, for wrong shapes and values that are not finite."""
    if width < 1 or height < 1:
        raise ValueError(f"image size must be positive, got {width}x{height}")
    count = len(next(iter(arguments.values())))
    for name, tensor in arguments.items():
        wanted = 2 if name == "features" else 1
        if tensor.ndim != wanted or len(tensor) != count:
            raise ValueError(
                f"{name}: got shape {tuple(tensor.shape)}, expected {count} rows and {wanted} dimension(s)"
            )
        require_finite(name, tensor)


def require_finite(name: str, tensor: Tensor) -> None:
    """Raise ValueError if any element is NaN or infinite, of a tensor on the CPU.

    Tensors of a card pass: each look would make the host wait for all that the card has still to do. Who keeps a map
    there looks at it once in a while by `require_all_finite`.
    """
    if tensor.device.type == "cpu":
        require_all_finite({name: tensor})


def require_all_finite(tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError, naming the tensor, if any element of any is NaN or infinite; on a card with a single read."""
    # A sum is finite unless an element is not (or it overflows, which the second look settles): one pass, no copy.
    if torch.isfinite(sum((x.detach().sum() for x in tensors.values()), torch.zeros(()))):
        return
    for name, tensor in tensors.items():
        if not (finite := torch.isfinite(tensor.detach())).all():
            bad = int((~finite).sum())
            raise ValueError(f"{name}: {bad} of {tensor.numel()} values are NaN or infinite")


def choose_backend(backend: str | None, example: Tensor) -> ModuleType:
    """The module that composites tensors like `example`; without a choice, the fastest that can."""
    name = backend or _fastest(example)
    if name == "reference":
        return reference
    if name == "cpu":
        from . import cpu  # importing numba takes a while: only where it is used

        return cpu
    if name == "cuda":
        if not cards.has_triton():
            raise ValueError("backend: 'cuda' needs triton >= 3.3, which comes with torch >= 2.7 built for CUDA")
        from . import cuda

        return cuda
    raise ValueError(f"backend: got {backend!r}, expected 'reference', 'cpu', 'cuda' or None")


def _fastest(example: Tensor) -> str:
    if example.device.type == "cpu" and example.dtype == torch.float32:
        return "cpu"
    return "cuda" if cards.takes_kernels(example) else "reference"
