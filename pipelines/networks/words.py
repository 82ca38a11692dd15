"""Heads that turn a network's features into classes: linear ones from a file, and words of the user's.

Words are for a network whose features share one space with those of texts.

CLIP (Radford et al., ICML 2021) and its kin compare images with texts: a word's probability at a pixel is the softmax
of the cosines between the pixel's feature and the words' embeddings, over a temperature. A word must win against the
card's background phrases too (as in LERF, Kerr et al., ICCV 2023), which together are "other": without them a room in
which a lamp and a shelf are asked for would consist of lamps and shelves.
"""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError, install_extra
from ...formats.reading import parsing, require_file
from ...formats.tensors import load_arrays
from .card import Card
from .runtime import open_runtime

_BATCH_NORM_EPSILON = 1e-5
_MAX_BYTES = 1 << 28

OTHER = "other"
MAX_WORDS = 200
"""Labels are bytes, and numbered objects need some too."""
_MAX_TOKENIZER_BYTES = 1 << 26


@dataclass(frozen=True)
class WordHead:
    """Scores of words: weight (C, F) unit vectors, of which each is compared with a feature of any length."""

    weight: NDArray[np.float32]
    temperature: float

    def scores(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., F) → (..., C) cosines over the temperature."""
        length = np.maximum(np.linalg.norm(features, axis=-1, keepdims=True), 1e-9)
        return np.asarray((features / length) @ self.weight.T / self.temperature, np.float32)


def with_words(card: Card, text: str) -> Card:
    """The card with the comma-separated words as its classes, behind them the background phrases as one class, "other".

    Raises InputError for no words, too many, or one of them twice.
    """
    words = [word for part in text.split(",") if (word := " ".join(part.split()))]
    if not words:
        raise InputError(f'{card.model.name} finds what it is asked for: --classes "radiator, bookshelf, lamp"')
    known = [word.casefold() for word in words]
    twice = [word for i, word in enumerate(words) if known[i] in known[:i]]
    if twice or len(words) > MAX_WORDS:
        problem = f"{twice[0]!r} is there twice" if twice else f"{len(words)} words, at most {MAX_WORDS}"
        raise InputError(f"proxy.classes: {problem}. Name every class once")
    background = tuple(phrase for phrase in card.background if phrase.casefold() not in known)
    card = replace(card, classes=(*words, *background), groups=(*words, *(OTHER for _ in background)))
    return replace(card, void=tuple(i for i, label in enumerate(card.labels) if label == OTHER))


def load_word_head(card: Card, threads: int, device: str) -> WordHead:
    """The embeddings of the card's classes, from its table of words or by its text encoder.

    Raises InputError for a table or encoder that is none, and for words that it does not have.
    """
    assert card.text is not None
    if card.text.suffix.lower() == ".npz":
        found = _from_table(card.text, card.classes)
    else:
        encode = _open_encoder(card, threads, device)
        found = [np.mean([_unit(card.text, encode(p.replace("{}", c))) for p in card.prompts], 0) for c in card.classes]
    return WordHead(np.stack([_unit(card.text, vector) for vector in found]), card.temperature)


def _unit(path: Path, vector: NDArray) -> NDArray[np.float32]:
    length = float(np.linalg.norm(vector.astype(np.float64)))
    if vector.ndim != 1 or not 0 < length < np.inf:
        raise InputError(f"{path}: a word's embedding has shape {vector.shape}, length {length}. Correct the card")
    return (vector / length).astype(np.float32)


def _from_table(path: Path, words: tuple[str, ...]) -> list[NDArray]:
    stored = load_arrays(path)
    names, rows = stored.get("words"), stored.get("embeddings")
    if names is None or rows is None or names.dtype.kind != "U" or rows.dtype.kind != "f" or rows.ndim != 2:
        raise InputError(f"{path}: no table of words. It holds words (K,), of text, and embeddings (K, F), of numbers")
    if names.shape != rows.shape[:1]:
        raise InputError(f"{path}: {names.size} words and {len(rows)} embeddings. Make the table again")
    row_of = {str(name).casefold(): row for name, row in zip(names, rows, strict=True)}
    if missing := [word for word in words if word.casefold() not in row_of]:
        raise InputError(
            f"{path}: it has no embedding of {', '.join(missing[:10])}; it knows {', '.join(map(str, names[:20]))}"
            f"{' …' if len(names) > 20 else ''}. Add them to the table, or leave them out"
        )
    return [row_of[word.casefold()] for word in words]


def _open_encoder(card: Card, threads: int, device: str) -> Callable[[str], NDArray]:
    """What gives the embedding (F,) of a text."""
    assert card.text is not None
    assert card.tokenizer is not None
    path, tokenizer = card.text, open_tokenizer(card.tokenizer)
    runtime = open_runtime(path, [card.text_output], threads, device)
    mask = next((name for name in runtime.inputs if name != card.text_input and "mask" in name), None)
    if set(runtime.inputs) - {mask} != {card.text_input} or card.text_output not in runtime.outputs:
        raise InputError(
            f"{path}: takes {', '.join(runtime.inputs)}, gives {', '.join(runtime.outputs)}; the card says text_input "
            f"{card.text_input}, text_output {card.text_output}. Correct the card"
        )
    port = runtime.inputs[card.text_input]
    fixed = port.shape[-1] if port.shape and isinstance(port.shape[-1], int) else 0

    def encode(text: str) -> NDArray:
        ids = tokenizer.encode(text).ids
        if not ids or len(ids) > (fixed or len(ids)):
            raise InputError(f"{path}: {text!r} has {len(ids)} tokens; it takes 1 to {fixed or 'many'}. Shorten it")
        padded = np.zeros((1, fixed or len(ids)), port.dtype or np.int64)
        padded[0, : len(ids)] = ids
        is_text = (np.arange(padded.shape[1]) < len(ids)).astype(padded.dtype)[None]
        try:
            feed: dict[str, NDArray] = {card.text_input: padded, **({mask: is_text} if mask else {})}
            return np.squeeze(runtime.run([card.text_output], feed)[0])
        except RuntimeError as error:
            raise InputError(f"{path}: does not run on a text ({error}). Correct the card") from error

    return encode


def open_tokenizer(path: Path) -> Any:
    """A `tokenizers.Tokenizer`. Raises InputError without that package, and for a file that is none."""
    try:
        from tokenizers import Tokenizer
    except ImportError as error:
        raise InputError(
            f"a text encoder needs a package that is not here: {install_extra('words')}. Or give the card "
            'a table of embeddings: text = "words.npz"'
        ) from error
    require_file(path, _MAX_TOKENIZER_BYTES)
    try:
        return Tokenizer.from_file(str(path))
    except Exception as error:  # the library's errors share no narrower base class
        raise InputError(f"{path}: no tokenizer.json of `tokenizers` ({error}). Download it again") from error


@dataclass(frozen=True)
class LinearHead:
    """scores = features @ weight.T + bias; weight (C, F), bias (C,)."""

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]

    def scores(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """(..., F) → (..., C)."""
        return (features @ self.weight.T + self.bias).astype(np.float32)


def load_linear_head(path: Path, classes: int) -> LinearHead:
    """The head of DINOv2's linear segmenters: batch norm, then a 1 x 1 convolution, folded into one matrix.

    Only tensors are read from the file, never code. Raises InputError for anything else than such a head.
    """
    import torch

    size = require_file(path, _MAX_BYTES)
    with parsing(path, "linear segmentation head", "pull it again"):
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
        if size > _MAX_BYTES:
            raise ValueError(f"it unpacks to {size} bytes")
        stored = torch.load(path, map_location="cpu", weights_only=True)
        state = stored.get("state_dict", stored)
        parts = {k: state[f"decode_head.{k}"].double().numpy() for k in _KEYS}
        if not all(np.isfinite(part).all() for part in parts.values()) or not (parts["bn.running_var"] >= 0).all():
            raise ValueError("a weight is not finite")
    weight = parts["conv_seg.weight"].reshape(len(parts["conv_seg.weight"]), -1)
    features = weight.shape[1]
    if weight.shape[0] != classes or any(parts[k].shape != (features,) for k in _KEYS[:4]):
        raise InputError(f"{path}: a head for {weight.shape[0]} classes; the card names {classes}")
    gain = parts["bn.weight"] / np.sqrt(parts["bn.running_var"] + _BATCH_NORM_EPSILON)
    bias = parts["conv_seg.bias"] + weight @ (parts["bn.bias"] - gain * parts["bn.running_mean"])
    return LinearHead((weight * gain).astype(np.float32), bias.astype(np.float32))


_KEYS = ("bn.weight", "bn.bias", "bn.running_mean", "bn.running_var", "conv_seg.weight", "conv_seg.bias")
