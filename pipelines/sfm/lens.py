"""A calibrated lens, and the frames without its distortion."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.datasets.sequence import Camera
from ..types import Calibration, Intrinsics

_BORDER_POINTS = 65
_TURN_STEPS = 501
FOCAL_GUESS = 1.2
"""Focal length in longer sides of the image where it is unknown."""
_MIN_SHIFT_PX = 0.3


def to_pycolmap(camera: Camera) -> pycolmap.Camera:
    """Make a fixed camera with known intrinsics: OPENCV with distortion, FULL_OPENCV with more than two radial ones,
    PINHOLE, or OPENCV_FISHEYE."""
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    model = "PINHOLE"
    if camera.fisheye:
        model = "OPENCV_FISHEYE"
        params += (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    elif any(camera.distortion[4:]):
        model = "FULL_OPENCV"
        params += [*camera.distortion, 0.0, 0.0, 0.0][:8]
    elif any(camera.distortion):
        model = "OPENCV"
        params += camera.distortion[:4]
    made = pycolmap.Camera.create_from_model_name(1, model, camera.fx, camera.width, camera.height)
    made.params = params
    made.has_prior_focal_length = True
    return made


def unknown_camera(width: int, height: int, focal: float, is_prior: bool) -> pycolmap.Camera:
    """Make a camera to be calibrated: one focal length, the image centre, one radial coefficient."""
    made = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, width, height)
    made.has_prior_focal_length = is_prior
    return made


def set_lens(camera: pycolmap.Camera, coefficients: int) -> None:
    """Turn a SIMPLE_RADIAL or RADIAL camera into one of one or two radial coefficients, in place, a new one zero."""
    params = [*camera.params, 0.0][: 3 + coefficients]
    camera.model = (pycolmap.CameraModelId.SIMPLE_RADIAL, pycolmap.CameraModelId.RADIAL)[coefficients - 1]
    camera.params = params


def distortion_of(camera: pycolmap.Camera) -> tuple[float, ...]:
    """(k1, k2, p1, p2), with k3 and k4 to k6 where the camera has them; zeros for a pinhole."""
    params = [float(p) for p in camera.params]
    if camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL:
        return params[3], 0.0, 0.0, 0.0
    if camera.model == pycolmap.CameraModelId.RADIAL:
        return params[3], params[4], 0.0, 0.0
    if camera.model == pycolmap.CameraModelId.OPENCV:
        return params[4], params[5], params[6], params[7]
    if camera.model == pycolmap.CameraModelId.FULL_OPENCV:
        return tuple(params[4:12] if any(params[9:12]) else params[4:9])
    return 0.0, 0.0, 0.0, 0.0


@dataclass(frozen=True)
class Lens:
    """A distorted camera and the pinhole of the same image size that takes its place.

    The pinhole keeps the principal point, and the focal length too unless the frame's border would then look past the
    source's: it is enlarged just enough that every pixel of the undistorted frame has an image (what falls outside is
    cropped). `shift_px` is the largest distance by which a pixel moves.
    """

    camera: pycolmap.Camera
    pinhole: Intrinsics
    shift_px: float

    @property
    def is_straight(self) -> bool:
        """Return whether there is too little distortion to take away."""
        return self.shift_px <= _MIN_SHIFT_PX

    def undistort_points(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M, 2) pixels of the source to pixels of the pinhole."""
        rays = np.asarray(self.camera.cam_from_img(np.ascontiguousarray(xy, dtype=np.float64)))
        return rays * [self.pinhole.fx, self.pinhole.fy] + [self.pinhole.cx, self.pinhole.cy]

    def undistort_image(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(H, W, 3) of the source as the pinhole sees it."""
        x, y = self.maps
        return cv2.remap(rgb, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8, copy=False)

    def undistort_mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(H, W) of the source as the pinhole sees it."""
        x, y = self.maps
        return cv2.remap(mask.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0

    @cached_property
    def folded(self) -> NDArray[np.bool_] | None:
        """(H, W) pixels of the pinhole beyond where the distortion turns back, which would show a second time what lies
        within; None where it does not turn back inside the frame."""
        k = self.pinhole
        turn = _turning_radius(self.camera, k)
        across, down = ((np.arange(n) + 0.5 - c) / f for n, c, f in ((k.width, k.cx, k.fx), (k.height, k.cy, k.fy)))
        beyond = np.hypot(across, down[:, None]) >= turn
        return beyond if beyond.any() else None

    @cached_property
    def maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(H, W) columns and rows of the source, as OpenCV counts them, of the pixels of the pinhole."""
        columns, rows = np.meshgrid(np.arange(self.pinhole.width) + 0.5, np.arange(self.pinhole.height) + 0.5)
        source = _distort(self.camera, self.pinhole, np.stack([columns.ravel(), rows.ravel()], axis=1))
        # OpenCV counts pixel centres from (0, 0).
        maps = (source - 0.5).reshape(self.pinhole.height, self.pinhole.width, 2).astype(np.float32)
        return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def make_lens(camera: pycolmap.Camera) -> Lens:
    """Make the lens of a calibrated camera."""
    same = Intrinsics(
        camera.width, camera.height, camera.focal_length_x, camera.focal_length_y,
        camera.principal_point_x, camera.principal_point_y,
    )  # fmt: skip
    border = _border(same.width, same.height)
    shift = float(np.linalg.norm(_distort(camera, same, border) - border, axis=1).max())
    return Lens(camera, _without_blank_border(camera, same, border), shift)


def _without_blank_border(camera: pycolmap.Camera, same: Intrinsics, border: NDArray[np.float64]) -> Intrinsics:
    low, high = 1.0, 2.0
    if _inside(camera, same, border):
        return same
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if _inside(camera, _zoomed(same, middle), border) else (middle, high)
    return _zoomed(same, high)


def _zoomed(camera: Intrinsics, factor: float) -> Intrinsics:
    return Intrinsics(camera.width, camera.height, camera.fx * factor, camera.fy * factor, camera.cx, camera.cy)


def _inside(camera: pycolmap.Camera, pinhole: Intrinsics, border: NDArray[np.float64]) -> bool:
    # A hundredth of a pixel: a lens without distortion is inside although it is rounded.
    source = _distort(camera, pinhole, border)
    return bool((source > -0.01).all() and (source < [camera.width + 0.01, camera.height + 0.01]).all())


def _distort(camera: pycolmap.Camera, pinhole: Intrinsics, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    rays = np.ones((len(xy), 3))
    rays[:, :2] = (xy - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    return np.asarray(camera.img_from_cam(rays))


def _turning_radius(camera: pycolmap.Camera, pinhole: Intrinsics) -> float:
    """Tangent of the least angle to the axis beyond which the distortion folds back; infinite where it does not."""
    rays = (_border(pinhole.width, pinhole.height) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    along = np.linspace(0.0, 1.0, _TURN_STEPS)[:, None, None] * rays
    flat = along.reshape(-1, 2) * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy]
    seen = _distort(camera, pinhole, flat).reshape(along.shape) - [camera.principal_point_x, camera.principal_point_y]
    turns = np.diff(np.linalg.norm(seen, axis=2), axis=0) < 0
    return float(np.where(turns, np.linalg.norm(along[:-1], axis=2), np.inf).min())


def _border(width: int, height: int) -> NDArray[np.float64]:
    along = np.linspace(0.0, 1.0, _BORDER_POINTS)
    zero, one = np.zeros_like(along), np.ones_like(along)
    sides = [(along, zero), (along, one), (zero, along), (one, along)]
    return np.concatenate([np.stack(side, axis=1) for side in sides]) * [width, height]


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
    """Return the lens before undistortion, which may have enlarged the image to fill the frame."""
    k, zoom = calibration.intrinsics, 1.0
    for _ in range(6):
        camera = Camera(
            k.width, k.height, k.fx / zoom, k.fy / zoom, k.cx, k.cy, calibration.distortion, calibration.fisheye
        )
        zoom = make_lens(to_pycolmap(camera)).pinhole.fx / camera.fx
    return camera
