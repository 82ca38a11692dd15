"""Structure from motion as tasks, and what it starts from: images that were picked, their camera, masks."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial

import numpy as np
import pycolmap

from ...formats.datasets.sequence import Camera
from ...formats.images import read_rgb
from ..geometry.camera import Rig, rig_of
from ..run.stages import Chunk, StageContext
from ..sfm.driver import Divide, StructureFromMotion, no_prefetch
from ..sfm.features import clear_of
from ..sfm.lens import FOCAL_GUESS, to_pycolmap, unknown_camera
from ..sfm.matching import match_features
from ..sfm.rolling import frame_interval
from ..sfm.snapshots import Snapshots, features_name
from ..source.faces import Faces, find_faces
from ..source.given import given_poses, read_intrinsics
from ..source.picking import reduced_size
from ..source.recording import Recording, open_recording
from ..system.machine import window_size
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
    divide: Divide = no_prefetch,
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
        warn=context.warn,
    )


def _interval(frames: list[Frame]) -> float:
    return frame_interval(np.array([f.timestamp for f in frames]), np.array([f.source_index for f in frames]))


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
