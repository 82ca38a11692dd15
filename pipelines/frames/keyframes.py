"""Frames picked from the source, and keyframes among them by how far tracked points have moved."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ...formats.errors import InputError
from ...formats.images import write_rgb
from ...formats.textfile import read_json, write_json
from ...formats.video import VideoFrame
from ..config import FramesConfig
from ..run.stages import StageContext
from ..sfm.flow import find_corners, follow
from ..source.faces import Faces
from ..source.picking import Motion, reduce_image, sharpest_of_windows, sharpness
from ..source.recording import Recording
from ..system.parallel import map_lookahead, read_ahead
from ..types import Frame

PICKED, LOSSLESS = "picked", "lossless"
"""Folders of the snapshot."""
_TRACKED_SIDE = 480
_MAX_CORNERS = 600
_MIN_TRACKS = 30
_APART_PX = 6.0
_LEVELS = 4
_WIDE = 4 / 3
"""An image counts as at most so much longer than its shorter side: what a narrow one shows is soon out of it, across
and along."""
_MIN_SURVIVORS = 0.5
"""With fewer of its tracks left there is a new keyframe in any case."""


@dataclass(frozen=True)
class KeyframeChoice:
    """keyframes: indices of the chosen frames; displacement (N,): median displacement of each frame from the keyframe
    before it, as a fraction of the longer side, infinite where the tracks were lost. has_detail: whether any frame has
    enough corners to follow."""

    keyframes: list[int]
    displacement: NDArray[np.float64]
    has_detail: bool

    @property
    def largest_displacement(self) -> float:
        """Largest displacement that was seen, as a fraction of the longer side."""
        return float(self.displacement.max(initial=0.0))


def choose_keyframes(
    frames: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]], parallax: float
) -> KeyframeChoice:
    """Choose keyframes of grey frames (H, W) in order of time, each with a mask (H, W) of what is no part of the scene.

    They are the first, one whenever points have moved by `parallax`, and the last where it adds a view. Motion counts
    as a fraction of the longer side, or of 4/3 of the shorter one where that is less.
    """
    tracker = _Tracker()
    keyframes: list[int] = []
    displacement: list[float] = []
    count, has_detail = 0, False
    for i, (frame, left_out) in enumerate(frames):
        gray = reduce_image(frame, _TRACKED_SIDE)
        moved, survivors = tracker.advance(gray)
        displacement.append(moved)
        if i == 0 or moved > parallax or survivors < _MIN_SURVIVORS:
            keyframes.append(i)
            has_detail |= tracker.restart(gray, left_out) >= _MIN_TRACKS
        count = i + 1
    if keyframes and keyframes[-1] != count - 1 and displacement[-1] > parallax / 3:
        keyframes.append(count - 1)
    return KeyframeChoice(keyframes, np.array(displacement, dtype=np.float64), has_detail)


class _Tracker:
    """Follows the last keyframe's corners from frame to frame, each step checked by tracking back."""

    def __init__(self) -> None:
        self._previous: NDArray[np.uint8] | None = None
        self._origin = np.zeros((0, 2))
        self._points = np.zeros((0, 2))
        self._started = 0

    def restart(self, gray: NDArray[np.uint8], left_out: NDArray[np.bool_] | None) -> int:
        """Take `gray`, the frame advanced to last, as the keyframe; return the number of its corners."""
        if left_out is not None:
            left_out = cv2.resize(left_out.astype(np.uint8), gray.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        self._origin = self._points = find_corners(gray, self._origin[:0], _MAX_CORNERS, _APART_PX, left_out)
        self._started = len(self._origin)
        return self._started

    def advance(self, gray: NDArray[np.uint8]) -> tuple[float, float]:
        """Median displacement since the keyframe (fraction of the longer side), and the share of its tracks alive."""
        previous, self._previous = self._previous, gray
        if previous is None:
            return 0.0, 1.0
        if self._started == 0:  # the keyframe showed nothing: the next one is what shows something
            sees = len(find_corners(gray, self._origin[:0], _MAX_CORNERS, _APART_PX, None)) >= _MIN_TRACKS
            return 0.0, 0.0 if sees else 1.0
        if len(self._points):
            moved, found = follow(previous, gray, self._points, self._points, _LEVELS)
            self._origin, self._points = self._origin[found], moved[found]
        survivors = len(self._points) / self._started
        if len(self._points) < min(_MIN_TRACKS, self._started):
            return np.inf, survivors
        distance = np.linalg.norm(self._points - self._origin, axis=1)
        return float(np.median(distance)) / min(max(gray.shape), _WIDE * min(gray.shape)), survivors


def selected_image_path(context: StageContext, name: str) -> Path:
    """Return the file of a picked image, before undistortion."""
    return context.snapshot / PICKED / name


def lossless_image_path(context: StageContext, name: str) -> Path:
    """Return the file that holds a picked image's pixels as they were decoded, where that was asked for."""
    whole = context.snapshot / LOSSLESS / f"{name}.bmp"
    return whole if whole.exists() else selected_image_path(context, name)


def pick_frames(
    context: StageContext, source: Recording, faces: Faces | None, keep_lossless: bool = False
) -> list[Frame]:
    """The sharpest image of every window of time, and more images where these hardly overlap, kept in the snapshot,
    with `keep_lossless` as decoded too: what a lens is taken out of must not be compressed twice.

    Raises InputError for a source of one.
    """
    table = context.snapshot / "picked.json"
    if table.exists():
        stored = read_json(table, None)
        frames = [Frame(**row) for row in stored["frames"]]
        if all(selected_image_path(context, f.name).exists() for f in frames):
            for message in stored["warnings"]:
                context.warn(message)
            return frames
    config, earlier = context.config.frames, len(context.warnings)  # earlier ones are repeated by their stage
    rate = config.rate if source.is_timed() else 0.0
    motion = Motion()
    frames = _saved(context, source, faces, keep_lossless, _sharpest(context, source, rate, motion))
    wanted = motion.wanted() if rate > 0 else []
    if len(wanted) > len(frames):
        pictures = context.progress.track(source.read(set(wanted)), "picking", len(wanted))
        frames = _saved(context, source, faces, keep_lossless, ((p, sharpness(p.rgb)) for p in pictures))
    context.same_source()
    if len(frames) < 2:
        raise InputError(f"{source.path} gives one frame only; a reconstruction needs several views of a scene")
    if faces is not None:
        frames = _of_all_directions(frames, faces)
    write_json(table, {"frames": [asdict(f) for f in frames], "warnings": context.warnings[earlier:]})
    return frames


def _sharpest(
    context: StageContext, source: Recording, rate: float, motion: Motion
) -> Iterator[tuple[VideoFrame, float]]:
    """The sharpest images with their sharpness, by whose `motion` it is judged whether these are enough."""
    decoded = read_ahead(source.read(warn=context.warn), context.threads)
    pictures = context.progress.track(decoded, "picking", source.expected_frames or None)
    if rate <= 0:
        yield from sharpest_of_windows(pictures, rate)
        return
    for picture, score in sharpest_of_windows(motion.watch(pictures), rate):
        motion.pick(picture.source_index)
        yield picture, score


def _saved(
    context: StageContext,
    source: Recording,
    faces: Faces | None,
    keep_lossless: bool,
    chosen: Iterable[tuple[VideoFrame, float]],
) -> list[Frame]:
    """The frames of images with their sharpness, each written to the snapshot."""
    frames: list[Frame] = []

    def named() -> Iterator[tuple[VideoFrame, str]]:
        for picture, score in chosen:
            frame_id = len(frames)
            timestamp = picture.timestamp if source.is_timed() else _untimed(context.config.frames, frame_id)
            name = source.name(frame_id, picture.source_index)
            frames.append(Frame(frame_id, name, timestamp, picture.source_index, score))
            yield picture, name

    def save(one: tuple[VideoFrame, str]) -> None:
        _save_selected(context, source, *one, faces, keep_lossless)

    for _ in map_lookahead(save, named(), context.threads):
        pass
    return frames


def _of_all_directions(frames: list[Frame], faces: Faces) -> list[Frame]:
    """Direction by direction, as `Rig` counts."""
    named = [(c, f, faces.names(f.name)[c]) for c in range(len(faces)) for f in frames]
    return [replace(f, id=c * len(frames) + f.id, name=name) for c, f, name in named]


def _untimed(config: FramesConfig, frame_id: int) -> float:
    return frame_id / (config.rate if config.rate > 0 else 1.0)


def _save_selected(
    context: StageContext, source: Recording, picture: VideoFrame, name: str, faces: Faces | None, keep_lossless: bool
) -> None:
    if faces is not None:
        for face, rgb in zip(faces.names(name), faces.cut(picture.rgb), strict=True):
            write_rgb(selected_image_path(context, face), rgb)
        return
    path = selected_image_path(context, name)
    reduced = reduce_image(picture.rgb, context.config.frames.max_side)
    original = source.original(picture.source_index) if reduced is picture.rgb else None
    if original is not None:
        copy_file(original, path)
        return
    write_rgb(path, reduced)
    if keep_lossless and path.suffix.lower() != ".png":
        write_rgb(context.snapshot / LOSSLESS / f"{name}.bmp", reduced)
