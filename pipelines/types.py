"""Data exchanged between stages, and the conventions, stated once.

Conventions
- A transform is named target first: `cam_from_world @ points_in_world`. The inner names of a product cancel.
- Camera axes: x right, y down, z forward. The centre of the top-left pixel is (0.5, 0.5).
- `depth` is z along the optical axis, 0 where unknown; metres when the proxy is metric, else the unit of the run.
- Images are RGB uint8 (H, W, 3). Labels are uint8 (H, W), indices into the run's class table, `VOID` where unknown.
- Poses are float64 (4, 4); maps and renderings float32.
- Shapes: N frames, M Gaussians, C classes, P points, H x W pixels; K is the intrinsics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
VOID = 255
"""Label of a pixel whose class is unknown."""


def require_shape(name: str, array: NDArray, expected: Sequence[int | None]) -> None:
    """Raise ValueError unless `array` has the expected shape; None stands for any length."""
    shape = array.shape
    if len(shape) != len(expected) or any(e is not None and s != e for s, e in zip(shape, expected, strict=True)):
        want = tuple("any" if e is None else e for e in expected)
        raise ValueError(f"{name}: got shape {shape}, expected {want}")


def any_of(masks: Iterable[NDArray[np.bool_] | None]) -> NDArray[np.bool_] | None:
    """Return the union of the masks (H, W); None without any."""
    found = [m for m in masks if m is not None]
    return np.asarray(np.logical_or.reduce(found)) if found else None


def rows_by(group: NDArray[np.integer], count: int) -> list[NDArray[np.int64]]:
    """For each of the groups 0 to `count` - 1 the rows of `group` (Q,) that hold its number, in order."""
    order = np.argsort(group, kind="stable")
    return np.split(order, np.searchsorted(group[order], np.arange(1, count)))


@dataclass(frozen=True)
class Features:
    """keypoints (F, 4) float32: x, y in pixels, scale, orientation in radians; descriptors (F, 128): SIFT as uint8 of
    length NORM, learned ones, whose numbers have signs, as int8 of length SIGNED_NORM."""

    keypoints: NDArray[np.float32]
    descriptors: NDArray[np.uint8] | NDArray[np.int8]
    NORM: ClassVar[int] = 512
    SIGNED_NORM: ClassVar[int] = 254

    def __post_init__(self) -> None:
        require_shape("keypoints", self.keypoints, (None, 4))
        require_shape("descriptors", self.descriptors, (len(self.keypoints), 128))

    @property
    def nbytes(self) -> int:
        """Memory of both arrays, in bytes."""
        return self.keypoints.nbytes + self.descriptors.nbytes

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def xy(self) -> NDArray[np.float64]:
        """Keypoints (F, 2) in pixels."""
        return self.keypoints[:, :2].astype(np.float64)


@dataclass(frozen=True)
class Vocabulary:
    """Words (W, 128) of descriptors, and the mean (W * 128,) of how frames look in them: what all frames of a place
    share says nothing of which look at one spot."""

    words: NDArray[np.float64]
    mean: NDArray[np.float64]


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; lengths in pixels, first pixel's centre at (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size must be positive, got {self.width}x{self.height}")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive and finite, got {self}")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) calibration matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    @property
    def numbers(self) -> NDArray[np.float64]:
        """(4,) fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)

    def at_most(self, side: int) -> Intrinsics:
        """The camera of images whose long side is at most `side` pixels; 0 leaves it as it is."""
        scale = min(1.0, side / max(self.width, self.height)) if side > 0 else 1.0
        return self.resized(max(round(self.width * scale), 1), max(round(self.height * scale), 1))

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the camera after its image is resized to width x height."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def of_size(self, width: int, height: int) -> Intrinsics:
        """The camera of images of another size that sees as much from top to bottom, and more or less at the sides."""
        scale = height / self.height
        cx = self.cx * scale + (width - self.width * scale) / 2
        return Intrinsics(width, height, self.fx * scale, self.fy * scale, cx, self.cy * scale)

    def every(self, stride: int) -> Intrinsics:
        """The camera of an image's pixels [stride // 2 :: stride] along both sides.

        Of an even stride these are not the middles of the squares that a smaller image of the same view would have.
        """
        off = stride // 2 - (stride - 1) / 2
        width, height = (len(range(stride // 2, side, stride)) for side in (self.width, self.height))
        cx, cy = (self.cx - off) / stride, (self.cy - off) / stride
        return Intrinsics(width, height, self.fx / stride, self.fy / stride, cx, cy)


@dataclass(frozen=True)
class Frame:
    """One picked frame: `id` counts picked frames from 0, `source_index` is its place in the source."""

    id: int
    name: str
    timestamp: float
    source_index: int
    sharpness: float


@dataclass(frozen=True)
class Calibration:
    """The camera of the (undistorted) frames and how it came to be known.

    `origin` is "given", "exif" or "self-calibrated"; `focal_sd` its standard deviation in pixels (0 when given);
    `distortion` the (k1, k2, p1, p2[, k3[, k4, k5, k6]]) that was removed from the frames, of a `fisheye` (k1, k2, k3,
    k4).
    `directions`: in how many the camera looks at once, see `pipelines.geometry.camera.Rig`. `readout`: seconds of its
    rolling shutter, see `pipelines.sfm.rolling`.
    """

    intrinsics: Intrinsics
    origin: str
    focal_sd: float
    distortion: tuple[float, ...]
    fisheye: bool = False
    directions: int = 1
    readout: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class GivenPoses:
    """Poses that the user brings: cam_from_world (N, 4, 4) of all frames, NaN for a frame without; whether in metres;
    `what` they are."""

    cam_from_world: NDArray[np.float64]
    is_metric: bool
    what: str

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) which frames have one."""
        return np.asarray(np.isfinite(self.cam_from_world).all(axis=(1, 2)))


@dataclass(frozen=True)
class ProxyMaps:
    """Proxy maps of one frame, at their own resolution h x w (same field of view as the frame).

    depth (h, w) float32, 0 = unknown; confidence (h, w) float32 in [0, 1]: the reliability U of eq. (2);
    labels (h, w) uint8; label_confidence (h, w) float32 in [0, 1]: probability of that label.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    labels: NDArray[np.uint8]
    label_confidence: NDArray[np.float32]

    def __post_init__(self) -> None:
        require_shape("depth", self.depth, (None, None))
        for name in ("confidence", "labels", "label_confidence"):
            require_shape(name, getattr(self, name), self.depth.shape)


@dataclass(frozen=True)
class ClassTable:
    """Names and display colours (RGB 0..255) of the classes; a label is an index into both."""

    names: tuple[str, ...]
    colors: tuple[tuple[int, int, int], ...]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.colors) or len(self.names) > VOID:
            raise ValueError(f"got {len(self.names)} names, {len(self.colors)} colours; at most {VOID} classes")

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Trajectory:
    """A pose for every picked frame, or the reason why there is none.

    frame_ids (N,) int, timestamps (N,) seconds, cam_from_world (N, 4, 4) float64 (identity where lost),
    is_keyframe (N,) bool, lost_reasons: N strings, "" where the frame is posed.
    """

    frame_ids: NDArray[np.int64]
    timestamps: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]
    is_keyframe: NDArray[np.bool_]
    lost_reasons: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.frame_ids)
        require_shape("timestamps", self.timestamps, (n,))
        require_shape("cam_from_world", self.cam_from_world, (n, 4, 4))
        require_shape("is_keyframe", self.is_keyframe, (n,))
        if len(self.lost_reasons) != n:
            raise ValueError(f"lost_reasons: got {len(self.lost_reasons)}, expected {n}")
        if (self.is_keyframe & ~self.is_posed).any():
            raise ValueError("a lost frame cannot be a keyframe")

    @property
    def is_posed(self) -> NDArray[np.bool_]:
        """Whether each frame has a pose, (N,)."""
        return np.array([not reason for reason in self.lost_reasons], dtype=bool)

    @property
    def world_from_cam(self) -> NDArray[np.float64]:
        """(N, 4, 4) inverse poses."""
        return np.asarray(np.linalg.inv(self.cam_from_world), dtype=np.float64)

    @property
    def centers(self) -> NDArray[np.float64]:
        """(N, 3) camera centres in the world."""
        return self.world_from_cam[:, :3, 3]

    def moved(self, move: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Trajectory:
        """Change the poses (N, 4, 4) by a function; lost frames keep their identity, for they have no position."""
        poses = np.where(self.is_posed[:, None, None], move(self.cam_from_world), self.cam_from_world)
        return replace(self, cam_from_world=poses)

    def of_frames(self, frame_ids: NDArray[np.int64]) -> Trajectory:
        """Select these frames."""
        t, rows = self, np.flatnonzero(np.isin(self.frame_ids, frame_ids))
        reasons = tuple(t.lost_reasons[r] for r in rows)
        return Trajectory(t.frame_ids[rows], t.timestamps[rows], t.cam_from_world[rows], t.is_keyframe[rows], reasons)

    def split(self, hold_out: int) -> tuple[list[int], list[int]]:
        """Return the ids of the keyframes to use, and those held out of the posed frames: every `hold_out`-th, from
        half of that on."""
        posed, keyframes = (self.frame_ids[rows].tolist() for rows in (self.is_posed, self.is_keyframe))
        held = [i for i in posed if hold_out > 0 and i % hold_out == hold_out // 2]
        return [i for i in keyframes if i not in set(held)], held


@dataclass(frozen=True)
class LoopEdge:
    """A verified revisit: frame2_from_frame1 (4, 4) up to `scale`, with its inlier count."""

    frame1_id: int
    frame2_id: int
    frame2_from_frame1: NDArray[np.float64]
    scale: float
    inliers: int


@dataclass(frozen=True)
class MetresSource:
    """Estimate of one source alone: metres per unit and their relative standard deviation."""

    source: str
    per_unit: float
    relative_sd: float


@dataclass(frozen=True)
class Metres:
    """Length of the unit of a world, which is never rescaled by it: metres per unit and their relative standard
    deviation (that of the logarithm).

    is_guess: whether it rests only on what is usual in the world; sources: its evidence, strongest first; alone: the
    estimate of each; disagreement: the Birge ratio of the sources, over 1 where they scatter more than they should;
    only_in_room: whether it holds for a room alone, and nothing tells that the scene is one.
    """

    per_unit: float
    relative_sd: float
    is_guess: bool
    sources: tuple[str, ...]
    by_source: tuple[MetresSource, ...] = ()
    disagreement: float = 1.0
    only_in_room: bool = False

    def __post_init__(self) -> None:
        if not (self.per_unit > 0 and self.relative_sd > 0):
            raise ValueError(f"metres per unit and their deviation must be positive, got {self}")

    @property
    def text(self) -> str:
        """1 unit = about 0.83 m ± 18 % (estimated from floor height and 2 doors)."""
        *first, last = self.sources or ("nothing in particular",)
        text = f"{', '.join(first)} and {last}" if first else last
        text += ", if the scene is a room" if self.only_in_room else ""
        about, guess = ("about ", "estimated ") if self.is_guess else ("", "")
        percent = 100 * self.relative_sd
        spread = f"{percent:.0f}" if percent >= 2 else f"{percent:.1f}"
        return f"1 unit = {about}{self.per_unit:.{2 if self.is_guess else 3}g} m ± {spread}% ({guess}from {text})"
