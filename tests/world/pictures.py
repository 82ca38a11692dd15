"""Procedural pictures of things: posters, book spines, a door, a view through a window, a cardboard box."""

import cv2
import numpy as np
from numpy.random import Generator

from tests.world.textures import Color, Image, fractal_noise, planks, plaster, wood

_LETTERS = np.array(list("ABCDEFGHIKLMNOPRSTUVWXYZ"))


def poster(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """An abstract painting with a line of letters, in a frame."""
    h, w = shape
    ramp = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    top, bottom = rng.uniform(0.05, 0.8, (2, 3)).astype(np.float32)
    picture = np.broadcast_to(top * (1 - ramp) + bottom * ramp, (h, w, 3)).copy()
    for _ in range(26):
        tone = rng.uniform(0.02, 0.9, 3).tolist()
        points = (rng.uniform(-0.1, 1.1, (1, 2)) + rng.uniform(-0.25, 0.25, (4, 2))) * (w, h)
        if rng.random() < 0.5:
            cv2.fillPoly(picture, [points.astype(np.int32)], tone, cv2.LINE_AA)
        elif rng.random() < 0.6:
            reach = int(rng.uniform(0.03, 0.16) * min(h, w)) + 1
            cv2.circle(picture, points[0].astype(int).tolist(), reach, tone, -1, cv2.LINE_AA)
        else:
            ends = points[:2].astype(int).tolist()
            cv2.line(picture, ends[0], ends[1], tone, max(1, int(0.012 / texel)), cv2.LINE_AA)
    _write(picture, "".join(rng.choice(_LETTERS, 7)), (int(0.12 * w), int(0.9 * h)), 0.76 * w, rng)
    picture *= (1 + 0.06 * fractal_noise(shape, texel, 0.06, 4, rng))[..., None]
    cv2.rectangle(picture, (0, 0), (w - 1, h - 1), list(color), max(2, int(0.035 / texel)))
    return np.clip(picture, 0.01, 0.95)


def _write(picture: Image, text: str, at: tuple[int, int], width: float, rng: Generator) -> None:
    (pixels, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)
    scale = width / max(pixels, 1)
    tone = rng.uniform(0.7, 0.9, 3) if rng.random() < 0.5 else rng.uniform(0.02, 0.1, 3)
    # OpenCV writes into bytes only.
    ink = np.zeros(picture.shape[:2], np.uint8)
    cv2.putText(ink, text, at, cv2.FONT_HERSHEY_DUPLEX, scale, 255, max(1, int(2 * scale)), cv2.LINE_AA)
    share = ink[..., None].astype(np.float32) / 255
    picture += share * (tone.astype(np.float32) - picture)


def books(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """A row of book spines of uneven height on a dark ground."""
    h, w = shape
    picture = np.full((h, w, 3), 0.025, np.float32)
    left = 0
    while left < w:
        right = left + int(rng.uniform(0.018, 0.055) / texel) + 1
        top = int(rng.uniform(0.0, 0.3) * h)
        tone = rng.uniform(0.03, 0.75) * rng.dirichlet((1.2, 1.2, 1.2)) * 2
        picture[top:, left : right - 1] = np.clip(tone, 0.02, 0.9)
        for _ in range(int(rng.integers(1, 5))):
            at = top + int(rng.uniform(0.05, 0.9) * (h - top))
            picture[at : at + max(1, int(0.012 / texel)), left : right - 1] = rng.uniform(0.05, 0.85, 3)
        left = right
    return np.clip(picture * (1 + 0.08 * fractal_noise(shape, texel, 0.05, 4, rng))[..., None], 0.01, 0.95)


def door(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Four panels in a wooden leaf, and a handle."""
    h, w = shape
    picture = wood((w, h), texel, color, rng).transpose(1, 0, 2).copy()
    for low, high in ((0.07, 0.45), (0.53, 0.93)):
        for left, right in ((0.12, 0.46), (0.54, 0.88)):
            first, last = (int(left * w), int(low * h)), (int(right * w), int(high * h))
            tone = (np.asarray(color) * 0.45).tolist()
            cv2.rectangle(picture, first, last, tone, max(1, int(0.014 / texel)), cv2.LINE_AA)
    cv2.circle(picture, (int(0.93 * w), int(0.51 * h)), max(2, int(0.028 / texel)), (0.7, 0.6, 0.3), -1, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (w - 1, h - 1), (0.75, 0.73, 0.7), max(1, int(0.05 / texel)))
    return picture


def window(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Sky with clouds, hills and trees behind white bars."""
    h, w = shape
    clouds = np.clip(fractal_noise(shape, texel, 0.5, 5, rng, stretch=2), 0, 1.2)[..., None] / 1.2
    ramp = np.linspace(1.0, 0.75, h, dtype=np.float32)[:, None, None]
    picture = ((1 - 0.6 * clouds) * np.asarray(color, np.float32) + 0.6 * clouds) * ramp
    rows = np.arange(h, dtype=np.float32)[:, None]
    for layer, tone in enumerate(((0.18, 0.3, 0.2), (0.09, 0.2, 0.06))):
        ridge = h * (0.62 + 0.14 * layer) + 0.05 * h * fractal_noise((1, w), texel, 0.5, 5, rng)
        leaves = 1 + 0.35 * fractal_noise(shape, texel, 0.08, 4, rng)
        picture = np.where((rows > ridge)[..., None], np.asarray(tone, np.float32) * leaves[..., None], picture)
    picture = np.ascontiguousarray(np.clip(picture, 0.02, 0.95), np.float32)
    bar = max(2, int(0.05 / texel))
    for x in (0, w // 2, w - 1):
        cv2.line(picture, (x, 0), (x, h), (0.8, 0.8, 0.78), bar)
    for y in (0, h // 3, h - 1):
        cv2.line(picture, (0, y), (w, y), (0.8, 0.8, 0.78), bar)
    return picture


def cardboard(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """A printed cardboard box with tape."""
    h, w = shape
    picture = plaster(shape, texel, color, rng)
    picture[int(0.44 * h) : int(0.56 * h)] *= 0.7
    _write(picture, "".join(rng.choice(_LETTERS, 5)), (int(0.1 * w), int(0.36 * h)), 0.7 * w, rng)
    for _ in range(3):
        at = (rng.uniform(0.1, 0.8, 2) * (w, h)).astype(int)
        last = at + (rng.uniform(0.05, 0.2, 2) * (w, h)).astype(int) + 1
        cv2.rectangle(picture, at.tolist(), last.tolist(), rng.uniform(0.02, 0.5, 3).tolist(), -1)
    return picture


def glow(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """A lamp's shade or panel: almost even."""
    return np.clip(
        np.asarray(color, np.float32) * (1 + 0.03 * fractal_noise(shape, texel, 0.1, 3, rng))[..., None], 0, 1
    )


def beams(shape: tuple[int, int], texel: float, color: Color, rng: Generator) -> Image:
    """Boards painted pale: a wooden ceiling."""
    pale = planks(shape, texel, color, rng)
    return np.clip(0.35 * np.asarray(color, np.float32) + 0.65 * pale, 0.01, 0.95)
