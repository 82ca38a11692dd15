"""Running a network that a card describes: its files checked, images into its input box, outputs back to the image."""

from __future__ import annotations

import functools
import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.reading import file_sha256, files_sha256, note_read
from .card import Card
from .runtime import external_locations, is_tflite, open_runtime, require_own_weights
from .words import LinearHead, WordHead, load_linear_head, load_word_head

_MAX_OUTPUT_VALUES = 200_000_000
_IMAGENET_MEAN = (123.675, 116.28, 103.53)
_TOKENS = (1200, 3600)


class Network:
    """An opened network that a card describes."""

    def __init__(self, card: Card, threads: int, device: str) -> None:
        """Raises InputError for a file that is not what the card says, before anything is computed."""
        self.card = card
        _require_whole(card)
        self.head: LinearHead | WordHead | None = None
        if card.head is not None:
            self.head = load_linear_head(card.head, len(card.classes))
        elif card.text is not None:
            self.head = load_word_head(card, threads, device)
        wanted = list(_outputs(card).values())
        bonus = {k: n for k, n in (("normals", card.normals), ("kappa", card.normal_confidence)) if n}
        self._runtime = open_runtime(card.model, [*wanted, *bonus.values()], threads, device)
        inputs, outputs = self._runtime.inputs, self._runtime.outputs
        if set(inputs) != set(filter(None, (card.input, card.tokens))):
            raise InputError(f"{card.model}: its inputs are {', '.join(inputs)}; the card says {card.input}")
        for name in {**dict.fromkeys(wanted), card.output: None}:
            if name not in outputs:
                raise InputError(
                    f"{card.model}: it has no output {name!r}, only {', '.join(outputs)}. Correct the card"
                )
            _require_bounded(card.model, name, outputs[name].shape)
        _require_fitting(card, outputs[card.output].shape)
        kind = inputs[card.input].dtype
        if kind is None or not issubclass(kind, np.floating):
            raise InputError(f"{card.model}: input {card.input} is not of float or float16. Correct the card")
        self._dtype = kind
        # Optional: exports of the same family without them work as well.
        self._extras = {k: n for k, n in bonus.items() if n in outputs}
        if card.metadata:
            self.card = card = _with_metadata(card, self._runtime.metadata)
        shape = inputs[card.input].shape
        fixed = tuple(s for s in shape[2:] if isinstance(s, int) and s > 0) if len(shape) == 4 else ()
        if len(fixed) == 2 and all(card.size) and card.size != fixed:
            raise InputError(f"{card.model}: takes {fixed[0]}x{fixed[1]}, the card says {card.size}. Correct the card")
        self._size = fixed if len(fixed) == 2 else card.size

    def box(self, width: int, height: int) -> Letterbox:
        """Choose the placement of a width x height image in the network's input."""
        return choose_box(width, height, self._size, self.card.multiple, self.card.pixels)

    def run(self, image: NDArray[np.uint8], box: Letterbox) -> dict[str, NDArray]:
        """The outputs that the card names (output, confidence, mask, metric_scale, and normals, kappa where the file
        has them) without the batch axis, for an RGB image (h, w, 3).

        Raises InputError when the network fails on it or answers with something huge.
        """
        card = self.card
        mean, std = np.array(card.mean, np.float32), np.array(card.std, np.float32)
        # Padding of the mean colour: 0 after normalisation, here or in the graph.
        pad = mean * 255 if any(card.mean) else np.array(_IMAGENET_MEAN, np.float32)
        if any(s != 1.0 for s in card.std):  # in units of white too; of 1, the default, nothing is divided
            std *= card.white
        values = (box.put(image, pad) * np.float32(card.white / 255) - mean * card.white) / std
        batch = np.ascontiguousarray(values.transpose(2, 0, 1)[None]).astype(self._dtype)
        feed: dict[str, NDArray] = {card.input: batch}
        if card.tokens:
            tokens = round(box.box_width * box.box_height / card.multiple**2)
            feed[card.tokens] = np.array(min(max(tokens, _TOKENS[0]), _TOKENS[1]), np.int64)
        names = {**_outputs(card), **self._extras}
        try:
            outputs = self._runtime.run(list(names.values()), feed)
        except RuntimeError as error:
            size = f"{box.box_width}x{box.box_height}"
            raise InputError(f"{card.model}: does not run on an input of {size} ({error}). Correct the card") from error
        for output in outputs:
            if output.size > _MAX_OUTPUT_VALUES or output.size == 0:
                raise InputError(f"{card.model}: gave an output of shape {output.shape}. Correct the card")
        return {role: np.asarray(o[0]) for role, o in zip(names, outputs, strict=True)}


def _outputs(card: Card) -> dict[str, str]:
    """Role → name of what the card asks for."""
    roles = ("output", "confidence", "mask", "metric_scale")
    return {role: name for role in roles if (name := getattr(card, role))}


def _with_metadata(card: Card, metadata: dict[str, str]) -> Card:
    """The card with the mean and std that the file itself states, in units of white; its own where there are none."""
    found: dict[str, tuple[float, ...]] = {}
    for word in ("mean", "std"):
        for key, text in sorted(metadata.items()):
            numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*(?:[eE]-?\d+)?", text)]
            if word in key.lower() and len(numbers) == 3 and min(numbers) > 0:
                found[word] = tuple(n / 255 if max(numbers) > 5 else n for n in numbers)
                break
    return replace(card, mean=found["mean"], std=found["std"]) if len(found) == 2 else card


def _require_whole(card: Card) -> None:
    if not card.model.is_file():
        raise InputError(f"{card.model}: there is no such file. Pull or download it again")
    if not card.sha256:
        return
    actual = file_sha256(card.model)
    if actual != card.sha256.lower():
        raise InputError(f"{card.model}: its sha256 is {actual}, the card says {card.sha256}. Download it again")


def _require_bounded(path: Path, name: str, shape: Sequence[int | str | None]) -> None:
    fixed = [s for s in shape if isinstance(s, int)]
    if np.prod([float(s) for s in fixed]) > _MAX_OUTPUT_VALUES or any(s <= 0 for s in fixed):
        raise InputError(f"{path}: output {name} has the shape {list(shape)}, which is too large to be an image")


def _require_fitting(card: Card, shape: Sequence[int | str | None]) -> None:
    """Shape of the output of a file with fixed shapes, known before it runs: 1 x channels x rows x columns."""
    if card.kind in ("tokens", "points", "features") or len(shape) != 4 or not isinstance(shape[1], int):
        return
    planes = 1 if card.task != "segmentation" or card.kind == "argmax" else len(card.classes)
    if shape[1] != planes:
        wanted = f"{planes} classes" if planes > 1 else "one plane"
        raise InputError(
            f"{card.model}: output {card.output} has {shape[1]} channels, the card is for {wanted}. Correct "
            "`classes` or `output` in the card"
        )


@dataclass(frozen=True)
class Letterbox:
    """An image of width x height, scaled alike in both directions and centred in box_width x box_height."""

    width: int
    height: int
    box_width: int
    box_height: int

    @property
    def inner(self) -> tuple[int, int]:
        """(width, height) of the scaled image in whole pixels."""
        scale = min(self.box_width / self.width, self.box_height / self.height)
        return max(1, round(self.width * scale)), max(1, round(self.height * scale))

    @property
    def scale(self) -> tuple[float, float]:
        """Scale in x and y after rounding to whole pixels."""
        inner = self.inner
        return inner[0] / self.width, inner[1] / self.height

    @property
    def offset(self) -> tuple[int, int]:
        """(x, y) of the image's corner in the box."""
        inner = self.inner
        return (self.box_width - inner[0]) // 2, (self.box_height - inner[1]) // 2

    def put(self, image: NDArray[np.uint8], pad: NDArray[np.float32]) -> NDArray[np.float32]:
        """(box_height, box_width, 3) float32: the image (h, w, 3) in the middle, around it the colour `pad` (3,)."""
        inner, (x, y) = self.inner, self.offset
        shrinks = inner[0] < self.width
        scaled = cv2.resize(image, inner, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        box = np.empty((self.box_height, self.box_width, 3), np.float32)
        box[:] = pad
        box[y : y + inner[1], x : x + inner[0]] = scaled
        return box

    def take(self, output: NDArray[np.float32], align_corners: bool = False) -> NDArray[np.float32]:
        """(height, width, ...) the network's output (h', w', ...) at the image's pixels, bilinear.

        The output shows the same field of view as the box whatever its size (518 pixels in may give 516 out).
        """
        rows = self._coordinates(self.height, 1, self.box_height, output.shape[0], align_corners)
        columns = self._coordinates(self.width, 0, self.box_width, output.shape[1], align_corners)
        return _interpolate(_interpolate(output, rows, 0), columns, 1)

    def indices(self, rows: int, columns: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of an output of that size that are nearest to the image's rows and columns."""
        y = np.rint(self._coordinates(self.height, 1, self.box_height, rows, False)).astype(np.int64)
        x = np.rint(self._coordinates(self.width, 0, self.box_width, columns, False)).astype(np.int64)
        return np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)

    def _coordinates(self, count: int, axis: int, box: int, out: int, align_corners: bool) -> NDArray[np.float64]:
        """Array index in the output of every pixel's centre along one axis."""
        in_box = (np.arange(count) + 0.5) * self.scale[axis] + self.offset[axis]
        if align_corners:
            return (in_box - 0.5) * (out - 1) / max(box - 1, 1)
        return in_box * out / box - 0.5


def choose_box(width: int, height: int, size: tuple[int, ...], multiple: int, pixels: int) -> Letterbox:
    """The box for an image: the fixed `size` (height, width), else sides that are multiples of `multiple` with
    about the image's own aspect and `pixels` pixels in all."""
    if size[0] and size[1]:
        return Letterbox(width, height, size[1], size[0])
    ideal = math.sqrt(pixels / (width * height))
    columns = max(1, round(width * ideal / multiple))
    best = min(
        (max(1, c) for c in (columns - 1, columns, columns + 1)),
        key=lambda c: abs(math.log(c * height / (max(1, round(c * height / width)) * width))),
    )
    return Letterbox(width, height, best * multiple, max(1, round(best * height / width)) * multiple)


def _interpolate(values: NDArray[np.float32], at: NDArray[np.float64], axis: int) -> NDArray[np.float32]:
    """Linear interpolation along one axis at fractional indices; beyond the ends the last value is repeated."""
    at = np.clip(at, 0, values.shape[axis] - 1)
    low = np.minimum(at.astype(np.int64), max(values.shape[axis] - 2, 0))
    high = np.minimum(low + 1, values.shape[axis] - 1)
    share = (at - low).astype(np.float32).reshape([-1 if a == axis else 1 for a in range(values.ndim)])
    first = values.take(low, axis)
    return np.asarray(first + share * (values.take(high, axis) - first), np.float32)


def card_identity(card: Card) -> str:
    """The contract and the bytes of the network and of all that it loads. InputError for weights elsewhere.

    A file of the same size and time is read once a process: hundreds of megabytes are asked for at the begin and at the
    end of a command.
    """
    files = [*filter(None, (card.model, card.head, card.text, card.tokenizer))]
    if not is_tflite(card.model):
        require_own_weights(card.model)
    for file in files:  # what is known already is not opened again
        note_read(file)
    return _identity(card, tuple((s.st_size, s.st_mtime_ns) for s in (p.stat() for p in files if p.exists())))


@functools.lru_cache(maxsize=32)
def _identity(card: Card, _: tuple[tuple[int, int], ...]) -> str:
    external = []
    if not is_tflite(card.model):  # those carry all of their weights
        external = [card.model.parent / name for name in external_locations(card.model)]
    files = [*filter(None, (card.model, card.head, card.text, card.tokenizer)), *external]
    contract = repr(replace(card, model=Path(card.model.name), head=None, text=None, tokenizer=None))
    return hashlib.sha256((contract + files_sha256((p.name, p) for p in files)).encode()).hexdigest()
