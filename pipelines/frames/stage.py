"""Stage 1: pictures of the source become frames with timestamps, a calibrated camera and a backbone of keyframes."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ...formats.errors import InputError, RecoverableError
from ...formats.gps import photo_places
from ...formats.images import read_rgb, write_rgb
from ...formats.textfile import read_json, write_json
from ...formats.video import VideoFrame
from ..geometry.camera import Rig, rig_of
from ..masks.static import find_static
from ..run.files import BACKBONE, CALIBRATION, FEATURES, GIVEN_POSES, MATCHED_PAIRS, SPARSE, VOCABULARY, save_frames
from ..run.stages import StageContext
from ..run.tasks import in_chunks
from ..sfm.driver import Structure
from ..sfm.flow import Picture
from ..sfm.lens import Lens, distortion_of, make_lens
from ..sfm.rolling import straight_copy
from ..sfm.two_views import require_motion
from ..source.extending import is_extension, with_earlier_poses
from ..source.faces import Faces, find_faces, level_mosaic, looks_like_panoramas
from ..source.given import given_poses
from ..source.recording import FolderRecording, Recording, open_recording
from ..source.sharpness import reduce_image
from ..system.parallel import parallel_map
from ..types import Calibration, Frame, GivenPoses
from .defects import warn_of_defects
from .findings import (
    in_world_of,
    settled_origin,
    to_sparse_model,
    warn_of_focal,
    warn_of_given,
    warn_of_people,
    warn_of_structure,
)
from .inputs import require_several
from .keyframes import KeyframeChoice, choose_keyframes, pick_frames
from .masks import FrameMasks, grey_of, masks_of, picked
from .priors import solve
from .still import StillShare, leave_out_still
from .tasks import TASKS, known_camera, structure_from_motion

_FEW_KEYFRAMES = 12
_UNSURE_FOCAL = 0.05
_NOISE_IMAGES = 8
"""Keyframes of which noise is measured."""


def run(context: StageContext) -> dict[str, Any]:
    """See `StageContext`; raises InputError for a source that cannot be used."""
    context = replace(context, config=with_earlier_poses(context.source, context.config))
    source = open_recording(context.source, context.config.run.format)
    faces = find_faces(source, context.config.frames)
    if faces is None and looks_like_panoramas(source, context.config.frames):
        context.warn(
            "the images are twice as wide as high, like 360° panoramas: if they are, pass --camera equirectangular"
        )
    camera, origin = known_camera(context, source, faces)
    require_several(source, context.warn)
    frames = pick_frames(context, source, faces)
    given = given_poses(context.config.frames, source, frames, context.warn)
    rig = rig_of(1 if faces is None else len(faces), len(frames))
    masks = masks_of(context, source, faces, rig)
    still = leave_out_still(context, masks, frames, rig)
    try:
        keyframes = _keyframes(context, frames, masks, rig)
        masks.find_people(frames, keyframes, context.progress)
        structure, origin = _structure(
            context, (camera, origin), frames, keyframes, masks, rig, given, source.is_timed()
        )
    except InputError as error:
        if blame := masks.blame(frames, camera.width, camera.height):
            raise InputError(blame) from error
        if still.note:
            raise InputError(f"{error}{still.note}") from error
        raise
    told = {} if given is None else warn_of_given(context, structure, given, frames, keyframes)
    lens = make_lens(structure.model.cameras[1])
    origin, focal_sd = settled_origin(context, origin, camera, structure), structure.focal_sd
    if len(rig) == 1:
        times = np.array([frames[k].timestamp for k in keyframes])
        straight = straight_copy(structure.model, [f.xy for f in structure.features], times, structure.readout)
        origin = warn_of_focal(context, origin, camera, structure, straight, source.is_timed())
        evenly = keyframes[:: -(-len(keyframes) // _NOISE_IMAGES)]
        noise = warn_of_defects(context, [grey_of(context, masks, frames[k])[0] for k in evenly], straight)
        if structure.focal_sd:
            focal_sd = math.hypot(focal_sd, noise * structure.model.cameras[1].mean_focal_length())
    calibration = _calibration(context, lens, origin, focal_sd, faces, still)
    calibration = replace(calibration, readout=structure.readout)
    _write_backbone(context, structure, keyframes, lens, frames, given)
    _write_correspondences(context, structure, keyframes, lens)
    _write_frames(context, source, frames, lens)
    masked = masks.write(context.folder, frames, lens)
    CALIBRATION.save(context.folder, calibration)
    save_frames(context.folder, frames)
    if given is not None:
        GIVEN_POSES.save(context.folder, given)
    panoramas = {"panoramas": rig.stations} if len(rig) > 1 else {}
    told |= places_figure(source, frames) | ({} if source.is_timed() else {"timed": False})
    return _figures(frames, structure, calibration) | told | panoramas | masked | still.figures


def places_figure(source: Recording, frames: list[Frame]) -> dict[str, str]:
    """Count the images that say by GPS where they were taken, where any does."""
    if not isinstance(source, FolderRecording):
        return {}
    places = photo_places([source.file(frame.source_index) for frame in frames])
    count = int(np.isfinite(places[:, :2]).all(axis=1).sum())
    return {"gps": f"of {count} of {len(frames)} images"} if count else {}


# keyframes and structure ----------------------------------------------------------------------------------------


def _keyframes(context: StageContext, frames: list[Frame], masks: FrameMasks, rig: Rig) -> list[int]:
    """Ids of keyframes by parallax; of a short walk closer ones, so that there are enough for a reconstruction. Of
    panoramas all sides are keyframes."""
    table = context.snapshot / "keyframes.json"
    if not table.exists():
        chosen = list(_choose(context, frames, masks, rig).keyframes)
        if context.config.frames.poses and len(chosen) < _FEW_KEYFRAMES:  # blank pictures whose poses are known
            even = np.linspace(0, len(frames) - 1, min(_FEW_KEYFRAMES, len(frames))).round().astype(int)
            chosen = sorted({*chosen, *even.tolist()})
        write_json(table, rig.frames_of(chosen))
    return read_json(table, None)


def _choose(context: StageContext, frames: list[Frame], masks: FrameMasks, rig: Rig) -> KeyframeChoice:
    """Places by what is seen of them: of panoramas the level sides, two by two in one picture."""
    across = 2 if len(rig) > 1 else 1
    places = frames[: rig.stations]

    def pictures() -> Iterator[Picture]:
        for frame in context.progress.track(places, "keyframes", len(places)):
            if across == 1:
                yield grey_of(context, masks, frame)
                continue
            sides = [grey_of(context, masks, frames[i]) for i in rig.frames_of([frame.id])]
            hidden = [np.zeros(gray.shape, np.bool_) if mask is None else mask for gray, mask in sides]
            yield level_mosaic([gray for gray, _ in sides]), level_mosaic(hidden)

    parallax = context.config.frames.parallax
    while True:
        choice = choose_keyframes(pictures(), parallax / across)
        if not context.config.frames.poses:
            require_motion(choice.largest_displacement * across, choice.has_detail)
        if len(choice.keyframes) >= min(_FEW_KEYFRAMES, len(places)) or parallax < context.config.frames.parallax / 3:
            return choice
        parallax /= 2


def _structure(
    context: StageContext,
    camera: tuple[pycolmap.Camera, str],
    frames: list[Frame],
    keyframes: list[int],
    masks: FrameMasks,
    rig: Rig,
    given: GivenPoses | None,
    has_times: bool,
) -> tuple[Structure, str]:
    """The structure, and the origin of its camera."""

    def solved(context: StageContext) -> tuple[Structure, str]:
        def divide(name: str, count: int, known: dict[str, NDArray]) -> None:
            if count:
                in_chunks(context, TASKS[name], count, motion, frames=frames, keyframes=keyframes, **known)

        motion = structure_from_motion(context, *camera, frames, masks, rig, given, has_times, divide)
        return solve(context, motion, camera[1], keyframes)

    structure, origin = _with_people(context, frames, keyframes, masks, solved) or solved(context)
    warn_of_people(context, masks.judged, structure)
    warn_of_structure(context, structure, [frames[k].id for k in keyframes])
    return structure, origin


def _with_people(
    context: StageContext,
    frames: list[Frame],
    keyframes: list[int],
    masks: FrameMasks,
    solved: Callable[[StageContext], tuple[Structure, str]],
) -> tuple[Structure, str] | None:
    """Structure and origin made of people too, unless some of them move: these are left out from then on. None where
    that is so, or is known already, and where nobody is seen."""
    regions = [] if masks.judged else masks.regions(frames, keyframes)
    if not any(r.any() for r in regions):
        return None
    trial = replace(context, warnings=[])
    try:
        found = solved(trial)
    except InputError:  # what moves may fill the images
        masks.leave_out(frames, keyframes, None, 0, context.progress)
        return None
    matches = sum(len(p.matches) for p in found[0].pairs)
    masks.leave_out(frames, keyframes, find_static(regions, found[0]), matches, context.progress)
    if masks.any_moves:
        return None
    context.warnings.extend(trial.warnings)
    return found


def _calibration(
    context: StageContext, lens: Lens, origin: str, focal_sd: float, faces: Faces | None, still: StillShare
) -> Calibration:
    focal_sd *= lens.pinhole.fx / lens.camera.focal_length_x
    if focal_sd > _UNSURE_FOCAL * lens.pinhole.fx:
        context.warn(
            f"the focal length is uncertain: {lens.pinhole.fx:.0f} ± {focal_sd:.0f} px. If you know the intrinsics, "
            f"pass --intrinsics" + still.note
        )
    if faces is None:
        return Calibration(lens.pinhole, origin, focal_sd, distortion_of(lens.camera))
    removed = (0.0,) * 4 if faces.fisheye is None else faces.fisheye.distortion
    return Calibration(lens.pinhole, origin, focal_sd, removed, faces.fisheye is not None, len(faces))


# results --------------------------------------------------------------------------------------------------------


def _write_backbone(
    context: StageContext, structure: Structure, keyframes: list[int], lens: Lens, frames: list[Frame],
    given: GivenPoses | None,
) -> None:  # fmt: skip
    def load_rgb(frame_id: int) -> NDArray[np.uint8]:
        return read_rgb(picked(context, frames[frame_id].name))

    model = to_sparse_model(structure.model, keyframes, lens, load_rgb)
    if given is not None and is_extension(context.source):
        model = in_world_of(given, model)
    BACKBONE.save(context.folder, model)
    for number, piece in enumerate(structure.pieces, 2):
        SPARSE.save(context.folder / f"piece_{number}", to_sparse_model(piece, keyframes, lens, load_rgb))


def _write_correspondences(context: StageContext, structure: Structure, keyframes: list[int], lens: Lens) -> None:
    """What the stages after this one need of features and matches, in undistorted pixels."""
    for frame_id, features in zip(keyframes, structure.features, strict=True):
        keypoints = features.keypoints.copy()
        # What a lens of much distortion cannot have seen lies nowhere in the picture.
        keypoints[:, :2] = np.nan_to_num(lens.undistort_points(features.xy), nan=-1.0, posinf=-1.0, neginf=-1.0)
        FEATURES.save(context.folder, replace(features, keypoints=keypoints), of=frame_id)
    found = {(p.first, p.second): len(p.matches) for p in structure.pairs}
    tried = {(keyframes[i], keyframes[j]): found.get((i, j), 0) for i, j in structure.tried}
    VOCABULARY.save(context.folder, structure.vocabulary)
    MATCHED_PAIRS.save(context.folder, tried)


def _write_frames(context: StageContext, source: Recording, frames: list[Frame], lens: Lens) -> None:
    """The frames without distortion; those of a lens without any are the picked ones, byte for byte."""
    missing = [f for f in frames if not (context.folder / f.name).exists()]
    if lens.is_straight:
        for frame in context.progress.track(missing, "frames", len(missing)):
            copy_file(picked(context, frame.name), context.folder / frame.name)
        return
    by_index = {f.source_index: f for f in missing}

    def write(picture: VideoFrame) -> None:
        reduced = reduce_image(picture.rgb, context.config.frames.max_side)
        write_rgb(context.folder / by_index[picture.source_index].name, lens.undistort_image(reduced))

    # Read again from the source: a picked JPEG would be compressed twice.
    pictures: Iterator[VideoFrame] = source.read(by_index)
    done = parallel_map(write, pictures, context.threads)
    for _ in context.progress.track(done, "undistorting", len(missing)):
        pass
    _require_all(context, source, missing)


def _require_all(context: StageContext, source: Recording, frames: list[Frame]) -> None:
    """The source has given all of these frames again, as they were."""
    try:
        context.same_source()
    except InputError:
        for frame in frames:
            (context.folder / frame.name).unlink(missing_ok=True)
        raise
    if lost := [f.name for f in frames if not (context.folder / f.name).exists()]:
        raise RecoverableError(f"{source.path}: {len(lost)} frames could be read before and no longer, {lost[0]} first")


def _figures(frames: list[Frame], structure: Structure, calibration: Calibration) -> dict[str, Any]:
    report = structure.report
    return {
        "images": frames[-1].source_index + 1,
        "width": calibration.intrinsics.width,
        "height": calibration.intrinsics.height,
        "frames": len(frames),
        "keyframes": report.total,
        "keyframes_placed": report.registered,
        "points": report.points,
        "reprojection_px": round(report.reprojection_px, 4),
        "pairs_agreeing": round(report.pairs_agreeing, 4),
        "parts": len(report.components),
        "contradicted_seams": len(report.contradicted),
        "scale_drift": round(report.drift.factor, 3),
        "mapper": structure.mapper,
        "calibration": calibration.origin,
        "focal_px": round(calibration.intrinsics.fx, 3),
        "focal_sd_px": round(calibration.focal_sd, 3),
        "readout_seconds": round(sum(calibration.readout), 5),
        "sharpness": round(float(np.median([f.sharpness for f in frames])), 2),
    }
