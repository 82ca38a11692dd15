"""Plain folders of images with companion files under the usual names: which depth map, label image or pose row belongs
to which image, here and in data sets that are folders too."""

import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import count_images, folded, frame_number, list_images, match_names, natural_key, read_image_times
from ..images import IMAGE_SUFFIXES, first_readable, image_size, is_depth_map, read_label_png
from ..reading import resolve_within
from ..textfile import read_rows
from ..trajectory import read_trajectory
from .calibration import read_intrinsics_json
from .sequence import Dataset, LabelClass, known_classes

Array = NDArray[np.float64]

SENSOR_RATE = 30.0
"""Frames per second of the sensors of benchmarks that number their frames and state no times."""
SAME_INSTANT_SECONDS = 0.02
"""Two sensors' measurements at most this far apart belong together: half a frame at 25 a second."""

_IMAGE_FOLDERS = ("rgb", "images", "color", "frames")
_DEPTH_FOLDERS = ("depth", "depths")
_LABEL_FOLDERS = ("labels", "label", "semantic")
_POSE_FILES = ("traj.txt", "trajectory.txt", "poses.txt", "groundtruth.txt")
_INTRINSICS_FILES = ("intrinsics.json", "cam_params.json", "camera.json")
_MAX_IMAGES_SEARCHED = 300
_NO_PHOTOGRAPH = re.compile(r"(?<![a-z])(mask|depth|normal|alpha|label|semantic|thumb)s?(?![a-z])", re.IGNORECASE)


def open_folder(path: Path) -> Dataset:
    """Open a plain folder: only the images must be there.

    Beside or above them may be depth/ (16 bit PNG, millimetres unless depth_scale in the intrinsics says otherwise),
    labels/ (8 or 16 bit PNG of class ids) with classes.json, intrinsics.json (fx, fy, cx, cy, width, height,
    distortion, depth_scale, pixel_centre), timestamps.txt, and traj.txt: world-from-camera, a 4x4 matrix or a TUM line
    for each image or each frame number. Raises InputError where one of them contradicts the images.
    """
    folder = image_folder(path)
    if folder is None:
        raise InputError(f"no images in {path}: give the folder that holds the images, or one above rgb/ or images/")
    images = list_images(folder)
    root = path if folder != path else _root_of(folder)
    times = read_image_times(images)
    poses, left_out = _poses(images, times, root)
    calibration = next((root / name for name in _INTRINSICS_FILES if (root / name).is_file()), None)
    camera, scale = (None, None) if calibration is None else read_intrinsics_json(calibration, integer_centres=False)
    label_paths, table = _companions(images, root, _LABEL_FOLDERS), root / "classes.json"
    return sequence_of(
        "folder", root, images,
        timestamps=times,
        camera=camera,
        world_from_cam=poses,
        depth_paths=_companions(images, root, _DEPTH_FOLDERS),
        depth_per_metre=scale or 1000.0,
        label_paths=label_paths,
        classes=classes_of(label_paths, table if table.is_file() else None),
        notes=_unused_images(path, folder) + left_out,
    )  # fmt: skip


def image_folder(path: Path) -> Path | None:
    """Return the folder that holds most images: this one, or the rgb/, images/, color/ or frames/ in it. None without
    any.

    A picture or two beside images/ are thumbnails or plots; the other way round images/ is something else's.
    """
    counts = _image_counts(path)
    return max(counts, key=counts.__getitem__, default=None)


def _image_counts(path: Path) -> dict[Path, int]:
    folders = (path, *(path / name for name in _IMAGE_FOLDERS))
    return {folder: count for folder in folders if (count := count_images(folder))}


def _unused_images(path: Path, used: Path) -> tuple[str, ...]:
    counts = _image_counts(path)
    others = [f"{count} in {folder.name}/" for folder, count in counts.items() if folder != used]
    return (f"the {counts[used]} images in {used.name}/ are used, not the {' and '.join(others)}",) if others else ()


def _root_of(images: Path) -> Path:
    """Where to look for what belongs to a folder of images: above it, when it is the rgb/ of a larger folder."""
    siblings = (*_DEPTH_FOLDERS, *_LABEL_FOLDERS, *_POSE_FILES, *_INTRINSICS_FILES)
    belongs = images.name in _IMAGE_FOLDERS and any((images.parent / name).exists() for name in siblings)
    return images.parent if belongs else images


def _companions(images: list[Path], root: Path, folders: tuple[str, ...]) -> tuple[Path | None, ...]:
    existing = [root / name for name in folders if (root / name).is_dir() and root / name != images[0].parent]
    return files_for_images(images, existing[0]) if existing else ()


def _poses(images: list[Path], times: Array | None, root: Path) -> tuple[Array | None, tuple[str, ...]]:
    """(N, 4, 4) poses, None without any, and a note where there are some that cannot be assigned."""
    path = next((root / name for name in _POSE_FILES if (root / name).is_file()), None)
    if path is None:
        return None, ()
    found = read_trajectory(path)
    if found.names:
        rows = match_names([str(image) for image in images], found.names)
        return np.stack([np.full((4, 4), np.nan) if k is None else found.world_from_cam[k] for k in rows]), ()
    if found.times is None:
        return poses_for_images(images, found.world_from_cam, path), ()
    if times is not None:
        return poses_at(times, found.times, found.world_from_cam), ()
    if len(found.times) == len(images):
        return found.world_from_cam, ()
    why = f"the {len(found.times)} poses of {path.name} belong to times, and the {len(images)} images state none"
    return None, (f"{why}: the poses are not used; timestamps.txt with a line for each image would tell",)


# What belongs to which image ------------------------------------------------------------------------------------------


def sequence_of(format: str, root: Path, images: list[Path], **fields: Any) -> Dataset:
    """Make the sequence of image files, with their names and times unless the other `fields` have them."""
    if "timestamps" not in fields:
        fields["timestamps"] = read_image_times(images)
    names = fields.pop("names", tuple(p.name for p in images))
    return Dataset(format, root, names, image_paths=tuple(images), **fields)


def read_timed_files(
    path: Path, folder: Path, read_time: Callable[[str], float], line: str
) -> tuple[Array, list[Path]]:
    """Read a list of times and files of a `folder`: (N,) times in increasing order, and the files. Lists are not always
    sorted, and a few times occur twice.

    `line` is the form of its lines in errors. Raises InputError for another, an empty list, a file outside the folder.
    """
    try:
        entries = sorted({read_time(row[0]): row[1] for row in read_rows(path)}.items())
    except (IndexError, ValueError) as error:
        raise InputError(f"{path}: a line is not {line} ({error}): unpack the data set again") from error
    if not entries:
        raise InputError(f"{path} lists no files: unpack the data set again")
    return np.array([time for time, _ in entries], np.float64), [resolve_within(folder, f, path) for _, f in entries]


def files_for_images(images: list[Path], folder: Path, pattern: str = "*") -> tuple[Path | None, ...]:
    """Find for each image the file in `folder` of the same name, else of the same frame number; () without such a
    folder.

    Raises InputError when the folder has files and none of them belongs to an image.
    """
    if not folder.is_dir():
        return ()
    files = [p for p in folder.glob(pattern) if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    files.sort(key=lambda p: natural_key(p.name), reverse=True)  # of several that fit, the first is taken
    # A name before its dots, and a number, say which image only where no other image has it: of 17.25.png and 17.50.png
    # both are 17.
    rules: tuple[Callable[[Path], object], ...] = (
        lambda p: p.stem, lambda p: folded(p.stem), lambda p: p.name.split(".")[0], frame_number,
    )  # fmt: skip
    found: tuple[Path | None, ...] = (None,) * len(images)
    for rule in rules:
        keys, file_of = [rule(image) for image in images], {rule(p): p for p in files}
        times = Counter(keys)
        usable = [k is not None and times[k] == 1 for k in keys]
        found = tuple(f or (file_of.get(k) if ok else None) for f, k, ok in zip(found, keys, usable, strict=True))
    if files and not any(found):
        raise InputError(
            f"none of the {len(files)} files in {folder} belongs to an image of {images[0].parent}: "
            "give both the same file names or frame numbers"
        )
    return found if any(found) else ()


def images_outside(used: list[Path], taken: Iterable[Path | None] = ()) -> list[Path]:
    """Return the other images in the folders of those that are `used`: of the same kind and size, neither `taken` as
    something else nor called so."""
    first, others = first_readable(used), {*used, *taken}
    suffixes = {path.suffix.lower() for path in used}
    found = [p for folder in sorted({path.parent for path in used}) for p in sorted(folder.iterdir())]
    found = [p for p in found if p.suffix.lower() in suffixes and p not in others and not p.name.startswith(".")]
    return [p for p in found if not _NO_PHOTOGRAPH.search(p.stem) and p.is_file() and _is_alike(p, first)]


def _is_alike(path: Path, first: Path) -> bool:
    try:
        return image_size(path) == image_size(first) and not is_depth_map(path)
    except InputError:
        return False


def poses_for_images(images: list[Path], poses: Array, source: Path) -> Array:
    """Return (N, 4, 4) the rows of `poses` that belong to the images: one each, else the row of each frame number.

    Raises InputError when neither fits.
    """
    if len(poses) == len(images):
        return poses
    numbers = [frame_number(p) for p in images]
    rows = [n for n in numbers if n is not None and n < len(poses)]
    if len(rows) == len(images):
        return poses[rows]
    raise InputError(
        f"{source} has {len(poses)} poses for {len(images)} images, and the images' names are not row numbers: "
        "give one pose for each image"
    )


def poses_at(times: Array, pose_times: Array, world_from_cam: Array, tolerance: float = SAME_INSTANT_SECONDS) -> Array:
    """Return (N, 4, 4) the known poses nearest to `times`, NaN where none is within `tolerance` seconds."""
    known = np.isfinite(pose_times) & np.isfinite(world_from_cam).all(axis=(1, 2))
    if not known.any():
        return np.full((len(times), 4, 4), np.nan)
    pose_times, world_from_cam = pose_times[known], world_from_cam[known]
    order = np.argsort(pose_times, kind="stable")
    index = order[nearest_index(pose_times[order], times)]
    result = world_from_cam[index].copy()
    result[np.abs(pose_times[index] - times) > tolerance] = np.nan
    return result


def nearest_index(sorted_times: Array, times: Array) -> NDArray[np.int64]:
    """Find (N,) for each of `times` the index of the nearest of `sorted_times`, the earlier of two equally near."""
    after = np.searchsorted(sorted_times, times).clip(0, len(sorted_times) - 1)
    before = (after - 1).clip(0)
    closer = np.abs(sorted_times[before] - times) <= np.abs(sorted_times[after] - times)
    return np.where(closer, before, after).astype(np.int64)


def classes_of(label_paths: tuple[Path | None, ...], table: Path | None) -> tuple[LabelClass, ...]:
    """Return the classes of a set's table of them, without those that are void; without a table a class for every id
    that occurs in the label images, named by its number.

    Of long sequences some `_MAX_IMAGES_SEARCHED` evenly spread images are looked at.
    """
    existing = [p for p in label_paths if p is not None]
    if not existing or table is not None:
        return known_classes(table) if table is not None and label_paths else ()
    seen = np.zeros(65536, dtype=bool)
    for path in existing[:: max(1, len(existing) // _MAX_IMAGES_SEARCHED)]:
        seen[read_label_png(path).ravel()] = True
    return tuple(LabelClass(int(i), f"class {i}") for i in np.flatnonzero(seen) if i)
