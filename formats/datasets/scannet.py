"""ScanNet: scenes as color/, depth/, pose/, intrinsic/ and label-filt/, and the .sens files they are exported from."""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..image_folder import list_images
from ..images import MAX_IMAGE_PIXELS, decode_rgb, first_readable, image_size
from ..reading import opened, require_file
from ..textfile import read_table
from ..trajectory import clean_poses, read_matrices
from .matching import classes_found, files_for_images, sequence_of, times_at_sensor_rate
from .sequence import Camera, Dataset, LabelClass, find_label_table, read_nyu40_classes

_VERSION = 4
_JPEG, _PNG = 2, 1
_RAW_DEPTH, _ZLIB_DEPTH = 0, 1
_MAX_NAME_BYTES = 10_000
_FRAME_HEAD = struct.Struct("<16f4Q")
_MICROSECONDS = 1e-6

_LABEL_FOLDERS = ("label-filt", "label")
_COLOR_SIZE, _DEPTH_SIZE = (1296, 968), (640, 480)


def is_scannet(path: Path) -> bool:
    """Recognise color/ and pose/ with one text file a frame."""
    return (path / "color").is_dir() and (path / "pose").is_dir() and any((path / "pose").glob("*.txt"))


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
    return sequence_of(
        "scannet", path, images,
        timestamps=times_at_sensor_rate(images),
        camera=_camera(path / "intrinsic" / "intrinsic_color.txt", first_readable(images), _COLOR_SIZE),
        world_from_cam=np.stack([_pose(path / "pose" / f"{p.stem}.txt") for p in images]),
        depth_paths=depth_paths,
        depth_camera=_camera(path / "intrinsic" / "intrinsic_depth.txt", first_depth, _DEPTH_SIZE),
        label_paths=label_paths,
        classes=_classes(path, label_paths),
    )  # fmt: skip


def _pose(path: Path) -> NDArray[np.float64]:
    return read_matrices(path)[0] if path.is_file() else np.full((4, 4), np.nan)


def _camera(path: Path, image: Path | None, recorded_size: tuple[int, int]) -> Camera | None:
    if image is None or not path.is_file():
        return None
    k = read_table(path, 3)
    if len(k) < 3:
        raise InputError(f"{path} has {len(k)} rows, expected a 3x3 or 4x4 calibration matrix")
    return scaled_camera(k, recorded_size, image_size(image))


def scaled_camera(k: NDArray[np.float64], recorded: tuple[int, int], actual: tuple[int, int]) -> Camera:
    """Return the camera with calibration matrix k (first pixel at (0, 0)) for images of the actual size.

    Images are often passed on smaller than recorded, with the calibration as it was: then the principal point is
    far from the middle, and the matrix is taken to be that of the recorded size.
    """
    fits = abs(k[0, 2] / actual[0] - 0.5) < 0.15 and abs(k[1, 2] / actual[1] - 0.5) < 0.15
    width, height = actual if fits else recorded
    values = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
    return Camera.from_integer_centres(width, height, *values).resized(*actual)


def _classes(path: Path, label_paths: tuple[Path | None, ...]) -> tuple[LabelClass, ...]:
    if not label_paths:
        return ()
    table = find_label_table(path)
    return classes_found(label_paths) if table is None else read_nyu40_classes(table)


@dataclass(frozen=True)
class _Header:
    color_matrix: NDArray[np.float64]
    depth_matrix: NDArray[np.float64]
    depth_kind: int
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_shift: float
    frame_count: int


@dataclass(frozen=True)
class SensFrames:
    """Frames of a .sens file: offsets in the file of each one's colour and depth (N,), and their lengths."""

    path: Path
    depth_kind: int
    depth_size: tuple[int, int]
    starts: NDArray[np.int64]
    color_bytes: NDArray[np.int64]
    depth_bytes: NDArray[np.int64]

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8. Raises InputError for a damaged frame."""
        data = self._read(int(self.starts[index]), int(self.color_bytes[index]))
        return decode_rgb(data, f"frame {index} of {self.path}")

    def raw_depth(self, index: int) -> NDArray[np.uint16]:
        """Return (h, w) uint16. Raises InputError for a damaged frame."""
        width, height = self.depth_size
        start = int(self.starts[index] + self.color_bytes[index])
        data = self._read(start, int(self.depth_bytes[index]))
        if self.depth_kind == _ZLIB_DEPTH:
            try:
                # A limit, because a few bytes of zlib can unpack to gigabytes.
                data = zlib.decompressobj().decompress(data, width * height * 2)
            except zlib.error as error:
                raise InputError(f"{self.path}: depth of frame {index} is damaged ({error}): copy it again") from error
        if len(data) != width * height * 2:
            raise InputError(f"{self.path}: depth of frame {index} is damaged: copy the file again")
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
        header = _read_header(file, path)
        index, poses, times = _read_index(file, path, header.frame_count, size)
    frames = SensFrames(path, header.depth_kind, header.depth_size, *index)
    count = header.frame_count
    increasing = bool((np.diff(times) > 0).all() and times[-1] > times[0])
    return Dataset(
        format="sens",
        root=path,
        names=tuple(f"{i:06d}.jpg" for i in range(count)),
        timestamps=(times - times[0]) * _MICROSECONDS if increasing else None,
        camera=scaled_camera(header.color_matrix, header.color_size, header.color_size),
        world_from_cam=clean_poses(poses, str(path)),
        depth_camera=scaled_camera(header.depth_matrix, header.depth_size, header.depth_size),
        depth_per_metre=header.depth_shift,
        store=frames,
    )


def _read_header(file: BinaryIO, path: Path) -> _Header:
    version, name_bytes = _unpack(file, "<IQ", path)
    if version != _VERSION or name_bytes > _MAX_NAME_BYTES:
        raise InputError(f"{path} is no .sens file of version {_VERSION}: check that it is the right file")
    file.seek(name_bytes, 1)
    matrices = np.array(_unpack(file, "<64f", path), dtype=np.float64).reshape(4, 4, 4)
    color_kind, depth_kind, *sizes, shift, count = _unpack(file, "<2i4IfQ", path)
    if color_kind not in (_PNG, _JPEG) or depth_kind not in (_RAW_DEPTH, _ZLIB_DEPTH):
        raise InputError(
            f"{path} has colour compression {color_kind} and depth compression {depth_kind}, which cannot be read "
            "here: export it to a folder with ScanNet's own tool"
        )
    if sizes[0] * sizes[1] > MAX_IMAGE_PIXELS or sizes[2] * sizes[3] > MAX_IMAGE_PIXELS or not shift > 0:
        raise InputError(f"{path} has a damaged header (images of {sizes}): copy it again")
    return _Header(
        matrices[0], matrices[2], depth_kind, (sizes[0], sizes[1]), (sizes[2], sizes[3]), float(shift), count
    )


def _read_index(
    file: BinaryIO, path: Path, count: int, size: int
) -> tuple[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64], NDArray[np.float64]]:
    """(starts, colour bytes, depth bytes) of each frame, poses (N, 4, 4) and times (N,) as stored."""
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
    columns = np.array(rows, dtype=np.int64).T
    stored = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
    return (columns[0], columns[1], columns[2]), stored, np.array(times, dtype=np.float64)


def _unpack(file: BinaryIO, layout: str, path: Path) -> tuple:
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) != size:
        raise InputError(f"{path} ends within its headers: it was not copied completely, copy it again")
    return struct.unpack(layout, data)
