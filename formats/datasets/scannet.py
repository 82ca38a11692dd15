"""ScanNet: scenes as color/, depth/, pose/, intrinsic/ and label-filt/, and the .sens files they are exported from."""

import itertools
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import frame_number, list_images, read_image_times
from ..images import MAX_IMAGE_PIXELS, decode_rgb, first_readable, image_size
from ..reading import opened, parsing, require_file
from ..trajectory import clean_poses
from .benchmarks import calibration_matrix, pose_in
from .folder import SENSOR_RATE, classes_of, files_for_images, sequence_of
from .sequence import Camera, Dataset, find_label_table, read_nyu40_classes

_VERSION = 4
_JPEG, _PNG = 2, 1
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1
_MAX_NAME_BYTES = 10_000
_FRAME_HEAD = struct.Struct("<16f4Q")
_MICROSECONDS = 1e-6

_LABEL_FOLDERS = ("label-filt", "label")
_COLOR_SIZE, _DEPTH_SIZE = (1296, 968), (640, 480)


def open_scannet(path: Path) -> Dataset:
    """Open an exported ScanNet scene: metric poses, of which lost frames have none, depth of its own camera.

    Labels are joined to the NYU40 classes where scannetv2-labels.combined.tsv is in the folder or above it, else
    each raw id is a class of its own. Raises InputError where a part cannot be read.
    """
    images = list_images(path / "color")
    label_folder = next((path / name for name in _LABEL_FOLDERS if (path / name).is_dir()), path / _LABEL_FOLDERS[0])
    label_paths = files_for_images(images, label_folder)
    depth_paths = files_for_images(images, path / "depth")
    first_depth = next((p for p in depth_paths if p is not None), None)
    table = find_label_table(path) if label_paths else None
    return sequence_of(
        "scannet", path, images,
        timestamps=_times(images),
        camera=_camera(path / "intrinsic" / "intrinsic_color.txt", first_readable(images), _COLOR_SIZE),
        world_from_cam=np.stack([pose_in(path / "pose" / f"{p.stem}.txt") for p in images]),
        depth_paths=depth_paths,
        depth_camera=_camera(path / "intrinsic" / "intrinsic_depth.txt", first_depth, _DEPTH_SIZE),
        label_paths=label_paths,
        classes=classes_of(label_paths, None) if table is None else read_nyu40_classes(table),
    )  # fmt: skip


def _times(images: list[Path]) -> NDArray[np.float64]:
    """The images' own times, else their frame numbers (else their order) over the sensor's rate."""
    times = read_image_times(images)
    if times is not None:
        return times
    numbers = [frame_number(p) for p in images]
    if not all(a is not None and b is not None and a < b for a, b in itertools.pairwise([-1, *numbers])):
        numbers = list(range(len(images)))
    return np.array(numbers, dtype=np.float64) / SENSOR_RATE


def _camera(path: Path, image: Path | None, recorded_size: tuple[int, int]) -> Camera | None:
    known = image is not None and path.is_file()
    return scaled_camera(calibration_matrix(path), recorded_size, image_size(image)) if known and image else None


def scaled_camera(k: NDArray[np.float64], recorded: tuple[int, int], actual: tuple[int, int]) -> Camera:
    """Return the camera with calibration matrix k (first pixel at (0, 0)) for images of the actual size.

    Images are often passed on smaller than recorded, with the calibration as it was: then the principal point is
    far from the middle, and the matrix is taken to be that of the recorded size.
    """
    fits = abs(k[0, 2] / actual[0] - 0.5) < 0.15 and abs(k[1, 2] / actual[1] - 0.5) < 0.15
    width, height = actual if fits else recorded
    fx, fy, cx, cy = (float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(width, height, fx, fy, cx + 0.5, cy + 0.5).resized(*actual)


@dataclass(frozen=True)
class SensFrames:
    """Frames of a .sens file: in `index` a row (N, 3) for each of the offset of its colour, the length of that, and the
    length of the depth that follows."""

    path: Path
    depth_kind: int
    depth_size: tuple[int, int]
    index: NDArray[np.int64]

    def rgb(self, number: int) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8. Raises InputError for a damaged frame."""
        start, length, _ = self.index[number].tolist()
        return decode_rgb(self._read(start, length), f"frame {number} of {self.path}")

    def raw_depth(self, number: int) -> NDArray[np.uint16]:
        """Return (h, w) uint16. Raises InputError for a damaged frame."""
        (width, height), (start, before, length) = self.depth_size, self.index[number].tolist()
        data = self._read(start + before, length)
        with parsing(self.path, f"depth of frame {number}", "copy it again"):
            if self.depth_kind == _ZLIB_DEPTH:  # a limit, because a few bytes can unpack to gigabytes
                data = zlib.decompressobj().decompress(data, width * height * 2)
            return np.frombuffer(data, dtype="<u2").reshape(height, width).astype(np.uint16)

    def _read(self, start: int, length: int) -> bytes:
        with opened(self.path) as file:
            file.seek(start)
            return file.read(length)


def open_sens(path: Path) -> Dataset:
    """Open a .sens recording: metric poses, of which lost frames have none, depth of its own camera, no labels.

    Raises InputError for another version or compression, and for a file that ends before its frames do.
    """
    size = require_file(path)
    with opened(path) as file:
        version, name_bytes = _unpack(file, "<IQ", path)
        if version != _VERSION or name_bytes > _MAX_NAME_BYTES:
            raise InputError(f"{path} is no .sens file of version {_VERSION}: check that it is the right file")
        file.seek(name_bytes, 1)
        color_matrix, _, depth_matrix, _ = np.array(_unpack(file, "<64f", path), np.float64).reshape(4, 4, 4)
        color_kind, depth_kind, width, height, depth_width, depth_height, shift, count = _unpack(file, "<2i4IfQ", path)
        if color_kind not in (_PNG, _JPEG) or depth_kind not in (_RAW_DEPTH, _ZLIB_DEPTH):
            raise InputError(
                f"{path} has colour compression {color_kind} and depth compression {depth_kind}, which cannot be read "
                "here: export it to a folder with ScanNet's own tool"
            )
        if max(width * height, depth_width * depth_height) > MAX_IMAGE_PIXELS or not shift > 0:
            raise InputError(f"{path} has a damaged header (images of {width}x{height}): copy it again")
        index, poses, times = _read_index(file, path, count, size)
    increasing = bool((np.diff(times) > 0).all() and times[-1] > times[0])
    color_size, depth_size = (width, height), (depth_width, depth_height)
    return Dataset(
        format="sens",
        root=path,
        names=tuple(f"{i:06d}.jpg" for i in range(count)),
        timestamps=(times - times[0]) * _MICROSECONDS if increasing else None,
        camera=scaled_camera(color_matrix, color_size, color_size),
        world_from_cam=clean_poses(poses, str(path)),
        depth_camera=scaled_camera(depth_matrix, depth_size, depth_size),
        depth_per_metre=float(shift),
        store=SensFrames(path, depth_kind, depth_size, index),
    )


def _read_index(
    file: BinaryIO, path: Path, count: int, size: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The index of `SensFrames`, poses (N, 4, 4) and times (N,) as stored."""
    if count < 1 or count * _FRAME_HEAD.size > size:
        raise InputError(f"{path} declares {count} frames in {size / 1e6:.1f} MB: it is damaged, copy it again")
    rows, poses, times = [], [], []
    for i in range(count):
        *matrix, color_time, _, color_bytes, depth_bytes = _unpack(file, _FRAME_HEAD.format, path)
        start = file.tell()
        if start + color_bytes + depth_bytes > size:
            raise InputError(f"{path} ends in frame {i} of {count}: it was not copied completely, copy it again")
        rows.append((start, color_bytes, depth_bytes))
        poses.append(matrix)
        times.append(color_time)
        file.seek(color_bytes + depth_bytes, 1)
    return np.array(rows, np.int64), np.array(poses, np.float64).reshape(-1, 4, 4), np.array(times, np.float64)


def _unpack(file: BinaryIO, layout: str, path: Path) -> tuple:
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) != size:
        raise InputError(f"{path} ends within its headers: it was not copied completely, copy it again")
    return struct.unpack(layout, data)
