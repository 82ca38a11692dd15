"""Forward-only views of the map: the depth of surfaces, and how much each Gaussian takes part in an image."""

from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor

from ..types import Intrinsics
from .api import NEAR, Backend, choose_backend, depth_ratio, in_view, kernels_for, project_map, render, require_finite
from .gaussian_map import DECIDED_LOGIT, GaussianMap, decided_channels


@dataclass(frozen=True)
class BlendingWeights:
    """Of every Gaussian, over all pixels of an image: its summed (weighed by what the pixels count) and its largest
    blending weight, (M,) each."""

    total: Tensor
    largest: Tensor


@dataclass(frozen=True)
class Rendered:
    """colors (H, W, 3); depth and silhouette (H, W) as of a `Rendering`; median (H, W) as of `median_depth`; channels
    (H, W) int16: the class for which most is said, each Gaussian speaking for the strongest of its own as far as it is
    seen, -1 where nothing decides."""

    colors: Tensor
    depth: Tensor
    median: Tensor
    silhouette: Tensor
    channels: Tensor


def median_depth(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    near: float = NEAR,
    backend: Backend = None,
) -> Tensor:
    """(H, W) depth of the Gaussian at which half the light is lost, 0 where it never is: one surface, never a mean of
    two. No gradients; arguments as in `render`."""
    return _inspect(means, radii, opacities, cam_from_world, intrinsics, near, backend)[0]


@torch.no_grad()
def render_all(
    gaussian_map: GaussianMap, cam_from_world: Tensor, intrinsics: Intrinsics, backend: Backend = None
) -> Rendered:
    """Render what a camera at (4, 4) sees of a map, by one walk over it on the CPU. No gradients."""
    m, size = gaussian_map, (intrinsics.width, intrinsics.height)
    classes = m.class_logits.shape[1]
    if (module := _compiled(backend, m.means)) is not None:
        m = m.only(in_view(m.means, m.radii, cam_from_world, intrinsics))
        projected = project_map(m.means, m.radii, cam_from_world, intrinsics)
        features = torch.cat([m.colors, *_strongest(m.class_logits)], dim=1)
        require_finite("features", features)
        found = module.render_all(*projected, m.opacities, features, classes, *size, NEAR)
        colors, depth_sum, silhouette, median, strength, channel = found
        channels = torch.where(strength > DECIDED_LOGIT, channel, -1) if classes else torch.full_like(channel, -1)
        return Rendered(colors, depth_ratio(depth_sum, silhouette), median, silhouette, channels.to(torch.int16))
    strength, channel = _strongest(m.class_logits)
    own = torch.zeros_like(m.class_logits).scatter_(1, channel.long(), strength) if classes else m.class_logits
    seen, camera = (m.means, m.radii, m.opacities), (cam_from_world, intrinsics)
    drawn = render(*seen, torch.cat([m.colors, own], dim=1), *camera, backend=backend)
    channels, median = decided_channels(drawn.features[..., 3:]), median_depth(*seen, *camera, backend=backend)
    return Rendered(drawn.features[..., :3], drawn.depth, median, drawn.silhouette, channels.to(torch.int16))


def _strongest(logits: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 1) each: the largest of the class logits (M, C), and which that is; zeros without classes."""
    if logits.shape[1] == 0:
        return logits.new_zeros(len(logits), 1), logits.new_zeros(len(logits), 1)
    strength, channel = logits.max(1, keepdim=True)
    return strength, channel.to(logits)


def blending_weights(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    near: float = NEAR,
    backend: Backend = None,
    counts: Tensor | None = None,
) -> BlendingWeights:
    """Measure what each of the M Gaussians contributes to the image of a camera: 0 where it is not seen. No gradients;
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
    backend: Backend = None,
) -> tuple[Tensor, Tensor]:
    """Rows (R,) of the Gaussians in view, and (R, classes) what each contributes to the pixels of each class: channels
    (H, W) uint8, other numbers are no class; counts (H, W). No gradients; the others as in `render`."""
    seen = (means.detach(), radii.detach(), opacities.detach())
    if (module := _compiled(backend, means)) is not None:
        rows = in_view(means, radii, cam_from_world, intrinsics, NEAR)
        means, radii, opacities = (x.index_select(0, rows) for x in seen)
        projected = project_map(means, radii, cam_from_world, intrinsics)
        return rows, module.class_weights(*projected, opacities, NEAR, counts, channels, classes)
    # A rendering changes with a Gaussian's features by the Gaussian's part in each pixel.
    pixels = channels.reshape(-1, 1).long()
    weight = counts.reshape(-1, 1) * (pixels < classes)
    given = weight.new_zeros(len(pixels), classes).scatter_(1, pixels.clamp(max=classes - 1), weight)
    with torch.enable_grad():
        features = means.new_zeros(len(means), classes).requires_grad_()
        shown = render(*seen, features, cam_from_world, intrinsics, backend=backend).features
        found = torch.autograd.grad(shown, features, given.reshape(shown.shape))[0]
    return torch.arange(len(means), device=means.device), found


def _compiled(backend: Backend, example: Tensor) -> ModuleType | None:
    """The compiled CPU backend, where tensors like `example` take it."""
    if kernels_for(backend, example) is not None:
        return None
    module = choose_backend(backend, example)
    return module if hasattr(module, "render_all") else None


def _inspect(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    near: float,
    backend: Backend,
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
    drawn = means.detach().index_select(0, rows), radii.detach().index_select(0, rows)
    projected = project_map(*drawn, cam_from_world.detach(), intrinsics, near=near)
    module, size = choose_backend(backend, means), (intrinsics.width, intrinsics.height)
    median, *weights = module.inspect(*projected, opacities.detach().index_select(0, rows), *size, near, counts)
    total, largest = (torch.zeros_like(radii.detach()).index_copy(0, rows, weight) for weight in weights)
    return median, total, largest
