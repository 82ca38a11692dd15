"""Class probabilities by a network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError
from pipelines.proxy.networks.letterbox import Letterbox
from pipelines.proxy.networks.session import Network


def network_labels(network: Network, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """(class ids (h, w), -1 for void; probability of that class (h, w)) of an RGB image (h, w, 3).

    Raises InputError for an output that is no image of classes, or one without any number.
    """
    card = network.card
    height, width = image.shape[:2]
    box = network.box(width, height)
    output = network.run(image, box)[0]
    if card.kind == "argmax":
        return _from_ids(network, output, box)
    classes = len(card.classes)
    if output.ndim != 3 or output.shape[0] != classes:
        raise InputError(f"{card.model}: gave {output.shape}; {classes} classes by height by width are expected")
    scores = output.astype(np.float32).transpose(1, 2, 0)
    broken = np.asarray(~np.isfinite(scores).all(-1))
    if broken.all():
        raise InputError(f"{card.model}: gave no number but NaN. Is the input range of the card right?")
    scores = np.ascontiguousarray(np.where(broken[..., None], 0, scores))
    # Interpolated before the softmax: boundaries between two classes then run through between the samples.
    scores = box.take(scores, card.align_corners)
    ids = scores.argmax(-1)
    best = scores.max(-1)
    likely = 1 / np.exp(scores - best[..., None]).sum(-1) if card.kind != "probabilities" else np.clip(best, 0, 1)
    probability = np.asarray(likely, np.float32)
    ids = np.where(np.isin(ids, card.void), -1, ids)
    if broken.any():
        lost = box.take(broken.astype(np.float32), card.align_corners) > 0.5
        ids, probability = np.where(lost, -1, ids), np.where(lost, 0, probability)
    return ids, np.where(ids < 0, 0, probability).astype(np.float32)


def _from_ids(network: Network, output: NDArray, box: Letterbox) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where an image of class ids is expected")
    rows, columns = box.indices(plane.shape[0], plane.shape[1])
    ids = plane[rows[:, None], columns[None, :]].astype(np.int64)
    known = (ids >= 0) & (ids < len(network.card.classes)) & ~np.isin(ids, network.card.void)
    return np.where(known, ids, -1), known.astype(np.float32)
