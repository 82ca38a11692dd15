"""Structure from motion as tasks, and what it starts from: images that were picked, their camera, masks. A prior focal
length that is wrong is dropped before images or masks are blamed."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pycolmap

from ...formats.datasets.sequence import Camera
from ...formats.errors import InputError
from ...formats.images import read_rgb
from ..geometry.camera import Rig, rig_of
from ..run.stages import Chunk, StageContext
from ..sfm.candidates import GIVEN_ONLY
from ..sfm.consistency import unexplained
from ..sfm.driver import Divide, Structure, StructureFromMotion
from ..sfm.features import clear_of
from ..sfm.lens import FOCAL_GUESS, to_pycolmap, unknown_camera
from ..sfm.matching import VerifiedPair, match_features, match_pair
from ..sfm.rolling import frame_interval
from ..sfm.snapshots import Snapshots, features_name
from ..sfm.two_views import calibrated
from ..source.faces import Faces, find_faces
from ..source.given import given_poses, read_intrinsics
from ..source.picking import reduced_size
from ..source.recording import Recording, open_recording
from ..system.machine import window_size
from ..system.parallel import parallel_map
from ..system.progress import Progress
from ..types import Features, Frame, GivenPoses
from .keyframes import selected_image_path
from .learned import open_learned, picture_features
from .masks import FrameMasks, masks_of


def known_camera(context: StageContext, source: Recording, faces: Faces | None) -> tuple[pycolmap.Camera, str]:
    """The camera of the reduced frames as far as it is known before, and where from: given by the user, stated by the
    data set, exif, or nowhere."""
    config = context.config.frames
    if faces is not None:
        pinhole = Camera(**asdict(faces.pinhole))
        return to_pycolmap(pinhole), "given"
    width, height = reduced_size(source.width, source.height, config.max_side)
    if config.intrinsics:
        given = read_intrinsics(config.intrinsics, source.width, source.height)
        return to_pycolmap(given.resized(width, height)), "given"
    known = source.camera()
    if known is not None and not known.is_nominal and not known.fisheye:
        return to_pycolmap(known.resized(width, height)), "stated"
    if known is not None:
        return unknown_camera(width, height, known.fx * width / source.width, is_prior=True), "self-calibrated"
    exif = source.exif_focal()
    if exif is not None:
        return unknown_camera(width, height, exif * width / source.width, is_prior=True), "exif"
    return unknown_camera(width, height, FOCAL_GUESS * max(width, height), is_prior=False), "self-calibrated"


def structure_from_motion(
    context: StageContext,
    camera: pycolmap.Camera,
    origin: str,
    frames: list[Frame],
    masks: FrameMasks,
    rig: Rig,
    given: GivenPoses | None,
    has_times: bool,
    divide: Divide = lambda *_: None,
) -> StructureFromMotion:
    """Prepare structure from motion of these frames; `origin` is as in `known_camera`, `has_times` as of a source."""
    settings, size = context.config.frames, (camera.width, camera.height)
    learned = open_learned(settings)
    start = given.cam_from_world if given is not None else None

    snapshots = whole = Snapshots(context.snapshot)
    if masks.any_moves:
        snapshots = whole.inside("without_people")

    def extract(frame_id: int) -> Features:
        left_out = masks.left_out(frames[frame_id], *size)

        def found() -> Features:
            return picture_features(
                read_rgb(selected_image_path(context, frames[frame_id].name)), left_out, settings, learned
            )

        if snapshots is whole:
            return found()
        features = whole.value(features_name(frame_id), found)  # those with people are there where these were judged
        return features if left_out is None else clear_of(features, left_out)

    return StructureFromMotion(
        config=settings,
        camera=camera,
        is_fixed=origin in ("given", "stated"),
        is_stated=origin == "stated",
        given=start,
        frame_interval=_interval(frames) if has_times else 0.0,
        extract=extract,
        picture=lambda frame_id: masks.grey(frames[frame_id]),
        time=lambda frame_id: frames[frame_id].timestamp,
        match=match_features if learned is None else partial(learned.match, size=size),
        snapshots=snapshots,
        progress=context.progress,
        threads=context.threads,
        seed=context.config.run.seed,
        memory=context.memory_room,
        window=window_size(context.config.run.memory_mb, camera.width * camera.height),
        cam_from_rig=rig.cam_from_rig,
        divide=divide,
    )


def _interval(frames: list[Frame]) -> float:
    return frame_interval(np.array([f.timestamp for f in frames]), np.array([f.source_index for f in frames]))


# a prior focal length that leaves no structure or that the images contradict ------------------------------------

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
        divide=lambda *_: None,
        snapshots=snapshots,
    )
    try:
        found = free.run(keyframes)
    except InputError:
        return None
    return None if found.mapper == GIVEN_ONLY else found


# tasks ----------------------------------------------------------------------------------------------------------


def _opened(task: Chunk, progress: Progress) -> StructureFromMotion:
    if task.opened is not None:
        return task.opened
    context, frames = task.context(progress), task.known["frames"]
    source = open_recording(context.source, context.config.run.format)
    faces = find_faces(source, context.config.frames)
    camera, origin = known_camera(context, source, faces)
    rig = rig_of(1 if faces is None else len(faces), len(frames))
    masks = masks_of(context, source, faces, rig)
    given = given_poses(context.config.frames, source, frames)
    return structure_from_motion(context, camera, origin, frames, masks, rig, given, source.is_timed())


def _proposed(task: Chunk) -> list[tuple[int, int]]:
    return [(i, j) for i, j in task.known["pairs"].tolist()]


def extract_features(task: Chunk, progress: Progress) -> None:
    """Extract the features of the keyframes of a chunk."""
    _opened(task, progress).features_of(task.known["keyframes"], task.numbers)


def match_pairs(task: Chunk, progress: Progress) -> None:
    """Some blocks of the pairs."""
    structure = _opened(task, progress)
    structure.pairs_of(structure.features_of(task.known["keyframes"], range(0)), _proposed(task), task.numbers)


def map_windows(task: Chunk, progress: Progress) -> None:
    """Reconstruct the windows of a chunk."""
    _opened(task, progress).map_windows(task.numbers, task.known["keyframes"], _proposed(task))


TASKS: dict[str, Callable[[Chunk, Progress], None]] = {
    "features": extract_features, "pairs": match_pairs, "windows": map_windows,
}  # fmt: skip
"""Which task leaves what of structure from motion in the snapshots."""
