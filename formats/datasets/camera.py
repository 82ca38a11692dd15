"""The camera of a data set, with the pixel centre convention already settled."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from formats.errors import InputError


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels, first pixel's centre at (0.5, 0.5); distortion k1, k2, p1, p2[, k3] as OpenCV has it.

    `fisheye` says that the distortion is the equidistant k1..k4 instead.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False

    def __post_init__(self) -> None:
        values = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64)
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0 or not np.isfinite(values).all():
            raise InputError(f"these are no camera intrinsics: {self}: check the data set's calibration file")
        if not (-self.width < self.cx < 2 * self.width and -self.height < self.cy < 2 * self.height):
            raise InputError(f"the principal point is far outside the image: {self}: is it another camera's file?")

    @property
    def is_distorted(self) -> bool:
        """Whether an ideal pinhole camera would see another picture."""
        return any(self.distortion)

    @classmethod
    def from_integer_centres(
        cls,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    ) -> Camera:
        """From a calibration in which the first pixel's centre is (0, 0), as OpenCV and ROS have it."""
        return cls(width, height, fx, fy, cx + 0.5, cy + 0.5, distortion)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera after its image is resized to width x height."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


def warp_nearest(image: NDArray[np.float32], source: Camera, target: Camera) -> NDArray[np.float32]:
    """(H, W) `image` of the source camera as the target camera sees it from the same place, 0 outside.

    Both cameras look the same way and their lens distortion is left out; the nearest pixel is taken, because the mean
    of two depths lies on neither surface. The source camera is scaled to the image's size first.
    """
    source = source.resized(image.shape[1], image.shape[0])
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx * source.fx + source.cx
    y = (np.arange(target.height) + 0.5 - target.cy) / target.fy * source.fy + source.cy
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    inside_x, inside_y = (column >= 0) & (column < source.width), (row >= 0) & (row < source.height)
    warped = image[np.ix_(row.clip(0, source.height - 1), column.clip(0, source.width - 1))]
    return np.where(inside_y[:, None] & inside_x[None, :], warped, np.float32(0)).astype(np.float32)
