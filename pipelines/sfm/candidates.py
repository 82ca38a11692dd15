"""Models of matched keyframes that could be the structure, and which of them is.

A mapper's model is judged by all matches; where it is doubtful the next one is asked, and where neighbouring images
contradict it, it is made again from what these share.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..config import FramesConfig
from ..geometry.camera import ONE_CAMERA
from ..system.parallel import LruSequence
from ..system.progress import Progress
from ..types import Features
from .adjust import adjust_model
from .consistency import (
    MIN_BETTER,
    MIN_SELF_CALIBRATION_GAIN,
    ModelReport,
    judge,
    self_calibration_gain,
    unexplained,
)
from .given import posed_model
from .lens import FOCAL_GUESS, unknown_camera
from .matching import VerifiedPair, write_database
from .rolling import FILM, NO_READOUT, Readout, adjust_rolling, read_readout, straight_copy
from .snapshots import Snapshots
from .two_views import calibrated

_ANY_DISTORTION = 1e9
"""COLMAP takes a camera with a coefficient above 1 for one that ran away, and places no view of it. One that is held
cannot run away, and real ones have such: the third radial one of a Kinect is 1.16."""

_MIN_KEYFRAMES = 3
_MIN_POINTS = 30
NEIGHBOURS, GIVEN, GIVEN_ONLY = "neighbours", "given", "given-alone"
_AS_GOOD = 0.98
"""Share of a model's score from which another is as good: one of a camera found anew, one of given poses."""
_UNSURE = 0.03
"""Relative deviation of a focal length from which another start is tried: two of three that start from a wrong one are
at 0.05 and 5, most others at 0.001 to 0.02."""
_POOR = 0.5
"""Score of a model below which another start is tried, too: with a focal length that is 41 % off, at a stated deviation
of 0.2 %, a walk through a made home has 0.27, and 0.38 from the start that ends at 0.7 %."""
_TRACKS, _TRACKS_IN_A_CHAIN = 150, 300
"""Tracks, the longest, by which the global mapper places each view; the last adjustment has all of them again. Of nine
recordings 150 give poses as good as 300 in two thirds of the time. Where only neighbours share any they do not: a
corridor that is 0.3 cm off with 300 is 3 m off with 150, too far for its loops to close."""
_STRETCH, _STARTS = 40, (0.6, 0.7, 0.8, 0.95, 1.15, 1.4)
"""Keyframes in a row, and focal lengths in longer sides from which they are mapped: where a camera turns on the spot,
one that is a fifteenth too long makes a flat model that no adjustment opens, one as much too short is mended."""
_ScoredModel = tuple[pycolmap.Reconstruction, str, ModelReport]
"""A model, the mapper that made it, and how good it is."""


def _selection_score(tried: _ScoredModel) -> float:
    """Ranking score; models from given poses win ties."""
    return tried[2].score / (_AS_GOOD if tried[1].startswith(GIVEN) else 1.0)


@dataclass(frozen=True)
class KeyframeSet:
    """Keyframes as structure from motion sees them: features, their pixels (F, 2) again for when descriptors are
    dropped, times (K,) in seconds, the numbers of those that constrain scale weakly, and the user's poses (K, 4, 4),
    NaN where none, if any."""

    features: LruSequence[Features]
    xy: list[NDArray[np.float64]]
    times: NDArray[np.float64]
    weak: list[int]
    given: NDArray[np.float64] | None = None

    def part(self, window: range) -> KeyframeSet:
        """Select the keyframes of a window, renumbered from 0."""
        numbers = slice(window.start, window.stop)
        weak = [k - window.start for k in self.weak if k in window]
        given = None if self.given is None else self.given[numbers]
        return KeyframeSet(self.features.part(window), self.xy[numbers], self.times[numbers], weak, given)


@dataclass(frozen=True)
class AdjustedModel:
    model: pycolmap.Reconstruction
    mapper: str
    focal_sd: float
    score: float
    readout: Readout


def pairs_within(pairs: Sequence[VerifiedPair], part: range) -> list[VerifiedPair]:
    """Select the pairs of keyframes of a part, renumbered from 0."""
    inside = (p for p in pairs if p.first in part and p.second in part)
    return [replace(p, first=p.first - part.start, second=p.second - part.start) for p in inside]


def _better(
    first: AdjustedModel | None, second: AdjustedModel | None, views: KeyframeSet, pairs: Sequence[VerifiedPair]
) -> AdjustedModel | None:
    """Return the first of two models unless only the second exists or explains clearly more and as many views."""
    if first is None or second is None:
        return first or second
    left = unexplained(second.model, pairs, views.xy) < (1 - MIN_BETTER) * unexplained(first.model, pairs, views.xy)
    return second if left and second.score >= _AS_GOOD * first.score else first


@dataclass(frozen=True, kw_only=True)
class CandidateModels:
    """Inputs of candidate models besides the keyframes: `camera` is the prior, `is_fixed` holds it, `is_stated` holds
    it unless the images contradict it. `frame_interval`: seconds from one image of the source to the next, 0 where its
    times are unknown; no readout is longer. cam_from_rig (C, 3, 3): keyframes are ordered direction by direction, as in
    `Rig`."""

    config: FramesConfig
    camera: pycolmap.Camera
    is_fixed: bool
    snapshots: Snapshots
    progress: Progress
    seed: int
    is_stated: bool = False
    frame_interval: float = 0.0
    cam_from_rig: NDArray[np.float64] = field(default_factory=lambda: ONE_CAMERA.cam_from_rig)

    def _calibrated(self, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> AdjustedModel | None:
        """Return the best model, self-calibrated where that explains much more than the stated camera does."""
        held = self._best(views, pairs)
        if not self.is_stated:
            return held
        if held is not None:
            straight = straight_copy(held.model, views.xy, views.times, held.readout)
            if self_calibration_gain(straight) < MIN_SELF_CALIBRATION_GAIN:
                return held
        free = next(filter(None, (self._self_calibrate(name, views, pairs) for name in ("stated", "unknown"))), None)
        return _better(held, free, views, pairs)

    def _self_calibrate(self, start: str, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> AdjustedModel | None:
        """The model of a camera that is found anew, from the stated focal length or from nothing."""
        is_prior, (width, height) = start == "stated", (self.camera.width, self.camera.height)
        focal = self.camera.mean_focal_length() if is_prior else FOCAL_GUESS * max(width, height)
        snapshots = self.snapshots.inside(f"freed_from_{start}")
        camera = unknown_camera(width, height, focal, is_prior)
        return replace(self, camera=camera, is_fixed=False, is_stated=False, snapshots=snapshots)._best(views, pairs)

    def _best(self, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> AdjustedModel | None:
        """Return the best adjusted model; where the focal length that pairs tell leaves it unsure, or poor, also from
        one that a stretch of the path tells."""
        found = self._adjusted(views, pairs)
        if found is None or self.camera.has_prior_focal_length:
            return found
        if found.score >= _POOR and found.focal_sd < _UNSURE * found.model.cameras[1].mean_focal_length():
            return found
        camera = self._by_stretch(views, pairs)
        if camera is None:
            return found
        start = replace(self, camera=camera, snapshots=self.snapshots.inside("from_stretch"))
        other = start._adjusted(views, pairs, ("global",))  # the incremental mapper takes minutes to find the same
        return _better(found, other, views, pairs)

    def _by_stretch(self, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> pycolmap.Camera | None:
        """The camera that explains the matches of the best connected keyframes in a row best, None where none does."""
        steps, count = {p.first: len(p.matches) for p in pairs if p.second == p.first + 1}, len(views.xy)
        rows = [range(k, min(k + _STRETCH, count)) for k in range(0, max(count - _STRETCH, 0) + 1, _STRETCH // 4)]
        stretch = max(rows, key=lambda row: min((steps.get(k, 0) for k in row[:-1]), default=0))
        part, inside, tried = views.part(stretch), pairs_within(pairs, stretch), list[pycolmap.Reconstruction]()
        width, height = self.camera.width, self.camera.height
        for number, share in enumerate(_STARTS):
            camera = unknown_camera(width, height, share * max(width, height), is_prior=True)
            snapshots = self.snapshots.inside(f"focal_{number}")
            held = replace(self, camera=camera, is_fixed=True, snapshots=snapshots)
            found = held._build_model("global", part, inside, inside)
            if found is not None and found[2].registered >= _MIN_KEYFRAMES and found[2].points >= _MIN_POINTS:
                adjust_model(found[0], refine_camera=True)
                tried.append(found[0])
        if not tried:
            return None
        best = min(tried, key=lambda m: unexplained(m, inside, part.xy) / m.num_reg_images())
        return unknown_camera(width, height, best.cameras[1].mean_focal_length(), is_prior=True)

    def _adjusted(
        self, views: KeyframeSet, pairs: Sequence[VerifiedPair], mappers: Sequence[str] = ("global", "incremental")
    ) -> AdjustedModel | None:
        """Return the best adjusted model, with the readout of a rolling shutter that is given or found."""
        found = self._map(views, pairs, (*mappers, GIVEN))
        if found is None:
            return None
        model, mapper, report = found
        rolling = adjust_rolling(
            model, views.xy, views.times, self._readout(), not self.is_fixed, bool(views.weak), self.frame_interval
        )
        if rolling is not None:
            return AdjustedModel(rolling[0], mapper, rolling[2], report.score, rolling[1])
        focal_sd = adjust_model(model, not self.is_fixed, bool(views.weak))
        return AdjustedModel(model, mapper, focal_sd, report.score, NO_READOUT)

    def _readout(self) -> Readout | None:
        """Return the readout to adjust with, None for one to be found: not of panoramas, nor without times."""
        given = read_readout(self.config.rolling_shutter)
        return NO_READOUT if len(self.cam_from_rig) > 1 or (given is None and not self.frame_interval) else given

    def _map(
        self, views: KeyframeSet, pairs: Sequence[VerifiedPair], mappers: Sequence[str] = ("global", "incremental")
    ) -> _ScoredModel | None:
        """Return the best of the mappers' models; the next is only made when those before it are doubtful."""
        best: _ScoredModel | None = None
        possible = {GIVEN} if views.given is not None else set()
        possible |= {name for name in mappers if name != GIVEN and self.config.mapper in ("auto", name)}
        wanted = [name for name in mappers if name in possible]
        for name in self.progress.track(wanted, "camera model", len(wanted)):
            if best is not None and (best[2].is_sound or (best[1].startswith(NEIGHBOURS) and name != GIVEN)):
                continue
            found = self._build_model(name, views, pairs, pairs)
            if found is not None and (name == GIVEN or (found[2].is_consistent and not found[2].is_whole)):
                found = self._register_remaining(found, views, pairs, pairs)
            folded = found is not None and (found[2].contradicted or found[2].leaps)
            unfolded = self._remap_from_neighbours(views, pairs) if folded else None
            # Of two alike the one before, but the given poses are evidence that no match is.
            best = max(filter(None, (best, found, unfolded)), key=_selection_score, default=None)
        if best is None or best[2].registered < min(_MIN_KEYFRAMES, best[2].total) or best[2].points < _MIN_POINTS:
            return None
        return best

    def _remap_from_neighbours(self, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> _ScoredModel | None:
        """Map from neighbours alone, among which little repeats; tracking closes the loops."""
        total, reach = self._places(views.xy), self.config.overlap
        near = [p for p in pairs if abs(p.first % total - p.second % total) <= reach]
        straight = self._build_model(NEIGHBOURS, views, near, pairs)
        if straight is None or straight[2].contradicted:
            return straight
        return self._register_remaining(straight, views, pairs, near)

    def _register_remaining(
        self, found: _ScoredModel, views: KeyframeSet, every: Sequence[VerifiedPair], known: Sequence[VerifiedPair]
    ) -> _ScoredModel:
        """Register remaining keyframes incrementally where that raises the score; it was made from pairs `known`."""
        left = set(range(len(views.xy))) - {i - 1 for i in found[0].reg_image_ids()}
        more = [p for p in every if p.first in left or p.second in left]
        if not more:
            return found
        pairs = sorted({(p.first, p.second): p for p in (*known, *more)}.values(), key=lambda p: (p.first, p.second))
        grown = self._build_model(f"{found[1]}-grown", views, pairs, every, found[0])
        return found if grown is None or grown[2].score < found[2].score else grown

    def _build_model(
        self,
        name: str,
        views: KeyframeSet,
        pairs: Sequence[VerifiedPair],
        every: Sequence[VerifiedPair],
        start: pycolmap.Reconstruction | None = None,
    ) -> _ScoredModel | None:
        """A mapper's model of these pairs, judged by `every` one; one to `start` from is added to."""
        model = self.snapshots.model(name, lambda work: self._run_mapper(name, work, views, pairs, start))
        if model is None:
            return None
        return model, name, judge(model, every, views.xy, *self._range(views))

    def _run_mapper(
        self,
        name: str,
        work: Path,
        views: KeyframeSet,
        pairs: Sequence[VerifiedPair],
        start: pycolmap.Reconstruction | None,
    ) -> pycolmap.Reconstruction | None:
        if name == GIVEN:
            assert views.given is not None
            return posed_model(self.camera, views.xy, views.given, pairs, not self.is_fixed, self.seed)
        features, database = views.features, work / "database.db"
        names = [f"{i:06d}" for i in range(len(features))]
        camera = self.camera
        if start is None:
            camera, pairs = calibrated(camera, pairs, views.xy)
        write_database(database, camera, names, features, pairs, self.cam_from_rig)
        features.forget()  # the mapper needs the memory, and no descriptor
        if start is not None:
            return map_incrementally(database, work, False, self.seed, start)
        if name == "incremental":
            return map_incrementally(database, work, not self.is_fixed, self.seed)
        tracks = _TRACKS_IN_A_CHAIN if name == NEIGHBOURS else _TRACKS
        return map_globally(database, work, not self.is_fixed, self.seed, tracks)

    def _range(self, views: KeyframeSet) -> tuple[int, int, NDArray[np.float64] | None]:
        """How many places there are, how far a neighbour is, and the times of a film: see `judge`."""
        places = self._places(views.xy)
        return places, self.config.overlap, views.times[:places] if 0 < self.frame_interval < FILM else None

    def _places(self, views: Sequence[object]) -> int:
        return len(views) // len(self.cam_from_rig)


# pycolmap reports each step on stderr, through the progress bars; failures are reported by the caller.
pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
# Its import makes a process that is asked to end print a stack trace first: back to what there was before.
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is not None:
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def map_globally(
    database: Path, work: Path, refine_camera: bool, seed: int, tracks_per_view: int = _TRACKS
) -> pycolmap.Reconstruction | None:
    """Pose all images at once (Pan et al., Global Structure-from-Motion Revisited, ECCV 2024); None on failure."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.refine_focal_length = refine_camera
    mapper.bundle_adjustment.refine_extra_params = refine_camera
    mapper.refine_sensor_from_rig = mapper.bundle_adjustment.refine_sensor_from_rig = False
    mapper.track_required_tracks_per_view, mapper.ba_num_iterations = tracks_per_view, 2
    if not refine_camera:
        mapper.retriangulation.max_extra_param = _ANY_DISTORTION
    return _largest(pycolmap.global_mapping(database, work, work, options))


def map_incrementally(
    database: Path, work: Path, refine_camera: bool, seed: int, start: pycolmap.Reconstruction | None = None
) -> pycolmap.Reconstruction | None:
    """Pose image by image (Schönberger and Frahm, Structure-from-Motion Revisited, CVPR 2016); None on failure. A model
    of images in the database to `start` from keeps its poses; others are added to it."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = seed
    options.extract_colors = False
    options.min_model_size = 3
    options.ba_refine_sensor_from_rig = False
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = refine_camera
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = refine_camera
    if not refine_camera:
        options.max_extra_param = options.mapper.max_extra_param = options.triangulation.max_extra_param = (
            _ANY_DISTORTION
        )
    if start is None:
        return _largest(pycolmap.incremental_mapping(database, work, work, options))
    options.fix_existing_frames, options.multiple_models = True, False
    (before := work / "start").mkdir()
    start.write_binary(before)
    return _largest(pycolmap.incremental_mapping(database, work, work, options, before))


def _largest(models: dict[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    usable = [m for m in models.values() if m.num_reg_images() >= 2 and m.num_points3D() > 0]
    return max(usable, key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
