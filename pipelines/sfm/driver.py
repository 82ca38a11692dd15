"""Structure from motion over the keyframes: features, matches, poses and points, the camera."""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.textfile import read_json, write_json
from ..system.machine import WINDOW, release_free_memory, windows_of
from ..system.parallel import LruSequence, parallel_map
from ..types import Features, Vocabulary
from .adjust import adjust_model
from .candidates import GIVEN_ONLY, AdjustedModel, CandidateModels, KeyframeSet, pairs_within
from .components import cut, remove_keyframes, undetermined_cameras
from .consistency import MAX_DRIFT, ModelReport, judge
from .features import (
    GlobalDescriptors,
    compute_global_descriptors,
    far_apart,
    learn_vocabulary,
    loop_pairs,
    sequential_pairs,
)
from .flow import Picture, weakly_connected, with_bridges
from .given import bare_model, set_best_focal
from .joining import WindowModels, adjust_joined
from .lens import set_lens
from .matching import VerifiedPair, match_pair
from .rolling import NO_READOUT, Readout, RollingModel, adjust_rolling, read_readout, rectified_features
from .snapshots import features_name, pairs_name
from .two_views import require_parallax, why_no_structure

LEAST_PIECE, LOOP_CANDIDATES = 8, 4
"""Keyframes from which those that can be placed among each other alone make a piece; and how many that look alike each
keyframe is also matched with."""
_PAIRS_PER_BLOCK = 64
_FEATURES_SHARE = 0.25
"""Of the memory that there is: what has no room there is read again from the snapshot."""
Divide = Callable[[str, int, dict[str, NDArray]], None]


@dataclass(frozen=True)
class Structure:
    """An adjusted reconstruction (image i + 1 is keyframe i, all cameras are as camera 1) and how good it is.

    No point is seen from two of the report's components: the transform between them is unknown. `tried` are the pairs
    of keyframes that were matched, `pairs` those of them that obey one geometry. `pieces` are further models, in the
    same camera, of keyframes that the ones before could not place, each with a world and a unit of its own.
    `loose` were left out again: see `undetermined_cameras`.
    """

    model: pycolmap.Reconstruction
    report: ModelReport
    mapper: str
    focal_sd: float
    features: Sequence[Features]
    vocabulary: Vocabulary
    tried: list[tuple[int, int]]
    pairs: list[VerifiedPair]
    pieces: list[pycolmap.Reconstruction]
    readout: Readout = NO_READOUT
    loose: Sequence[int] = ()


@dataclass(frozen=True, kw_only=True)
class StructureFromMotion(CandidateModels):
    """`extract(frame_id)` gives a frame's features, `picture` what they are of, `match` the pairs of two frames' that
    are alike. time(frame_id): seconds at which a frame was taken; `given` (F, 4, 4): poses of all frames by another
    program, NaN where none. divide("features" | "pairs" | "windows", count, known) has so many of those left in the
    snapshots, by whoever does the tasks."""

    extract: Callable[[int], Features]
    picture: Callable[[int], Picture]
    time: Callable[[int], float]
    match: Callable[[Features, Features], NDArray[np.uint32]]
    threads: int
    memory: float = math.inf
    window: int = WINDOW
    divide: Divide = lambda *_: None
    given: NDArray[np.float64] | None = None

    def run(self, keyframe_ids: Sequence[int]) -> Structure:
        """Raises InputError when the keyframes have no parallax or too little in common."""
        self.divide("features", len(keyframe_ids), {})
        features = self.features_of(keyframe_ids)
        vocabulary = learn_vocabulary(features, self.seed)
        tried = self._proposed(features, vocabulary)
        features.forget()  # whoever does the tasks loads what it needs
        proposed = {"pairs": np.array(tried, np.int64).reshape(-1, 2)}
        self.divide("pairs", len(_blocks(tried)), proposed)
        windows = self._windows(len(features))
        self.divide("windows", len(windows) if len(windows) > 1 else 0, proposed)
        views, pairs = self._bridged(keyframe_ids, features, self.pairs_of(features, tried))
        features = views.features
        known_focal = self.camera.mean_focal_length() if self.camera.has_prior_focal_length else None
        if self.given is None:
            require_parallax(pairs, views.xy, (self.camera.width, self.camera.height), known_focal)
        at_once = len(windows) == 1
        found, apart = (self._calibrated(views, pairs), []) if at_once else self._in_windows(windows, views, pairs)
        found = found or self._as_given(views, pairs)
        if found is None:
            raise InputError(why_no_structure(len(features), pairs))
        found, pieces = self._largest_first(found, self._pieces(views, pairs, found.model, apart), views)
        report, loose = self._divided(found.model, views, pairs, found.readout)
        return Structure(
            found.model, report, found.mapper, found.focal_sd, features, vocabulary, tried, pairs, pieces,
            found.readout, loose,
        )  # fmt: skip

    def _divided(
        self, model: pycolmap.Reconstruction, views: KeyframeSet, pairs: Sequence[VerifiedPair], readout: Readout
    ) -> tuple[ModelReport, list[int]]:
        """Report on a model, cut into components that share no point, also where the scale changes within one, and list
        the loose keyframes taken out of it."""
        loose, breaks, range_of = list[int](), set[int](), self._range(views)
        straight = rectified_features(model, views.xy, views.times, readout)
        while True:
            report = judge(model, pairs, views.xy, *range_of, breaks, straight)
            cut(model, report.components, report.total)
            if report.drift.factor >= MAX_DRIFT and report.drift.at not in breaks:
                breaks.add(report.drift.at)
                continue
            found = [] if loose else self._loose(model, views, report)
            if not found:
                return report, loose
            loose = found
            remove_keyframes(model, loose)

    def _loose(self, model: pycolmap.Reconstruction, views: KeyframeSet, report: ModelReport) -> list[int]:
        """Keyframes whose poses the images do not determine: none of panoramas, which see all around."""
        if len(self.cam_from_rig) > 1 or not model.num_points3D():
            return []
        rolling = RollingModel(model, views.xy, views.times)
        bundle, _, pinhole = rolling.bundle()
        number = {i - 1: n for n, i in enumerate(rolling.images)}
        components = [[number[k] for k in component] for component in report.components]
        loose, _ = undetermined_cameras(bundle, pinhole, components, LEAST_PIECE, range(len(number)))
        return [rolling.images[n] - 1 for n in loose]

    def _as_given(self, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> AdjustedModel | None:
        """The given poses as they are, without a point."""
        if views.given is None:
            return None
        model = bare_model(self.camera, views.xy, views.given)
        if model.num_reg_images() < 2:
            return None
        if not self.camera.has_prior_focal_length and pairs:
            set_best_focal(model, pairs, views.xy)
        focal_sd = 0.0 if self.is_fixed else model.cameras[1].mean_focal_length()
        return AdjustedModel(model, GIVEN_ONLY, focal_sd, 0.0, NO_READOUT)

    def _windows(self, count: int) -> list[range]:
        """Which keyframes are mapped at once: of panoramas all."""
        return windows_of(count, self.window) if len(self.cam_from_rig) == 1 else [range(count)]

    def _in_windows(
        self, windows: Sequence[range], views: KeyframeSet, pairs: Sequence[VerifiedPair]
    ) -> tuple[AdjustedModel | None, list[pycolmap.Reconstruction]]:
        """Map a long recording window by window; return the joined model and the components apart from it."""
        views.features.forget()
        made, surest = WindowModels(), None
        for window in self.progress.track(windows, "windows", len(windows)):
            if (found := self._window(window, views, pairs)) is not None:
                made.add(found.model, window.start, found.focal_sd, found.readout)
                surest = found if surest is None or found.focal_sd < surest.focal_sd else surest
        if surest is None:
            return None, []
        camera, given = surest.model.cameras[1], read_readout(self.config.rolling_shutter)
        focal_sd = 0.0 if self.is_fixed else made.calibrate(camera)
        readout = made.readout() if given is None else given
        whole = replace(surest, model=made.largest().model(camera, views.xy), focal_sd=focal_sd)
        del surest, found  # not beside the model of all
        release_free_memory()
        together = partial(adjust_joined, narrowly=bool(views.weak))
        readout = together(whole.model, views.xy, views.times, readout, find_readout=given is None)
        others = made.others(whole.model.cameras[1], views.xy, whole.model, LEAST_PIECE)
        for other in others:
            together(other, views.xy, views.times, readout)
        return replace(whole, readout=readout), others

    def _window(self, window: range, views: KeyframeSet, pairs: Sequence[VerifiedPair]) -> AdjustedModel | None:
        """The model of one of several, made unless it is stored."""
        snapshots = self.snapshots.inside(f"window_{window.start:06d}_{window.stop:06d}")
        figures = snapshots.folder / "adjusted.json"

        def solve(_: Path) -> pycolmap.Reconstruction | None:
            of_window = replace(self, is_stated=False, snapshots=snapshots)
            if (found := of_window._calibrated(views.part(window), pairs_within(pairs, window))) is None:
                return None
            write_json(figures, [found.mapper, found.focal_sd, found.score, found.readout])
            return found.model

        if (model := snapshots.model("adjusted", solve)) is None:
            return None
        mapper, focal_sd, score, readout = read_json(figures, None)
        return AdjustedModel(model, mapper, focal_sd, score, tuple(readout))

    def map_windows(
        self, numbers: Iterable[int], keyframe_ids: Sequence[int], proposed: Sequence[tuple[int, int]]
    ) -> None:
        """Leave the models of some of several windows in the snapshots; all features and pairs are there."""
        features = self.features_of(keyframe_ids, range(0))
        views, pairs = self._bridged(keyframe_ids, features, self.pairs_of(features, proposed))
        for number in numbers:
            self._window(self._windows(len(keyframe_ids))[number], views, pairs)

    def _pieces(
        self,
        views: KeyframeSet,
        pairs: Sequence[VerifiedPair],
        model: pycolmap.Reconstruction,
        apart: Sequence[pycolmap.Reconstruction],
    ) -> list[pycolmap.Reconstruction]:
        """Map the keyframes that `model` leaves, besides those `apart`, in its camera, a window's worth at once."""
        camera, pieces = model.cameras[1], [*apart]
        camera.has_prior_focal_length = True
        placed = {i - 1 for m in (model, *apart) for i in m.reg_image_ids()}
        left, count = [k for k in range(len(views.xy)) if k not in placed], len(views.xy)
        most, numbers = len(self._windows(count)[0]), itertools.count(2)
        for first in range(0, len(left), most):
            pieces += self._pieces_of(set(left[first : first + most]), views, pairs, camera, numbers)
        return pieces

    def _pieces_of(
        self,
        left: set[int],
        views: KeyframeSet,
        pairs: Sequence[VerifiedPair],
        camera: pycolmap.Camera,
        numbers: Iterator[int],
    ) -> list[pycolmap.Reconstruction]:
        pieces: list[pycolmap.Reconstruction] = []
        for number in numbers:
            rest = [p for p in pairs if p.first in left and p.second in left]
            if len({k for p in rest for k in (p.first, p.second)}) < LEAST_PIECE:
                return pieces
            snapshots = self.snapshots.inside(f"piece_{number}")
            of_piece = replace(self, camera=camera, is_fixed=True, snapshots=snapshots)
            tried = [of_piece._map(views, rest, ("global",))]
            if tried[0] is None or not self._is_piece(tried[0][2]):
                tried.append(of_piece._map(views, rest, ("incremental",)))
            found = max(filter(None, tried), key=lambda f: (self._is_piece(f[2]), f[2].registered), default=None)
            if found is None or found[2].registered < LEAST_PIECE:
                return pieces
            piece = found[0]
            adjust_model(piece, refine_camera=False)
            report = judge(piece, rest, views.xy, *self._range(views))
            left -= {i - 1 for i in piece.reg_image_ids()}
            if self._is_piece(report):
                remove_keyframes(piece, [k for component in report.components[1:] for k in component])
                pieces.append(piece)
        return pieces

    def _is_piece(self, report: ModelReport) -> bool:
        return len(report.largest) >= LEAST_PIECE and report.is_consistent

    def _largest_first(
        self, found: AdjustedModel, pieces: list[pycolmap.Reconstruction], views: KeyframeSet
    ) -> tuple[AdjustedModel, list[pycolmap.Reconstruction]]:
        """Return the largest model, which calibrates all where it is surer, and the others; with one readout."""
        models = [found.model, *pieces]
        largest = max(models, key=lambda m: m.num_reg_images())
        done = largest if largest is found.model else None
        others = [m for m in models if m is not largest]
        if done is None and not self.is_fixed:
            again = pycolmap.Reconstruction(largest)
            set_lens(again.cameras[1], 1)
            if (focal_sd := adjust_model(again, refine_camera=True)) < found.focal_sd:
                largest, found = again, replace(found, focal_sd=focal_sd)
                for other in others:
                    other.cameras[1].params = again.cameras[1].params.tolist()
                    adjust_model(other, refine_camera=False)

        def rolled(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
            if model is done:
                return model
            again = adjust_rolling(model, views.xy, views.times, found.readout, refine_camera=False)
            return model if again is None else again[0]

        return replace(found, model=rolled(largest)), [rolled(m) for m in others]

    def features_of(self, keyframe_ids: Sequence[int], part: range | None = None) -> LruSequence[Features]:
        """Return the features of all keyframes; those of a `part` of them (all) are extracted at once."""

        def stored(frame_id: int) -> Features:
            return self.snapshots.value(features_name(frame_id), lambda: self.extract(frame_id))

        numbers = range(len(keyframe_ids)) if part is None else part
        found = parallel_map(stored, [keyframe_ids[k] for k in numbers], self.threads)
        room = _FEATURES_SHARE * self.memory
        features = LruSequence(len(keyframe_ids), lambda k: stored(keyframe_ids[k]), lambda f: f.nbytes, room)
        for k, value in zip(numbers, self.progress.track(found, "features", len(numbers)), strict=True):
            features.keep(k, value)
        return features

    def _proposed(self, features: LruSequence[Features], vocabulary: Vocabulary) -> list[tuple[int, int]]:
        descriptors, places = compute_global_descriptors(features, len(features), vocabulary), self._places(features)
        allowed = far_apart(len(features), self.config.overlap + 1, places)
        loops = loop_pairs(GlobalDescriptors((descriptors,)), allowed, LOOP_CANDIDATES)
        following = sequential_pairs(places, self.config.overlap)
        firsts = range(0, len(features), places)
        return sorted({*((n + i, n + j) for n in firsts for i, j in following), *loops})

    def pairs_of(
        self, features: LruSequence[Features], proposed: Sequence[tuple[int, int]], part: range | None = None
    ) -> list[VerifiedPair]:
        """Verify the proposed pairs, of a `part` of their blocks (all), and return those that obey one geometry."""
        blocks = _blocks(proposed)
        wanted = range(len(blocks)) if part is None else part

        def match(pair: tuple[int, int]) -> VerifiedPair | None:
            return match_pair(pair, (features[pair[0]], features[pair[1]]), self.camera, self.seed, self.match)

        def match_block(block: Sequence[tuple[int, int]]) -> list[VerifiedPair]:
            return [p for p in parallel_map(match, block, self.threads) if p is not None]

        numbered = self.progress.track(wanted, "matches", len(wanted))
        found = (self.snapshots.value(pairs_name(i), partial(match_block, blocks[i])) for i in numbered)
        return list(itertools.chain.from_iterable(found))

    def _bridged(
        self, keyframe_ids: Sequence[int], features: LruSequence[Features], pairs: list[VerifiedPair]
    ) -> tuple[KeyframeSet, list[VerifiedPair]]:
        """All views, with points followed through keyframes that hold the path's size badly."""
        weak = weakly_connected(pairs, len(features), self.config.overlap) if len(self.cam_from_rig) == 1 else []
        if weak:
            tracked = self.progress.track(weak, "weak keyframes", len(weak))
            stored = self.snapshots.inside("bridges")
            features, pairs = with_bridges(features, pairs, tracked, lambda k: self.picture(keyframe_ids[k]), stored)
        times = np.array([self.time(k) for k in keyframe_ids])
        given = None if self.given is None else self.given[list(keyframe_ids)]
        return KeyframeSet(features, [f.xy for f in features], times, weak, given), pairs


def _blocks(proposed: Sequence[tuple[int, int]]) -> list[Sequence[tuple[int, int]]]:
    return [proposed[i : i + _PAIRS_PER_BLOCK] for i in range(0, len(proposed), _PAIRS_PER_BLOCK)]
