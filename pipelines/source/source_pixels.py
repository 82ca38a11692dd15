"""Which pixel of the source is behind a pixel of an undistorted frame."""

import numpy as np
from numpy.typing import NDArray

from ...formats.datasets.sequence import Camera
from ..sfm.lens import make_lens, to_pycolmap
from ..types import Calibration


class FramePixels:
    """Pixels of the source's image from which the pixels of an undistorted frame come.

    Inverts the run's own undistortion, so it is right even where the focal length is not.
    """

    def __init__(self, calibration: Calibration) -> None:
        k = calibration.intrinsics
        v, u = np.indices((k.height, k.width)) + 0.5
        rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1).reshape(-1, 3)
        camera = to_pycolmap(distorted_camera(calibration))
        self._size = (k.width, k.height)
        self._xy = camera.img_from_cam(rays).reshape(k.height, k.width, 2)

    def sample(self, image: NDArray) -> NDArray:
        """(H, W) the nearest pixels of `image` (h, w), which covers the source's whole image."""
        scale = (image.shape[1] / self._size[0], image.shape[0] / self._size[1])
        # A hair to the right: at an even reduction the centre is exactly between two pixels, but for rounding.
        column, row = (np.floor(self._xy[..., i] * scale[i] + 1e-6).astype(np.int64) for i in (0, 1))
        return image[row.clip(0, image.shape[0] - 1), column.clip(0, image.shape[1] - 1)]


def distorted_camera(calibration: Calibration) -> Camera:
    """The lens before undistortion, which may have enlarged the image to fill the frame."""
    k, zoom = calibration.intrinsics, 1.0
    for _ in range(6):
        camera = Camera(
            k.width, k.height, k.fx / zoom, k.fy / zoom, k.cx, k.cy, calibration.distortion, calibration.fisheye
        )
        zoom = make_lens(to_pycolmap(camera)).pinhole.fx / camera.fx
    return camera
