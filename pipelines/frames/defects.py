"""Defects of a recording that bend the path while every residual looks small: noise, images shifted on the sensor."""

from collections.abc import Sequence

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.colmap import ModelArrays
from ..run.stages import StageContext

_NOISY = 0.03
"""Standard deviation of the noise over the contrast of an image. Fifteen recordings by day: up to 0.012; one with a
seventh of the light 0.09."""
_SHIFTED, _MIN_GAIN = 0.004, 0.1
"""Of the longer side, by how much images are shifted; and the share of the residuals that the shifts explain. Eleven
recordings: up to 0.004 and 0.03; one whose crop wanders 0.015 and 0.19."""
_MIN_OBSERVATIONS = 30
_ROUNDS = 4
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6


def warn_of_defects(
    context: StageContext, images: Sequence[NDArray[np.uint8]], straight: pycolmap.Reconstruction
) -> float:
    """Warn of noisy images, and of ones shifted against the lens; return the relative standard deviation by which noise
    makes the focal length less certain than the residuals say.

    Args:
        context: takes the warnings.
        images: some of the grey images (H, W).
        straight: the model, with its observations where frames taken at once would have them.
    """
    noise = float(np.median([noise_of(image) for image in images])) if len(images) else 0.0
    if noise > _NOISY:
        context.warn(
            f"the images are noisy ({noise:.0%} of their contrast): too little light. Features are off together, so "
            "that the camera's path and focal length are less certain than the residuals say. Film with more light"
        )
    shift, gain = shift_of_images(straight)
    camera = straight.cameras[1]
    if gain > _MIN_GAIN and shift > _SHIFTED * max(camera.width, camera.height):
        context.warn(
            f"images are shifted against the lens, each by another {shift:.0f} pixels or so, as electronic "
            "stabilisation does, or a rolling shutter where the times of the images are unknown: the camera's path is "
            "less certain than it looks. Switch stabilisation off; give the video itself, not images of it"
        )
    return noise if noise > _NOISY else 0.0


def noise_of(gray: NDArray[np.uint8]) -> float:
    """Estimate the standard deviation of the noise of an image (H, W), as a share of its contrast, by the median of a
    Laplacian that edges hardly change (Immerkaer, Fast noise variance estimation, 1996)."""
    response = np.abs(cv2.filter2D(gray.astype(np.float32), -1, _LAPLACIAN))
    dark, bright = np.percentile(gray, (5, 95))
    return float(np.median(response) / 0.6745 / max(bright - dark, 1.0))


def shift_of_images(model: pycolmap.Reconstruction) -> tuple[float, float]:
    """Estimate by how many pixels each image is shifted against the lens, beyond what a motion of its camera explains,
    as a root mean square over the images; and the mean share of their squared residuals that this explains."""
    found, camera = ModelArrays.of(model), model.cameras[1]
    focal, shifts, gains = camera.mean_focal_length(), [], []
    for pose, own in zip(found.cam_from_world, found.rows(), strict=True):
        if own.stop - own.start < _MIN_OBSERVATIONS:
            continue
        points = found.points[found.obs_point[own]] @ pose[:3, :3].T + pose[:3, 3]
        rays = points[:, :2] / points[:, 2:]
        residual = (np.asarray(camera.cam_from_img(found.obs_xy[own])) - rays) * focal
        shift, gain = _shift(rays, focal / points[:, 2], residual, focal)
        shifts.append(shift)
        gains.append(gain)
    if not shifts:
        return 0.0, 0.0
    apart = np.array(shifts) - np.mean(shifts, axis=0)
    return float(np.sqrt((apart**2).sum(1).mean())), float(np.mean(gains))


def _shift(
    rays: NDArray[np.float64], near: NDArray[np.float64], residual: NDArray[np.float64], focal: float
) -> tuple[NDArray[np.float64], float]:
    """The shift (2,) of an image beside a motion of its camera that explains its residuals (M, 2) in pixels best, and
    by what share it lowers their squares; `near` (M,): pixels by which a point moves for a unit of length."""
    x, y = rays.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    across = [near, zero, -near * x, -focal * x * y, focal * (1 + x**2), -focal * y, one, zero]
    down = [zero, near, -near * y, -focal * (1 + y**2), focal * x * y, focal * x, zero, one]
    system = np.stack([np.stack(across, 1), np.stack(down, 1)], 1).reshape(-1, 8)
    wanted, weight = residual.ravel(), np.ones(2 * len(x))
    for _ in range(_ROUNDS):  # Cauchy's weights at a pixel
        solved = np.linalg.lstsq(system * weight[:, None], wanted * weight, rcond=None)[0]
        left = wanted - system @ solved
        weight = np.repeat(1 / np.sqrt(1 + (left.reshape(-1, 2) ** 2).sum(1)), 2)
    held = np.linalg.lstsq(system[:, :6] * weight[:, None], wanted * weight, rcond=None)[0]
    before = float((((wanted - system[:, :6] @ held) * weight) ** 2).sum())
    return np.asarray(solved[6:], np.float64), 1 - float(((left * weight) ** 2).sum()) / max(before, 1e-12)
