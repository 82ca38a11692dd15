"""Which depth map, label image or pose row belongs to which colour image."""

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import frame_number, natural_key, read_image_times
from ..images import IMAGE_SUFFIXES, first_readable, image_size, is_depth_map
from ..names import folded
from ..reading import resolve_within
from ..textfile import read_rows
from .sequence import Dataset, LabelClass, used_label_ids

SENSOR_RATE = 30.0
"""Frames per second of the sensors of benchmarks that number their frames and state no times."""

SAME_INSTANT_SECONDS = 0.02
"""Two sensors' measurements at most this far apart belong together: half a frame at 25 a second."""

_MAX_IMAGES_SEARCHED = 300
_NO_PHOTOGRAPH = re.compile(r"(?<![a-z])(mask|depth|normal|alpha|label|semantic|thumb)s?(?![a-z])", re.IGNORECASE)


def read_timed_files(
    path: Path, folder: Path, read_time: Callable[[str], float], line: str
) -> tuple[NDArray[np.float64], list[Path]]:
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
    return np.array([time for time, _ in entries], np.float64), [
        resolve_within(folder, file, path) for _, file in entries
    ]


def files_for_images(images: list[Path], folder: Path, pattern: str = "*") -> tuple[Path | None, ...]:
    """Find for each image the file in `folder` of the same name, else of the same frame number; () without such a
    folder.

    Raises InputError when the folder has files and none of them belongs to an image.
    """
    if not folder.is_dir():
        return ()
    files = sorted((p for p in folder.glob(pattern) if p.suffix.lower() in IMAGE_SUFFIXES), key=_by_name)
    files = [p for p in files if not p.name.startswith(".")]
    # A name before its dots, and a number, say which image only where no other image has it: of 17.25.png and 17.50.png
    # both are 17.
    rules: tuple[Callable[[Path], object], ...] = (lambda p: p.stem, lambda p: folded(p.stem), _bare_name, frame_number)
    found: tuple[Path | None, ...] = (None,) * len(images)
    for rule in rules:
        keys, file_of = [rule(image) for image in images], {rule(p): p for p in reversed(files)}
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
    first, others = first_readable(used), set(used).union(path for path in taken if path is not None)
    suffixes = {path.suffix.lower() for path in used}
    found = [p for folder in sorted({path.parent for path in used}) for p in sorted(folder.iterdir())]
    found = [p for p in found if p.suffix.lower() in suffixes and p not in others and not p.name.startswith(".")]
    return [p for p in found if not _NO_PHOTOGRAPH.search(p.stem) and p.is_file() and _is_alike(p, first)]


def _is_alike(path: Path, first: Path) -> bool:
    try:
        return image_size(path) == image_size(first) and not is_depth_map(path)
    except InputError:
        return False


def poses_for_images(images: list[Path], poses: NDArray[np.float64], source: Path) -> NDArray[np.float64]:
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


def poses_at(
    times: NDArray[np.float64],
    pose_times: NDArray[np.float64],
    world_from_cam: NDArray[np.float64],
    tolerance: float = SAME_INSTANT_SECONDS,
) -> NDArray[np.float64]:
    """Return (N, 4, 4) for each of `times` the known pose nearest in time, NaN where none is within `tolerance`
    seconds."""
    known = np.isfinite(pose_times) & np.isfinite(world_from_cam).all(axis=(1, 2))
    if not known.any():
        return np.full((len(times), 4, 4), np.nan)
    pose_times, world_from_cam = pose_times[known], world_from_cam[known]
    order = np.argsort(pose_times, kind="stable")
    index = order[nearest_index(pose_times[order], times)]
    result = world_from_cam[index].copy()
    result[np.abs(pose_times[index] - times) > tolerance] = np.nan
    return result


def nearest_index(sorted_times: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.int64]:
    """Find (N,) for each of `times` the index of the nearest of `sorted_times`, the earlier of two equally near."""
    after = np.searchsorted(sorted_times, times).clip(0, len(sorted_times) - 1)
    before = (after - 1).clip(0)
    closer = np.abs(sorted_times[before] - times) <= np.abs(sorted_times[after] - times)
    return np.where(closer, before, after).astype(np.int64)


def sequence_of(format: str, root: Path, images: list[Path], **fields: Any) -> Dataset:
    """Make the sequence of image files, called as they are, at the times that they state, unless the other `fields` say
    otherwise."""
    if "timestamps" not in fields:
        fields["timestamps"] = read_image_times(images)
    names = fields.pop("names", tuple(p.name for p in images))
    return Dataset(format, root, names, image_paths=tuple(images), **fields)


def times_at_sensor_rate(images: list[Path]) -> NDArray[np.float64]:
    """Return (N,) seconds of a benchmark's images: their own times, else their frame numbers (else their order) over
    `SENSOR_RATE`."""
    times = read_image_times(images)
    if times is not None:
        return times
    numbers = [frame_number(p) for p in images]
    usable = all(a is not None and b is not None and a < b for a, b in itertools.pairwise(numbers))
    counts = numbers if usable and numbers[0] is not None else list(range(len(images)))
    return np.array(counts, dtype=np.float64) / SENSOR_RATE


def classes_found(paths: tuple[Path | None, ...]) -> tuple[LabelClass, ...]:
    """Return a class for every id that occurs in the label images, named by its number: for sets that name none.

    Of long sequences some `_MAX_IMAGES_SEARCHED` evenly spread images are looked at.
    """
    existing = [p for p in paths if p is not None]
    used = used_label_ids(existing[:: max(1, len(existing) // _MAX_IMAGES_SEARCHED)])
    return tuple(LabelClass(i, f"class {i}") for i in sorted(used - {0}))


def _by_name(path: Path) -> tuple[tuple[int, int, str], ...]:
    return natural_key(path.name)


def _bare_name(path: Path) -> str:
    return path.name.split(".")[0]
