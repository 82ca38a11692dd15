"""Class probabilities by a network."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from .card import Card
from .session import Letterbox, Network


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
