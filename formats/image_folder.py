"""The images of a folder: which they are, their order, and when they were taken."""

import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .images import IMAGE_SUFFIXES, UNREAD_SUFFIXES, VIDEO_SUFFIXES, exif_time, is_depth_map, read_rgb
from .names import match_names
from .reading import reaching
from .textfile import is_number, read_rows

_SIGNS = (
    "accelerometer.txt", "calib.txt", "cam_params.json", "camera.json", "classes.json", "depth", "depth.txt", "depths",
    "groundtruth.txt", "intrinsics.json", "label", "labels", "poses.txt", "semantic", "sensor.yaml", "sparse",
    "traj.txt", "trajectory.txt", "transforms.json",
)  # fmt: skip
"""What makes the folder above images a data set: times in another are notes of any kind."""
_MOST_DIGITS = 18
_IMAGE_FOLDERS = ("rgb", "images", "color", "frames", "data", "image_0", "image_2")
_LIST_NAMES = ("timestamps.txt", "times.txt", "rgb.txt")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key under which img2 comes before img10. Raises nothing; equal names have equal keys."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(p), p) if p.isdecimal() and p.isascii() else (1, 0, p) for p in parts)


def list_images(folder: Path) -> list[Path]:
    """List the image files directly in `folder`, in natural order; hidden files are left out.

    Raises InputError when there is no such folder or no image in it.
    """
    folder = Path(folder)
    with reaching(folder):
        if not folder.is_dir():
            raise InputError(f"no such folder: {folder}: check the spelling, and that the disk is mounted")
        files = [p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file()]
    images = [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise InputError(_why_no_images(folder, files))
    return sorted(images, key=lambda p: natural_key(p.name))


def unread_images(folder: Path) -> list[Path]:
    """List the images directly in `folder` of a format that is not read, in natural order; those that lie there under
    the same name in one that is read (a camera's raw file beside its JPEG) are not missed."""
    with reaching(folder):
        files = [p for p in folder.iterdir() if not p.name.startswith(".") and p.is_file()]
    read = {p.stem.lower() for p in files if p.suffix.lower() in IMAGE_SUFFIXES}
    unread = [p for p in files if p.suffix.lower() in UNREAD_SUFFIXES and p.stem.lower() not in read]
    return sorted(unread, key=lambda p: natural_key(p.name))


def count_images(folder: Path) -> int:
    """Count the image files directly in a folder, hidden ones left out; 0 where there is no such folder."""
    try:
        names = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
        return sum(p.is_file() for p in names)
    except OSError:  # none, no folder, or none that may be read
        return 0


def hint_at_inner_folder(folder: Path, least: int = 2) -> str:
    """Name the folder in `folder`, or in one of its folders, with the most images; "" where none has `least`."""
    inside = _folders_in(folder)
    everywhere = [*inside, *(deeper for outer in inside for deeper in _folders_in(outer))]
    counts = {p.relative_to(folder).as_posix(): count_images(p) for p in everywhere}
    name = max(counts, key=counts.__getitem__, default="")
    return f"the folder {name}/ in it holds {counts[name]} images: give that" if counts.get(name, 0) >= least else ""


def _folders_in(folder: Path) -> list[Path]:
    try:
        return [p for p in sorted(folder.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    except OSError:  # none that may be read
        return []


def unused_pictures(images: Collection[Path], others: Collection[Path | None] = ()) -> tuple[str, ...]:
    """Say in words which pictures and videos in the folders of some images are neither these nor `others` that are read
    as well; () where all are.

    A raw file or a clip beside a photograph of the same name is the same shot.
    """
    used, shots, found = {*images, *others}, {path.stem for path in images}, Counter[str]()
    for path in (path for folder in {path.parent for path in images} for path in folder.iterdir()):
        kind = path.suffix.lower()
        if path in used or path.name.startswith(".") or not path.is_file():
            continue
        if kind in IMAGE_SUFFIXES and not is_depth_map(path):
            found["images"] += 1
        elif kind in UNREAD_SUFFIXES | VIDEO_SUFFIXES and path.stem not in shots:
            found[kind] += 1
    notes = []
    if more := found.pop("images", 0):
        notes.append(f"{more} images beside the {len(images)} that are read are not named by the data set: left out")
    if found:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(found.items()))
        notes.append(
            f"beside the {len(images)} images that are read are files of kinds that are not ({kinds}): left out"
        )
    return tuple(notes)


def _why_no_images(folder: Path, files: list[Path]) -> str:
    unread = sorted({p.suffix.lower() for p in files} & UNREAD_SUFFIXES)
    if unread:
        return f"no readable image in {folder}: {', '.join(unread)} files are not supported, export them as JPEG first"
    videos = sorted(p.name for p in files if p.suffix.lower() in VIDEO_SUFFIXES)
    if videos:
        more = f"{len(videos)} videos, such as {videos[0]}" if videos[1:] else f"the video {videos[0]}"
        return f"no images in {folder}, but {more}: give one of them, or the folder to `msgs-slam batch`"
    hint = hint_at_inner_folder(folder)
    kinds = f"give the folder that directly holds the {', '.join(sorted(IMAGE_SUFFIXES))} files"
    return f"no images in {folder} ({len(files)} other files): {hint or kinds}"


def read_image_times(images: list[Path]) -> NDArray[np.float64] | None:
    """Read (N,) seconds at which the images were taken, strictly increasing; None where they are unknown.

    Looks for timestamps.txt, times.txt or rgb.txt in the images' folder, then in the one above where that is a data
    set: a number a line for each image in order, or for each frame number in the images' names; or lines of
    `seconds name` or `name seconds`. Else EXIF. An image that cannot be read gets a time between its neighbours'.
    Raises InputError for a list that matches the images in none of these ways.
    """
    if not images:
        return None
    listed = times_file(images[0].parent)
    return _from_exif(images) if listed is None else _require_increasing(_from_list(listed, images), listed)


def times_file(folder: Path) -> Path | None:
    """Return the list of times that belongs to the images of a folder, None where there is none."""
    with reaching(folder):
        if found := _list_in(folder):
            return found
        above = folder.resolve().parent
        found = _list_in(above)
        is_theirs = found is not None and (
            any((above / name).exists() for name in _SIGNS)
            or (folder.name in _IMAGE_FOLDERS and _concerns(found, folder))
        )
        return found if is_theirs else None


def _concerns(path: Path, folder: Path) -> bool:
    """Whether a list states a time for each image of a folder."""
    try:
        _from_list(path, list_images(folder))
    except InputError:
        return False
    return True


def _list_in(folder: Path) -> Path | None:
    return next((folder / name for name in _LIST_NAMES if (folder / name).is_file()), None)


def frame_number(path: Path) -> int | None:
    """Return the last run of digits in a file name without its suffixes (frame-000012.color.jpg: 12), None without
    one."""
    digits = re.findall(r"[0-9]+", path.name.split(".")[0])
    return int(digits[-1]) if digits and len(digits[-1]) <= _MOST_DIGITS else None


def _from_list(path: Path, images: list[Path]) -> NDArray[np.float64]:
    rows = read_rows(path)
    try:
        if rows and all(len(row) >= 2 for row in rows):
            time, name = (0, 1) if is_number(rows[0][0]) else (1, 0)
            listed = match_names([str(p) for p in images], [row[name] for row in rows])
            missing = next((p.name for p, k in zip(images, listed, strict=True) if k is None), None)
            if missing is not None:
                raise InputError(f"{path}: no time for {missing!r}: give one line of `seconds name` for each image")
            return np.array([float(rows[k][time]) for k in listed if k is not None], dtype=np.float64)
        times = np.array([float(row[0]) for row in rows], dtype=np.float64)
    except ValueError as error:
        raise InputError(
            f"{path}: a line states no seconds ({error}): give one line of `seconds name` for each image"
        ) from error
    if len(times) == len(images):
        return times
    numbers = [frame_number(p) for p in images]
    if all(n is not None and n < len(times) for n in numbers):
        return times[[n for n in numbers if n is not None]]
    raise InputError(
        f"{path} has {len(times)} times for {len(images)} images, and their names hold no row numbers: "
        "give one line for each image, or remove the file"
    )


def _require_increasing(times: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise InputError(f"{path}: times must be finite and increase from image to image: sort it, or remove the file")
    return times


def _is_damaged(path: Path) -> bool:
    """Whether an image with a whole header cannot be decoded."""
    try:
        read_rgb(path)
    except InputError:
        return True
    return False


def _from_exif(images: list[Path]) -> NDArray[np.float64] | None:
    """None where an image states no time, or times do not increase: cameras that write whole seconds say no order."""
    stored = np.full(len(images), np.nan)
    readable = np.zeros(len(images), dtype=bool)
    for i, path in enumerate(images):
        try:
            time = exif_time(path)
        except InputError:
            continue  # damaged: left out when it is read, whatever its time
        if time is None and _is_damaged(path):
            continue
        if time is None:
            return None
        stored[i], readable[i] = time, True
    known = np.flatnonzero(readable)
    if not len(known) or (np.diff(stored[known]) <= 0).any():
        return None
    step = (stored[known[-1]] - stored[known[0]]) / max(known[-1] - known[0], 1) or 1.0
    index = np.arange(len(images))
    times = np.interp(index, known, stored[known])
    times += step * (np.minimum(index - known[0], 0) + np.maximum(index - known[-1], 0))
    return np.asarray(times - times[0])
