"""Drawing a map from a camera: projection (MSGS-SLAM eq. 5) around the compositing of eq. (6)-(9); and looking at one
without gradients: the depth of surfaces, the classes, how much each Gaussian takes part in an image."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..geometry import se3
from ..geometry.camera import project_gaussians
from ..system import gpu
from ..system.machine import has_triton
from ..system.threads import PART, for_each, fused_kernel
from ..types import Intrinsics
from . import rules
from .gaussian_map import DECIDED_LOGIT, GaussianMap, decided_channels
from .rules import GaussianStats

Backend: TypeAlias = str | ModuleType | None
NEAR = 0.01
"""Gaussians whose centre is nearer than this (or behind the camera) are not drawn; in the unit of the map."""


@dataclass(frozen=True)
class Rendering:
    """features (H, W, C); depth (H, W) = depth sum / depth silhouette, 0 where nothing is seen; silhouette (H, W)."""

    features: Tensor
    depth: Tensor
    silhouette: Tensor


def render(
    means: Tensor,
    radii: Tensor,
    opacities: Tensor,
    features: Tensor,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    twist: Tensor | None = None,
    near: float = NEAR,
    backend: Backend = None,
    stats: GaussianStats | None = None,
) -> Rendering:
    """Draw M Gaussians from the pose exp(twist) @ cam_from_world; differentiable in all of them.

    means (M, 3), radii (M,) world standard deviations, opacities (M,) 0..1, features (M, C), cam_from_world (4, 4),
    twist (6,) translation first (see `pipelines.geometry.se3`). Pose and twist best stay on the host where the
    Gaussians lie on a card: on six numbers a card is slower. The backward pass fills `stats`. Raises
    ValueError for wrong shapes, and for NaN and infinity in what lies on the CPU.
    """
    pose = cam_from_world if twist is None else moved(cam_from_world, twist)
    if (kernels := kernels_for(backend, means)) is not None:
        size = (intrinsics.width, intrinsics.height)
        check_arguments({"radii": radii, "opacities": opacities, "features": features}, *size)
        records = kernels.project(means, radii, opacities, placed_as(pose, means), intrinsics, near)
        shown, above, below, silhouette = kernels.composite_records(records, features, *size, stats=stats)
        return Rendering(shown, kernels.depth_ratio(above, below), silhouette)
    if not torch.is_grad_enabled():
        rows = in_view(means, radii, pose, intrinsics, near)
        means, radii, opacities, features = (x.index_select(0, rows) for x in (means, radii, opacities, features))
    u, v, sigma_px, z = project_map(means, radii, pose, intrinsics, near)
    size = (intrinsics.width, intrinsics.height)
    image = composite(u, v, sigma_px, z, opacities, features, *size, backend, near, stats)
    depth = depth_ratio(image.depth_sum, image.depth_silhouette)
    return Rendering(image.features, depth, image.silhouette)


def kernels_for(backend: Backend, example: Tensor) -> ModuleType | None:
    """Return the kernels that also project, where tensors like `example` take them; they cull themselves."""
    if backend != "cuda" and (backend is not None or not gpu.supports_triton(example)):
        return None
    return choose_backend("cuda", example)


def moved(cam_from_world: Tensor, twist: Tensor) -> Tensor:
    """Return exp(twist) @ cam_from_world in the precision of the pose (float64 in this project); raises ValueError for
    NaN in a twist on the CPU."""
    require_finite("twist", twist)
    return se3.exp(twist.to(cam_from_world.dtype)) @ cam_from_world


def project_map(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float = NEAR
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project Gaussians into a camera: u, v, sigma_px, z (M,); raises ValueError for NaN in what lies on the CPU."""
    for name, tensor in (("means", means), ("radii", radii), ("cam_from_world", cam_from_world)):
        require_finite(name, tensor)
    if means.device.type == "cpu" and means.dtype == torch.float32:
        from .cpu import project  # imports numba

        return project(means, radii, placed_as(cam_from_world, means), intrinsics, near)
    points_in_cam = se3.transform(placed_as(cam_from_world, means), means)
    return project_gaussians(points_in_cam, radii, intrinsics, near)


def placed_as(numbers: Tensor, other: Tensor) -> Tensor:
    """Return `numbers` on the device and in the type of `other`; the gradient comes back in one copy."""
    if numbers.device == other.device:
        return numbers.to(other)
    return _PlacedAs.apply(numbers, other)


class _PlacedAs(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, numbers: Tensor, other: Tensor) -> Tensor:
        ctx.device, ctx.dtype = numbers.device, numbers.dtype
        return numbers.detach().to(other)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        return grads[0].to(ctx.device).to(ctx.dtype), None


def depth_ratio(depth_sum: Tensor, depth_silhouette: Tensor) -> Tensor:
    """Divide the depth sum by its silhouette, with value and gradient 0 where no Gaussian is seen."""
    seen = depth_silhouette > 1e-6
    return torch.where(seen, depth_sum / torch.where(seen, depth_silhouette, 1.0), 0.0)


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
    backend: Backend = None,
    near: float = 0.0,
    stats: GaussianStats | None = None,
) -> Composite:
    """Blend M Gaussians into a width x height image; differentiable in the first six arguments.

    u, v, sigma_px (M,) pixels, pixel centres at half integers; z (M,) depth, ignored where <= near; opacity (M,) 0..1;
    features (M, C). backend: "cpu", "cuda", a module with the same functions, or None for the one that runs these
    tensors. stats: filled by the backward pass. Raises
    ValueError for wrong shapes, for NaN or infinity on the CPU (by the argument's name) and for an unknown backend.
    """
    arguments = {"u": u, "v": v, "sigma_px": sigma_px, "z": z, "opacity": opacity, "features": features}
    check_arguments(arguments, width, height)
    module = choose_backend(backend, u)
    return Composite(*module.composite(u, v, sigma_px, z, opacity, features, width, height, float(near), stats))


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


def choose_backend(backend: Backend, example: Tensor) -> ModuleType:
    """Return the module that composites tensors like `example`; without a choice, the one that can."""
    if isinstance(backend, ModuleType):
        return backend
    name = backend or _able(example)
    if name == "cpu":
        from . import cpu  # importing numba takes a while: only where it is used

        return cpu
    if name == "cuda":
        if not has_triton():
            raise ValueError("backend: 'cuda' needs triton >= 3.3, which comes with torch >= 2.7 built for CUDA")
        from . import cuda

        return cuda
    raise ValueError(f"backend: got {backend!r}, expected 'cpu', 'cuda', a module or None")


def _able(example: Tensor) -> str:
    if example.device.type == "cpu" and example.dtype == torch.float32:
        return "cpu"
    if gpu.supports_triton(example):
        return "cuda"
    raise ValueError(
        f"nothing renders {example.dtype} on {example.device}: float32 is rendered on a CPU, and on an NVIDIA card of "
        "compute capability 8.0 and more with triton >= 3.3"
    )


@torch.no_grad()
def in_view(means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float = NEAR) -> Tensor:
    """List the indices (n,) of the Gaussians whose square reaches the image, a pixel to spare: no others count."""
    for name, tensor in (("means", means), ("radii", radii)):
        require_finite(name, tensor)
    k, pose = intrinsics, cam_from_world.to(means)
    if means.device.type == "cpu" and means.dtype == torch.float32:
        camera = np.array([k.fx, k.fy, k.cx, k.cy, k.width, k.height, near], np.float32)
        centers, sizes, motion = (x.detach().contiguous().numpy() for x in (means, radii, pose))
        parts = -(-len(centers) // PART)
        found = [np.empty(0, np.int64)] * parts

        def find(part: int) -> None:
            own = slice(part * PART, (part + 1) * PART)
            found[part] = _list_in_view(centers[own], sizes[own], motion, camera, own.start)

        for_each(find, parts)
        return torch.from_numpy(np.concatenate([np.empty(0, np.int64), *found]))
    if gpu.supports_triton(means):
        return torch.nonzero(marked_in_view(means, radii, pose, k, near))[:, 0]
    u, v, sigma_px, z = project_gaussians(se3.transform(pose, means), radii, k, near)
    reach = rules.CUT_SIGMAS * sigma_px + 1
    seen = (z > near) & (u > -reach) & (u < k.width + reach) & (v > -reach) & (v < k.height + reach)
    return torch.nonzero(seen)[:, 0]


def marked_in_view(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float = NEAR
) -> Tensor:
    """Mark those `in_view`, (M,) bool, of tensors of one GPU; unlike a list it keeps nobody waiting for its length."""
    from .cuda_projection import mark_in_view  # imports triton

    return mark_in_view(means, radii, cam_from_world.to(means), intrinsics, near)


@fused_kernel
def _list_in_view(
    means: NDArray[np.float32], radii: NDArray[np.float32], pose: NDArray[np.float32], camera: NDArray[np.float32],
    start: int,
) -> NDArray[np.int64]:  # fmt: skip
    """See `in_view`; camera: fx, fy, cx, cy, width, height, near; the first of these is Gaussian number `start`."""
    fx, fy, cx, cy, width, height, near = camera
    focal = np.sqrt(fx * fy) * np.float32(rules.CUT_SIGMAS)
    out, count = np.empty(len(means), np.int64), 0
    for i in range(len(means)):
        x, y, z = means[i]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        # All lengths times the depth: nothing is divided, nor branched on, which is guessed wrong as often as right.
        reach = focal * radii[i] + depth
        u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) + cx * depth
        v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) + cy * depth
        inside = (u > -reach) & (v > -reach) & (u < width * depth + reach) & (v < height * depth + reach)
        out[count] = start + i
        count += (depth > near) & inside
    return out[:count].copy()


# looking --------------------------------------------------------------------------------------------------------


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


@torch.no_grad()
def median_depth(
    gaussian_map: GaussianMap, cam_from_world: Tensor, intrinsics: Intrinsics, backend: Backend = None
) -> Tensor:
    """(H, W) depth of the Gaussian at which half the light is lost, 0 where it never is: one surface, never a mean of
    two. No gradients; arguments as in `render`."""
    return _inspect(gaussian_map, cam_from_world, intrinsics, backend)[1]


@torch.no_grad()
def blending_weights(
    gaussian_map: GaussianMap,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    backend: Backend = None,
    counts: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Measure what each of the M Gaussians contributes to the image of a camera: its summed and its largest blending
    weight over all pixels, (M,) each. No gradients; `counts` (H, W): what a pixel's weights count in the sums, None for
    1; the others as in `render`."""
    rows, _, *weights = _inspect(gaussian_map, cam_from_world, intrinsics, backend, counts)
    total, largest = (torch.zeros_like(gaussian_map.log_radii).index_copy(0, rows, w) for w in weights[:2])
    return total, largest


@torch.no_grad()
def class_weights(
    gaussian_map: GaussianMap,
    cam_from_world: Tensor,
    intrinsics: Intrinsics,
    channels: Tensor,
    counts: Tensor,
    backend: Backend = None,
) -> tuple[Tensor, Tensor]:
    """Rows (R,) of the Gaussians in view, and (R, C) what each contributes to the pixels of each class: channels
    (H, W) uint8, other numbers are no class; counts (H, W). No gradients; the others as in `render`."""
    m, classes = gaussian_map, gaussian_map.class_logits.shape[1]
    known = channels < classes
    if _compiled(backend, m.means) is not None:
        of_pixels = (torch.where(known, counts, 0.0), torch.where(known, channels, 0))
        rows, *_, found = _inspect(m, cam_from_world, intrinsics, backend, *of_pixels, classes)
        return rows, found
    # A rendering changes with a Gaussian's features by the Gaussian's part in each pixel.
    pixels, weight = channels.reshape(-1, 1).long(), (counts * known).reshape(-1, 1)
    given = weight.new_zeros(len(pixels), classes).scatter_(1, pixels.clamp(max=classes - 1), weight)
    with torch.enable_grad():
        features = m.means.new_zeros(len(m), classes).requires_grad_()
        seen = (m.means.detach(), m.radii.detach(), m.opacities.detach(), features)
        shown = render(*seen, cam_from_world, intrinsics, backend=backend).features
        found = torch.autograd.grad(shown, features, given.reshape(shown.shape))[0]
    return torch.arange(len(m), device=m.means.device), found


@torch.no_grad()
def render_all(
    gaussian_map: GaussianMap, cam_from_world: Tensor, intrinsics: Intrinsics, backend: Backend = None
) -> Rendered:
    """Render what a camera at (4, 4) sees of a map, by one walk over it on the CPU. No gradients."""
    m, camera = gaussian_map, (cam_from_world, intrinsics)
    classes = m.class_logits.shape[1]
    if (module := _compiled(backend, m.means)) is not None:
        m = m.only(in_view(m.means, m.radii, *camera))
        features = torch.cat([m.colors, *_strongest(m.class_logits)], dim=1)
        require_finite("features", features)
        size = (intrinsics.width, intrinsics.height)
        found = module.render_all(*project_map(m.means, m.radii, *camera), m.opacities, features, classes, *size, NEAR)
        colors, depth_sum, silhouette, median, strength, channel = found
        channels = torch.where(strength > DECIDED_LOGIT, channel, -1) if classes else torch.full_like(channel, -1)
        return Rendered(colors, depth_ratio(depth_sum, silhouette), median, silhouette, channels.to(torch.int16))
    strength, channel = _strongest(m.class_logits)
    own = torch.zeros_like(m.class_logits).scatter_(1, channel.long(), strength) if classes else m.class_logits
    drawn = render(m.means, m.radii, m.opacities, torch.cat([m.colors, own], dim=1), *camera, backend=backend)
    channels, median = decided_channels(drawn.features[..., 3:]), median_depth(m, *camera, backend)
    return Rendered(drawn.features[..., :3], drawn.depth, median, drawn.silhouette, channels.to(torch.int16))


def _strongest(logits: Tensor) -> tuple[Tensor, Tensor]:
    """(M, 1) each: the largest of the class logits (M, C), and which that is; zeros without classes."""
    if logits.shape[1] == 0:
        return logits.new_zeros(len(logits), 1), logits.new_zeros(len(logits), 1)
    strength, channel = logits.max(1, keepdim=True)
    return strength, channel.to(logits)


def _compiled(backend: Backend, example: Tensor) -> ModuleType | None:
    """The compiled CPU backend, where tensors like `example` take it."""
    if kernels_for(backend, example) is not None:
        return None
    module = choose_backend(backend, example)
    return module if hasattr(module, "render_all") else None


def _inspect(
    gaussian_map: GaussianMap, cam_from_world: Tensor, intrinsics: Intrinsics, backend: Backend, *pixels: Any
) -> tuple[Tensor, ...]:
    """Rows (R,) of the Gaussians looked at, and what a backend's `inspect` tells of them, given the `pixels`."""
    m, size = gaussian_map, (intrinsics.width, intrinsics.height)
    if (kernels := kernels_for(backend, m.means)) is not None:
        records = kernels.project(m.means, m.radii, m.opacities, cam_from_world.to(m.means), intrinsics, NEAR)
        counts = pixels[0] if pixels else None
        return torch.arange(len(m), device=m.means.device), *kernels.inspect_records(records, *size, counts)
    radii, opacities = m.radii, m.opacities
    require_finite("opacities", opacities)
    rows = in_view(m.means, radii, cam_from_world, intrinsics)
    means, radii, opacities = (x.index_select(0, rows) for x in (m.means, radii, opacities))
    projected = project_map(means, radii, cam_from_world, intrinsics)
    return rows, *choose_backend(backend, m.means).inspect(*projected, opacities, *size, NEAR, *pixels)
