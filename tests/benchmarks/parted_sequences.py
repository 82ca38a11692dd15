"""Recordings in parts: what nothing joins, what a loop joins, two videos of one place; each with its truth."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

PARTED = ("whiteroom_halves", "whiteroom_apart", "two_rooms", "kitchen_two", "kitchen_7scenes")
LONG = "kitchen_long/kitchen_33s_640x480_30fps.mp4"
_SECOND = 500
"""The frame of the long kitchen video at which its second half begins."""
_FIRST = 300
"""Frames of the short one, which is the beginning of the long one."""


def kitchen_two_row(index: int) -> int:
    """The long video's frame of which picture `index` of both is one."""
    return index if index < _FIRST else _SECOND + index - _FIRST


def write_parted(name: str, folder: Path, data: Path) -> Path:
    """Write the sequence unless it is there; `data` is the folder of the recordings at hand."""
    folder.mkdir(parents=True, exist_ok=True)
    return _WRITERS[name](folder, data)


def _halves(folder: Path, data: Path, before: int) -> Path:
    """The first third of whiteroom's walk, and the last: from 414 on it passes over where it began. Before that both
    look across the table at the same walls: no two stretches of 25 pictures of this room share less than 15 %."""
    (folder / "rgb").mkdir(exist_ok=True)
    for picture in sorted((data / "whiteroom" / "rgb").glob("*.jpg")):
        if int(picture.stem) < 150 or 300 <= int(picture.stem) < before:
            shutil.copy(picture, folder / "rgb" / picture.name)
    return folder / "rgb"


def _two_rooms(folder: Path, data: Path) -> Path:
    """The first 60 pictures each of two rooms, which share nothing but the camera's size and focal length (525 px)."""
    (folder / "rgb").mkdir(exist_ok=True)
    kitchen = sorted((data / "kitchen").glob("*.color.jpg"))[:60]
    white = sorted((data / "whiteroom" / "rgb").glob("*.jpg"))[:60]
    walk = np.loadtxt(data / "whiteroom" / "traj.txt").reshape(-1, 4, 4)
    poses = [np.loadtxt(str(p).replace("color.jpg", "pose.txt")) for p in kitchen] + [walk[int(p.stem)] for p in white]
    for row, picture in enumerate((*kitchen, *white)):
        shutil.copy(picture, folder / "rgb" / f"{row:06d}.jpg")
    np.savetxt(folder / "traj.txt", np.reshape(poses, (-1, 16)))
    return folder / "rgb"


def _kitchen_two(folder: Path, data: Path) -> Path:
    second = folder / "second.avi"
    if not second.exists():
        writer = cv2.VideoWriter(str(second), cv2.VideoWriter_fourcc(*"MJPG"), 30, (640, 480))
        writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
        for i, frame in enumerate(_frames(data / LONG)):
            if i >= _SECOND:
                writer.write(frame)
        writer.release()
    both = folder / "both.videos"
    both.write_text(f"{data / 'videos/kitchen_640x480_30fps.mp4'}\n{second}\n")
    return both


def _seven_scenes(folder: Path, data: Path) -> Path:
    """Every fourth frame of the long kitchen as a 7-Scenes folder that says nothing of the camera."""
    truth = np.loadtxt(data / "kitchen_long" / "world_from_camera_16.txt").reshape(-1, 4, 4)
    for i, frame in enumerate(_frames(data / LONG)):
        if i % 4 == 0:
            cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), frame)
            np.savetxt(folder / f"frame-{i:06d}.pose.txt", truth[i])
    return folder


def _frames(path: Path) -> list[np.ndarray]:
    capture, frames = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        frames.append(read[1])
    return frames


_WRITERS: dict[str, Callable[[Path, Path], Path]] = {
    "whiteroom_halves": lambda folder, data: _halves(folder, data, before=450),
    "whiteroom_apart": lambda folder, data: _halves(folder, data, before=405),
    "two_rooms": _two_rooms,
    "kitchen_two": _kitchen_two,
    "kitchen_7scenes": _seven_scenes,
}
