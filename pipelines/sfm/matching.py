"""Feature matches of two keyframes, and their geometric verification."""

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from ..system.jit import kernel
from ..types import Features

_SIFT, _LEARNED = (0.8, 0.7), (1.0, 0.555)
"""Of the angle between two descriptors that match: as a share of the next best one's (Lowe), and in radians."""
Descriptors = NDArray[np.uint8] | NDArray[np.int8]
_MAX_ERROR, MIN_INLIERS = 2.0, 15
"""Pixels within which a match obeys a geometry, and how many have to."""
_ABREAST = 32
"""Columns that are compared side by side: two vectors of the widest there are."""
_BELOW_ALL = -(2**24)
"""Below all products of descriptors, which are whole numbers that a float has exactly."""
_ROWS = 512
"""Of the table of all products: with as many columns as an image has features they stay in the cache."""
_FIRST_TRIALS, _NEARLY = 300, 0.8
"""Trials of the first look at a pair, and its share of the least inliers: chosen on two recordings."""


@dataclass(frozen=True)
class VerifiedPair:
    """Two keyframes (indices into the keyframes, first < second) whose matches obey one geometry.

    matches (M, 2) uint32 feature indices; `config` is pycolmap's TwoViewGeometryConfiguration as a number.
    matrices (3, 3, 3) float64 are F, E and H, zero where the configuration has none.
    """

    first: int
    second: int
    matches: NDArray[np.uint32]
    config: int
    matrices: NDArray[np.float64]


def match_descriptors(
    first: Descriptors, second: Descriptors, limits: tuple[float, float] | None = None
) -> NDArray[np.uint32]:
    """(M, 2) mutual nearest neighbours that pass Lowe's ratio test, sorted by the first index; `limits` are the largest
    ratio and angle, those of the kind of descriptor unless given."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.uint32)
    best, score, runner_up, best_back = _two_nearest(first, second)
    is_sift = first.dtype == np.uint8
    max_ratio, max_angle = limits or (_SIFT if is_sift else _LEARNED)
    norm = Features.NORM if is_sift else Features.SIGNED_NORM
    angle = np.arccos(np.clip(score / norm**2, 0, 1))
    next_angle = np.arccos(np.clip(runner_up / norm**2, 0, 1))
    index = np.arange(len(first))
    good = (best_back[best] == index) & (angle < max_angle) & (angle < max_ratio * next_angle)
    return np.stack([index[good], best[good]], axis=1).astype(np.uint32)


def _two_nearest(
    first: Descriptors, second: Descriptors
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Nearest of `second` to each of `first`, its product and the next one's; and of `first` to each of `second`."""
    table, of_row, of_column = (_byte_products if _has_byte_products() else _float_products)(first, second)
    rows, columns = len(first), len(second)
    found = np.zeros(rows, np.int64), *np.full((2, rows), _BELOW_ALL, np.float32)
    back = np.full(columns, _BELOW_ALL, of_column.dtype), np.zeros(columns, np.int32)
    for start in range(0, rows, _ROWS):
        part = slice(start, start + _ROWS)
        _scan_rows(table(part), start, of_row[part], of_column, *(values[part] for values in found), *back)
    return *found, back[1]


@functools.cache
def _has_byte_products() -> bool:
    """Whether the processor has VNNI: four times as fast as floats; without it sums of pairs overflow."""
    import torch

    return bool(getattr(torch.cpu, "_is_vnni_supported", bool)()) and hasattr(torch, "_int_mm")


_Products = tuple[Callable[[slice], NDArray], NDArray, NDArray]
"""The table of products of some rows with all columns, and what is added to each row (N,) and column (M,) of it."""


def _float_products(first: Descriptors, second: Descriptors) -> _Products:
    rows, columns = first.astype(np.float32), second.astype(np.float32).T
    return lambda part: rows[part] @ columns, np.zeros(len(first), np.float32), np.zeros(len(second), np.float32)


def _byte_products(first: Descriptors, second: Descriptors) -> _Products:
    """Of bytes without sign less 128, so that they have one: (a - 128)(b - 128) = ab - 128a - 128b + 128²."""
    import torch

    shift = 128 if first.dtype == np.uint8 else 0
    rows, columns = ((d.astype(np.int16) - shift).astype(np.int8) for d in (first, second))
    sums = [shift * d.sum(axis=1, dtype=np.int32) for d in (rows, columns)]
    left, right = torch.from_numpy(rows), torch.from_numpy(columns).T

    def table(part: slice) -> NDArray[np.int32]:
        return np.asarray(torch._int_mm(left[part], right).numpy())

    return table, sums[0] + np.int32(shift**2 * first.shape[1]), sums[1]


@kernel
def _scan_rows(table, start, of_row, of_column, best, score, runner_up, column_score, column_best):  # type: ignore[no-untyped-def]
    """See `_two_nearest`: a part of the rows, in one pass.

    Columns lie in `_ABREAST` lanes, each with a best of its own, and nothing branches on a number: loops over the lanes
    become vector instructions.
    """
    rows, columns = table.shape
    least = of_column.dtype.type(_BELOW_ALL)
    tops, seconds = np.empty((2, _ABREAST), of_column.dtype)
    places = np.empty(_ABREAST, np.int32)
    whole = columns - columns % _ABREAST
    for i in range(rows):
        own, more = np.int32(start + i), of_row[i]
        for k in range(_ABREAST):
            tops[k], seconds[k], places[k] = least, least, 0
        for j in range(0, whole, _ABREAST):
            for k in range(_ABREAST):
                value, top = table[i, j + k] + of_column[j + k] + more, tops[k]
                less = top if value > top else value
                seconds[k] = less if less > seconds[k] else seconds[k]
                places[k] = np.int32(j) if value > top else places[k]
                tops[k] = value if value > top else top
            for k in range(_ABREAST):
                value, before = table[i, j + k] + of_column[j + k] + more, column_score[j + k]
                column_best[j + k] = own if value > before else column_best[j + k]
                column_score[j + k] = value if value > before else before
        top, second, at = least, least, np.int64(0)
        for k in range(_ABREAST):
            place = places[k] + k
            if tops[k] > top or (tops[k] == top and place < at and top > least):
                second = max(top, max(second, seconds[k]))
                top, at = tops[k], place
            else:
                second = max(second, max(seconds[k], tops[k]))
        for j in range(whole, columns):
            value = table[i, j] + of_column[j] + more
            if value > top:
                second, top, at = top, value, j
            elif value > second:
                second = value
            if value > column_score[j]:
                column_score[j], column_best[j] = value, own
        best[i], score[i], runner_up[i] = at, top, second


def match_features(first: Features, second: Features) -> NDArray[np.uint32]:
    """(M, 2) indices of features that are alike."""
    return match_descriptors(first.descriptors, second.descriptors)


def match_pair(
    pair: tuple[int, int],
    features: tuple[Features, Features],
    camera: pycolmap.Camera,
    seed: int,
    match: Callable[[Features, Features], NDArray[np.uint32]] = match_features,
) -> VerifiedPair | None:
    """Match two keyframes and keep what one epipolar geometry or homography explains; None where nothing does.

    The random choices depend on the seed and the pair alone, so pairs may be verified in any order on any thread.
    """
    matches = match(*features)
    if len(matches) < MIN_INLIERS:
        return None
    return verify_matches(pair, matches, (features[0].xy, features[1].xy), camera, seed)


def verify_matches(
    pair: tuple[int, int],
    matches: NDArray[np.uint32],
    xy: tuple[NDArray[np.float64], NDArray[np.float64]],
    camera: pycolmap.Camera,
    seed: int,
) -> VerifiedPair | None:
    """Robust two-view geometry of proposed matches, or None. See `match_pair`."""
    if not _may_agree(xy[0][matches[:, 0]], xy[1][matches[:, 1]]):
        return None
    pair_seed = int(np.random.SeedSequence([seed, *pair]).generate_state(1)[0] & 0x7FFFFFFF)
    options = _verification_options(pair_seed)
    geometry = pycolmap.estimate_two_view_geometry(camera, xy[0], camera, xy[1], matches, options)
    inliers = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    if len(inliers) < MIN_INLIERS:
        return None
    matrices = np.stack([_matrix(m) for m in (geometry.F, geometry.E, geometry.H)])
    return VerifiedPair(*pair, inliers, int(geometry.config), matrices)


def _may_agree(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    """Whether about enough of matched pixels (M, 2) obey one epipolar geometry, by OpenCV's USAC."""
    # A millisecond; a pair with nothing in common costs the full count of trials for three geometries. Of some pairs of
    # a walk through a house and of a kitchen it refused 100 of 130 of those, and none of 421 others.
    try:
        _, inliers = cv2.findFundamentalMat(first, second, cv2.USAC_FAST, _MAX_ERROR, 0.99, _FIRST_TRIALS)
    except cv2.error:  # it finds no model at all where a camera only turns: that is for the full look to say
        return True
    return inliers is not None and int(inliers.sum()) >= _NEARLY * MIN_INLIERS


def _matrix(value: NDArray[np.float64] | None) -> NDArray[np.float64]:
    return np.zeros((3, 3)) if value is None else np.array(value, dtype=np.float64)


def _verification_options(seed: int) -> pycolmap.TwoViewGeometryOptions:
    chosen = pycolmap.TwoViewGeometryOptions()
    chosen.min_num_inliers = MIN_INLIERS
    chosen.detect_watermark = False
    chosen.compute_relative_pose = True
    chosen.ransac.max_error = _MAX_ERROR
    chosen.ransac.random_seed = seed
    chosen.ransac.num_threads = 1
    # Of the pairs of a kitchen 99.5 % of the agreeing matches are found in a fifth of the time of pycolmap's ten
    # thousand trials; what a thousand miss, agrees by so small a share that no mapper misses it.
    chosen.ransac.min_num_trials, chosen.ransac.max_num_trials = 30, 1000
    chosen.ransac.dyn_num_trials_multiplier, chosen.ransac.confidence = 1.0, 0.99
    return chosen


def write_database(
    path: Path,
    camera: pycolmap.Camera,
    names: Sequence[str],
    features: Iterable[Features],
    pairs: Iterable[VerifiedPair],
    cam_from_rig: NDArray[np.float64],
) -> None:
    """Image i (counted from 0) gets the id i + 1. An older file is replaced.

    cam_from_rig (C, 3, 3): the images are those of the first of C directions, then those of the next and so on, each
    direction a camera of its own, counted from 1. The images i, i + N / C and so on share a frame of COLMAP.
    """
    path.unlink(missing_ok=True)
    stations = len(names) // len(cam_from_rig)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        rig, cameras = _write_rig(database, camera, cam_from_rig)
        frames = [pycolmap.Frame(rig_id=rig) for _ in range(stations)]
        for i, (name, feature) in enumerate(zip(names, features, strict=True)):
            image = pycolmap.Image(name=name, camera_id=cameras[i // stations])
            image.image_id = database.write_image(image)
            frames[i % stations].add_data_id(image.data_id)
            database.write_keypoints(image.image_id, feature.keypoints)
        for station, frame in enumerate(frames, 1):
            assert database.write_frame(frame) == station, "frames and the first images are numbered alike"
        for pair in pairs:
            _write_pair(database, pair)


def _write_rig(
    database: pycolmap.Database, camera: pycolmap.Camera, cam_from_rig: NDArray[np.float64]
) -> tuple[int, list[int]]:
    cameras = [database.write_camera(camera)]
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, cameras[0]))
    for rotation in cam_from_rig[1:]:
        cameras.append(database.write_camera(pycolmap.Camera(camera.todict() | {"camera_id": len(cameras) + 1})))
        turned = pycolmap.Rigid3d(np.column_stack([rotation, np.zeros(3)]))
        rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, cameras[-1]), turned)
    return database.write_rig(rig), cameras


def _write_pair(database: pycolmap.Database, pair: VerifiedPair) -> None:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pair.config
    geometry.inlier_matches = pair.matches
    for name, matrix in zip("FEH", pair.matrices, strict=True):
        if matrix.any():
            setattr(geometry, name, matrix)
    database.write_matches(pair.first + 1, pair.second + 1, pair.matches)
    database.write_two_view_geometry(pair.first + 1, pair.second + 1, geometry)
