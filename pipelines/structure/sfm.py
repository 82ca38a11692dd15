"""Structure from motion over the keyframes: features, matches, poses and points, the camera."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap
from numpy.typing import NDArray

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.config import FramesConfig
from msgs_slam.pipelines.correspondence.bridges import Picture, weak_keyframes, with_bridges
from msgs_slam.pipelines.correspondence.database import write_database
from msgs_slam.pipelines.correspondence.matching import VerifiedPair, match_pair
from msgs_slam.pipelines.correspondence.retrieval import (
    Looks,
    describe_all,
    far_apart,
    learn_vocabulary,
    loop_pairs,
    sequential_pairs,
)
from msgs_slam.pipelines.correspondence.snapshots import Snapshots
from msgs_slam.pipelines.geometry.rig import ONE_CAMERA
from msgs_slam.pipelines.structure.adjust import adjust
from msgs_slam.pipelines.structure.consistency import ModelReport, check_pairs, judge, without_misplaced
from msgs_slam.pipelines.structure.freeing import LEAST_BETTER, LEAST_GAIN_OF_FREEING, gain_of_freeing, unexplained
from msgs_slam.pipelines.structure.lens import FOCAL_GUESS, set_lens, unknown_camera
from msgs_slam.pipelines.structure.mappers import calibrate_focal, map_globally, map_incrementally
from msgs_slam.pipelines.structure.mend import mended
from msgs_slam.pipelines.structure.parallax import HOW_TO_FILM, require_parallax
from msgs_slam.pipelines.structure.rolling import (
    NO_READOUT,
    Readout,
    adjust_rolling,
    read_readout,
    straight_copy,
)
from msgs_slam.pipelines.structure.seams import cut, take_out
from msgs_slam.pipelines.structure.window_size import SIZE, windows_of
from msgs_slam.pipelines.structure.windows import Joined, adjust_joined
from msgs_slam.pipelines.system.memory import give_back
from msgs_slam.pipelines.system.progress import Progress
from msgs_slam.pipelines.system.streamed import Streamed
from msgs_slam.pipelines.types import Features, Vocabulary

_PAIRS_PER_BLOCK = 64
_FEATURES_SHARE = 0.25
"""Of the memory that there is: what has no room there is read again from the snapshot."""
_MIN_KEYFRAMES = 3
_MIN_POINTS = 30
LENS_HELD, NEIGHBOURS = "global-lens-held", "neighbours"
_UNSURE_FOCAL = 0.03
_AS_GOOD = 0.98
"""The second attempt's share of the first one's score, from which it is as good and its surer focal length decides."""
_Tried = tuple[pycolmap.Reconstruction, str, ModelReport]
"""A model, the mapper that made it, and how good it is."""
Ahead = Callable[[str, int, dict[str, NDArray]], None]
T = TypeVar("T")
R = TypeVar("R")


def nothing_ahead(name: str, count: int, known: dict[str, NDArray]) -> None:
    """All is done here."""


@dataclass(frozen=True)
class Structure:
    """An adjusted reconstruction (image i + 1 is keyframe i, all cameras are as camera 1) and how good it is.

    No point is seen from two of the report's parts: nothing tells how these lie to each other. `tried` are the pairs
    of keyframes that were matched, `pairs` those of them that obey one geometry. `pieces` are further models, in the
    same camera, of keyframes that the ones before could not place, each with a world and a unit of its own.
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


@dataclass(frozen=True)
class _Views:
    """What is known of the keyframes: features, their pixels (F, 2) again, which are needed when descriptors no longer
    are, times (K,) in seconds, and the numbers of those that hold the path's size badly."""

    features: Streamed[Features]
    xy: list[NDArray[np.float64]]
    times: NDArray[np.float64]
    weak: list[int]

    def part(self, window: range) -> _Views:
        """Of the keyframes of a window, counted from 0."""
        numbers = slice(window.start, window.stop)
        weak = [k - window.start for k in self.weak if k in window]
        return _Views(self.features.part(window), self.xy[numbers], self.times[numbers], weak)


@dataclass(frozen=True)
class _Adjusted:
    model: pycolmap.Reconstruction
    mapper: str
    focal_sd: float
    score: float
    readout: Readout


@dataclass(frozen=True)
class StructureFromMotion:
    """`extract(frame_id)` gives a frame's features, `picture` what they are of, `match` the pairs of two frames' that
    are alike; `camera` is what is known of the camera before, and `is_fixed` says that it is held; `is_stated` that it
    is only as long as the pictures do not contradict it.
    cam_from_rig (C, 3, 3): the keyframes come direction by direction, as `Rig` counts frames. time(frame_id): seconds
    at which a frame was taken. ahead("features" | "pairs" | "windows", count, known) may have others leave those in the
    snapshots beforehand."""

    config: FramesConfig
    camera: pycolmap.Camera
    is_fixed: bool
    extract: Callable[[int], Features]
    picture: Callable[[int], Picture]
    time: Callable[[int], float]
    match: Callable[[Features, Features], NDArray[np.uint32]]
    snapshots: Snapshots
    progress: Progress
    threads: int
    seed: int
    memory: float = math.inf
    window: int = SIZE
    ahead: Ahead = nothing_ahead
    is_stated: bool = False
    cam_from_rig: NDArray[np.float64] = field(default_factory=lambda: ONE_CAMERA.cam_from_rig)

    def run(self, keyframe_ids: Sequence[int]) -> Structure:
        """Raises InputError when the keyframes have no parallax or too little in common."""
        self.ahead("features", len(keyframe_ids), {})
        features = self.features_of(keyframe_ids)
        vocabulary = learn_vocabulary(features, self.seed)
        tried = self._proposed(features, vocabulary)
        proposed = {"pairs": np.array(tried, np.int64).reshape(-1, 2)}
        self.ahead("pairs", len(_blocks(tried)), proposed)
        views, pairs = self._bridged(keyframe_ids, features, self.pairs_of(features, tried))
        features = views.features
        self.ahead("windows", self._windows(len(features)), proposed)
        known_focal = self.camera.mean_focal_length() if self.camera.has_prior_focal_length else None
        require_parallax(pairs, views.xy, (self.camera.width, self.camera.height), known_focal)
        found = self._in_windows(views, pairs) or self._calibrated(views, pairs)
        if found is None:
            raise InputError(
                f"no structure could be found: {len(pairs)} pairs of {len(features)} views match. The views have too "
                f"little texture, blur or overlap. {HOW_TO_FILM}, slowly and in good light"
            )
        found, pieces = self._largest_first(found, self._pieces(views, pairs, found.model), views)
        report = judge(found.model, pairs, views.xy, self._places(features), self.config.overlap)
        cut(found.model, report.parts, report.total)
        return Structure(
            found.model, report, found.mapper, found.focal_sd, features, vocabulary, tried, pairs, pieces, found.readout
        )

    def _calibrated(self, views: _Views, pairs: Sequence[VerifiedPair]) -> _Adjusted | None:
        """The best model; of a stated camera the model of one that is found anew, where that explains the pictures
        much better, or where the stated one gives none."""
        held = self._self_calibrated(views, pairs)
        if not self.is_stated:
            return held
        if held is not None:
            straight = straight_copy(held.model, views.xy, views.times, held.readout)
            if gain_of_freeing(straight) < LEAST_GAIN_OF_FREEING:
                return held
        free = next(filter(None, (self._freed(name, views, pairs) for name in ("stated", "unknown"))), None)
        if held is None or free is None:
            return free or held
        contradicted = unexplained(held.model, pairs, views.xy)
        is_better = unexplained(free.model, pairs, views.xy) < (1 - LEAST_BETTER) * contradicted
        return free if is_better and free.score >= _AS_GOOD * held.score else held

    def _freed(self, start: str, views: _Views, pairs: Sequence[VerifiedPair]) -> _Adjusted | None:
        """The model of a camera that is found anew, from the stated focal length or from nothing."""
        is_prior, (width, height) = start == "stated", (self.camera.width, self.camera.height)
        focal = self.camera.mean_focal_length() if is_prior else FOCAL_GUESS * max(width, height)
        snapshots = Snapshots(self.snapshots.folder / f"freed_from_{start}")
        snapshots.folder.mkdir(exist_ok=True)
        camera = unknown_camera(width, height, focal, is_prior)
        return replace(self, camera=camera, is_fixed=False, is_stated=False, snapshots=snapshots)._self_calibrated(
            views, pairs
        )

    def _self_calibrated(self, views: _Views, pairs: Sequence[VerifiedPair]) -> _Adjusted | None:
        """The best model; of two where the first is not sure of its camera."""
        found = self._adjusted(views, pairs, ("global", "incremental"))
        if found is not None and found.focal_sd > _UNSURE_FOCAL * found.model.cameras[1].mean_focal_length():
            # A lens that is bent before the poses stand can run away with the focal length.
            again = self._adjusted(views, pairs, (LENS_HELD,))
            if again is not None and again.focal_sd < found.focal_sd and again.score >= _AS_GOOD * found.score:
                return again
        return found

    def _in_windows(self, views: _Views, pairs: Sequence[VerifiedPair]) -> _Adjusted | None:
        """Of a long recording the models of its windows, joined, in the camera of the window that is surest of it.
        None of a shorter one, of panoramas, and where the windows do not hang together."""
        windows = windows_of(len(views.xy), self.window)
        if not self._windows(len(views.xy)):
            return None
        views.features.forget()
        joined, surest = Joined(), None
        for window in self.progress.track(windows, "windows", len(windows)):
            found = self._window(window, views.part(window), pairs)
            if found is None or not joined.add(found.model, window.start):
                return None
            surest = found if surest is None or found.focal_sd < surest.focal_sd else surest
        assert surest is not None
        whole = replace(surest, model=joined.model(surest.model.cameras[1], views.xy))
        del joined, surest, found  # not beside the model of all
        give_back()
        adjust_joined(whole.model, views.xy, views.times, whole.readout, pairs, windows, bool(views.weak))
        return whole

    def _windows(self, count: int) -> int:
        """How many there are; 0 where all is made at once."""
        windows = len(windows_of(count, self.window))
        return windows if windows > 1 and len(self.cam_from_rig) == 1 else 0

    def _window(self, window: range, views: _Views, pairs: Sequence[VerifiedPair]) -> _Adjusted | None:
        inside = [replace(p, first=p.first - window.start, second=p.second - window.start)
                  for p in pairs if p.first in window and p.second in window]  # fmt: skip
        snapshots = Snapshots(self.snapshots.folder / f"window_{window.start:06d}_{window.stop:06d}")
        snapshots.folder.mkdir(exist_ok=True)
        return replace(self, is_stated=False, snapshots=snapshots)._calibrated(views, inside)

    def map_window(self, number: int, keyframe_ids: Sequence[int], proposed: Sequence[tuple[int, int]]) -> None:
        """Leave the models of a window in the snapshots; all features and pairs are there."""
        window, features = windows_of(len(keyframe_ids), self.window)[number], self.features_of(keyframe_ids, range(0))
        views, pairs = self._bridged(keyframe_ids, features, self.pairs_of(features, proposed))
        self._window(window, views.part(window), pairs)

    def _places(self, views: Sequence[object]) -> int:
        return len(views) // len(self.cam_from_rig)

    def _adjusted(self, views: _Views, pairs: Sequence[VerifiedPair], mappers: Sequence[str]) -> _Adjusted | None:
        """The best model, its camera calibrated unless it is fixed; with the readout of a rolling shutter, where one is
        given or the model shows it."""
        found = self._map(views, pairs, mappers)
        if found is None:
            return None
        model, mapper, report = found
        readout = NO_READOUT if len(self.cam_from_rig) > 1 else read_readout(self.config.rolling_shutter)
        rolling = adjust_rolling(model, views.xy, views.times, readout, not self.is_fixed, bool(views.weak))
        if rolling is not None:
            return _Adjusted(rolling[0], mapper, rolling[2], report.score, rolling[1])
        return _Adjusted(model, mapper, adjust(model, not self.is_fixed, bool(views.weak)), report.score, NO_READOUT)

    def _pieces(
        self, views: _Views, pairs: Sequence[VerifiedPair], model: pycolmap.Reconstruction
    ) -> list[pycolmap.Reconstruction]:
        """Sound models of the keyframes that `model` leaves, in its camera, until there is none of the least size."""
        camera = model.cameras[1]
        camera.has_prior_focal_length = True
        left = set(range(len(views.xy))) - {i - 1 for i in model.reg_image_ids()}
        pieces: list[pycolmap.Reconstruction] = []
        number = 1
        while True:
            number += 1
            rest = [p for p in pairs if p.first in left and p.second in left]
            if len({k for p in rest for k in (p.first, p.second)}) < self.config.least_piece:
                return pieces
            snapshots = Snapshots(self.snapshots.folder / f"piece_{number}")
            snapshots.folder.mkdir(exist_ok=True)
            alone = replace(self, camera=camera, is_fixed=True, snapshots=snapshots)
            tried = [alone._map(views, rest, ("global",))]
            if tried[0] is None or not self._is_piece(tried[0][2]):
                tried.append(alone._map(views, rest, ("incremental",)))
            found = max(filter(None, tried), key=lambda f: (self._is_piece(f[2]), f[2].registered), default=None)
            if found is None or found[2].registered < self.config.least_piece:
                return pieces
            piece = found[0]
            adjust(piece, refine_camera=False)
            report = judge(piece, rest, views.xy, self._places(views.xy), self.config.overlap)
            left -= {i - 1 for i in piece.reg_image_ids()}
            if self._is_piece(report):
                take_out(piece, [k for part in report.parts[1:] for k in part])
                pieces.append(piece)

    def _is_piece(self, report: ModelReport) -> bool:
        return len(report.parts[0]) >= self.config.least_piece and report.is_consistent

    def _largest_first(
        self, found: _Adjusted, pieces: list[pycolmap.Reconstruction], views: _Views
    ) -> tuple[_Adjusted, list[pycolmap.Reconstruction]]:
        """The largest model, which calibrates the camera of all where it is surer of it, and the others; all with the
        readout of the first."""
        models = [found.model, *pieces]
        largest = max(models, key=lambda m: m.num_reg_images())
        done = largest if largest is found.model else None
        others = [m for m in models if m is not largest]
        if done is None and not self.is_fixed:
            again = pycolmap.Reconstruction(largest)
            set_lens(again.cameras[1], 1)
            if (focal_sd := adjust(again, refine_camera=True)) < found.focal_sd:
                largest, found = again, replace(found, focal_sd=focal_sd)
                for other in others:
                    other.cameras[1].params = again.cameras[1].params.tolist()
                    adjust(other, refine_camera=False)

        def rolled(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
            if model is done:
                return model
            again = adjust_rolling(model, views.xy, views.times, found.readout, refine_camera=False)
            return model if again is None else again[0]

        return replace(found, model=rolled(largest)), [rolled(m) for m in others]

    def features_of(self, keyframe_ids: Sequence[int], part: range | None = None) -> Streamed[Features]:
        """Of all keyframes; those of a `part` of them (all) are made at once."""

        def stored(frame_id: int) -> Features:
            return self.snapshots.features(frame_id, lambda: self.extract(frame_id))

        numbers = range(len(keyframe_ids)) if part is None else part
        found = parallel_map(stored, [keyframe_ids[k] for k in numbers], self.threads)
        room = _FEATURES_SHARE * self.memory
        features = Streamed(len(keyframe_ids), lambda k: stored(keyframe_ids[k]), lambda f: f.nbytes, room)
        for k, value in zip(numbers, self.progress.track(found, "features", len(numbers)), strict=True):
            features.keep(k, value)
        return features

    def _proposed(self, features: Streamed[Features], vocabulary: Vocabulary) -> list[tuple[int, int]]:
        looks, places = describe_all(features, len(features), vocabulary), self._places(features)
        allowed = far_apart(len(features), self.config.overlap + 1, places)
        loops = loop_pairs(Looks((looks,)), allowed, self.config.loop_candidates)
        following = sequential_pairs(places, self.config.overlap)
        firsts = range(0, len(features), places)
        return sorted({*((n + i, n + j) for n in firsts for i, j in following), *loops})

    def pairs_of(
        self, features: Streamed[Features], proposed: Sequence[tuple[int, int]], part: range | None = None
    ) -> list[VerifiedPair]:
        """Those of the proposed pairs that obey one geometry; of a `part` of their blocks (all)."""
        blocks = _blocks(proposed)
        wanted = range(len(blocks)) if part is None else part

        def match(pair: tuple[int, int]) -> VerifiedPair | None:
            return match_pair(pair, (features[pair[0]], features[pair[1]]), self.camera, self.seed, self.match)

        def match_block(block: Sequence[tuple[int, int]]) -> list[VerifiedPair]:
            return [p for p in parallel_map(match, block, self.threads) if p is not None]

        numbered = self.progress.track(wanted, "matches", len(wanted))
        found = (self.snapshots.pairs(i, lambda b=blocks[i]: match_block(b)) for i in numbered)  # type: ignore[misc]
        return list(itertools.chain.from_iterable(found))

    def _bridged(
        self, keyframe_ids: Sequence[int], features: Streamed[Features], pairs: list[VerifiedPair]
    ) -> tuple[_Views, list[VerifiedPair]]:
        """All views, with points followed through keyframes that hold the path's size badly."""
        weak = weak_keyframes(pairs, len(features), self.config.overlap) if len(self.cam_from_rig) == 1 else []
        if weak:
            told = self.progress.track(weak, "weak keyframes", len(weak))
            stored = Snapshots(self.snapshots.folder / "bridges")
            features, pairs = with_bridges(features, pairs, told, lambda k: self.picture(keyframe_ids[k]), stored)
        return _Views(features, [f.xy for f in features], np.array([self.time(k) for k in keyframe_ids]), weak), pairs

    def _map(
        self,
        views: _Views,
        pairs: Sequence[VerifiedPair],
        mappers: Sequence[str] = ("global", "incremental"),
    ) -> _Tried | None:
        """The best of the mappers' models, None where none is any; the next is only made when those before it are
        doubtful."""
        best: _Tried | None = None
        wanted = [name for name in mappers if self.config.mapper in ("auto", name)]
        for name in self.progress.track(wanted, "camera model", len(wanted)):
            if best is not None and (best[2].is_sound or best[1].startswith(NEIGHBOURS)):
                break
            found = self._tried(name, views, pairs, pairs)
            unfolded = None if found is None or not found[2].contradicted else self._unfolded(views, pairs)
            # Of two alike the one before.
            best = max(filter(None, (best, found, unfolded)), key=lambda f: f[2].score, default=None)
        if best is None or best[2].registered < min(_MIN_KEYFRAMES, best[2].total) or best[2].points < _MIN_POINTS:
            return None
        return best

    def _unfolded(self, views: _Views, pairs: Sequence[VerifiedPair]) -> _Tried | None:
        """The model of a path that things which repeat have folded: made of what neighbours share, for little repeats
        within so few pictures, and once more with the other pairs that agree with that, which close its loops."""
        total, reach = self._places(views.xy), self.config.overlap

        def among(places: set[tuple[int, int]]) -> list[VerifiedPair]:
            return [p for p in pairs if (p.first % total, p.second % total) in places]

        near = {(i, j) for i in range(total) for j in range(max(i - reach, 0), min(i + reach + 1, total))}
        straight = self._tried(NEIGHBOURS, views, among(near), pairs)
        if straight is None or straight[2].contradicted:
            return straight
        agreeing = {(c.first, c.second) for c in check_pairs(straight[0], pairs, views.xy, total) if c.agrees}
        closing = near | agreeing | {(j, i) for i, j in agreeing}
        closed = self._tried(f"{NEIGHBOURS}-closed", views, among(closing), pairs)
        return straight if closed is None or closed[2].score < straight[2].score else closed

    def _tried(
        self, name: str, views: _Views, pairs: Sequence[VerifiedPair], every: Sequence[VerifiedPair]
    ) -> _Tried | None:
        """A mapper's model of these pairs, judged by `every` one."""
        model = self.snapshots.model(name, lambda work: self._run_mapper(name, work, views.features, pairs))
        if model is None:
            return None
        seen = every, views.xy, self._places(views.xy), self.config.overlap
        model = without_misplaced(model, *seen)
        report = judge(model, *seen)
        if views.weak:
            model, report = mended(model, report, *seen, self.seed)
        return model, name, report

    def _run_mapper(
        self, name: str, work: Path, features: Streamed[Features], pairs: Sequence[VerifiedPair]
    ) -> pycolmap.Reconstruction | None:
        database = work / "database.db"
        names = [f"{i:06d}" for i in range(len(features))]
        write_database(database, self.camera, names, features, pairs, self.cam_from_rig)
        features.forget()  # the mapper needs the memory, and no descriptor
        if not self.camera.has_prior_focal_length:
            calibrate_focal(database, self.seed)
        if name == "incremental":
            return map_incrementally(database, work, not self.is_fixed, self.seed)
        return map_globally(database, work, not self.is_fixed, self.seed, bend_lens=name != LENS_HELD)


def _blocks(proposed: Sequence[tuple[int, int]]) -> list[Sequence[tuple[int, int]]]:
    return [proposed[i : i + _PAIRS_PER_BLOCK] for i in range(0, len(proposed), _PAIRS_PER_BLOCK)]


def parallel_map(function: Callable[[T], R], items: Iterable[T], threads: int) -> Iterator[R]:
    """`map` on threads, in order; at most a few results wait in memory."""
    items = iter(items)
    with ThreadPoolExecutor(max(1, threads)) as pool:
        waiting = [pool.submit(function, item) for item in itertools.islice(items, 2 * max(1, threads))]
        while waiting:
            yield waiting.pop(0).result()
            waiting.extend(pool.submit(function, item) for item in itertools.islice(items, 1))
