"""Identity of a network as one hash: equal networks give equal results."""

from __future__ import annotations

import functools
import hashlib
from dataclasses import replace
from pathlib import Path

from ...formats.digest import files_sha256
from .card import Card
from .onnx_file import external_locations, require_own_weights
from .runtime import is_tflite


def card_identity(card: Card) -> str:
    """The contract and the bytes of the network and of all that it loads. InputError for weights elsewhere.

    A file of the same size and time is read once a process: hundreds of megabytes are asked for at the begin and at the
    end of a command.
    """
    files = [*filter(None, (card.model, card.head, card.text, card.tokenizer))]
    return _identity(card, tuple((s.st_size, s.st_mtime_ns) for s in (p.stat() for p in files if p.exists())))


@functools.lru_cache(maxsize=32)
def _identity(card: Card, _: tuple[tuple[int, int], ...]) -> str:
    beside = []
    if not is_tflite(card.model):  # those carry all of their weights
        require_own_weights(card.model)
        beside = [card.model.parent / name for name in external_locations(card.model)]
    files = [*filter(None, (card.model, card.head, card.text, card.tokenizer)), *beside]
    contract = repr(replace(card, model=Path(card.model.name), head=None, text=None, tokenizer=None))
    return hashlib.sha256((contract + files_sha256((p.name, p) for p in files)).encode()).hexdigest()
