"""Images of 360° and fisheye cameras, brought to what a pinhole camera sees before anything else looks at them.

A panorama becomes six images, the sides of a cube; a fisheye of known lens one, of the width that fits.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.datasets.sequence import Camera
from ...formats.errors import InputError
from ...formats.video_head import PART, WHOLE, image_sphere, video_sphere
from ..config import FramesConfig
from ..geometry.camera import CUBE, LEVEL
from ..sfm.lens import make_lens, to_pycolmap
from ..types import Intrinsics
from .given import read_intrinsics
from .picking import reduced_size
from .recording import FolderRecording, Recording, VideoRecording

Pixel = TypeVar("Pixel", np.uint8, np.bool_)
Map = tuple[NDArray[np.float32], NDArray[np.float32]]
_ROWS = 2
"""Rows beyond each pole, for the cubic interpolation there."""


@dataclass(frozen=True)
class Faces:
    """Pinhole images cut out of each source image, in one direction or the six of `CUBE`, with the camera `pinhole`.

    size (width, height): source images are resized to it first; maps: for each direction the pixels of the resized
    image, as OpenCV counts them, of a panorama with `_ROWS` more above it. `fisheye`: the lens that is removed, None
    for panoramas.
    """

    pinhole: Intrinsics
    size: tuple[int, int]
    maps: tuple[Map, ...]
    fisheye: Camera | None

    def __len__(self) -> int:
        return len(self.maps)

    def names(self, name: str) -> list[str]:
        """Return the names of the images cut out of the image `name`."""
        return [f"f{c}_{name}" for c in range(len(self))] if len(self) > 1 else [name]

    def cut(self, rgb: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
        """(H, W, 3) of every direction."""
        small = cv2.resize(rgb, self.size, interpolation=cv2.INTER_AREA) if rgb.shape[1::-1] != self.size else rgb
        return [self._remapped(small, camera, cv2.INTER_CUBIC) for camera in range(len(self))]

    def cut_mask(self, mask: NDArray[np.bool_], camera: int) -> NDArray[np.bool_]:
        """(H, W) of one direction; the mask has the reduced size."""
        return self._remapped(mask.astype(np.uint8), camera, cv2.INTER_NEAREST) > 0

    def _remapped(self, small: NDArray[Any], camera: int, how: int) -> NDArray[np.uint8]:
        border = cv2.BORDER_REPLICATE
        if self.fisheye is None:
            # Over a pole the image goes on half-way round.
            half = small.shape[1] // 2
            ends = (np.roll(rows, half, axis=1) for rows in (small[_ROWS - 1 :: -1], small[: -_ROWS - 1 : -1]))
            small, border = np.concatenate([next(ends), small, next(ends)]), cv2.BORDER_WRAP
        return cv2.remap(small, *self.maps[camera], how, borderMode=border).astype(np.uint8, copy=False)


def find_faces(source: Recording, config: FramesConfig) -> Faces | None:
    """None for images that are a plain camera's already.

    Raises InputError for a panorama that is not whole, and a fisheye whose lens is not known where `frames.camera` says
    that it is one.
    """
    kind = _said(source) if config.camera == "auto" else config.camera
    if kind == PART:
        raise InputError(
            f"{source.path} declares a partial or stereo panorama: export it as one full equirectangular "
            "image, twice as wide as high, or treat it as an ordinary image with --camera perspective"
        )
    if kind == WHOLE:
        return panorama_faces(source.width, source.height, config.max_side)
    lens = None if kind == "perspective" else _fisheye(source, config)
    if lens is None and kind == "fisheye":
        raise InputError(
            "--camera fisheye needs the lens: --intrinsics fx,fy,cx,cy,k1,k2,k3,k4 as OpenCV's fisheye module finds "
            "them, or a file (COLMAP's cameras.txt with OPENCV_FISHEYE, or JSON)"
        )
    return None if lens is None else fisheye_face(lens, config.max_side)


def has_panorama_shape(source: Recording, config: FramesConfig) -> bool:
    """Whether the images have the shape of panoramas, and nothing says what they are."""
    unsaid = config.camera == "auto" and not config.intrinsics and source.dataset() is None
    return unsaid and source.width == 2 * source.height


def _said(source: Recording) -> str:
    if isinstance(source, VideoRecording):
        return video_sphere(source.files[0])
    return image_sphere(source.file(0)) if isinstance(source, FolderRecording) else ""


def _fisheye(source: Recording, config: FramesConfig) -> Camera | None:
    if config.intrinsics:
        camera: Camera | None = read_intrinsics(config.intrinsics, source.width, source.height)
        if config.camera == "fisheye" and camera is not None:
            camera = replace(camera, fisheye=True)
    else:
        camera = source.camera()
    return camera if camera is not None and camera.fisheye and not camera.is_nominal else None


def panorama_faces(width: int, height: int, max_side: int) -> Faces:
    """Make the faces of an equirectangular panorama: the first looks at its middle; it spans 360 by 180 degrees.

    Raises InputError for another shape.
    """
    if abs(width - 2 * height) > 0.01 * width:
        raise InputError(
            f"an equirectangular panorama is twice as wide as high, these images are {width}x{height}: export them "
            "full and mono, or treat them as ordinary images with --camera perspective"
        )
    # In its middle a side then has as many pixels to the degree as the panorama has.
    side = max(16, round(min(width / math.pi, max_side) / 2) * 2)
    pinhole = Intrinsics(side, side, side / 2, side / 2, side / 2, side / 2)
    wide = min(width, round(math.pi * side))
    size = (wide, max(1, round(wide / 2)))
    rows, columns = np.indices((side, side)) + 0.5
    rays = np.stack([columns / (side / 2) - 1, rows / (side / 2) - 1, np.ones((side, side))], axis=-1)
    return Faces(pinhole, size, tuple(_on_panorama(rays @ r, *size) for r in CUBE), None)


def _on_panorama(rays: NDArray[np.float64], width: int, height: int) -> Map:
    """Pixels of directions (H, W, 3) in the rig; OpenCV's first pixel has its centre at (0, 0)."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    across, down = np.arctan2(x, z) / (2 * np.pi) + 0.5, np.arcsin(y) / np.pi + 0.5
    return (across * width - 0.5).astype(np.float32), (down * height - 0.5 + _ROWS).astype(np.float32)


def fisheye_face(camera: Camera, max_side: int) -> Faces:
    """The middle of a fisheye image as a pinhole of the same focal length sees it."""
    size = reduced_size(camera.width, camera.height, max_side)
    small = camera.resized(*size)
    lens = make_lens(to_pycolmap(small))
    return Faces(lens.pinhole, size, (lens.maps,), small)


def level_mosaic(faces: list[NDArray[Pixel]]) -> NDArray[Pixel]:
    """The images (H, W) of the level directions as one of twice the side, by which panoramas are compared."""
    front, right, back, left = faces[:LEVEL]
    return np.vstack([np.hstack([front, right]), np.hstack([back, left])])
