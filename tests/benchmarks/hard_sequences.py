"""Recordings that break trackers, made from the synthetic world and from those at hand, each with its truth.

Every one is a folder of pictures `rgb/` named by number with `traj.txt` beside it, one world_from_cam 4x4 a row, nan
where it is not known.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from tests.world.build import World

Array = NDArray[np.float64]
SIZE = (480, 360)


def write_hard(name: str, folder: Path, data: Path) -> Path:
    """Write the sequence unless it is there; `data` is the folder of the recordings at hand."""
    if not (folder / "traj.txt").exists():
        (folder / "rgb").mkdir(parents=True, exist_ok=True)
        poses = HARD[name](folder / "rgb", data)
        np.savetxt(folder / "traj.txt", poses.reshape(-1, 16))
    return folder / "rgb"


def write_noisy_depth(source: Path, target: Path) -> None:
    """Each depth times its own factor (3 %) and a smooth field (6 %): what a good network does wrong."""
    from tests.benchmarks.rooms.network import network_like

    target.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    for path in sorted(source.glob("*.png")):
        depth = network_like(cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float64), 6, rng, blur=0)
        cv2.imwrite(str(target / path.name), np.clip(np.round(depth), 0, 65535).astype(np.uint16))


def turn(folder: Path, data: Path) -> Array:
    """A full turn on the spot in 60 frames; the hand shakes by two centimetres."""
    return draw(folder, standing(np.linspace(0, 2 * np.pi, 60, endpoint=False), 0.02))


def turn_within(folder: Path, data: Path) -> Array:
    """A walk, half a turn forth and back on the spot in its middle, and the walk goes on."""
    from tests.world.paths import room_walk

    there = room_walk(np.linspace(0, 0.3, 40))
    away = np.radians(90) * np.sin(np.linspace(0, np.pi, 26)[1:-1])
    turning = np.tile(there[-1], (len(away), 1, 1))
    turning[:, :3, :3] = [about_z(a) @ there[-1, :3, :3] for a in away]
    turning[:, :3, 3] += 0.01 * np.random.default_rng(0).standard_normal((len(away), 3))
    on = room_walk(np.linspace(0.3, 0.6, 41)[1:])
    return draw(folder, np.concatenate([there, turning, on]))


def fast(folder: Path, data: Path) -> Array:
    """Two laps round the table in steps of 10 to 17 degrees, blurred and noisy."""
    return fast_walk(folder, 54, seed=1)


def fast_blank(folder: Path, data: Path) -> Array:
    """The same without texture on the walls."""
    return fast_walk(folder, 54, seed=2, blank_walls=True)


def blackout(folder: Path, data: Path) -> Array:
    """One lap of it with the light off for three frames: no picture shows what lies on both sides."""
    poses = fast_walk(folder, 26, seed=1)
    for i in (12, 13, 14):
        save(folder, i, np.random.default_rng(i).integers(0, 6, (SIZE[1], SIZE[0], 3)).astype(np.uint8))
    return poses


def fast_walk(folder: Path, count: int, seed: int, blank_walls: bool = False) -> Array:
    """Steps of 10 to 17 degrees round the table, each picture blurred over a tenth of a step."""
    from tests.world.paths import room_walk

    steps = np.cumsum(np.random.default_rng(seed).uniform(10, 17, count)) / 360
    return draw(folder, room_walk(steps), blurred=room_walk, steps=steps, noise=3.0, blank_walls=blank_walls)


def corridor_half_blank(folder: Path, data: Path) -> Array:
    """Once round the corridor, of which two sides show nothing but lamps on plain walls."""
    return blank_ring(folder, blank_sides=(1, 2))


def corridor_blank(folder: Path, data: Path) -> Array:
    """The same with no side that shows more."""
    return blank_ring(folder, blank_sides=(0, 1, 2, 3))


def blank_ring(folder: Path, blank_sides: tuple[int, ...]) -> Array:
    from tests.benchmarks.worlds.corridor import corridor_walk, ring_corridor
    from tests.world.build import build_world

    poses = corridor_walk(np.linspace(0, 1.08, 150))
    world = build_world("corridor", ring_corridor(True, blank_sides), 0, 0.006)
    return draw(folder, poses, world=world)


def exposure(folder: Path, data: Path) -> Array:
    """The white room with automatic exposure at its worst: gain and gamma swing, and jump twelve times."""
    rng = np.random.default_rng(3)
    pictures = sorted((data / "whiteroom/rgb").iterdir())
    jumps = np.repeat(rng.uniform(-0.5, 0.5, 13), 12)[: len(pictures)]
    swing = 0.5 * np.sin(np.arange(len(pictures)) / 6)
    for i, path in enumerate(pictures):
        image = cv2.imread(str(path)).astype(np.float64) / 255
        changed = image ** np.exp(0.4 * swing[i]) * np.exp(jumps[i]) + 0.03 * swing[i]
        save(folder, i, np.clip(changed * 255 + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    poses = np.loadtxt(data / "whiteroom/traj.txt").reshape(-1, 4, 4)
    return poses[[int(p.stem) for p in pictures]]


def rolling(folder: Path, data: Path) -> Array:
    """80 frames of a walk round the table by someone who looks left and right by 12 degrees, at 10 frames a second by a
    camera that takes 30 ms from the first row to the last."""
    return rolled(folder, readout=0.3)


def rolling_not(folder: Path, data: Path) -> Array:
    """The same by one that takes all rows at once."""
    return rolled(folder, readout=0.0)


def rolled(folder: Path, readout: float) -> Array:
    from tests.world.clip import ClipOptions, develop, make_world, render_rolling

    world, step = make_world("room", texel=0.006), 0.0108
    options = ClipOptions(frames=80, width=SIZE[0], height=SIZE[1], noise=1.0, readout=readout)
    for i in range(options.frames):
        light = render_rolling(world, options, looking_about, i * step, step)[0]
        save(folder, i, develop(light, options, i)[..., ::-1])
    return looking_about(np.arange(options.frames) * step)


def looking_about(steps: Array) -> Array:
    """(N, 4, 4) world_from_cam of `room_walk` by someone who turns the head left and right and a little up."""
    from tests.world.paths import room_walk

    poses = room_walk(steps)
    left = np.radians(12) * np.sin(40.7 * steps)
    up = np.radians(4) * np.sin(64 * steps + 1)
    for pose, yaw, pitch in zip(poses, left, up, strict=True):
        nod = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
        pose[:3, :3] = about_z(yaw) @ pose[:3, :3] @ nod
    return poses


def kitchen_twice(folder: Path, data: Path) -> Array:
    """The kitchen forth, and back between the frames of the way there: every place is seen again."""
    wanted = [*range(0, 300, 4), *range(298, 0, -4)]
    poses = np.array([np.loadtxt(data / f"kitchen/frame-{i:06d}.pose.txt") for i in wanted])
    for row, i in enumerate(wanted):
        save(folder, row, cv2.imread(str(data / f"kitchen/frame-{i:06d}.color.jpg")))
    return poses


def replica_fast(folder: Path, data: Path) -> Array:
    """Every second frame of the office: 12 degrees a step at the median, up to 30."""
    pictures = sorted((data / "replica_office0/rgb").iterdir())
    poses = np.loadtxt(data / "replica_office0/traj_derived_c2w.txt").reshape(-1, 4, 4)
    for row, path in enumerate(pictures[::2]):
        save(folder, row, cv2.imread(str(path)))
    return poses[::2]


def whiteroom_fast(folder: Path, data: Path) -> Array:
    """The white room in steps of 10 to 17 degrees; most of it has hardly any texture."""
    from msgs_slam.formats.video import VideoReader

    steps = np.cumsum(np.random.default_rng(4).integers(12, 17, 40))
    poses = np.loadtxt(data / "whiteroom/traj.txt").reshape(-1, 4, 4)
    steps = steps[steps < len(poses)]
    wanted = {int(i): row for row, i in enumerate(steps)}
    for frame in VideoReader(data / "whiteroom/video.mp4", wanted):
        save(folder, wanted[frame.source_index], frame.rgb[..., ::-1])
    return poses[steps]


HARD: dict[str, Callable[[Path, Path], Array]] = {
    f.__name__: f
    for f in (
        turn, turn_within, fast, fast_blank, blackout, corridor_half_blank, corridor_blank, exposure,
        kitchen_twice, replica_fast, whiteroom_fast, rolling, rolling_not,
    )
}  # fmt: skip


def standing(angles: Array, shake: float) -> Array:
    """(N, 4, 4) world_from_cam of someone who stands beside the table and turns; `shake` in metres."""
    from tests.world.paths import look_at

    rng = np.random.default_rng(0)
    center = np.array([1.6, 1.3, 1.45]) + shake * rng.standard_normal((len(angles), 3))
    ahead = np.stack([np.cos(angles), np.sin(angles), -0.15 + 0.1 * np.sin(3 * angles)], axis=1)
    return look_at(center, center + ahead, roll=0.03 * np.sin(4 * angles))


def about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def draw(
    folder: Path,
    poses: Array,
    blurred: Callable[[Array], Array] | None = None,
    steps: Array | None = None,
    noise: float = 1.0,
    blank_walls: bool = False,
    world: World | None = None,
) -> Array:
    """Pictures of a world, or else the room, from world_from_cam (N, 4, 4), which are returned; with motion blur over
    a tenth of a step where the walk and its steps are given."""
    from tests.world.clip import ClipOptions, make_world, render_view

    world = make_world("room", texel=0.006, blank_walls=blank_walls) if world is None else world
    options = ClipOptions(width=SIZE[0], height=SIZE[1])
    rng = np.random.default_rng(0)
    for i, pose in enumerate(poses):
        views = [pose]
        if blurred is not None and steps is not None:
            views = list(blurred(steps[i] + np.array([-0.05, 0.0, 0.05]) * 13 / 360))
        light = np.mean([render_view(world, options, view)[0] for view in views], axis=0)
        grey = 255 * np.clip(light, 0, 1) ** (1 / 2.2) + noise * rng.standard_normal(light.shape)
        save(folder, i, np.clip(np.round(grey), 0, 255).astype(np.uint8)[..., ::-1])
    return poses


def save(folder: Path, number: int, bgr: NDArray[np.uint8]) -> None:
    """One picture without loss."""
    cv2.imwrite(str(folder / f"{number:06d}.png"), bgr)
