"""The camera of a data set, with the pixel centre convention already settled."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

_LARGEST_SIDE = 65535
_FOCAL_SIDES = 100
"""Focal lengths beyond this many sides of the image, or below its inverse, are slips of the unit or damage."""
_STRONGEST_DISTORTION = 1000.0
_SAME_SHAPE = 0.01


def distortion_names(fisheye: bool) -> tuple[str, ...]:
    """Return the names of a camera's distortion coefficients."""
    return ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels, first pixel's centre at (0.5, 0.5); distortion k1, k2, p1, p2[, k3[, k4, k5, k6]] as in
    OpenCV.

    `fisheye` says that the distortion is the equidistant k1..k4 instead; `is_nominal` that these are the numbers of the
    kind of camera, not a calibration of this one.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False
    is_nominal: bool = field(default=False, repr=False)  # a source is known by the text of its camera

    def __post_init__(self) -> None:
        values = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64)
        side = max(self.width, self.height)
        sane = 1 <= min(self.width, self.height) <= side <= _LARGEST_SIDE and bool(np.isfinite(values).all())
        sane = sane and all(side / _FOCAL_SIDES <= f <= side * _FOCAL_SIDES for f in (self.fx, self.fy))
        if not sane or max(abs(k) for k in (0.0, *self.distortion)) > _STRONGEST_DISTORTION:
            raise InputError(f"these are no camera intrinsics: {self}: check the data set's calibration file")
        if not (-self.width < self.cx < 2 * self.width and -self.height < self.cy < 2 * self.height):
            raise InputError(f"the principal point is far outside the image: {self}: is it another camera's file?")

    @property
    def is_distorted(self) -> bool:
        """Whether an ideal pinhole camera would see another image."""
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
        """Make a camera from a calibration in which the first pixel's centre is (0, 0), as in OpenCV and ROS."""
        return cls(width, height, fx, fy, cx + 0.5, cy + 0.5, distortion)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera after its image is resized to width x height.

        Raises InputError for images of another shape, by more than 1 % and a pixel of rounding: no resizing makes one
        of the other.
        """
        sx, sy = width / self.width, height / self.height
        if abs(width * self.height - height * self.width) > max(
            _SAME_SHAPE * width * self.height, self.width, self.height, width, height
        ):
            raise InputError(
                f"the camera is for images of {self.width}x{self.height}, these are {width}x{height}, another shape: "
                "is it another camera's file, or are the images cropped or turned?"
            )
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
