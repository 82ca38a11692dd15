"""A camera that is carried through a made room or home: a video, a folder of truth that `evaluate` reads, and views
from beside the path."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from .clip import lens
from .light import LitRoom
from .surfaces import CLASSES
from .textures import Random

TRUTH_EVERY = 6
"""Frames from one with depth and labels to the next."""
BESIDE, ASIDE, TURNED = 16, 0.5, math.radians(20)
"""Views beside the path; metres and angle from it."""
_CLEAR = 0.3
"""Metres that they stay away from things."""
_SAME = 0.02
"""Relative difference of depth up to which a point is the one that the path saw."""
Array = NDArray[np.float64]


class Moving(Protocol):
    """Where a camera is."""

    @property
    def seconds(self) -> float:
        """How long it moves."""

    def poses(self, times: Array) -> Array:
        """world_from_cam (..., 4, 4) at `times` (...) in seconds; x right, y down, z forward."""


@dataclass(frozen=True)
class Tremor:
    """Of hands, and the sway of steps: frequencies, phases (K,), amplitudes (K, 6) of x, y, z, yaw, pitch, roll."""

    frequencies: Array
    phases: Array
    amplitudes: Array

    def __call__(self, times: Array) -> Array:
        """(..., 6) at `times` (...)."""
        return np.asarray(np.sin(2 * np.pi * self.frequencies * times[..., None] + self.phases) @ self.amplitudes)


def waves(r: Random) -> tuple[Array, Array]:
    """Frequencies and amplitudes of a tremor by chance; the first wave is that of the steps."""
    frequencies = np.concatenate([[r.uniform(1.6, 2.0)], r.uniform(0.3, 3, 11)])
    size = np.array([0.004, 0.004, 0.004, 0.006, 0.005, 0.006]) * r.uniform(0.5, 1.5)
    amplitudes = r.normal(size=(12, 6)) * size / frequencies[:, None]
    amplitudes[0] = [0.006, 0.01, 0.006, 0.001, 0.002, 0.001]
    return frequencies, amplitudes


def looking(eye: Array, yaw: Array, pitch: Array, shaken: Array) -> Array:
    """world_from_cam (..., 4, 4) of a camera at `eye` (..., 3) by `yaw`, `pitch` (...) and tremor (..., 6)."""
    yaw, pitch = yaw + shaken[..., 3], pitch + shaken[..., 4]
    z = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(pitch), np.sin(yaw) * np.cos(pitch)], -1)
    x = np.cross(z, [0, 1.0, 0])
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y, roll = np.cross(z, x), shaken[..., 5, None]
    out = np.broadcast_to(np.eye(4), (*np.shape(yaw), 4, 4)).copy()
    columns = x * np.cos(roll) + y * np.sin(roll), y * np.cos(roll) - x * np.sin(roll), z
    out[..., :3, :3], out[..., :3, 3] = np.stack(columns, -1), eye + shaken[..., :3]
    return out


@dataclass(frozen=True)
class Camera:
    """Size in pixels, focal length in pixels, images a second; how much of the exposure is held (None: by chance), and
    what share of the way the rest follows within an image; rays through a pixel, 2 or 3."""

    width: int
    height: int
    focal: float
    rate: int
    held: float | None = None
    follows: float = 0.15
    rays: int = 3


def film(lit: LitRoom, moving: Moving, camera: Camera, target: Path, r: Random) -> None:
    """Write video.mp4 and the truth beside it, whole or not at all."""
    part = target.with_suffix(".part")
    for name in ("rgb", "depth", "labels", "things", "beside"):
        (part / name).mkdir(parents=True, exist_ok=True)
    times = np.arange(int(moving.seconds * camera.rate)) / camera.rate
    options = {"crf": str(int(r.integers(16, 26))), "threads": "1"}
    look = _Look(camera, r)
    with av.open(str(part / "video.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=camera.rate, options=options)
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        for k, image in enumerate(look.images(lit, moving, times, r)):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            if k % TRUTH_EVERY == 0:
                cv2.imwrite(str(part / f"rgb/{k:06d}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        file.mux(stream.encode(None))
    exact, depths = moving.poses(times), []
    for k in range(0, len(times), TRUTH_EVERY):
        depth, label = lit.measure(exact[k], camera.width, camera.height, camera.focal)
        cv2.imwrite(str(part / f"depth/{k:06d}.png"), np.round(depth * 1000).astype(np.uint16))
        cv2.imwrite(str(part / f"labels/{k:06d}.png"), label + np.uint8(1))
        seen = lit.things(exact[k], camera.width, camera.height, camera.focal)
        cv2.imwrite(str(part / f"things/{k:06d}.png"), seen)
        depths.append(depth)
    _describe(part, exact, times, camera)
    _write_beside(part / "beside", lit, look, exact, np.stack(depths))
    part.rename(target)


def _describe(folder: Path, poses: Array, times: Array, camera: Camera) -> None:
    np.savetxt(folder / "traj.txt", poses.reshape(-1, 16), fmt="%.9f")
    np.savetxt(folder / "timestamps.txt", times, fmt="%.6f")
    w, h = camera.width, camera.height
    values = {"width": w, "height": h, "fx": camera.focal, "fy": camera.focal, "cx": w / 2, "cy": h / 2}
    (folder / "intrinsics.json").write_text(json.dumps({**values, "pixel_centre": "half", "depth_scale": 1000.0}))
    classes = [{"id": i, "name": name} for i, name in enumerate(("none", *CLASSES))]
    (folder / "classes.json").write_text(json.dumps({"classes": classes}, indent=1))


class _Look:
    """How a camera shows light: rows read one after the other, motion blur, exposure and white balance that follow
    what is seen, vignetting, blur, noise."""

    def __init__(self, camera: Camera, r: Random) -> None:
        self.camera, self.exposures = camera, list[float]()
        readout, shutter = r.choice([0, 0.012, 0.022]), r.uniform(0.002, 0.016)
        rows = np.arange(camera.height) / camera.height - 0.5
        self.within = shutter * np.array([0, -0.33, 0.33])[3 - camera.rays :, None] + readout * rows
        self.develop, self.blur = lens((camera.height, camera.width), r), r.uniform(0.3, 0.9)
        self.grain, self.level = r.uniform(0.4, 2.5), r.uniform(0.18, 0.38)
        held = r.choice([0.3, 0.6, 1.0])
        self.held = held if camera.held is None else camera.held
        self.balance = 1 + r.normal(size=3) * 0.04

    def images(self, lit: LitRoom, moving: Moving, times: Array, r: Random) -> Iterator[NDArray[np.uint8]]:
        """Frames (h, w, 3)."""
        c, usual, exposed = self.camera, 0.0, 0.0
        for k, time in enumerate(times):
            light, _, _ = lit.photograph(moving.poses(time + self.within), c.width, c.height, c.focal, c.rays)
            seen = math.log(max(float(np.median(light)), 1e-4))
            usual = usual if k else seen
            wanted = self.held * usual + (1 - self.held) * seen
            exposed = exposed + c.follows * (wanted - exposed) if k else wanted
            self.exposures.append(exposed)
            drift = self.balance * (1 + 0.01 * np.sin(time * np.array([0.4, 0.5, 0.7])))
            x = cv2.GaussianBlur(self.develop(light * self.level * math.exp(-exposed) * drift), (0, 0), self.blur)
            noise = cv2.GaussianBlur(r.normal(size=x.shape), (0, 0), 0.6) * 1.8 * self.grain
            yield np.clip(x + noise, 0, 255).astype(np.uint8)

    def still(self, lit: LitRoom, pose: Array, k: int) -> tuple[NDArray[np.uint8], NDArray]:
        """An image (h, w, 3) without noise, blur and shade, with the exposure of frame `k`; and its depth."""
        c = self.camera
        light, depth, _ = lit.photograph(pose, c.width, c.height, c.focal)
        x = self.develop(light * self.level * math.exp(-self.exposures[k]) * self.balance)
        return np.clip(x, 0, 255).astype(np.uint8), depth


# beside the path ------------------------------------------------------------------------------------------------


def _write_beside(folder: Path, lit: LitRoom, look: _Look, exact: Array, depths: Array) -> None:
    """Views to either side in turn, where there is place: images, with what the path saw as alpha, and poses."""
    poses: list[Array] = []
    for n, k in enumerate(np.linspace(0, len(exact) - 1, BESIDE).astype(int)):
        pose = _aside(lit, exact[k], 1 if n % 2 else -1, 1 if n % 4 < 2 else -1)
        if pose is None:
            continue
        image, depth = look.still(lit, pose, k)
        seen = _seen(pose, depth, exact[::TRUTH_EVERY], depths, look.camera)
        rgba = np.dstack([image[..., ::-1], np.where(seen, 255, 0)]).astype(np.uint8)
        cv2.imwrite(str(folder / f"{len(poses):06d}.png"), rgba)
        poses.append(pose)
    np.savetxt(folder / "poses.txt", np.reshape(poses, (-1, 16)), fmt="%.9f")


def _aside(lit: LitRoom, pose: Array, side: int, turn: int) -> Array | None:
    """The pose beside another, to this side or else to the other one."""
    for way in (side, -side):
        c, s = math.cos(TURNED), math.sin(TURNED) * turn
        out = pose.copy()
        out[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ pose[:3, :3]
        out[:3, 3] += ASIDE * way * pose[:3, 0] * [1, 0, 1]
        around = np.concatenate([out[:3, :3].T, -out[:3, :3].T])
        path_is_free = lit.distance(pose[:3, 3], way * pose[None, :3, 0])[0] > ASIDE + _CLEAR
        if path_is_free and lit.distance(out[:3, 3], around).min() > _CLEAR:
            return out
    return None


def _seen(pose: Array, depth: Array, exact: Array, depths: Array, camera: Camera) -> NDArray[np.bool_]:
    """(h, w) whether what a view shows was seen by one of the frames."""
    w, h, f = camera.width, camera.height, camera.focal
    v, u = np.mgrid[:h, :w] + 0.5
    rays = np.stack([(u - w / 2) / f, (v - h / 2) / f, np.ones((h, w))], -1)
    world = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    seen = np.zeros((h, w), bool)
    for other, far in zip(exact, depths, strict=True):
        cam = (world - other[:3, 3]) @ other[:3, :3]
        z = np.maximum(cam[..., 2], 1e-6)
        x, y = cam[..., 0] / z * f + w / 2, cam[..., 1] / z * f + h / 2
        inside = (cam[..., 2] > 0.1) & (x > 0) & (y > 0) & (x < w - 1) & (y < h - 1)
        there = far[np.clip(y, 0, h - 1).astype(int), np.clip(x, 0, w - 1).astype(int)]
        seen |= inside & (np.abs(z / np.maximum(there, 1e-6) - 1) < _SAME)
    return seen & (depth > 0)
