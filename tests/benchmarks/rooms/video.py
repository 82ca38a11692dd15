"""A hand-held walk of twelve seconds through a made room: a video, and a folder of truth that `evaluate` reads."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from .clip import lens
from .furniture import Catalogue
from .light import LitRoom
from .room import Room, build_room
from .surfaces import CLASSES
from .textures import Random

WIDTH, HEIGHT, SECONDS, RATE = 640, 480, 12, 10
TRUTH_EVERY = 6
"""Frames from one with depth and labels to the next."""
_CELL, _BODY, _CLEAR = 0.05, 0.25, 0.3
"""Metres: cells of the floor, room that a person takes around its middle, what the camera stays away from things."""
_TRIES, _COMPARED = 4000, 12
_FAR = 1.5
"""Metres of a walk: on a shorter one the camera hardly does more than turn."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Walk:
    """Where the camera is at any time: along a curve (3, 3) of the floor plan with its height, turning once around by
    `sweep`, with the tremor of hands and the sway of steps: frequencies (K,), phases and amplitudes (K, 6)."""

    curve: Array
    yaw: float
    sweep: float
    pitch: float
    nod: float
    frequencies: Array
    phases: Array
    amplitudes: Array

    @property
    def length(self) -> float:
        """Metres of the curve, without tremor and sway."""
        u = np.linspace(0, 1, 33)[:, None]
        a, b, c = self.curve
        return float(np.linalg.norm(np.diff((1 - u) ** 2 * a + 2 * u * (1 - u) * b + u**2 * c, axis=0), axis=1).sum())

    def poses(self, times: Array) -> Array:
        """world_from_cam (..., 4, 4) at `times` (...) in seconds; x right, y down, z forward."""
        u = times / SECONDS
        along = (u + 0.03 - 0.03 * np.cos(2 * np.pi * u) - 0.1 * np.sin(2 * np.pi * u) / (2 * np.pi))[..., None]
        a, b, c = self.curve
        eye = (1 - along) ** 2 * a + 2 * along * (1 - along) * b + along**2 * c
        waves = np.sin(2 * np.pi * self.frequencies * times[..., None] + self.phases) @ self.amplitudes
        eye = eye + waves[..., :3]
        yaw = self.yaw + self.sweep * (u + 0.06 * np.sin(4 * np.pi * u + self.phases[0])) + waves[..., 3]
        pitch = self.pitch + self.nod * np.sin(3 * np.pi * u + self.phases[1]) + waves[..., 4]
        z = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(pitch), np.sin(yaw) * np.cos(pitch)], -1)
        x = np.cross(z, [0, 1.0, 0])
        x /= np.linalg.norm(x, axis=-1, keepdims=True)
        y, roll = np.cross(z, x), waves[..., 5, None]
        out = np.broadcast_to(np.eye(4), (*times.shape, 4, 4)).copy()
        columns = x * np.cos(roll) + y * np.sin(roll), y * np.cos(roll) - x * np.sin(roll), z
        out[..., :3, :3], out[..., :3, 3] = np.stack(columns, -1), eye
        return out


def make_video(seed: int, catalogue: Catalogue, target: Path) -> bool:
    """Write video.mp4 and the truth beside it; False where there is no place to walk."""
    room, r = build_room(seed, catalogue)
    lit = LitRoom(room.surfaces)
    walk = _walk(room, lit, r)
    if walk is None:
        return False
    part, focal = target.with_suffix(".part"), float(r.uniform(0.7, 0.98)) * WIDTH
    for name in ("rgb", "depth", "labels"):
        (part / name).mkdir(parents=True, exist_ok=True)
    times = np.arange(SECONDS * RATE) / RATE
    with av.open(str(part / "video.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=RATE, options={"crf": str(int(r.integers(16, 26))), "threads": "1"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for k, image in enumerate(_filmed(lit, walk, times, focal, r)):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            if k % TRUTH_EVERY == 0:
                cv2.imwrite(str(part / f"rgb/{k:06d}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        file.mux(stream.encode(None))
    exact = walk.poses(times)
    for k in range(0, len(times), TRUTH_EVERY):
        depth, label = lit.measure(exact[k], WIDTH, HEIGHT, focal)
        cv2.imwrite(str(part / f"depth/{k:06d}.png"), np.round(depth * 1000).astype(np.uint16))
        cv2.imwrite(str(part / f"labels/{k:06d}.png"), label + np.uint8(1))
    _describe(part, exact, times, focal)
    part.rename(target)
    return True


def _describe(folder: Path, poses: Array, times: Array, focal: float) -> None:
    np.savetxt(folder / "traj.txt", poses.reshape(-1, 16), fmt="%.9f")
    np.savetxt(folder / "timestamps.txt", times, fmt="%.6f")
    camera = {"width": WIDTH, "height": HEIGHT, "fx": focal, "fy": focal, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "intrinsics.json").write_text(json.dumps({**camera, "pixel_centre": "half", "depth_scale": 1000.0}))
    classes = [{"id": i, "name": name} for i, name in enumerate(("none", *CLASSES))]
    (folder / "classes.json").write_text(json.dumps({"classes": classes}, indent=1))


# the walk -------------------------------------------------------------------------------------------------------


def _walk(room: Room, lit: LitRoom, r: Random) -> Walk | None:
    """A curve of 1.2 to 5 metres over free floor; of some such walks that which sees farthest and is no mere
    turn: people film across a room."""
    free, ball = _free_floor(room), r.normal(size=(150, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    places = (np.argwhere(free) + 0.5) * _CELL
    height = r.uniform(1.2, min(1.65, room.size[2] - 0.5))
    found: list[tuple[float, Walk]] = []
    for _ in range(_TRIES if len(places) else 0):
        x, z = places[r.integers(len(places), size=3)].T
        walk = _some_walk(np.stack([x, height + r.normal(size=3) * 0.08, z], 1), r)
        path = walk.poses(np.linspace(0, SECONDS, 49))
        cells = (path[:, [0, 2], 3] / _CELL).astype(int)
        length = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).sum()
        if not 1.2 <= length <= 5 or not free[tuple(np.clip(cells, 0, np.array(free.shape) - 1).T)].all():
            continue
        if (seen := _sees(lit, path[::4], ball)) > 0:
            found.append((seen * min(1.0, walk.length / _FAR), walk))
        if len(found) == _COMPARED:
            break
    return max(found, key=lambda f: f[0])[1] if found else None


def _free_floor(room: Room) -> NDArray[np.bool_]:
    """Cells (x, z) of the floor on which a person can stand."""
    wide, deep, _ = room.size
    x, z = np.meshgrid(np.arange(0, wide, _CELL), np.arange(0, deep, _CELL), indexing="ij")
    free = (x > 0.35) & (z > 0.35) & (x < wide - 0.35) & (z < deep - 0.35)
    for a, b, c, d in room.taken:
        free &= (x < a - _BODY) | (x > c + _BODY) | (z < b - _BODY) | (z > d + _BODY)
    return free


def _some_walk(curve: Array, r: Random) -> Walk:
    frequencies = np.concatenate([[r.uniform(1.6, 2.0)], r.uniform(0.3, 3, 11)])
    size = np.array([0.004, 0.004, 0.004, 0.006, 0.005, 0.006]) * r.uniform(0.5, 1.5)
    amplitudes = r.normal(size=(12, 6)) * size / frequencies[:, None]
    amplitudes[0] = [0.006, 0.01, 0.006, 0.001, 0.002, 0.001]
    sweep = math.radians(r.uniform(80, 230)) * r.choice([-1, 1])
    pitch, nod = r.normal() * 0.08 - 0.2, r.uniform(0.05, 0.2)
    return Walk(curve, r.uniform(0, 2 * np.pi), sweep, pitch, nod, frequencies, r.uniform(0, 6.28, 12), amplitudes)


def _sees(lit: LitRoom, poses: Array, ball: Array) -> float:
    """Metres that the views see, on average, at most four of each; 0 where one of them is close to something."""
    middles = []
    for pose in poses:
        far = lit.distance(pose[:3, 3], ball)
        ahead = far[(ball @ pose[:3, 2]) > 0.85]
        if far.min() < _CLEAR or len(ahead) == 0 or ahead.min() < 0.4 or not 0.9 < np.median(ahead) < 20:
            return 0.0
        middles.append(min(float(np.median(ahead)), 4.0))
    return float(np.mean(middles))


# the camera -----------------------------------------------------------------------------------------------------


def _filmed(lit: LitRoom, walk: Walk, times: Array, focal: float, r: Random) -> Iterator[NDArray[np.uint8]]:
    """Frames (h, w, 3): rows read one after the other, motion blur, exposure and white balance that follow what is
    seen, vignetting, blur, noise."""
    readout, shutter = r.choice([0, 0.012, 0.022]), r.uniform(0.002, 0.016)
    within = shutter * np.array([0, -0.33, 0.33])[:, None] + readout * (np.arange(HEIGHT) / HEIGHT - 0.5)
    develop, blur, grain = lens((HEIGHT, WIDTH), r), r.uniform(0.3, 0.9), r.uniform(0.4, 2.5)
    level, held, balance = r.uniform(0.18, 0.38), r.choice([0.3, 0.6, 1.0]), 1 + r.normal(size=3) * 0.04
    usual = exposed = 0.0
    for k, time in enumerate(times):
        light, _, _ = lit.photograph(walk.poses(time + within), WIDTH, HEIGHT, focal)
        seen = math.log(max(float(np.median(light)), 1e-4))
        usual = usual if k else seen
        wanted = held * usual + (1 - held) * seen
        exposed = exposed + 0.15 * (wanted - exposed) if k else wanted
        drift = balance * (1 + 0.01 * np.sin(time * np.array([0.4, 0.5, 0.7])))
        x = cv2.GaussianBlur(develop(light * level * math.exp(-exposed) * drift), (0, 0), blur)
        noise = cv2.GaussianBlur(r.normal(size=x.shape), (0, 0), 0.6) * 1.8 * grain
        yield np.clip(x + noise, 0, 255).astype(np.uint8)
