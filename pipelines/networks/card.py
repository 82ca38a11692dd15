"""The card of a network: a TOML or JSON file that says what goes in and what comes out.

task = "depth"                    # or "segmentation", or "person": how likely every pixel is one
model = "metric3d.onnx"           # beside the card; ONNX, or TensorFlow Lite as .tflite
input = "pixel_values"            # 1 x 3 x H x W, RGB (.tflite: 1 x H x W x 3, quantised or not)
white = 255.0                     # input value of white; 1.0 for networks that want 0..1
mean = [0.485, 0.456, 0.406]      # subtracted, in units of `white`; leave out what the graph does itself
std = [0.229, 0.224, 0.225]
multiple = 28                     # sides are multiples of this, near `pixels` in total; or: size = [height, width]
pixels = 263424
output = "predicted_depth"        # .tflite: any tensor of the network, also one before its last step
canonical_focal = 1000.0          # depth · focal / canonical_focal is metres; 0: depth is metres as it comes
focal = [0, 0]                    # of the camera it was trained with, in pixels of its input (`size`), for a
                                  # network without a canonical focal length that is to tell metres
metres_line = [1.0, 1.0]          # of such a network: true metres are the first times what it says to the power of the
                                  # second
relative = ""                     # else "scale", "depth" or "inverse": depth up to scale; depth, or inverse depth, up
                                  # to scale and shift; each frame is then aligned to the triangulated points
valid = [0.1, 200.0]              # values at or beyond these stops are unknown
confidence = "confidence"         # an output in 0..1, when there is one
normals = "predicted_normal"      # an output of unit normals, and one of how sure they are (any positive numbers)
normal_confidence = "normal_confidence"
metadata = true                   # mean and std stand in the file's own metadata and win over the card's
classes = "labels.txt"            # segmentation: names, a file or a list
kind = "logits"                   # segmentation: logits, probabilities, argmax, tokens (a transformer's), or features
head = "head.pth"                 # tokens: a linear head for the classes; without one, alike features are a class
text = "text.onnx"                # features, or tokens, in one space with texts: their encoder, or an .npz with
                                  # `words` (K,) and `embeddings` (K, F); the classes are then words of the user's
tokenizer = "tokenizer.json"      # of the library `tokenizers`; for an encoder
text_input = "input_ids"
text_output = "text_embeds"
prompts = ["a photo of a {}."]    # what is encoded for a word: the mean over these
background = ["object", "things", "stuff", "texture"]    # what fits these better than every word is "other"
temperature = 0.01                # of the softmax over cosines
"""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

from ...formats.datasets.sequence import read_class_table
from ...formats.errors import InputError
from ...formats.reading import parsing
from ...formats.textfile import read_json, read_toml
from ..system.values import value_from_json

_MAX_CARD_BYTES = 1 << 20
_MAX_SIDE = 8192
_FILES = ("model", "head", "text", "tokenizer")
_KINDS = {
    "depth": ("plane", "points"),
    "segmentation": ("logits", "probabilities", "argmax", "tokens", "features"),
    "person": ("probability",),
}


@dataclass(frozen=True)
class Card:
    """See the module's text. `size` is (height, width), (0, 0) when any multiple will do.

    groups: for every class the name of the group that it counts for; () when classes stay as they are.
    """

    task: str
    model: Path
    input: str
    output: str
    white: float = 255.0
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    size: tuple[int, ...] = (0, 0)
    multiple: int = 1
    pixels: int = 448 * 588
    align_corners: bool = False
    canonical_focal: float = 0.0
    focal: tuple[float, ...] = (0.0, 0.0)
    metres_line: tuple[float, ...] = (1.0, 1.0)
    relative: str = ""
    valid: tuple[float, ...] = (0.0, float("inf"))
    confidence: str = ""
    normals: str = ""
    normal_confidence: str = ""
    metadata: bool = False
    kind: str = ""
    classes: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    head: Path | None = None
    void: tuple[int, ...] = ()
    tokens: str = ""
    mask: str = ""
    metric_scale: str = ""
    sha256: str = ""
    text: Path | None = None
    tokenizer: Path | None = None
    text_input: str = "input_ids"
    text_output: str = "text_embeds"
    prompts: tuple[str, ...] = ("a photo of a {}.",)
    background: tuple[str, ...] = ("object", "things", "stuff", "texture")
    temperature: float = 0.01

    @property
    def name(self) -> str:
        """`onnx:NAME` or `tflite:NAME`, after the file."""
        return f"{'tflite' if self.model.suffix.lower() == '.tflite' else 'onnx'}:{self.model.stem}"

    @property
    def is_clustered(self) -> bool:
        """Features without a head or words: their clusters are the classes."""
        return self.kind == "tokens" and self.head is None and self.text is None

    @property
    def labels(self) -> tuple[str, ...]:
        """The classes that come out: the groups, in the order of their first class, or the classes themselves."""
        return tuple(dict.fromkeys(self.groups)) or self.classes


def read_card(path: Path) -> Card:
    """Raises InputError for a file that is no card, unknown or missing keys, and values that make no sense."""
    values = _read(path)
    known = {f.name for f in fields(Card)}
    for key in values:
        if key not in known:
            raise InputError(f"{path}: there is no key {key!r} in a card; known: {', '.join(known)}")
    for key in ("task", "model", "input", "output"):
        if not isinstance(values.get(key), str):
            raise InputError(f'{path}: the card lacks {key} = "…"')
    for key in _FILES:
        if isinstance(values.get(key), str):
            values[key] = _in_folder(path, values[key])
    if isinstance(values.get("classes"), str):
        table = read_class_table(_in_folder(path, values["classes"]))
        values["classes"] = [table[i].name if i in table else f"class {i}" for i in range(max(table) + 1)]
    return card_from_values(values, path)


def card_from_values(values: dict[str, Any], path: Path) -> Card:
    """A card from its keys, `model` already a path; `path` is what errors call it. Raises InputError."""
    kinds = get_type_hints(Card)
    try:
        if bad := [k for k, v in values.items() if k in _FILES and not isinstance(v, Path)]:
            raise ValueError(f"{bad[0]} is the name of a file, got {values[bad[0]]!r}")
        card = Card(**{k: v if k in _FILES else value_from_json(kinds[k], v, k) for k, v in values.items()})
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: {error}") from error
    _check(card, path)
    return card


def _read(path: Path) -> dict[str, Any]:
    try:
        values = read_json(path, _MAX_CARD_BYTES) if path.suffix.lower() == ".json" else read_toml(path)
    except InputError as error:
        raise InputError(f"{error}; give the card, not the network: onnx:CARD.toml") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: not a card: a table of keys is expected")
    return values


def _in_folder(path: Path, name: str) -> Path:
    """A file in the card's own folder; a card from elsewhere must not name files all over the disk."""
    folder = path.parent.resolve()
    with parsing(path, "card that names a file", "correct it"):
        target = (folder / name).resolve()
        if not target.is_relative_to(folder):
            raise InputError(f"{path}: {name} lies outside the card's folder. Put the file beside the card")
        if not target.is_file():
            raise InputError(f"{path}: there is no {name} beside the card. Put it there, or correct the card")
    return target


def _check(card: Card, path: Path) -> None:
    numbers = (card.white, card.canonical_focal, card.temperature, *card.mean, *card.std)
    is_table = card.text is not None and card.text.suffix.lower() == ".npz"
    problems = {
        "numbers are finite and below a million": all(math.isfinite(n) and abs(n) < 1e6 for n in numbers),
        f"task is {', '.join(_KINDS)}": card.task in _KINDS,
        f"kind is {', '.join(_KINDS.get(card.task, ()))}": card.kind in ("", *_KINDS.get(card.task, ())),
        "mean and std have three numbers, std positive": len(card.mean) == len(card.std) == 3 and min(card.std) > 0,
        "white is positive": card.white > 0,
        "size is [height, width]": len(card.size) == 2 and all(0 <= s <= _MAX_SIDE for s in card.size),
        "multiple is 1..512": 1 <= card.multiple <= 512,
        "pixels is 1000..10000000": 1000 <= card.pixels <= 10_000_000,
        "valid is [lowest, highest]": len(card.valid) == 2 and 0 <= card.valid[0] < card.valid[1],
        "relative is scale, depth or inverse": card.relative in ("", "scale", "depth", "inverse"),
        "canonical_focal is 0 or positive": card.canonical_focal >= 0,
        "focal is [fx, fy], positive, and goes with size": card.focal == (0, 0)
        or (len(card.focal) == 2 and min(card.focal) > 0 and all(card.size)),
        "metres_line is [factor, power], each 0.1 to 10": len(card.metres_line) == 2
        and all(0.1 <= n <= 10 for n in card.metres_line),
        "groups has one name for each class": len(card.groups) in (0, len(card.classes)),
        "features need text": card.kind != "features" or card.text is not None,
        "segmentation needs classes": card.is_clustered
        or card.task != "segmentation"
        or card.text is not None
        or 1 <= len(card.classes) <= 10_000,
        "text goes with features or tokens, without classes or a head": card.text is None
        or (card.kind in ("features", "tokens") and not card.classes and card.head is None),
        "a text encoder needs a tokenizer": card.text is None or is_table or card.tokenizer is not None,
        "prompts has a text or more, with {} for the word": card.prompts and all("{}" in p for p in card.prompts),
        "temperature is positive": card.temperature > 0,
        "classes of tokens need a head": not (card.is_clustered and card.classes),
    }
    for rule, holds in problems.items():
        if not holds:
            raise InputError(f"{path}: {rule}")
