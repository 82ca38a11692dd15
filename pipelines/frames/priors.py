"""A focal length that was known before and leaves no structure: it is dropped before the images are blamed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...formats.errors import InputError
from ..correspondence.snapshots import Snapshots, features_name
from ..engine.stages import StageContext
from ..structure.candidates import GIVEN_ALONE
from ..structure.lens import FOCAL_GUESS, unknown_camera
from ..structure.sfm import Structure, StructureFromMotion, when_asked

_STATED_BY = {"exif": "EXIF states", "stated": "the data set states", "self-calibrated": "the data set states"}


def solve(
    context: StageContext, motion: StructureFromMotion, origin: str, keyframes: Sequence[int]
) -> tuple[Structure, str]:
    """Run structure from motion, where nothing is found once more without the prior focal length; return the structure
    and the origin of its camera.

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
        free = _without_prior(context, motion, origin, keyframes) if structure.mapper == GIVEN_ALONE else None
        if free is None:
            return structure, origin
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


def _without_prior(
    context: StageContext, motion: StructureFromMotion, origin: str, keyframes: Sequence[int]
) -> Structure | None:
    """The structure of an unknown focal length; None where none was known, nothing is found, or the camera is that of
    a finished run or cut from panoramas.

    Features are the same; pairs are matched again, for at a wrong focal length too few matches obey one geometry.
    """
    held = origin == "given" and not context.config.frames.intrinsics
    if held or motion.is_extension or not motion.camera.has_prior_focal_length:
        return None
    width, height = motion.camera.width, motion.camera.height
    snapshots = Snapshots(motion.snapshots.folder / "without_prior")
    snapshots.folder.mkdir(exist_ok=True)
    free = replace(
        motion,
        camera=unknown_camera(width, height, FOCAL_GUESS * max(width, height), is_prior=False),
        is_fixed=False,
        is_stated=False,
        extract=lambda i: motion.snapshots.value(features_name(i), lambda: motion.extract(i)),
        snapshots=snapshots,
        divide=when_asked,
    )
    try:
        found = free.run(keyframes)
    except InputError:
        return None
    return None if found.mapper == GIVEN_ALONE else found
