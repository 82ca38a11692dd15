"""Stage 1: pictures of the source become frames with timestamps, a calibrated camera and a backbone of keyframes."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ...formats.errors import InputError
from ...formats.gps import photo_places
from ...formats.images import read_rgb, write_rgb
from ...formats.textfile import read_json, write_json
from ..geometry.camera import rig_of
from ..masks.static import find_static
from ..run.files import BACKBONE, CALIBRATION, FEATURES, GIVEN_POSES, MATCHED_PAIRS, SPARSE, VOCABULARY, save_frames
from ..run.stages import StageContext, in_chunks
from ..sfm.driver import Structure
from ..sfm.flow import Picture
from ..sfm.lens import distortion_of, make_lens
from ..sfm.rolling import straight_copy
from ..sfm.two_views import require_motion
from ..source.extending import is_extension, with_earlier_poses
from ..source.faces import find_faces, has_panorama_shape, level_mosaic
from ..source.given import given_poses
from ..source.recording import FolderRecording, Recording, open_recording
from ..system.parallel import parallel_map, read_ahead
from ..types import Calibration, Frame
from .findings import (
    in_world_of,
    settled_origin,
    to_sparse_model,
    warn_of_defects,
    warn_of_focal,
    warn_of_given,
    warn_of_people,
    warn_of_structure,
)
from .inputs import require_several
from .keyframes import KeyframeChoice, choose_keyframes, lossless_image_path, pick_frames, selected_image_path
from .masks import masks_of
from .tasks import TASKS, known_camera, solve, structure_from_motion

_FEW_KEYFRAMES = 12
_UNSURE_FOCAL = 0.05
_NOISE_IMAGES = 8
"""Keyframes of which noise is measured."""


def run(context: StageContext) -> dict[str, Any]:
    """See `StageContext`; raises InputError for a source that cannot be used."""
    return FramesStage(context).run()


class FramesStage:
    """The stage's steps in their order, and what they share."""

    def __init__(self, context: StageContext) -> None:
        self.context = replace(context, config=with_earlier_poses(context.source, context.config))
        self.config = self.context.config.frames

    def run(self) -> dict[str, Any]:
        """Do the steps in order; returns the figures."""
        self.open()
        self.pick()
        self.place()
        self.calibrate()
        self.undistort()
        return self.save()

    def open(self) -> None:
        """Open the source; find how it is cut into pinhole images, and what is known of their camera."""
        context = self.context
        self.recording = open_recording(context.source, context.config.run.format)
        self.faces = find_faces(self.recording, self.config)
        if self.faces is None and has_panorama_shape(self.recording, self.config):
            context.warn(
                "the images are twice as wide as high, like 360° panoramas: if they are, pass --camera equirectangular"
            )
        self.camera, self.origin = known_camera(context, self.recording, self.faces)
        require_several(self.recording, context.warn)

    def pick(self) -> None:
        """Pick frames, and find what of them is left out."""
        context = self.context
        is_straight = self.origin == "given" and make_lens(self.camera).is_straight
        self.frames = pick_frames(context, self.recording, self.faces, keep_lossless=not is_straight)
        self.given = given_poses(self.config, self.recording, self.frames, context.warn)
        self.rig = rig_of(1 if self.faces is None else len(self.faces), len(self.frames))
        self.masks = masks_of(context, self.recording, self.faces, self.rig)
        self.still = self.masks.leave_out_still(context, self.frames)

    # structure ----------------------------------------------------------------------------------------------------

    def place(self) -> None:
        """Choose keyframes and reconstruct them; without a structure, masks are blamed if they leave too little."""
        try:
            self.keyframes = self.keyframes_by_parallax()
            self.masks.find_people(self.frames, self.keyframes, self.context.progress)
            self.structure, self.origin = self._with_people() or self._solved(self.context)
        except InputError as error:
            if blame := self.masks.blame(self.frames, self.camera.width, self.camera.height):
                raise InputError(blame) from error
            if self.still.note:
                raise InputError(f"{error}{self.still.note}") from error
            raise
        warn_of_people(self.context, self.masks.judged, self.structure)
        warn_of_structure(self.context, self.structure, [self.frames[k].id for k in self.keyframes])
        self.of_given: dict[str, Any] = {}
        if self.given is not None:
            self.of_given = warn_of_given(self.context, self.structure, self.given, self.frames, self.keyframes)

    def keyframes_by_parallax(self) -> list[int]:
        """Choose keyframes, by id, by parallax; of a short walk closer ones, so that there are enough for a
        reconstruction. Of panoramas all sides are keyframes."""
        table, frames = self.context.snapshot / "keyframes.json", self.frames
        if not table.exists():
            chosen = list(self._choose(frames).keyframes)
            if self.config.poses and len(chosen) < _FEW_KEYFRAMES:  # blank pictures whose poses are known
                even = np.linspace(0, len(frames) - 1, min(_FEW_KEYFRAMES, len(frames))).round().astype(int)
                chosen = sorted({*chosen, *even.tolist()})
            write_json(table, self.rig.frames_of(chosen))
        return read_json(table, None)

    def _choose(self, frames: list[Frame]) -> KeyframeChoice:
        """Places by what is seen of them: of panoramas the level sides, two by two in one picture."""
        # Two square sides in one picture: by their own length, which is 3/4 of what counts for the picture.
        across = 4 / 3 if len(self.rig) > 1 else 1.0
        places = frames[: self.rig.stations]

        def pictures() -> Iterator[Picture]:
            for frame in self.context.progress.track(places, "keyframes", len(places)):
                if len(self.rig) == 1:
                    yield self.masks.grey(frame)
                    continue
                sides = [self.masks.grey(frames[i]) for i in self.rig.frames_of([frame.id])]
                hidden = [np.zeros(gray.shape, np.bool_) if mask is None else mask for gray, mask in sides]
                yield level_mosaic([gray for gray, _ in sides]), level_mosaic(hidden)

        parallax = self.config.parallax
        while True:
            choice = choose_keyframes(read_ahead(pictures(), self.context.threads), parallax / across)
            if not self.config.poses:
                require_motion(choice.largest_displacement * across, choice.has_detail)
            if len(choice.keyframes) >= min(_FEW_KEYFRAMES, len(places)) or parallax < self.config.parallax / 3:
                return choice
            parallax /= 2

    def _solved(self, context: StageContext) -> tuple[Structure, str]:
        """The structure, and the origin of its camera; `context` takes the warnings."""

        def divide(name: str, count: int, known: dict[str, NDArray]) -> None:
            if count:
                in_chunks(context, TASKS[name], count, motion, frames=self.frames, keyframes=self.keyframes, **known)

        motion = structure_from_motion(
            context, self.camera, self.origin, self.frames, self.masks, self.rig, self.given,
            self.recording.is_timed(), divide,
        )  # fmt: skip
        return solve(context, motion, self.origin, self.keyframes)

    def _with_people(self) -> tuple[Structure, str] | None:
        """Structure and origin made of people too, unless some of them move: these are left out from then on. None
        where that is so, or is known already, and where no people are seen."""
        masks, frames, keyframes, progress = self.masks, self.frames, self.keyframes, self.context.progress
        regions = [] if masks.judged else masks.regions(frames, keyframes)
        if not any(r.any() for r in regions):
            return None
        trial = replace(self.context, warnings=[])
        try:
            found = self._solved(trial)
        except InputError:  # what moves may fill the images
            masks.leave_out(frames, keyframes, None, 0, progress)
            return None
        matches = sum(len(p.matches) for p in found[0].pairs)
        masks.leave_out(frames, keyframes, find_static(regions, found[0]), matches, progress)
        if masks.any_moves:
            return None
        self.context.warnings.extend(trial.warnings)
        return found

    # camera -------------------------------------------------------------------------------------------------------

    def calibrate(self) -> None:
        """Find the lens, and how sure its focal length is."""
        structure = self.structure
        self.lens = lens = make_lens(structure.model.cameras[1])
        origin = settled_origin(self.context, self.origin, self.camera, structure)
        focal_sd = structure.focal_sd
        if len(self.rig) == 1:
            origin, focal_sd = self._judged_focal(origin)
        focal_sd *= lens.pinhole.fx / lens.camera.focal_length_x
        if focal_sd > _UNSURE_FOCAL * lens.pinhole.fx:
            self.context.warn(
                f"the focal length is uncertain: {lens.pinhole.fx:.0f} ± {focal_sd:.0f} px. If you know the "
                f"intrinsics, pass --intrinsics" + self.still.note
            )
        faces, directions, is_fisheye = self.faces, 1, False
        distortion = distortion_of(lens.camera)
        if faces is not None:
            distortion = (0.0,) * 4 if faces.fisheye is None else faces.fisheye.distortion
            directions, is_fisheye = len(faces), faces.fisheye is not None
        self.calibration = Calibration(
            lens.pinhole, origin, focal_sd, distortion, is_fisheye, directions, readout=structure.readout
        )

    def _judged_focal(self, origin: str) -> tuple[str, float]:
        """The camera's final origin, and the focal length's standard deviation, which noise makes larger."""
        structure, frames = self.structure, [self.frames[k] for k in self.keyframes]
        times = np.array([f.timestamp for f in frames])
        straight = straight_copy(structure.model, [f.xy for f in structure.features], times, structure.readout)
        origin = warn_of_focal(self.context, origin, self.camera, structure, straight, self.recording.is_timed())
        evenly = frames[:: -(-len(frames) // _NOISE_IMAGES)]
        noise = warn_of_defects(self.context, [self.masks.grey(f)[0] for f in evenly], straight)
        focal = structure.model.cameras[1].mean_focal_length()
        return origin, math.hypot(structure.focal_sd, noise * focal) if structure.focal_sd else 0.0

    # results ------------------------------------------------------------------------------------------------------

    def undistort(self) -> None:
        """Write the frames without distortion; those of a lens without any are the picked ones, byte for byte."""
        context, folder = self.context, self.context.folder

        def write(frame: Frame) -> None:
            if self.lens.is_straight:
                copy_file(selected_image_path(context, frame.name), folder / frame.name)
            else:
                write_rgb(
                    folder / frame.name, self.lens.undistort_image(read_rgb(lossless_image_path(context, frame.name)))
                )

        missing = [f for f in self.frames if not (folder / f.name).exists()]
        done = parallel_map(write, missing, context.threads)
        for _ in context.progress.track(done, "undistorting", len(missing)):
            pass

    def save(self) -> dict[str, Any]:
        """Write what the next stages read; returns the figures."""
        context = self.context
        self._save_models()
        self._save_correspondences()
        masked = self.masks.write(context.folder, self.frames, self.lens)
        context.save(CALIBRATION, self.calibration)
        save_frames(context.folder, self.frames)
        if self.given is not None:
            context.save(GIVEN_POSES, self.given)
        figures = _figures(self.frames, self.structure, self.calibration)
        figures |= self.of_given | places_figure(self.recording, self.frames)
        figures |= ({} if self.recording.is_timed() else {"timed": False}) | masked | self.still.figures
        return figures | ({"panoramas": self.rig.stations} if len(self.rig) > 1 else {})

    def _save_models(self) -> None:
        def load_rgb(frame_id: int) -> NDArray[np.uint8]:
            return read_rgb(selected_image_path(self.context, self.frames[frame_id].name))

        model = to_sparse_model(self.structure.model, self.keyframes, self.lens, load_rgb)
        if self.given is not None and is_extension(self.context.source):
            model = in_world_of(self.given, model)
        self.context.save(BACKBONE, model)
        for number, piece in enumerate(self.structure.pieces, 2):
            sparse = to_sparse_model(piece, self.keyframes, self.lens, load_rgb)
            self.context.save(SPARSE, sparse, piece=f"piece_{number}")

    def _save_correspondences(self) -> None:
        """What the stages after this one need of features and matches, in undistorted pixels."""
        structure, keyframes = self.structure, self.keyframes
        for frame_id, features in zip(keyframes, structure.features, strict=True):
            keypoints = features.keypoints.copy()
            # What a lens of much distortion cannot have seen lies nowhere in the picture.
            straight = self.lens.undistort_points(features.xy)
            keypoints[:, :2] = np.nan_to_num(straight, nan=-1.0, posinf=-1.0, neginf=-1.0)
            self.context.save(FEATURES, replace(features, keypoints=keypoints), of=frame_id)
        found = {(p.first, p.second): len(p.matches) for p in structure.pairs}
        tried = {(keyframes[i], keyframes[j]): found.get((i, j), 0) for i, j in structure.tried}
        self.context.save(VOCABULARY, structure.vocabulary)
        self.context.save(MATCHED_PAIRS, tried)


def places_figure(recording: Recording, frames: list[Frame]) -> dict[str, str]:
    """Count the images that say by GPS where they were taken, where any does."""
    if not isinstance(recording, FolderRecording):
        return {}
    places = photo_places([recording.file(frame.source_index) for frame in frames])
    count = int(np.isfinite(places[:, :2]).all(axis=1).sum())
    return {"gps": f"of {count} of {len(frames)} images"} if count else {}


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
