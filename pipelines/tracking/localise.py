"""Whether added videos show what a finished run has seen, through the same camera: asked before anything is changed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.video import VideoFrame
from ..config import FramesConfig
from ..frames.learned import open_learned, picture_features
from ..run.files import CALIBRATION, SPARSE
from ..run.folder import RunFolder
from ..source.opening import VideoSource
from ..source.sharpness import reduce_image
from ..structure.calibration import read_intrinsics
from ..structure.lens import Lens, calibrated_camera, make_lens, to_pycolmap
from ..system.progress import Progress
from ..system.wording import quoted
from ..types import Features
from .pictures import Pictures, load_shutter
from .pnp import MIN_INLIERS, solve_pose
from .relocalise import relocalise
from .state import FEATURE_SD, Sightings, TrackState

_SAMPLES, _ENOUGH, _LEAST = 24, 4, 2
"""Pictures of a video that are looked at; recognised ones that are enough to stop at, and that are needed."""
_FOCALS = np.geomspace(0.5, 2.0, 25)
_SAME_FOCAL, _BETTER = 0.08, 1.25
"""Relative difference that is no other camera; how many times as many agreeing points make it one. Seen on one clip of
a rendered room, which is told from itself enlarged by 1.3."""


def require_overlap(
    run: RunFolder, videos: Sequence[Path], settings: FramesConfig, seed: int, progress: Progress
) -> None:
    """Raise InputError for the first video in which fewer than two pictures are recognised, or whose pictures are
    recognised much better by another focal length than that of the run."""
    state = TrackState.from_backbone(run.load(SPARSE, "global_ba"), FEATURE_SD, shutter=load_shutter(run))
    pictures = _WithAdded(run, settings)
    lens = _lens_of(run, settings)
    for video in videos:
        recognised, seen = 0, []
        for features in progress.track(_features_of(video, settings, lens), f"looking at {video.name}", _SAMPLES):
            number = pictures.add(features)
            found, solved = relocalise(number, state, pictures, seed)
            seen.append(found)
            recognised += solved is not None and int(solved.inliers.sum()) >= MIN_INLIERS
            if recognised == _ENOUGH:
                break
        _require_same_focal(run, video, seen, state, seed)
        if recognised < _LEAST:
            raise InputError(
                f"{video}: of {len(seen)} of its images {recognised} show what {run.root} has seen, so nothing tells "
                "where it belongs. Film it from a place that the run has seen on, or make it a run of its own: "
                f"`msgs-slam reconstruct {quoted(video)}`. Nothing was changed"
            )


class _WithAdded(Pictures):
    """The run's pictures, and behind them those that are looked for in it."""

    def __init__(self, run: RunFolder, settings: FramesConfig) -> None:
        super().__init__(run, settings)
        self._added: dict[int, Features] = {}

    def add(self, features: Features) -> int:
        """The number by which these features are asked for from now on."""
        number = len(self.frames) + len(self._added)
        self._added[number] = features
        return number

    def features(self, frame_id: int) -> Features:
        """As of any picture."""
        return self._added[frame_id] if frame_id in self._added else super().features(frame_id)


def _lens_of(run: RunFolder, settings: FramesConfig) -> Lens:
    known = run.load(CALIBRATION)
    if not settings.intrinsics:
        return make_lens(calibrated_camera(known))
    size = known.intrinsics.width, known.intrinsics.height
    return make_lens(to_pycolmap(read_intrinsics(settings.intrinsics, *size).resized(*size)))


def _features_of(video: Path, settings: FramesConfig, lens: Lens) -> Iterator[Features]:
    """Of pictures spread over the video, in the run's undistorted pixels."""
    learned = open_learned(settings)
    for picture in _samples(video):
        rgb = lens.undistort_image(reduce_image(picture.rgb, settings.max_side))
        yield picture_features(rgb, None, settings, learned)


def _samples(video: Path) -> Iterator[VideoFrame]:
    source = VideoSource(video)
    count = max(source.expected_frames, _SAMPLES)
    return source.read(set(np.linspace(0, count - 1, _SAMPLES).round().astype(int).tolist()))


def _require_same_focal(run: RunFolder, video: Path, seen: Sequence[Sightings], state: TrackState, seed: int) -> None:
    """Look at the pictures of most matches through lenses of other focal lengths."""
    best = sorted((s for s in seen if len(s) >= MIN_INLIERS), key=len)[-_ENOUGH:]
    if not best:
        return
    camera = run.load(CALIBRATION).intrinsics

    def agreeing(factor: float) -> int:
        lens = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        solved = [solve_pose(s.xy, state.points[s.point], lens, seed) for s in best]
        return sum(int(found.inliers.sum()) for found in solved if found is not None)

    counts: NDArray[np.int64] = np.array([agreeing(f) for f in _FOCALS])
    factor, most = float(_FOCALS[counts.argmax()]), int(counts.max())
    if abs(factor - 1) > _SAME_FOCAL and most >= MIN_INLIERS and most > _BETTER * agreeing(1.0):
        raise InputError(
            f"{video}: it was taken by another camera, or zoomed: its focal length is about {factor * camera.fx:.0f} "
            f"px, that of {run.root} {camera.fx:.0f} px. Make it a run of its own: "
            f"`msgs-slam reconstruct {quoted(video)}`. Nothing was changed"
        )
