"""A recorded sequence with whatever truth its data set has, and its camera, in one set of conventions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..images import read_depth_png, read_label_png, read_rgb
from ..reading import parsing
from ..textfile import is_number, read_fields, read_json, read_text

_TABLE_NAME = "scannetv2-labels.combined.tsv"
_LEVELS_UP = 4

_VOID_NAMES = frozenset({"none", "void", "undefined", "unlabeled", "unlabelled", "unknown", "ignore"})
_CLASS_TABLES = ("classes.json", "info_semantic.json", "classes.txt", "labels.txt", "classes_used.txt")
_MAX_TABLE_BYTES = 16 << 20
MAX_ID = 65535

_LARGEST_SIDE = 65535
_FOCAL_SIDES = 100
"""Focal lengths beyond this many sides of the image, or below its inverse, are slips of the unit or damage."""
_STRONGEST_DISTORTION = 1000.0
_SAME_SHAPE = 0.01

VOID_LABEL = 255
"""Label of a pixel without a class."""
_UNITS_PER_METRE = (1e-3, 1e9)


@dataclass(frozen=True)
class LabelClass:
    """A class of the data set: its id in the label images, its name, its RGB colour where the set defines one.

    `other_ids` mean the same class: sets with fine labels are commonly read through a table that joins them.
    """

    id: int
    name: str
    color: tuple[int, int, int] | None = None
    other_ids: tuple[int, ...] = ()

    @property
    def is_void(self) -> bool:
        """Whether it is what is no class."""
        return self.name.strip().lower() in _VOID_NAMES


class FrameStore(Protocol):
    """Frames stored in one container file instead of a folder."""

    def rgb(self, index: int, /) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8."""

    def raw_depth(self, index: int, /) -> NDArray[np.uint16]:
        """Return (H, W) uint16 in the container's unit."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """N frames of one camera.

    names: N file names, unique, in order. timestamps (N,) seconds, strictly increasing, as measured or counted at the
    sensor's known rate; None where unknown. image_paths: N paths, or none where `store` holds the frames. camera: None
    where unknown. world_from_cam (N, 4, 4) float64 with exact rotations, camera axes x right, y down, z forward; NaN
    for a frame without a pose; None without any. `metric` says whether the unit of the poses is the metre, else it is
    any. depth_paths, label_paths: N paths, None for a frame without; empty without any. depth_camera: the camera of the
    depth images where that is another one than `camera`; color_from_depth: metres that its points are moved by to lie
    in the colour camera. Depth in metres is raw / depth_per_metre, unknown where raw is one of depth_invalid. classes:
    what `labels` gives indices into. mask_paths: N paths as depth_paths, of images that are black where the frame shows
    no part of the scene. notes: what a user should know about this recording, what of it is not used above all; one
    sentence each.
    """

    format: str
    root: Path
    names: tuple[str, ...]
    timestamps: NDArray[np.float64] | None
    image_paths: tuple[Path, ...] = ()
    camera: Camera | None = None
    world_from_cam: NDArray[np.float64] | None = None
    metric: bool = True
    depth_paths: tuple[Path | None, ...] = ()
    depth_camera: Camera | None = None
    color_from_depth: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_per_metre: float = 1000.0
    depth_invalid: tuple[int, ...] = (0, 65535)
    label_paths: tuple[Path | None, ...] = ()
    mask_paths: tuple[Path | None, ...] = ()
    classes: tuple[LabelClass, ...] = ()
    store: FrameStore | None = field(default=None, repr=False)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n, times, poses = len(self.names), self.timestamps, self.world_from_cam
        if n == 0:
            raise InputError(f"no frames in {self.root}: check that the data set was unpacked completely")
        if len(set(self.names)) != n:
            raise InputError(f"{self.root}: two frames have the same file name: rename one")
        if times is not None and not (times.shape == (n,) and np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise InputError(f"{self.root}: the frames' timestamps do not increase: sort the image list by time")
        low, high = _UNITS_PER_METRE
        if not low <= self.depth_per_metre <= high:
            raise InputError(
                f"{self.root}: a depth scale of {self.depth_per_metre:g} units a metre cannot be: correct it"
            )
        if len(self.classes) >= VOID_LABEL:
            raise InputError(f"{self.root} has {len(self.classes)} classes, at most {VOID_LABEL - 1} are supported")
        for paths in (self.image_paths, self.depth_paths, self.label_paths, self.mask_paths):
            if len(paths) not in (0, n) or not (self.image_paths or self.store):
                raise ValueError(f"Dataset: {len(paths)} paths for {n} frames")
        if poses is not None and poses.shape != (n, 4, 4):
            raise ValueError(f"Dataset: {n} frames and poses of shape {poses.shape}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def has_depth(self) -> bool:
        """Whether any frame has depth."""
        return any(p is not None for p in self.depth_paths) or (self.store is not None)

    @property
    def has_labels(self) -> bool:
        """Whether any frame has labels."""
        return any(p is not None for p in self.label_paths)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names by the indices that `labels` gives."""
        return tuple(c.name for c in self.classes)

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) whether the frame's pose is known."""
        if self.world_from_cam is None:
            return np.zeros(len(self), dtype=bool)
        return np.asarray(np.isfinite(self.world_from_cam).all(axis=(1, 2)))

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8. Raises InputError for an unreadable image."""
        return self.store.rgb(index) if self.store else read_rgb(self.image_paths[index])

    def depth(self, index: int) -> NDArray[np.float32] | None:
        """Return (h, w) float32 z-depth in metres with the field of view of the colour image, 0 = unknown; None
        without.

        Depth of another camera is moved to the colour camera's pixels.
        """
        if self.store is not None:
            raw = self.store.raw_depth(index)
        elif self.depth_paths and (path := self.depth_paths[index]) is not None:
            raw = read_depth_png(path)
        else:
            return None
        depth = raw.astype(np.float32) / np.float32(self.depth_per_metre)
        depth[np.isin(raw, self.depth_invalid)] = 0
        if self.depth_camera is None or self.camera is None:
            return depth
        return shift_viewpoint(warp_nearest(depth, self.depth_camera, self.camera), self.camera, self.color_from_depth)

    def labels(self, index: int) -> NDArray[np.uint8] | None:
        """Return (h, w) uint8 indices into `classes`, VOID_LABEL for none of them; None without labels."""
        path = self.label_paths[index] if self.label_paths else None
        if path is None:
            return None
        table = np.full(65536, VOID_LABEL, dtype=np.uint8)
        for number, label_class in enumerate(self.classes):
            table[[label_class.id, *label_class.other_ids]] = number
        return table[read_label_png(path)]


def distortion_names(fisheye: bool) -> tuple[str, ...]:
    """Return the names of a camera's distortion coefficients."""
    return ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels, first pixel's centre at (0.5, 0.5); distortion k1, k2, p1, p2[, k3[, k4, k5, k6]] as in
    OpenCV.

    `fisheye` says that the distortion is the equidistant k1..k4 instead; `is_nominal` that these are the numbers of the
    kind of camera, not a calibration of this one.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False
    is_nominal: bool = field(default=False, repr=False)  # a source is known by the text of its camera

    def __post_init__(self) -> None:
        values = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64)
        side = max(self.width, self.height)
        sane = 1 <= min(self.width, self.height) <= side <= _LARGEST_SIDE and bool(np.isfinite(values).all())
        sane = sane and all(side / _FOCAL_SIDES <= f <= side * _FOCAL_SIDES for f in (self.fx, self.fy))
        if not sane or max(abs(k) for k in (0.0, *self.distortion)) > _STRONGEST_DISTORTION:
            raise InputError(f"these are no camera intrinsics: {self}: check the data set's calibration file")
        if not (-self.width < self.cx < 2 * self.width and -self.height < self.cy < 2 * self.height):
            raise InputError(f"the principal point is far outside the image: {self}: is it another camera's file?")

    @property
    def is_distorted(self) -> bool:
        """Whether an ideal pinhole camera would see another image."""
        return any(self.distortion)

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera after its image is resized to width x height.

        Raises InputError for images of another shape, by more than 1 % and a pixel of rounding: no resizing makes one
        of the other.
        """
        rounding = max(_SAME_SHAPE * width * self.height, self.width, self.height, width, height)
        if abs(width * self.height - height * self.width) > rounding:
            raise InputError(
                f"the camera is for images of {self.width}x{self.height}, these are {width}x{height}, another shape: "
                "is it another camera's file, or are the images cropped or turned?"
            )
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)


def warp_nearest(image: NDArray[np.float32], source: Camera, target: Camera) -> NDArray[np.float32]:
    """Return (H, W) `image` of the source camera as the target camera sees it from the same place, 0 outside.

    Both cameras look the same way and their lens distortion is left out; the nearest pixel is taken, because the mean
    of two depths lies on neither surface. The source camera is scaled to the image's size first.
    """
    source = source.resized(image.shape[1], image.shape[0])
    x = (np.arange(target.width) + 0.5 - target.cx) / target.fx * source.fx + source.cx
    y = (np.arange(target.height) + 0.5 - target.cy) / target.fy * source.fy + source.cy
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    inside_x, inside_y = (column >= 0) & (column < source.width), (row >= 0) & (row < source.height)
    warped = image[np.ix_(row.clip(0, source.height - 1), column.clip(0, source.width - 1))]
    return np.where(inside_y[:, None] & inside_x[None, :], warped, np.float32(0)).astype(np.float32)


def shift_viewpoint(
    depth: NDArray[np.float32], camera: Camera, offset: tuple[float, float, float]
) -> NDArray[np.float32]:
    """Return (H, W) z-depth of a camera, 0 = unknown, as the same camera sees it from elsewhere: points there are those
    here plus `offset` (metres). The nearest of several surfaces wins."""
    if not any(offset):
        return depth
    row, column = np.nonzero(depth > 0)
    z = depth[row, column].astype(np.float64)
    there = z + offset[2]
    u = (column + 0.5 - camera.cx) * (z / there) + camera.fx * offset[0] / there + camera.cx - 0.5
    v = (row + 0.5 - camera.cy) * (z / there) + camera.fy * offset[1] / there + camera.cy - 0.5
    out = np.full(depth.shape, np.inf)
    # Two columns and rows each: a surface that the other camera sees from less aside has no gaps.
    for y, x in ((f(v), g(u)) for f in (np.floor, np.ceil) for g in (np.floor, np.ceil)):
        inside = (there > 0) & (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
        np.minimum.at(out, (y[inside].astype(int), x[inside].astype(int)), there[inside])
    return np.where(np.isfinite(out), out, 0).astype(np.float32)


def known_classes(path: Path) -> tuple[LabelClass, ...]:
    """Read the classes of a table by their ids, without the void ones. Raises InputError as `read_class_table`."""
    return tuple(c for _, c in sorted(read_class_table(path).items()) if not c.is_void)


def find_class_table(label_folder: Path) -> Path | None:
    """The table in the label folder or the one above it; None when there is none."""
    candidates = (folder / name for folder in (label_folder, label_folder.parent) for name in _CLASS_TABLES)
    return next((path for path in candidates if path.is_file()), None)


def read_class_table(path: Path) -> dict[int, LabelClass]:
    """id → class. JSON: {"classes": [{"id", "name", "color"?}]}, such a list, a list of names, or {"id": "name"};
    text: a name a line (ids from 0) up to the first empty line, or `id name [numbers]` a line; # begins a comment.
    Raises InputError.
    """
    stored = read_json(path, _MAX_TABLE_BYTES) if path.suffix == ".json" else read_text(path, _MAX_TABLE_BYTES)
    with parsing(path, "table of classes", "write a list of {id, name}"):
        table = _from_text(stored) if isinstance(stored, str) else _from_json(stored)
    if not table or min(table) < 0 or max(table) > MAX_ID:
        raise InputError(f"{path}: class ids must be in 0..{MAX_ID} and at least one is needed")
    return table


def _from_json(value: Any) -> dict[int, LabelClass]:
    if isinstance(value, dict) and "classes" in value:
        value = value["classes"]
    if isinstance(value, dict):
        return {int(k): LabelClass(int(k), str(v)) for k, v in value.items()}
    if not isinstance(value, list):
        raise ValueError("it lists no classes")
    table: dict[int, LabelClass] = {}
    for i, row in enumerate(value):
        found = LabelClass(i, row) if isinstance(row, str) else _class_of(row)
        if table.setdefault(found.id, found) is not found:
            raise ValueError(f"the class id {found.id} occurs twice")
    return table


def _class_of(row: Any) -> LabelClass:
    color = row.get("color")
    is_rgb = isinstance(color, list) and len(color) == 3 and all(isinstance(v, int | float) for v in color)
    red, green, blue = (min(max(int(v), 0), 255) for v in color) if is_rgb else (0, 0, 0)
    return LabelClass(int(row["id"]), str(row["name"]), (red, green, blue) if is_rgb else None)


def _from_text(text: str) -> dict[int, LabelClass]:
    lines = [line.split("#")[0].strip() for line in text.strip().splitlines() if line.lstrip()[:1] != "#"]
    # Prose may follow the names after an empty line, as in the lists that come with some networks.
    lines = lines[: lines.index("")] if "" in lines else lines
    rows = [line.split() for line in lines]
    if all(len(r) >= 2 and r[0].isdecimal() for r in rows):
        return {
            int(r[0]): LabelClass(int(r[0]), " ".join(takewhile(lambda field: not is_number(field), r[1:])) or r[1])
            for r in rows
        }
    return {i: LabelClass(i, line) for i, line in enumerate(lines)}


def find_label_table(path: Path) -> Path | None:
    """scannetv2-labels.combined.tsv in the folder or one of the four above it."""
    folders = [path.resolve(), *path.resolve().parents][: _LEVELS_UP + 1]
    return next((f / _TABLE_NAME for f in folders if (f / _TABLE_NAME).is_file()), None)


def read_nyu40_classes(path: Path) -> tuple[LabelClass, ...]:
    """Read the NYU40 classes, each with the raw ids that belong to it. Raises InputError for another table."""
    members: dict[tuple[int, str], list[int]] = {}
    table = read_fields(path)
    raw, joined, named = (table.column(name) for name in ("id", "nyu40id", "nyu40class"))
    if raw is None or joined is None or named is None:
        raise InputError(f"{path} is not ScanNet's label table (no id, nyu40id or nyu40class): download it again")
    try:
        for row in table.rows:
            if len(row) > max(raw, joined, named) and row[joined] and int(row[joined]) > 0:
                members.setdefault((int(row[joined]), row[named]), []).append(int(row[raw]))
    except ValueError as error:
        raise InputError(f"{path} is not ScanNet's label table ({error}): download it again") from error
    if not members or any(not 0 <= i <= 65535 for ids in members.values() for i in ids):
        raise InputError(f"{path} is not ScanNet's label table: download it again")
    return tuple(LabelClass(ids[0], name, None, tuple(ids[1:])) for (_, name), ids in sorted(members.items()))
