"""Forward-only views of the map: the depth of surfaces, and how much each Gaussian takes part in an image."""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor

from ..types import Intrinsics
from .api import NEAR, choose_backend, in_view, kernels_for, project_map, render, require_finite


@dataclass(frozen=True)
class BlendingWeights:
    """Of every Gaussian, over all pixels of an image: its summed (weighed by what the pixels count) and its largest
    blending weight, (M,) each."""

    total: Tensor
    largest: Tensor


def median_depth(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    near: float = NEAR,
    backend: str | None = None,
) -> Tensor:
    """(H, W) depth of the Gaussian at which half the light is lost, 0 where it never is: one surface, never a mean of
    two. No gradients; arguments as in `render`."""
    return _inspect(means, radii, opacities, cam_from_world, intrinsics, near, backend)[0]


def median_and_seen(
    means: Tensor, radii: Tensor, opacities: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics
) -> tuple[Tensor, Tensor]:
    """The `median_depth`, and the rows (n,) of the Gaussians that have a weight in the image: what hides behind walls
    has none, and without it the same image is rendered."""
    median, _, largest = _inspect(means, radii, opacities, cam_from_world, intrinsics, NEAR, None)
    return median, torch.nonzero(largest)[:, 0]


def blending_weights(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    near: float = NEAR,
    backend: str | None = None,
    counts: Tensor | None = None,
) -> BlendingWeights:
    """What each of the M Gaussians contributes to the image of a camera: 0 where it is not seen at all. No gradients;
    `counts` (H, W): what a pixel's weights count in the sums, None for 1; the others as in `render`."""
    return BlendingWeights(*_inspect(means, radii, opacities, cam_from_world, intrinsics, near, backend, counts)[1:])


def class_weights(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    channels: Tensor,
    counts: Tensor,
    classes: int,
    backend: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Rows (R,) of the Gaussians in view, and (R, classes) what each contributes to the pixels of each class: channels
    (H, W) uint8, other numbers are no class; counts (H, W). No gradients; the others as in `render`."""
    seen = (means.detach(), radii.detach(), opacities.detach())
    if (module := _compiled(backend, means)) is not None:
        rows = in_view(means, radii, cam_from_world, intrinsics, NEAR)
        projected = project_map(seen[0][rows], seen[1][rows], cam_from_world, intrinsics)
        return rows, module.class_weights(*projected, seen[2][rows], NEAR, counts, channels, classes)
    # A rendering changes with a Gaussian's features by the Gaussian's part in each pixel.
    pixels = channels.reshape(-1, 1).long()
    weight = counts.reshape(-1, 1) * (pixels < classes)
    given = weight.new_zeros(len(pixels), classes).scatter_(1, pixels.clamp(max=classes - 1), weight)
    with torch.enable_grad():
        features = means.new_zeros(len(means), classes).requires_grad_()
        shown = render(*seen, features, cam_from_world, intrinsics, backend=backend).features
        found = torch.autograd.grad(shown, features, given.reshape(shown.shape))[0]
    return torch.arange(len(means), device=means.device), found


def error_shares(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    colors: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    error_of: Callable[[Tensor], Tensor],
) -> tuple[Tensor, Tensor]:
    """The errors of the pixels, weighed by each Gaussian's part in them and summed, and its radius in pixels, of those
    in view; (M,) each. `error_of`: (H, W, 3) colours of the map to (H, W) errors. No gradients; the others as in
    `render`."""
    seen = (means.detach(), radii.detach(), opacities.detach())
    if (module := _compiled(None, means)) is not None:
        rows = in_view(*seen[:2], cam_from_world, intrinsics)
        u, v, sigma_px, z = project_map(seen[0][rows], seen[1][rows], cam_from_world, intrinsics)
        size = (intrinsics.width, intrinsics.height)
        given = (u, v, sigma_px, z, seen[2][rows], colors[rows], *size, NEAR, error_of)
        found = (module.weighted_errors(*given), sigma_px)
        errors, footprints = (torch.zeros_like(seen[1]).index_copy(0, rows, x) for x in found)
        return errors, footprints
    if (kernels := kernels_for(None, means)) is None:
        shown = render(*seen, colors.detach(), cam_from_world, intrinsics).features
        weights = blending_weights(*seen, cam_from_world, intrinsics, counts=error_of(shown))
        return weights.total, project_map(*seen[:2], cam_from_world, intrinsics)[2]
    # Projected and listed once for both.
    size = (intrinsics.width, intrinsics.height)
    records = kernels.project(*seen, cam_from_world.to(means), intrinsics, NEAR)
    tiles = kernels.list_tiles(records, *size)
    shown = kernels.composite_records(records, colors.detach(), *size, tiles)[0]
    return kernels.inspect_records(records, *size, error_of(shown), tiles)[1], records[:, 2]


def _compiled(backend: str | None, example: Tensor) -> ModuleType | None:
    """The compiled CPU backend, where tensors like `example` take it."""
    if kernels_for(backend, example) is not None:
        return None
    module = choose_backend(backend, example)
    return module if module.__name__.endswith(".cpu") else None


def _inspect(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    near: float,
    backend: str | None,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    if (kernels := kernels_for(backend, means)) is not None:
        pose = cam_from_world.detach().to(means)
        records = kernels.project(means.detach(), radii.detach(), opacities.detach(), pose, intrinsics, near)
        found: tuple[Tensor, Tensor, Tensor] = kernels.inspect_records(
            records, intrinsics.width, intrinsics.height, counts
        )
        return found
    require_finite("opacities", opacities)
    rows = in_view(means, radii, cam_from_world, intrinsics, near)
    drawn = means.detach()[rows], radii.detach()[rows]
    projected = project_map(*drawn, cam_from_world.detach(), intrinsics, near=near)
    module, size = choose_backend(backend, means), (intrinsics.width, intrinsics.height)
    median, *weights = module.inspect(*projected, opacities.detach()[rows], *size, near, counts)
    total, largest = (torch.zeros_like(radii.detach()).index_copy(0, rows, weight) for weight in weights)
    return median, total, largest
