"""Interfaces of providers of depth and of labels: frames with their cameras (`geometry/sequence.py`) go in, estimates
come out."""

from __future__ import annotations

import colorsys
import re
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .types import VOID, ClassTable, Frame, require_shape

_FINEST = 0.005
"""Expected error in log depth at which a depth has all confidence."""
MAX_CLASSES = 16
"""Segments and clusters make at most this many classes."""


@dataclass(frozen=True)
class DepthEstimate:
    """depth (h, w) float32, 0 = unknown; confidence (h, w) float32 in [0, 1], 0 where the depth is unknown.

    `invalid` counts the values of the source that were no depth: NaN, infinite or negative. normals (h, w, 3) int8 in
    127ths, unit vectors in the camera that face it, where a network gives them; 0 = unknown.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    invalid: int = 0
    normals: NDArray[np.int8] | None = None

    def __post_init__(self) -> None:
        require_shape("depth", self.depth, (None, None))
        require_shape("confidence", self.confidence, self.depth.shape)
        if self.normals is not None:
            require_shape("normals", self.normals, (*self.depth.shape, 3))

    def without(self, left_out: NDArray[np.bool_] | None) -> DepthEstimate:
        """Unknown in a mask (h, w)."""
        if left_out is None:
            return self
        normals = None if self.normals is None else np.where(left_out[..., None], np.int8(0), self.normals)
        depth, confidence = (np.where(left_out, np.float32(0), a) for a in (self.depth, self.confidence))
        return DepthEstimate(depth, confidence, self.invalid, normals)


def confidence_of(error: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the confidence of depths by their expected error in log depth: 0.4 at 2 %, 0.3 at 3 %, 0.14 at 10 %."""
    return np.asarray((_FINEST / np.maximum(error, _FINEST)) ** (2 / 3), np.float32)


def error_of(confidence: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the expected error in log depth by the confidence: what `confidence_of` undoes."""
    return np.asarray(_FINEST / np.maximum(confidence, 0.01) ** 1.5, np.float64)


@dataclass(frozen=True)
class LabelEstimate:
    """labels (h, w) uint8 indices into the provider's class table or VOID; confidence (h, w) float32 in [0, 1].

    descriptor (F,) is a unit vector that says how the image looks, where a network gives one.
    """

    labels: NDArray[np.uint8]
    confidence: NDArray[np.float32]
    descriptor: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        require_shape("labels", self.labels, (None, None))
        require_shape("confidence", self.confidence, self.labels.shape)

    def without(self, left_out: NDArray[np.bool_] | None) -> LabelEstimate:
        """Void in a mask (h, w)."""
        if left_out is None:
            return self
        labels = np.where(left_out, np.uint8(VOID), self.labels)
        return LabelEstimate(labels, np.where(left_out, np.float32(0), self.confidence), self.descriptor)


class Provider(Protocol):
    """Common part of all providers: a pass over all frames first, then estimates frame by frame."""

    name: str

    @property
    def shared_state(self) -> tuple[str, ...]:
        """The names of what `fit` finds out of all frames together, and of the providers inside this one."""
        return ()

    def missing(self, frames: list[Frame]) -> list[Frame]:
        """The frames it will know nothing of."""
        return []

    def precompute(self, frames: list[Frame]) -> None:
        """Do the part of `fit` that concerns single frames, for these; results are kept."""
        return

    def figures(self) -> dict[str, Any]:
        """Return the figures of the pass for the report, as plain values."""
        return {}


def dump_state(provider: Provider) -> dict[str, Any]:
    """Return the state that `fit` left, to send to the processes that estimate single frames."""
    found = {name: getattr(provider, name) for name in provider.shared_state}
    return {name: dump_state(v) if hasattr(v, "shared_state") else v for name, v in found.items()}


def load_state(provider: Provider, found: dict[str, Any]) -> None:
    """Take over the state of `dump_state` in place of calling `fit`; `estimate` may be called afterwards."""
    for name, value in found.items():
        if hasattr(own := getattr(provider, name), "shared_state"):
            load_state(own, value)
        else:
            setattr(provider, name, value)


class DepthProvider(Provider, Protocol):
    """Depth of every frame. What can be refused without slow work is refused when the provider is made."""

    metric: bool
    """Whether depths are metres; else they are in the unit of the run's backbone."""

    def fit(self, frames: list[Frame]) -> None:
        """Slow passes over all frames that `estimate` builds on; goes on where it was interrupted."""
        return

    def estimate(self, frame: Frame) -> DepthEstimate:
        """Depth at the size of the proxy maps. May be asked from two threads at once."""
        ...


class SemanticsProvider(Provider, Protocol):
    """Class of every pixel of every frame."""

    def fit(self, frames: list[Frame], depth_of: Callable[[Frame], DepthEstimate]) -> None:
        """Slow passes over all frames that `estimate` and `classes` build on."""

    def warnings(self) -> list[str]:
        """Return the problems that `fit` found, for the report."""
        return []

    def estimate(self, frame: Frame, depth: DepthEstimate) -> LabelEstimate:
        """Labels at the size of the proxy maps. May be asked from two threads at once."""
        ...

    def classes(self) -> ClassTable:
        """Return the table of classes; valid after `fit`."""
        ...


_COMMON = {
    (203, 219, 196): "wall column building house railing fence",
    (114, 59, 63): "floor rug carpet stairs stairway step ground",
    (255, 225, 242): "ceiling beam roof",
    (80, 195, 255): "window windowpane glass mirror screen-door",
    (190, 121, 95): "door double-door doorframe",
    (148, 109, 217): "bed pillow blanket cradle mattress",
    (4, 51, 195): "seating chair sofa armchair couch stool bench seat swivel-chair ottoman cushion",
    (238, 175, 32): "table desk coffee-table counter countertop kitchen-island bar",
    (72, 58, 4): "storage cabinet shelf shelves wardrobe bookcase bookshelf chest-of-drawers dresser box basket book",
    (218, 134, 196): "curtain blind blinds towel clothes apparel shower-curtain",
    (243, 255, 52): "lamp light chandelier sconce",
    (204, 21, 96): "picture painting poster bulletin-board whiteboard signboard clock",
    (1, 27, 61): "screen television tv monitor computer laptop",
    (23, 108, 148): "appliance refrigerator stove oven microwave dishwasher washer hood sink toilet bathtub radiator",
    (9, 140, 20): "plant flower tree palm vase indoor-plant",
    (255, 22, 25): "person people animal",
    (161, 246, 151): "outdoors sky grass road sidewalk earth field mountain",
}
"""Colours of common names; those after the first of a line get tints. Between any two of these colours and the greys
CIEDE2000 is at least 10, also as seen without one kind of cones (Machado et al. 2009)."""
_NAMELESS = re.compile(r"(object|other|unknown|void|none)-?(\d*)")


def class_colors(names: Iterable[str]) -> tuple[tuple[int, int, int], ...]:
    """RGB colours that depend on the names alone; what has no name ("object 3", "other") is grey."""
    return tuple(_class_color(re.sub(r"[\s_-]+", "-", name.strip().lower())) for name in names)


def _class_color(name: str) -> tuple[int, int, int]:
    if found := _NAMELESS.fullmatch(name):
        return (112 + 24 * (int(found[2] or 1) % 3),) * 3
    for base, alike in _COMMON.items():
        if name in (tints := alike.split()):
            place = tints.index(name)
            share, end = (place + 1) // 2 * 0.12, 255 * (place % 2)
            red, green, blue = (round(c + (end - c) * share) for c in base)
            return red, green, blue
    number = re.search(r"\d+$", name)
    i = int(number[0]) if number else zlib.crc32(name.encode())
    color = colorsys.hsv_to_rgb((0.08 + i * 0.618034) % 1.0, (0.55, 0.75, 0.4)[i // 3 % 3], (0.95, 0.7, 0.85)[i % 3])
    red, green, blue = (round(c * 255) for c in color)
    return red, green, blue
