"""Depth, and class probabilities, from the outputs of a network."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..geometry.camera import unproject_depth
from ..geometry.voxels import normals_in_cam
from ..types import Intrinsics
from .card import Card
from .session import Letterbox, Network

_ALIKE = np.radians(30)
_MIN_COSINE = 0.7


PLAIN_CONFIDENCE = 0.5
"""Confidence of a network that gives none of its own."""


@dataclass(frozen=True)
class NetworkDepth:
    """depth, confidence (h, w); `invalid` values were NaN or negative; normals (h, w, 3) int8 in 127ths that face the
    camera, and the focal length in pixels that the network's own points imply, where it gives them."""

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    invalid: int
    normals: NDArray[np.int8] | None = None
    focal: float | None = None


def network_depth(network: Network, image: NDArray[np.uint8], intrinsics: Intrinsics) -> NetworkDepth:
    """Depth of an RGB image with these intrinsics.

    A canonical depth becomes metres by the focal length of the image as the network saw it: `z = d · f / f_canonical`
    (Metric3D, Yin et al., ICCV 2023). Values at the network's stops, NaN and negative ones are unknown.
    Raises InputError when the output is no image of depth.
    """
    card = network.card
    box = network.box(intrinsics.width, intrinsics.height)
    outputs = network.run(image, box)
    focal = None
    if card.kind == "points":
        raw, focal = points_depth(network, outputs, box, intrinsics)
    else:
        raw = _plane(network, outputs["output"])
    broken = ~np.isfinite(raw) | (raw < 0)
    bad = broken | (raw <= card.valid[0]) | (raw >= card.valid[1])
    # Bilinear reading must not mix invalid values in: a pixel is known when all that it is made of is.
    depth = box.take(np.where(bad, 0, raw).astype(np.float32), card.align_corners)
    if bad.any():
        depth[box.take(bad.astype(np.float32), card.align_corners) > 1e-3] = 0
    if card.canonical_focal:
        scale_x, scale_y = box.scale
        depth *= np.float32((intrinsics.fx * scale_x + intrinsics.fy * scale_y) / 2 / card.canonical_focal)
    normals = _normals(network, outputs, box, depth, intrinsics)
    if "confidence" in outputs:
        given = np.nan_to_num(_plane(network, outputs["confidence"]), nan=0.0)
        confidence = box.take(np.clip(given, 0, 1), card.align_corners)
    else:
        kappa = box.take(_plane(network, outputs["kappa"]), card.align_corners) if "kappa" in outputs else None
        confidence = plain_confidence(depth, normals, kappa, intrinsics)
    known = (confidence * (depth > 0)).astype(np.float32)
    stored = None if normals is None else np.round(normals * 127).astype(np.int8)
    return NetworkDepth(depth, known, int(broken.sum()), stored, focal)


def plain_confidence(
    depth: NDArray[np.float32], normals: NDArray[np.float32] | None, kappa: NDArray | None, intrinsics: Intrinsics
) -> NDArray[np.float32]:
    """(h, w) confidence of a depth whose network says nothing of it: a half where its two answers, the normals and
    the slope of the depth, agree, down to a quarter where they do not; a quarter up or down by how sure the normals
    are (a weak cue: `kappa` has no scale of its own)."""
    confidence = np.full(depth.shape, PLAIN_CONFIDENCE, np.float32)
    if normals is None:
        return confidence
    slope = normals_in_cam(depth, intrinsics)
    cosine = (slope * normals).sum(-1)
    agree = np.exp(-((np.arccos(np.clip(cosine, -1, 1)) / _ALIKE) ** 2))
    confidence = confidence * np.where(np.abs(slope).sum(-1) > 0, 0.5 + 0.5 * agree, 0.75)
    if kappa is not None:
        sure = np.maximum(np.nan_to_num(kappa, nan=0.0, posinf=0.0), 0)
        confidence = confidence * (0.75 + 0.5 * sure / (sure + max(float(np.median(sure)), 1e-9)))
    return confidence.astype(np.float32)


def _normals(
    network: Network, outputs: dict[str, NDArray], box: Letterbox, depth: NDArray[np.float32], intrinsics: Intrinsics
) -> NDArray[np.float32] | None:
    """(h, w, 3) unit normals that face the camera."""
    given = outputs.get("normals")
    if given is None or given.ndim != 3 or 3 not in (given.shape[0], given.shape[2]):
        return None
    given = given if given.shape[2] == 3 else given.transpose(1, 2, 0)
    normals = box.take(np.nan_to_num(given).astype(np.float32), network.card.align_corners)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(length > 0.1, normals / np.maximum(length, 1e-6), 0).astype(np.float32)
    rays = unproject_depth(np.ones(depth.shape), intrinsics)
    normals = np.where((normals * rays).sum(-1, keepdims=True) > 0, -normals, normals)
    slope = normals_in_cam(depth, intrinsics)
    both = (np.abs(slope).sum(-1) > 0) & (np.abs(normals).sum(-1) > 0)
    if not both.any() or np.median((slope * normals).sum(-1)[both]) < _MIN_COSINE:
        return None
    return normals.astype(np.float32)


def _plane(network: Network, output: NDArray) -> NDArray[np.float32]:
    """(h', w') of an output that may carry a channel axis of length 1."""
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2 or min(plane.shape) < 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where an image of depth is expected")
    return plane.astype(np.float32)


def points_depth(
    network: Network, outputs: dict[str, NDArray], box: Letterbox, intrinsics: Intrinsics
) -> tuple[NDArray[np.float32], float | None]:
    """(h', w') depth in metres of an affine-invariant point map (h', w', 3), 0 outside its mask, and the focal length
    in pixels that it implies by itself.

    The network knows z only up to a shift, which the known focal length settles (MoGe, Wang et al., CVPR 2025).
    """
    card = network.card
    points = outputs["output"].astype(np.float64)
    if points.ndim != 3 or points.shape[2] != 3 or min(points.shape[:2]) < 2:
        raise InputError(f"{card.model}: gave {points.shape} where an image of points is expected")
    valid = np.isfinite(points).all(-1)
    if "mask" in outputs:
        valid &= _plane(network, outputs["mask"]) > 0.5
    if valid.sum() < 16:
        return np.zeros(valid.shape, np.float32), None
    rays = _rays(box, intrinsics, valid.shape)[valid]
    shift = solve_shift(points[valid], rays)
    _, focal = solve_shift_and_focal(points[valid][::7], rays[::7] * intrinsics.fx)
    scale = float(np.ravel(outputs["metric_scale"])[0]) if "metric_scale" in outputs else 1.0
    return np.where(valid, (points[..., 2] + shift) * scale, 0).astype(np.float32), focal


def solve_shift(points: NDArray[np.float64], rays: NDArray[np.float64]) -> float:
    """The s for which points (P, 3) with z + s are on their rays (P, 2), x/z and y/z: robust least squares."""
    weight = np.ones(len(points))
    shift = 0.0
    for _ in range(10):
        gap = points[:, :2] - points[:, 2:] * rays
        shift = float((weight[:, None] * rays * gap).sum() / max((weight[:, None] * rays**2).sum(), 1e-12))
        residual = np.linalg.norm(gap - shift * rays, axis=1)
        weight = 1 / (1 + (residual / (2 * np.median(residual) + 1e-9)) ** 2)
    return shift


def solve_shift_and_focal(points: NDArray[np.float64], pixels: NDArray[np.float64]) -> tuple[float, float]:
    """(shift, focal in pixels) of points (P, 3) seen at `pixels` (P, 2) from the principal point, focal unknown.

    Every point says `f · x - s · u = u · z`; two unknowns, solved by robust least squares.
    """
    rows = np.concatenate([np.stack([points[:, a], -pixels[:, a]], -1) for a in (0, 1)])
    right = np.concatenate([pixels[:, a] * points[:, 2] for a in (0, 1)])
    weight = np.ones(len(right))
    focal, shift = 1.0, 0.0
    for _ in range(10):
        focal, shift = np.linalg.lstsq(rows * weight[:, None], right * weight, rcond=None)[0]
        residual = np.abs(rows @ (focal, shift) - right)
        weight = 1 / (1 + (residual / (2 * np.median(residual) + 1e-9)) ** 2)
    return float(shift), float(focal)


def _rays(box: Letterbox, intrinsics: Intrinsics, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """(h', w', 2) x/z and y/z of every pixel of the network's output."""
    u = (np.arange(shape[1]) + 0.5) * box.box_width / shape[1]
    v = (np.arange(shape[0]) + 0.5) * box.box_height / shape[0]
    x = ((u - box.offset[0]) / box.scale[0] - intrinsics.cx) / intrinsics.fx
    y = ((v - box.offset[1]) / box.scale[1] - intrinsics.cy) / intrinsics.fy
    return np.stack(np.meshgrid(x, y), axis=-1)


def network_probabilities(network: Network, output: NDArray, width: int, height: int, side: int = 0) -> NDArray:
    """(h, w, C) float32 probability of every class from the network's output for an image of width x height; at the
    image's own pixels, or at `side` samples along its longer side. All 0 where the network says nothing.

    Raises InputError for an output that is no image of classes, or one without any number.
    """
    card = network.card
    box = network.box(width, height)
    if side and side < max(width, height):
        share = side / max(width, height)
        box = replace(box, width=max(1, round(width * share)), height=max(1, round(height * share)))
    if card.kind == "argmax":
        return _from_ids(network, output, box)
    scores = _scores(network, output, box)
    broken = np.asarray(~np.isfinite(scores).all(-1))
    if broken.all():
        raise InputError(f"{card.model}: gave no number but NaN. Is the input range of the card right?")
    scores = np.ascontiguousarray(np.where(broken[..., None], 0, scores))
    if card.groups:
        scores = _grouped(card, scores)
    # Interpolated before the softmax: boundaries between two classes then run through between the samples.
    scores = box.take(scores, card.align_corners)
    is_probability = card.kind == "probabilities" or bool(card.groups)
    found = np.clip(scores, 0, 1) if is_probability else softmax(scores)
    if broken.any():
        found[box.take(broken.astype(np.float32), card.align_corners) > 0.5] = 0
    return np.asarray(found, np.float32)


def softmax(scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """(..., C) → probabilities of the same shape."""
    raised = np.exp(scores - scores.max(-1, keepdims=True))
    return np.asarray(raised / raised.sum(-1, keepdims=True), np.float32)


def best_classes(probabilities: NDArray[np.float32], void: Sequence[int]) -> tuple[NDArray[np.int64], NDArray]:
    """(class ids (h, w), -1 where one of `void` or nothing at all is likeliest; probability of that class (h, w))."""
    ids, best = probabilities.argmax(-1), probabilities.max(-1)
    ids = np.where(np.isin(ids, list(void)) | (best <= 0), -1, ids)
    return ids, np.where(ids < 0, 0, best).astype(np.float32)


def _scores(network: Network, output: NDArray, box: Letterbox) -> NDArray[np.float32]:
    """(h', w', C) scores of the classes."""
    card = network.card
    if card.kind == "tokens":
        return _token_scores(network, output, box)
    head = network.head
    planes, what = (
        (len(card.classes), "classes") if head is None else (head.weight.shape[1], "features, as of the words,")
    )
    if output.ndim != 3 or output.shape[0] != planes:
        raise InputError(f"{card.model}: gave {output.shape}; {planes} {what} by height by width are expected")
    values = np.asarray(output.astype(np.float32).transpose(1, 2, 0))
    return values if head is None else head.scores(values)


def _token_scores(network: Network, output: NDArray, box: Letterbox) -> NDArray[np.float32]:
    """(rows, columns, C) scores of the patches of a transformer."""
    head = network.head
    if head is None or output.ndim != 2 or output.shape[1] != head.weight.shape[1]:
        raise InputError(f"{network.card.model}: gave {output.shape}, which does not fit the head or the words")
    return head.scores(patch_features(network, output, box.width, box.height))


def patch_features(network: Network, output: NDArray, width: int, height: int) -> NDArray[np.float32]:
    """(rows, columns, F) features of a transformer's patches for an image of width x height; the tokens before the
    patches (the class token) are left out. Raises InputError for an output that is no such list of tokens."""
    box = network.box(width, height)
    rows, columns = box.box_height // network.card.multiple, box.box_width // network.card.multiple
    if output.ndim != 2 or output.shape[0] < rows * columns:
        raise InputError(f"{network.card.model}: gave {output.shape} where {rows * columns} tokens are expected")
    patches = output[output.shape[0] - rows * columns :].astype(np.float32)
    return patches.reshape(rows, columns, -1)


def class_token(network: Network, output: NDArray, width: int, height: int) -> NDArray[np.float32] | None:
    """(F,) unit vector that describes the whole image: a transformer's first token; None where there is none."""
    box = network.box(width, height)
    patches = (box.box_height // network.card.multiple) * (box.box_width // network.card.multiple)
    if network.card.kind != "tokens" or output.ndim != 2 or output.shape[0] <= patches:
        return None
    token = np.nan_to_num(output[0].astype(np.float32))
    return (token / max(float(np.linalg.norm(token)), 1e-6)).astype(np.float32)


def _grouped(card: Card, scores: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h', w', G) probabilities of the groups: the sum over their classes."""
    if card.kind != "probabilities":
        scores = softmax(scores)
    labels = card.labels
    member = np.zeros((len(card.classes), len(labels)), np.float32)
    member[np.arange(len(card.classes)), [labels.index(g) for g in card.groups]] = 1
    return (scores @ member).astype(np.float32)


def _from_ids(network: Network, output: NDArray, box: Letterbox) -> NDArray[np.float32]:
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where an image of class ids is expected")
    rows, columns = box.indices(plane.shape[0], plane.shape[1])
    ids = plane[rows[:, None], columns[None, :]].astype(np.int64)
    return np.asarray(ids[..., None] == np.arange(len(network.card.classes)), np.float32)
