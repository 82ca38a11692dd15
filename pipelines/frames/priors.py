"""A prior focal length that leaves no structure or that the images contradict: dropped before these are blamed."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pycolmap

from ...formats.errors import InputError
from ..run.stages import StageContext
from ..sfm.candidates import GIVEN_ONLY
from ..sfm.consistency import unexplained
from ..sfm.driver import Structure, StructureFromMotion, no_prefetch
from ..sfm.lens import FOCAL_GUESS, unknown_camera
from ..sfm.matching import VerifiedPair, match_pair
from ..sfm.snapshots import features_name
from ..sfm.two_views import calibrated
from ..system.parallel import parallel_map

_PAIRS = 60
"""Pairs of keyframes that are matched again without the prior, evenly chosen."""
_DOUBTFUL = 1.2
"""A focal length from pairs of views that is farther off by this factor is followed up: from pairs alone it is right to
8 %."""
_MIN_BETTER = 0.1
"""Share of the cost of all matches that goes without the prior where it was wrong."""
_SIGNIFICANT = 3.0
"""Standard deviations between two focal lengths that contradict each other."""
_STATED_BY = {"exif": "the metadata state", "stated": "the data set states", "self-calibrated": "the data set states"}


def solve(
    context: StageContext, motion: StructureFromMotion, origin: str, keyframes: Sequence[int]
) -> tuple[Structure, str]:
    """Run structure from motion, once more without the prior focal length where nothing is found or pairs of views tell
    another one; return the structure and the origin of its camera.

    `origin` is as in `known_camera`. Raises InputError as `StructureFromMotion.run` does, and for a camera of
    --intrinsics without which there is a structure.
    """
    try:
        structure = motion.run(keyframes)
    except InputError:
        free = _without_prior(context, motion, origin, keyframes)
        if free is None:
            raise
    else:
        free = _without_prior(context, motion, origin, keyframes) if structure.mapper == GIVEN_ONLY else None
        if free is None:
            return _unless_contradicted(context, motion, origin, structure, keyframes)
    focal, placed = motion.camera.mean_focal_length(), f"{free.report.registered} of {free.report.total} keyframes"
    if origin == "given":
        raise InputError(
            f"the camera of --intrinsics (focal length {focal:.0f} px) leaves no structure, and without it {placed} "
            "are placed: correct or omit it"
        )
    context.warn(
        f"the focal length that {_STATED_BY[origin]} ({focal:.0f} px) leaves no structure and is not used: without it "
        f"{placed} are placed"
    )
    return free, "self-calibrated"


def _unless_contradicted(
    context: StageContext, motion: StructureFromMotion, origin: str, structure: Structure, keyframes: Sequence[int]
) -> tuple[Structure, str]:
    """The structure and the origin of its camera; those without the prior focal length, which a start from is a local
    minimum where it is far off, if the images say that it is wrong."""
    if origin not in _STATED_BY or not motion.camera.has_prior_focal_length or not _is_doubtful(motion, structure):
        return structure, origin
    free = _without_prior(context, motion, origin, keyframes)
    if free is None or not _is_better(free, structure):
        return structure, origin
    context.warn(
        f"the focal length that {_STATED_BY[origin]} ({motion.camera.mean_focal_length():.0f} px) contradicts the "
        f"images and is not used: they say {_focal(free):.0f} ± {free.focal_sd:.0f} px. To hold a camera in any case "
        "give it with --intrinsics"
    )
    return free, "self-calibrated"


def _is_doubtful(motion: StructureFromMotion, structure: Structure) -> bool:
    """Whether pairs of views, verified without the prior, tell another focal length than the structure has."""
    pairs, features, unknown = structure.pairs, structure.features, _unknown(motion)

    def again(number: int) -> VerifiedPair | None:
        i, j = pairs[number].first, pairs[number].second
        return match_pair((i, j), (features[i], features[j]), unknown, motion.seed, motion.match)

    chosen = range(0, len(pairs), -(-len(pairs) // _PAIRS)) if pairs else range(0)
    found = [p for p in parallel_map(again, chosen, motion.threads) if p is not None]
    camera, _ = calibrated(unknown, found, [f.xy for f in features])
    off = math.log(camera.mean_focal_length() / _focal(structure))
    return bool(found) and abs(off) > math.log(_DOUBTFUL)


def _is_better(free: Structure, held: Structure) -> bool:
    """Whether a structure without the prior has another focal length and explains the images clearly better."""
    xy = [f.xy for f in free.features]
    apart = abs(_focal(free) - _focal(held)) > _SIGNIFICANT * math.hypot(free.focal_sd, held.focal_sd)
    left = unexplained(free.model, free.pairs, xy), unexplained(held.model, free.pairs, xy)
    return apart and free.report.registered >= held.report.registered and left[0] < (1 - _MIN_BETTER) * left[1]


def _focal(structure: Structure) -> float:
    return float(structure.model.cameras[1].mean_focal_length())


def _unknown(motion: StructureFromMotion) -> pycolmap.Camera:
    width, height = motion.camera.width, motion.camera.height
    return unknown_camera(width, height, FOCAL_GUESS * max(width, height), is_prior=False)


def _without_prior(
    context: StageContext, motion: StructureFromMotion, origin: str, keyframes: Sequence[int]
) -> Structure | None:
    """The structure of an unknown focal length; None where none was known, nothing is found, or the camera is cut from
    panoramas.

    Features are the same; pairs are matched again, for at a wrong focal length too few matches obey one geometry.
    """
    held = origin == "given" and not context.config.frames.intrinsics
    if held or not motion.camera.has_prior_focal_length:
        return None
    snapshots = motion.snapshots.inside("without_prior")
    free = replace(
        motion,
        camera=_unknown(motion),
        is_fixed=False,
        is_stated=False,
        extract=lambda i: motion.snapshots.value(features_name(i), lambda: motion.extract(i)),
        snapshots=snapshots,
        divide=no_prefetch,
    )
    try:
        found = free.run(keyframes)
    except InputError:
        return None
    return None if found.mapper == GIVEN_ONLY else found
