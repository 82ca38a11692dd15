"""Running an ONNX network."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from formats.digest import file_sha256
from formats.errors import InputError
from pipelines.progress import log
from pipelines.proxy.networks.card import Card
from pipelines.proxy.networks.head import load_linear_head
from pipelines.proxy.networks.letterbox import Letterbox, choose_box
from pipelines.proxy.networks.onnx_file import require_own_weights

_MAX_OUTPUT_VALUES = 200_000_000
_IMAGENET_MEAN = (123.675, 116.28, 103.53)
_TOKENS = (1200, 3600)
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class Network:
    """An opened network that a card describes."""

    def __init__(self, card: Card, threads: int, device: str) -> None:
        """Raises InputError for a file that is not what the card says, before anything is computed."""
        self.card = card
        require_own_weights(card.model)
        _require_hash(card)
        self.head = load_linear_head(card.head, len(card.classes)) if card.head is not None else None
        self._session = _open(card.model, threads, device)
        inputs = {i.name: i for i in self._session.get_inputs()}
        outputs = {o.name: o for o in self._session.get_outputs()}
        if set(inputs) != set(filter(None, (card.input, card.tokens))):
            raise InputError(f"{card.model}: its inputs are {', '.join(inputs)}; the card says {card.input}")
        for wanted in _outputs(card).values():
            if wanted not in outputs:
                raise InputError(f"{card.model}: it has no output {wanted!r}, only {', '.join(outputs)}")
            _require_bounded(card.model, wanted, outputs[wanted].shape)
        _require_channels(card, outputs[card.output].shape)
        kind = inputs[card.input].type
        if kind not in _TYPES:
            raise InputError(f"{card.model}: input {card.input} is {kind}; float or float16 is expected")
        self._dtype = _TYPES[kind]
        # A bonus: exports of the same family without them work as well.
        self._extras = {k: n for k, n in (("normals", card.normals), ("kappa", card.normal_confidence)) if n in outputs}
        if card.metadata:
            self.card = card = _with_metadata(card, self._session.get_modelmeta().custom_metadata_map)
        shape = inputs[card.input].shape
        fixed = len(shape) == 4 and all(isinstance(s, int) and s > 0 for s in shape[2:])
        self._size = card.size if all(card.size) or not fixed else tuple(shape[2:])

    def box(self, width: int, height: int) -> Letterbox:
        """How a picture of width x height goes into the network."""
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
        values = (box.put(image, pad) * np.float32(card.white / 255) - mean * card.white) / (std * _std_unit(card))
        batch = np.ascontiguousarray(values.transpose(2, 0, 1)[None]).astype(self._dtype)
        feed: dict[str, NDArray] = {card.input: batch}
        if card.tokens:
            tokens = round(box.box_width * box.box_height / card.multiple**2)
            feed[card.tokens] = np.array(min(max(tokens, _TOKENS[0]), _TOKENS[1]), np.int64)
        try:
            names = {**_outputs(card), **self._extras}
            outputs: Sequence[NDArray] = self._session.run(list(names.values()), feed)
        except Exception as error:  # onnxruntime's errors share no narrower base class
            if type(error).__module__.startswith("onnxruntime"):
                size = f"{box.box_width}x{box.box_height}"
                raise InputError(
                    f"{card.model}: does not run on an input of {size} ({error}). Correct the card"
                ) from error
            raise
        for output in outputs:
            if output.size > _MAX_OUTPUT_VALUES or output.size == 0:
                raise InputError(f"{card.model}: gave an output of shape {output.shape}. Correct the card")
        return {role: np.asarray(o[0]) for role, o in zip(names, outputs, strict=True)}


def _outputs(card: Card) -> dict[str, str]:
    """Role → name of what the card asks for."""
    roles = ("output", "confidence", "mask", "metric_scale")
    return {role: name for role in roles if (name := getattr(card, role))}


def _with_metadata(card: Card, metadata: dict[str, str]) -> Card:
    """The card with the mean and std that the file itself states, in units of white; its own where there are none.

    Keys that hold the words and three numbers are taken, whatever else they are called; numbers over 5 are of 0..255.
    """
    found: dict[str, tuple[float, ...]] = {}
    for word in ("mean", "std"):
        for key, text in sorted(metadata.items()):
            numbers = [float(n) for n in re.findall(r"-?\d+\.?\d*(?:[eE]-?\d+)?", text)]
            if word in key.lower() and len(numbers) == 3 and min(numbers) > 0:
                found[word] = tuple(n / 255 if max(numbers) > 5 else n for n in numbers)
                break
    return replace(card, mean=found["mean"], std=found["std"]) if len(found) == 2 else card


def _std_unit(card: Card) -> float:
    """std is in units of white too; a std of 1 (the default) means that nothing is divided."""
    return 1.0 if all(s == 1.0 for s in card.std) else card.white


def _open(path: Path, threads: int, device: str) -> ort.InferenceSession:
    wanted = "CUDAExecutionProvider" if device == "cuda" else "CPUExecutionProvider"
    if wanted not in ort.get_available_providers():
        log.warning("this onnxruntime has no CUDA: the network runs on the CPU (pip install onnxruntime-gpu)")
        wanted = "CPUExecutionProvider"
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Threads that spin while they wait steal the cores of whatever else runs.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    providers = [wanted] if wanted == "CPUExecutionProvider" else [wanted, "CPUExecutionProvider"]
    try:
        session = ort.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's errors share no narrower base class
        if type(error).__module__.startswith("onnxruntime"):
            raise InputError(f"{path}: onnxruntime cannot load it ({error}). Download it again") from error
        raise
    # It falls back to the CPU without an error when CUDA's libraries are missing.
    if session.get_providers()[0] != wanted:
        log.warning("%s was asked for, the network runs on %s", wanted, session.get_providers()[0])
    return session


def _require_hash(card: Card) -> None:
    if not card.sha256:
        return
    actual = file_sha256(card.model)
    if actual != card.sha256.lower():
        raise InputError(f"{card.model}: its sha256 is {actual}, the card says {card.sha256}. Download it again")


def _require_bounded(path: Path, name: str, shape: Sequence[int | str | None]) -> None:
    fixed = [s for s in shape if isinstance(s, int)]
    if np.prod([float(s) for s in fixed]) > _MAX_OUTPUT_VALUES or any(s <= 0 for s in fixed):
        raise InputError(f"{path}: output {name} has the shape {list(shape)}, which is too large to be an image")


def _require_channels(card: Card, shape: Sequence[int | str | None]) -> None:
    if card.task == "depth" or card.kind in ("argmax", "tokens") or len(shape) != 4 or not isinstance(shape[1], int):
        return
    if shape[1] != len(card.classes):
        raise InputError(f"{card.model}: has {shape[1]} classes, the card names {len(card.classes)}. Correct the card")
