"""Fitting an image into a network's input, and reading its output back at the image's pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


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
        key=lambda c: _aspect_error(c, max(1, round(c * height / width)), width, height),
    )
    return Letterbox(width, height, best * multiple, max(1, round(best * height / width)) * multiple)


def _aspect_error(columns: int, rows: int, width: int, height: int) -> float:
    return abs(math.log(columns * height / (rows * width)))


def _interpolate(values: NDArray[np.float32], at: NDArray[np.float64], axis: int) -> NDArray[np.float32]:
    """Linear interpolation along one axis at fractional indices; beyond the ends the last value is repeated."""
    at = np.clip(at, 0, values.shape[axis] - 1)
    low = np.minimum(at.astype(np.int64), max(values.shape[axis] - 2, 0))
    high = np.minimum(low + 1, values.shape[axis] - 1)
    share = (at - low).astype(np.float32).reshape([-1 if a == axis else 1 for a in range(values.ndim)])
    first = values.take(low, axis)
    return np.asarray(first + share * (values.take(high, axis) - first), np.float32)
