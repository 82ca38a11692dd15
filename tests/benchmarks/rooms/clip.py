"""A clip of a made room: a hand-held walk, a camera's pictures, the sparse points that structure from motion would
give, and the product's stereo on them."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from msgs_slam.pipelines.depth.stereo.provider import MultiviewDepth
from msgs_slam.pipelines.geometry.sequence import Sequence
from msgs_slam.pipelines.geometry.sparse_model import SparseModel
from msgs_slam.pipelines.system.progress import SilentProgress
from msgs_slam.pipelines.types import Calibration, Frame, Intrinsics

from .furniture import Catalogue
from .light import LitRoom
from .room import Room, build_room
from .textures import Random

WIDTH, HEIGHT = 448, 336
KEYFRAMES = 12
PLANES = 128
_CLEAR = 0.3
"""Metres that the camera stays away from things."""
_TRIES = 400
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Clip:
    """images (N, h, w, 3), truth (N, h, w) depth in metres (0: nothing) and classes (N, h, w); cam_from_world
    (N, 4, 4) as structure from motion would know them; focal in widths; and the sparse points."""

    kind: str
    focal: float
    images: NDArray[np.uint8]
    truth: NDArray[np.float16]
    classes: NDArray[np.uint8]
    cam_from_world: Array
    points: Array
    colors: NDArray[np.uint8]
    obs_frame: NDArray[np.int64]
    obs_point: NDArray[np.int64]
    obs_xy: Array

    def save(self, path: Path) -> None:
        """One .npz, whole or not at all."""
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, **{f.name: getattr(self, f.name) for f in fields(self)})
        part.rename(path)

    @classmethod
    def load(cls, path: Path) -> "Clip":
        """Inverse of `save`."""
        with np.load(path, allow_pickle=False) as held:
            columns = {f.name: held[f.name] for f in fields(cls)}
        return cls(**{**columns, "kind": str(columns["kind"]), "focal": float(columns["focal"])})

    @property
    def camera(self) -> Intrinsics:
        """The pictures' camera."""
        height, width = self.images.shape[1:3]
        focal = self.focal * width
        return Intrinsics(width, height, focal, focal, width / 2, height / 2)

    def sequence(self) -> Sequence:
        """The frames and what structure from motion would know of them."""
        frames = [Frame(i, f"{i:06d}.png", i / 3, i, 1.0) for i in range(len(self.images))]
        model = SparseModel(
            np.arange(len(frames), dtype=np.int64), self.cam_from_world, self.points, self.colors, self.obs_frame,
            self.obs_point, self.obs_xy,
        )  # fmt: skip
        calibration = Calibration(self.camera, "given", 0.0, (0.0, 0.0, 0.0, 0.0))
        return Sequence(frames, calibration, self.camera, model, lambda f: self.images[f.id])

    def stereo(self, folder: Path, device: str = "cpu") -> tuple[MultiviewDepth, list[Frame]]:
        """The product's stereo on a device, its first pass done; that is kept in the folder."""
        sequence = self.sequence()
        folder.mkdir(parents=True, exist_ok=True)
        provider = MultiviewDepth(
            sequence, max(self.camera.width, self.camera.height), PLANES, lambda: folder, 1, SilentProgress(), device
        )
        provider.fit(sequence.frames)
        return provider, sequence.frames


def make_clip(seed: int, catalogue: Catalogue, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Clip | None:
    """Build the room of a seed and film it at a size (width, height); None where there is no place to walk."""
    room, r = build_room(seed, catalogue)
    lit = LitRoom(room.surfaces)
    poses = _walk(room, lit, KEYFRAMES, r)
    if poses is None:
        return None
    focal, (width, height) = float(r.uniform(0.7, 0.98)), size
    shots = [lit.photograph(pose, width, height, focal * width) for pose in poses]
    depths, classes = np.stack([d for _, d, _ in shots]), np.stack([c for _, _, c in shots])
    images = np.stack(_exposed([c for c, _, _ in shots], r))
    exact = np.linalg.inv(poses)
    camera = Intrinsics(width, height, focal * width, focal * width, width / 2, height / 2)
    sparse = _sparse_points(images, depths, exact, camera, r)
    known = _shaken(exact, float(r.choice([0, 0.0003, 0.0008])), r)
    return Clip(room.kind, focal, images, depths.astype(np.float16), classes, known, *sparse)


def worn(clip: Clip, seed: int, shaken: float = 1.0) -> Clip:
    """The clip by a worse camera: noise, blur, distortion that is left, poses (by `shaken` times as much) and focal
    length that are off by more."""
    r = np.random.default_rng(seed)
    height, width = clip.images.shape[1:3]
    noise, blur, quality = r.uniform(0.5, 5), r.uniform(0, 1.2), int(r.integers(60, 95))
    y, x = (np.mgrid[:height, :width] + 0.5 - np.array([height / 2, width / 2])[:, None, None]) / width
    bend = 1 + r.normal() * 0.01 * (x**2 + y**2) / clip.focal**2
    at = (
        (x * bend * width + width / 2 - 0.5).astype(np.float32),
        (y * bend * width + height / 2 - 0.5).astype(np.float32),
    )
    images = []
    for image in clip.images:
        seen = cv2.remap(image, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = cv2.GaussianBlur(seen, (0, 0), blur) if blur > 0.3 else seen
        coarse = cv2.resize(r.normal(size=(height // 2, width // 2, 3)), (width, height))
        stored = np.clip(seen + noise * 0.7 * (r.normal(size=seen.shape) + coarse), 0, 255).astype(np.uint8)
        images.append(_compressed(stored, quality))
    poses = _shaken(clip.cam_from_world, shaken * float(r.choice([0.0005, 0.001, 0.002])), r)
    poses[:, :3, 3] += np.cumsum(r.normal(size=(len(poses), 3)) * 0.0007, 0)
    focal = clip.focal * float(1 + r.normal() * 0.004)
    return replace(clip, images=np.stack(images), cam_from_world=poses, focal=focal)


def _compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """An RGB image (h, w, 3) as it is after JPEG."""
    stored = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(stored, cv2.IMREAD_COLOR)[..., ::-1], np.uint8).copy()


def _shaken(cam_from_world: Array, by: float, r: Random) -> Array:
    """Poses of structure from motion are a little off."""
    out = cam_from_world.copy()
    for pose in out:
        pose[:3, :3] = cv2.Rodrigues(r.normal(size=3) * by * 0.5)[0] @ pose[:3, :3]
        pose[:3, 3] += r.normal(size=3) * by
    return out


# the walk -------------------------------------------------------------------------------------------------------


def _walk(room: Room, lit: LitRoom, count: int, r: Random) -> Array | None:
    """(N, 4, 4) world from camera: some centimetres and degrees a step, clear of things, looking into the room."""
    wide, deep, high = room.size
    ball = r.normal(size=(200, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    for _ in range(_TRIES):
        path = _path(room.size, count, r)
        inside = (path[:, [0, 2]] > _CLEAR).all() and (path[:, 0] < wide - _CLEAR).all()
        if not inside or (path[:, 2] > deep - _CLEAR).any() or (path[:, 1] > high - _CLEAR).any():
            continue
        if min(lit.distance(p, ball).min() for p in path[::3]) < _CLEAR:
            continue
        poses = _views(path, _interesting(room, path[count // 2], r), r)
        ahead = ball[(ball @ poses[count // 2][:3, 2]) > 0.8]
        far = lit.distance(path[count // 2], ahead) if len(ahead) else np.ones(1)
        least = r.choice([1.2, 2.0, 2.4], p=[0.3, 0.5, 0.2])
        if least <= np.median(far) <= 20 and far.min() >= 0.4:
            return poses
    return None


def _path(size: tuple[float, float, float], count: int, r: Random) -> Array:
    wide, deep, high = size
    start = np.array([r.uniform(0.4, wide - 0.4), r.uniform(1.05, min(1.7, high - 0.5)), r.uniform(0.4, deep - 0.4)])
    step, bend, way = r.uniform(0.04, 0.14), r.normal() * 0.6, r.uniform(0, 2 * np.pi)
    t = np.linspace(0, 1, count)
    angle = way + bend * (t - 0.5) * 2
    path = start + np.cumsum(step * np.stack([np.cos(angle), 0 * t, np.sin(angle)], 1), 0)
    path[:, 1] += 0.04 * np.sin(t * r.uniform(2, 6) + r.uniform(0, 6))
    return np.asarray(path + r.normal(size=path.shape) * 0.006)


def _interesting(room: Room, eye: Array, r: Random) -> float:
    """The direction of a dozen in which most things stand."""
    middles = np.array(
        [((a + c) / 2, (b + d) / 2) for a, b, c, d in room.taken + room.entries]
        + [(room.size[0] / 2, room.size[1] / 2)]
    )
    bearing = np.arctan2(middles[:, 1] - eye[2], middles[:, 0] - eye[0])
    far = np.hypot(middles[:, 1] - eye[2], middles[:, 0] - eye[0]) > 1
    yaws = r.uniform(0, 2 * np.pi, 12)
    return float(max(yaws, key=lambda yaw: ((np.cos(bearing - yaw) > 0.88) & far).sum() + r.uniform(0, 2)))


def _views(path: Array, yaw: float, r: Random) -> Array:
    count = len(path)
    turn, pitch, nod = r.normal() * math.radians(1.8) * count, r.normal() * 0.14 - 0.18, r.normal() * 0.06
    out = []
    for i, eye in enumerate(path):
        t = i / (count - 1) - 0.5
        around, up = yaw + turn * t * 2 + r.normal() * 0.006, pitch + nod * t + r.normal() * 0.006
        z = np.array([np.cos(around) * np.cos(up), np.sin(up), np.sin(around) * np.cos(up)])
        x = np.cross(z, [0, 1.0, 0])
        x /= np.linalg.norm(x)
        roll = r.normal() * 0.012
        c, s = math.cos(roll), math.sin(roll)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z], 1) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        pose[:3, 3] = eye
        out.append(pose)
    return np.array(out)


# the camera -----------------------------------------------------------------------------------------------------


def _exposed(light: list[NDArray[np.float32]], r: Random) -> list[NDArray[np.uint8]]:
    """Linear light as a camera stores it: exposure that drifts, white balance, vignetting, blur, noise, JPEG."""
    exposure = r.uniform(0.18, 0.42) / max(float(np.median(np.stack(light))), 1e-4)
    balance, drift = 1 + r.normal(size=3) * 0.04, np.cumsum(r.normal(size=len(light)) * r.choice([0, 0.01, 0.04]))
    develop = lens(light[0].shape[:2], r)
    blur, grain, quality = abs(r.normal()) * 0.4, abs(r.normal()) * 0.8, int(r.integers(88, 100))
    shaken = r.random() < 0.3
    out = []
    for k, image in enumerate(light):
        x = develop(image * exposure * balance * math.exp(drift[k]))
        if blur > 0.3:
            x = cv2.GaussianBlur(x, (0, 0), blur)
        if shaken and r.random() < 0.5:
            x = cv2.filter2D(x, -1, _shake(r))
        stored = np.clip(x + r.normal(size=x.shape) * grain, 0, 255).astype(np.uint8)
        out.append(_compressed(stored, quality))
    return out


def lens(size: tuple[int, ...], r: Random) -> Callable[[NDArray], NDArray]:
    """Vignetting, a soft shoulder for what is bright, and the curve of sRGB."""
    height, width = size
    y, x = np.mgrid[:height, :width]
    radius = ((x - width / 2) / width * 1.4) ** 2 + ((y - height / 2) / height * 1.4) ** 2
    shade = (1 - r.uniform(0, 0.25) * radius)[..., None]

    def develop(light: NDArray) -> NDArray:
        x = light * shade
        x = np.where(x < 0.6, x, 0.6 + 0.4 * (1 - np.exp(-np.maximum(x - 0.6, 0) / 0.4)))
        return np.asarray(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055))

    return develop


def _shake(r: Random) -> NDArray[np.float32]:
    kernel = np.zeros((5, 5), np.float32)
    a, b = r.integers(0, 5, (2, 2)).tolist()
    cv2.line(kernel, a, b, 1)
    return kernel / kernel.sum()


# structure from motion ------------------------------------------------------------------------------------------


def _sparse_points(
    images: NDArray[np.uint8], depths: NDArray[np.float32], cam_from_world: Array, camera: Intrinsics, r: Random
) -> tuple[Array, NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64], Array]:
    """Corners lifted by their true depth with some noise, seen where the true depth says so: points (P, 3), colours,
    and observations: frame, point, place."""
    points, colors = zip(
        *(_corners(*at, camera, r) for at in zip(images, depths, cam_from_world, strict=True)), strict=True
    )
    world, tones = np.concatenate(points), np.concatenate(colors)
    frames, numbers, places = [], [], []
    for k, pose in enumerate(cam_from_world):
        cam = world @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(cam[:, 2], 1e-6)
        u, v = cam[:, 0] / z * camera.fx + camera.cx, cam[:, 1] / z * camera.fy + camera.cy
        inside = (cam[:, 2] > 0.1) & (u > 1) & (v > 1) & (u < camera.width - 1) & (v < camera.height - 1)
        i = np.flatnonzero(inside)
        there = np.maximum(depths[k][v[i].astype(int), u[i].astype(int)], 1e-6)
        i = i[(np.abs(z[i] / there - 1) < 0.02) & (r.random(len(i)) < 0.8)]
        frames.append(np.full(len(i), k))
        numbers.append(i)
        places.append(np.stack([u[i], v[i]], 1))
    frame, number, place = np.concatenate(frames), np.concatenate(numbers), np.concatenate(places)
    often = np.bincount(number, minlength=len(world))[number] >= 2
    return world, tones, frame[often], number[often], place[often]


def _corners(
    image: NDArray[np.uint8], depth: NDArray[np.float32], pose: Array, camera: Intrinsics, r: Random
) -> tuple[Array, NDArray[np.uint8]]:
    found = cv2.goodFeaturesToTrack(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 250, 0.01, 6)
    if found is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    place = found[:, 0]
    x, y = np.clip(place.astype(int), 0, [camera.width - 1, camera.height - 1]).T
    z = depth[y, x].astype(np.float64)
    good = z > 0
    place, x, y = place[good] + 0.5, x[good], y[good]
    z = z[good] * (1 + r.normal(size=len(x)) * 0.004)
    rays = np.stack([(place[:, 0] - camera.cx) / camera.fx, (place[:, 1] - camera.cy) / camera.fy, np.ones(len(x))], 1)
    return (rays * z[:, None] - pose[:3, 3]) @ pose[:3, :3], image[y, x]
