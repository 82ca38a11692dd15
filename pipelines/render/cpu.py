"""The renderer on CPUs: one walk over the tiles of each band that draws, looks or weighs, and its autograd operation;
and the projection of world Gaussians to an image (MSGS-SLAM eq. 5), one pass there and one back.

Gaussians are outermost, then the rows of a tile, sixteen pixels of a row at once.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..system.lanes import add_to_box, load, maximum, reduce_max, splat, store, total, where
from ..system.threads import PART, Floats, Ints, Longs, as_array, for_each, fused_kernel, inlined, inner
from ..types import Intrinsics
from .cpu_backward import pull_back
from .cpu_bands import (
    PIXELS,
    TILE,
    ImageBands,
    Vectors,
    clear,
    for_each_band,
    padded_channels,
    row_opacity,
    split_into_bands,
    vectors_for,
    walk_tiles,
)
from .rules import GaussianStats

F32 = np.float32
DEPTH_SUM, WEIGHTS, MEDIAN, COUNT = (PIXELS * i for i in range(4))
"""Planes of a tile's state, beside its light: the sum of weighted depths, the weights of the Gaussian at hand, median
depths, and what a pixel counts in sums of weights."""
IMAGES, WITH_MEDIAN, WITH_CLASSES = 3, 4, 6
"""Planes that are drawn: depth sum, depth silhouette, silhouette; median depth; strength and number of a class."""
STRENGTH, CHANNEL, FEATURES = 3, 4, 5
"""Of a Gaussian's features in `render_all`: after its colours how sure its class is, the class, and how many in all."""
ONLY, IS_MIXED = PIXELS, PIXELS + 1
"""Behind the classes of a tile's pixels: the class that is seen, and 1 where there are more."""
_ZERO, _HALF, _ONE = F32(0), F32(0.5), F32(1)


def composite(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, features: Tensor, width: int, height: int,
    near: float, stats: GaussianStats | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Return the feature image (H, W, C), depth sum, depth silhouette and silhouette (H, W) of float32 CPU tensors;
    the backward pass fills the stats."""
    return _Composite.apply(u, v, sigma_px, z, opacity, features, width, height, near, stats)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *projected, values = (as_array(tensor) for tensor in arguments[:6])
        width, height, near, ctx.stats = arguments[6:]
        bands = split_into_bands(tuple(projected), values, padded_channels(values.shape[1]), width, height, near)
        features, planes, _ = draw_bands(bands, width, height, values.shape[1])
        outputs = (torch.from_numpy(features), *torch.from_numpy(planes).unbind(0))
        ctx.save_for_backward(outputs[0])
        ctx.state = (bands, planes)
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        bands, planes = ctx.state
        features = as_array(ctx.saved_tensors[0])
        upstream = [
            np.zeros_like(image) if gradient is None else as_array(gradient)
            for image, gradient in zip((features, *planes), gradients, strict=True)
        ]
        marks = None if ctx.stats is None else ctx.stats.marks()
        d_geometry, d_features, noted = pull_back(bands, features, planes, upstream[0], np.stack(upstream[1:]), marks)
        if ctx.stats is not None:
            ctx.stats.largest, ctx.stats.error_share = torch.from_numpy(noted).unbind(1)
        return (*torch.from_numpy(d_geometry).unbind(0), torch.from_numpy(d_features), *[None] * 4)


def inspect(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, width: int, height: int, near: float,
    counts: Tensor | None = None, channels: Tensor | None = None, classes: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Find the median depth (H, W), and of each Gaussian the summed and the largest blending weight, (M,), and the sums
    by the class of the pixels, (M, classes); float32 CPU tensors. In the sums a pixel counts as counts (H, W) says, as
    1 where None, for the class of its channel (H, W) uint8."""
    bands = _bands_of((u, v, sigma_px, z, opacity), None, width, height, near)
    counted = torch.ones(height, width) if counts is None else counts.contiguous()
    of = torch.zeros(height, width, dtype=torch.uint8) if channels is None else channels.contiguous()
    _, planes, found = draw_bands(bands, width, height, 0, WITH_MEDIAN, classes, (counted.numpy(), of.numpy()))
    weights = torch.from_numpy(found)
    return torch.from_numpy(planes[3]), weights[:, 0], weights[:, 1], weights[:, 2:]


def render_all(
    u: Tensor, v: Tensor, sigma_px: Tensor, z: Tensor, opacity: Tensor, features: Tensor, classes: int, width: int,
    height: int, near: float,
) -> tuple[Tensor, ...]:  # fmt: skip
    """Draw colours (H, W, 3), and (H, W) each the depth sum, silhouette, median depth, and of the classes the largest
    sum of strengths and the one that has it; features (M, 5): colour, strength, class; float32 CPU tensors."""
    bands = _bands_of((u, v, sigma_px, z, opacity), features, width, height, near)
    colors, planes, _ = draw_bands(bands, width, height, 3, WITH_CLASSES, classes)
    return torch.from_numpy(colors), *(torch.from_numpy(planes[k]) for k in (0, 2, 3, 4, 5))


def _bands_of(
    gaussians: tuple[Tensor, ...], features: Tensor | None, width: int, height: int, near: float
) -> ImageBands:
    projected = tuple(tensor.detach().contiguous().numpy() for tensor in gaussians)
    values = np.zeros((len(projected[0]), 0), F32) if features is None else features.detach().contiguous().numpy()
    return split_into_bands(projected, values, values.shape[1], width, height, near)


def draw_bands(
    bands: ImageBands,
    width: int,
    height: int,
    channels: int,
    planes: int = IMAGES,
    classes: int = 0,
    pixels: tuple[Floats, NDArray[np.uint8]] | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Walk once over all bands.

    Args:
        bands: with features padded to `padded_channels`, of WITH_CLASSES as `render_all` has them; without where
            pixels are given.
        channels: of the image.
        planes: how many are drawn: IMAGES, WITH_MEDIAN or WITH_CLASSES.
        classes: how many there are.
        pixels: what each counts (H, W) and its class (H, W), where Gaussians are weighed.

    Returns:
        The image (H, W, channels); the planes (P, H, W); and of each Gaussian, where it is weighed, the sum of its
        weights, the largest, and the sums by class (M, 2 + classes), else (0, 2 + classes).
    """
    image, out = np.empty((height, width, channels), F32), np.empty((planes, height, width), F32)
    is_weighed, vectors = pixels is not None, vectors_for(channels) if planes == IMAGES else None
    found = np.zeros((len(bands.first) if is_weighed else 0, 2 + classes), F32)
    shared = np.empty((int(bands.slots[-1]) if is_weighed else 0, 2 + classes), F32)
    given = pixels or (np.zeros((0, 0), F32), np.zeros((0, 0), np.uint8))
    places, room = (bands.first, bands.slots), channels if planes == WITH_MEDIAN else 3 + max(classes, 1)
    room = padded_channels(channels) if planes == IMAGES else room
    walk = {IMAGES: paint_band, WITH_MEDIAN: weigh_band, WITH_CLASSES: paint_class_band}[planes]
    for_each_band(
        lambda b: walk(
            vectors, room, classes, b, bands.own(b), *places, *bands.prepared[b], *given, image, out, found, shared
        ),
        bands.starts,
    )
    if is_weighed and len(straddling := bands.straddling):
        starts = bands.slots[straddling]
        found[straddling] = np.add.reduceat(shared, starts)
        found[straddling, 1] = np.maximum.reduceat(shared[:, 1], starts)
    return image, out, found


@inner
def open_drawing(job: tuple[Any, ...], vectors: Vectors, light: Floats, tile: tuple[int, ...]) -> None:
    """Empty the tile; load what its pixels count and their classes, and whether it shows more than one, or which."""
    image, state, own_class, counted, channels = job[0], job[1], job[5], job[6], job[7]
    left, top, columns, rows = tile
    clear(image)
    clear(state)
    if counted.size == 0:
        return
    only, is_mixed = -1, 0
    for y in range(rows):
        for x in range(columns):
            pixel, count, channel = TILE * y + x, counted[top + y, left + x], int(channels[top + y, left + x])
            state[COUNT + pixel], own_class[pixel] = count, channel
            if count > _ZERO:
                if only >= 0 and only != channel:
                    is_mixed = 1
                only = channel
    own_class[ONLY], own_class[IS_MIXED] = only, is_mixed


@inner
def blend_rows(
    light: Floats, state: Floats, falloff_y: Floats, first: int, last: int,
    pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Weights of one Gaussian in rows first..last of a tile; light and depth sum go on behind it."""
    depth = pair[5]
    for y in range(first, last + 1):
        row = TILE * y
        before = load(light, row)
        weight = row_opacity(y, before, falloff_y, pair) * before
        store(state, WEIGHTS + row, weight)
        store(light, row, before - weight)
        store(state, DEPTH_SUM + row, load(state, DEPTH_SUM + row) + weight * depth)


@inlined
def paint_image(
    job: tuple[Any, ...], vectors: Vectors, light: Floats, falloff_y: Floats, i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Blend one Gaussian into the tile's image."""
    image, state, features, stride = job[0], job[1], job[2], job[3]
    x0, x1, y0, y1 = box
    blend_rows(light, state, falloff_y, y0, y1, pair)
    if vectors is None:
        paint_rows(image, state, features, 3 * i, y0, y1)
    else:
        corner = TILE * y0 + x0
        add_to_box(
            image, corner * stride, features, i * stride, state, WEIGHTS + corner, y1 - y0 + 1, x1 - x0 + 1, vectors
        )


@inner
def paint_rows(
    image: Floats, state: Floats, features: Floats, at: int, first: int,
    last: int,
) -> None:  # fmt: skip
    """Add three features, those from `at` on, to the three planes of a tile's image, sixteen pixels at once."""
    red, green, blue = features[at], features[at + 1], features[at + 2]
    for row in range(TILE * first, TILE * last + TILE, TILE):
        weight = load(state, WEIGHTS + row)
        store(image, row, load(image, row) + weight * red)
        store(image, PIXELS + row, load(image, PIXELS + row) + weight * green)
        store(image, 2 * PIXELS + row, load(image, 2 * PIXELS + row) + weight * blue)


@inner
def note_median(state: Floats, row: int, weight: Any, behind: Any, depth: np.float32) -> None:
    """Note the depth of a Gaussian behind which less than half of the light is left, where no nearer one is noted."""
    before = load(state, MEDIAN + row)
    here = (behind < splat(_HALF)) & (weight > splat(_ZERO)) & (before <= splat(_ZERO))
    store(state, MEDIAN + row, before + where(here, splat(depth)))


@inlined
def paint_class(
    job: tuple[Any, ...], vectors: None, light: Floats, falloff_y: Floats, i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Blend one Gaussian's colours, and its strength into the plane of its class; note the median depth."""
    image, state, features = job[0], job[1], job[2]
    _, _, y0, y1 = box
    blend_rows(light, state, falloff_y, y0, y1, pair)
    paint_rows(image, state, features, FEATURES * i, y0, y1)
    strength, plane = features[FEATURES * i + STRENGTH], PIXELS * (3 + int(features[FEATURES * i + CHANNEL]))
    for row in range(TILE * y0, TILE * y1 + TILE, TILE):
        weight = load(state, WEIGHTS + row)
        store(image, plane + row, load(image, plane + row) + weight * strength)
        note_median(state, row, weight, load(light, row), pair[5])


@inlined
def weigh(
    job: tuple[Any, ...], vectors: None, light: Floats, falloff_y: Floats, i: int,
    box: tuple[int, ...], pair: tuple[Any, ...],
) -> None:  # fmt: skip
    """Add one Gaussian's weights in a tile to its row, and note where half of the light is lost in it."""
    state, seen, own_class = job[1], job[4], job[5]
    x0, x1, y0, y1 = box
    blend_rows(light, state, falloff_y, y0, y1, pair)
    summed, top_weight = splat(_ZERO), splat(_ZERO)
    for row in range(TILE * y0, TILE * y1 + TILE, TILE):
        weight, behind = load(state, WEIGHTS + row), load(light, row)
        summed, top_weight = summed + weight * load(state, COUNT + row), maximum(top_weight, weight)
        note_median(state, row, weight, behind, pair[5])
    sum_here = total(summed)
    seen[i, 0] += sum_here
    seen[i, 1] = max(seen[i, 1], reduce_max(top_weight))
    if seen.shape[1] > 2 and own_class[IS_MIXED] == 0:  # most tiles show one class
        seen[i, 2 + max(own_class[ONLY], 0)] += sum_here
    elif seen.shape[1] > 2:
        for y in range(y0, y1 + 1):
            for pixel in range(TILE * y + x0, TILE * y + x1 + 1):
                seen[i, 2 + own_class[pixel]] += state[WEIGHTS + pixel] * state[COUNT + pixel]


@inner
def close_drawing(job: tuple[Any, ...], vectors: Vectors, light: Floats, tile: tuple[int, ...]) -> None:
    """Write the tile into the images."""
    image, state, stride, planes, out, classes = job[0], job[1], job[3], job[8], job[9], job[10]
    left, top, columns, rows = tile
    for y in range(rows):
        for x in range(columns):
            pixel = TILE * y + x
            row = out[top + y, left + x]
            for c in range(len(row)):
                row[c] = image[PIXELS * c + pixel if vectors is None else pixel * stride + c]
            seen = _ONE - light[pixel]
            planes[0, top + y, left + x] = state[DEPTH_SUM + pixel]
            planes[1, top + y, left + x] = seen
            planes[2, top + y, left + x] = seen
            if len(planes) > IMAGES:
                planes[3, top + y, left + x] = state[MEDIAN + pixel]
            if len(planes) == WITH_CLASSES:
                best = 0
                for c in range(1, classes):
                    if image[PIXELS * (3 + c) + pixel] > image[PIXELS * (3 + best) + pixel]:
                        best = c
                planes[4, top + y, left + x] = image[PIXELS * (3 + best) + pixel]
                planes[5, top + y, left + x] = best


@inner
def walk_band(
    visit: Any, vectors: Vectors, room: int, classes: int, band: int, own: Ints, first: Ints, slots: Longs,
    records: Floats, features: Floats, tile_starts: Longs, members: Ints, counted: Floats, channels: NDArray[np.uint8],
    out: Floats, planes: Floats, found: Floats, shared: Floats,
) -> None:  # fmt: skip
    """Fill the band's rows of the image and the planes, and those of `found` (or of `shared`) of the Gaussians seen in
    it; see `draw_bands`. `room`: numbers a tile keeps of a pixel's channels."""
    height, width = out.shape[:2]
    is_weighed = counted.size > 0
    seen = np.zeros((len(own) if is_weighed else 0, found.shape[1]), np.float32)
    kept = 4 if is_weighed else 3 if len(planes) > IMAGES else 2
    image, state = np.empty(PIXELS * room, np.float32), np.empty(PIXELS * kept, np.float32)
    own_class, stride = np.zeros(PIXELS + 2, np.int64), len(features) // max(len(own), 1)
    job = (image, state, features, stride, seen, own_class, counted, channels, planes, out, classes)
    walk_tiles((open_drawing, visit, close_drawing), job, vectors, band, tile_starts, members, records, width, height)
    for k in range(len(seen)):
        i = own[k]
        row = shared[slots[i] + band - first[i]] if slots[i + 1] > slots[i] else found[i]
        for c in range(found.shape[1]):
            row[c] = seen[k, c]


@fused_kernel
def paint_band(*given: Any) -> None:
    """Draw images; each kernel is compiled for what it does with a Gaussian alone, at two thirds of the time."""
    walk_band(paint_image, *given)


@fused_kernel
def paint_class_band(*given: Any) -> None:
    """Draw images, median depths and classes."""
    walk_band(paint_class, *given)


@fused_kernel
def weigh_band(*given: Any) -> None:
    """Draw median depths, and weigh Gaussians."""
    walk_band(weigh, *given)


# projection -------------------------------------------------------------------------------------------------------


def project(
    means: Tensor, radii: Tensor, cam_from_world: Tensor, intrinsics: Intrinsics, near: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """u, v, sigma_px, z (M,) as of `geometry.camera.project_gaussians`, of float32 Gaussians on the CPU seen from
    cam_from_world (4, 4), float32; differentiable in the first three. The same bytes for any number of threads."""
    return _Projected.apply(means, radii, cam_from_world, intrinsics, near)


class _Projected(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        k, near = arguments[3:]
        ctx.save_for_backward(*arguments[:3])
        ctx.camera = np.array([k.fx, k.fy, k.cx, k.cy, (k.fx * k.fy) ** 0.5, near], np.float32)
        given = [as_array(x) for x in arguments[:3]]
        out = np.empty((4, len(given[0])), np.float32)
        for_each(lambda part: _project(part * PART, *given, ctx.camera, out), -(-out.shape[1] // PART))
        return torch.from_numpy(out).unbind(0)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, radii, pose = (as_array(x) for x in ctx.saved_tensors)
        pull = [as_array(x) for x in gradients]
        d_means, d_radii, parts = np.empty_like(means), np.empty_like(radii), -(-len(means) // PART)
        d_pose = np.zeros((parts, 4, 4))
        for_each(
            lambda n: _pull_back(n * PART, means, radii, pose, ctx.camera, *pull, d_means, d_radii, d_pose[n]), parts
        )
        moved = torch.from_numpy(d_pose.sum(0).astype(np.float32)) if ctx.needs_input_grad[2] else None
        return torch.from_numpy(d_means), torch.from_numpy(d_radii), moved, None, None


@inner
def _in_camera(pose: Floats, center: Floats) -> tuple[np.float32, np.float32, np.float32]:
    """The centre (3,) seen from cam_from_world (4, 4)."""
    a, b, c = center
    x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
    y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
    z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
    return x, y, z


@fused_kernel
def _project(
    start: int, means: Floats, radii: Floats, pose: Floats, camera: Floats, out: Floats,
) -> None:  # fmt: skip
    """Project one part, from Gaussian `start` on; camera: fx, fy, cx, cy, the mean of the focal lengths, near."""
    fx, fy, cx, cy, focal, near = camera
    one = np.float32(1)
    for i in range(start, min(start + PART, len(means))):
        x, y, z = _in_camera(pose, means[i])
        inverse = one / (z if z > near else one)
        out[0, i] = fx * (x * inverse) + cx
        out[1, i] = fy * (y * inverse) + cy
        out[2, i] = focal * (radii[i] * inverse)
        out[3, i] = z


@fused_kernel
def _pull_back(
    start: int, means: Floats, radii: Floats, pose: Floats, camera: Floats, pull_u: Floats, pull_v: Floats,
    pull_sigma: Floats, pull_z: Floats, d_means: Floats, d_radii: Floats, d_pose: NDArray[np.float64],
) -> None:  # fmt: skip
    """Gradients of one part by those of u, v, sigma_px and z; its share of the pose's is added in float64."""
    fx, fy, _, _, focal, near = camera
    one, none = np.float32(1), np.float32(0)
    for i in range(start, min(start + PART, len(means))):
        a, b, c = means[i]
        x, y, z = _in_camera(pose, means[i])
        inverse = one / (z if z > near else one)
        by_u, by_v, by_sigma = fx * pull_u[i], fy * pull_v[i], focal * pull_sigma[i]
        by_inverse = (by_u * x + by_v * y + by_sigma * radii[i]) * inverse * inverse
        d_radii[i] = by_sigma * inverse
        d_x, d_y = by_u * inverse, by_v * inverse
        d_z = pull_z[i] - (by_inverse if z > near else none)
        for k in range(3):
            d_means[i, k] = pose[0, k] * d_x + pose[1, k] * d_y + pose[2, k] * d_z
        d_pose[0, 0] += d_x * a
        d_pose[0, 1] += d_x * b
        d_pose[0, 2] += d_x * c
        d_pose[0, 3] += d_x
        d_pose[1, 0] += d_y * a
        d_pose[1, 1] += d_y * b
        d_pose[1, 2] += d_y * c
        d_pose[1, 3] += d_y
        d_pose[2, 0] += d_z * a
        d_pose[2, 1] += d_z * b
        d_pose[2, 2] += d_z * c
        d_pose[2, 3] += d_z
