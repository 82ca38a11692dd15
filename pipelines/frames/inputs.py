"""Checks before the stage begins, and the windows into which memory divides it.

Imports nothing that computes.
"""

from pathlib import Path

from ...formats.errors import InputError
from ...formats.image_folder import hint_at_inner_folder
from ..config import Config
from ..run.files import CALIBRATION
from ..run.folder import RunFolder
from ..source.files import Warn
from ..source.given import check_poses, read_intrinsics
from ..source.recording import FolderRecording, Recording, open_recording
from ..system.machine import window_size, windows_of
from .learned import open_learned
from .masks import check_masks


def frames_division(run: RunFolder, config: Config) -> list[range]:
    """Return the windows of structure from motion, which are smaller for less memory: other ones give other poses."""
    calibration, figures = run.load(CALIBRATION), run.records["frames"].figures
    pixels = calibration.intrinsics.width * calibration.intrinsics.height
    size = window_size(config.run.memory_mb, pixels)
    return windows_of(figures.get("keyframes", 0), size) if calibration.directions == 1 else []


def check_frames(source: Path, config: Config) -> None:
    """Raise InputError for a source, or a camera given for it, that cannot be used."""
    opened = open_recording(source, config.run.format)
    require_several(opened)
    from ..sfm.rolling import read_readout  # pycolmap, for sources that can be used
    from ..source.faces import find_faces

    check_masks(source, config)
    open_learned(config.frames)
    if any(read_readout(config.frames.rolling_shutter) or ()) and not opened.is_timed():
        raise InputError(
            f"frames.rolling_shutter={config.frames.rolling_shutter} needs to know when each image was taken, and "
            f"{source} does not tell: give the video itself, or put the times in {source.name}/times.txt"
        )
    faces = find_faces(opened, config.frames)
    if faces is None and config.frames.intrinsics:
        read_intrinsics(config.frames.intrinsics, opened.width, opened.height)
    if faces is not None and len(faces) > 1:
        _check_panoramas(config)
    check_poses(config.frames, opened)


def _check_panoramas(config: Config) -> None:
    """What knows pixels of the source's own pictures does not know its panoramas."""
    if config.frames.poses:
        raise InputError("--poses cannot be used with panoramas, which are cut into several images first: omit it")
    files = [p for p in (config.proxy.depth, config.proxy.semantics) if p.startswith("files")]
    reference = config.proxy.scale_ref.strip()
    if files or (reference and not reference.startswith("height")):
        what = f"{files[0]!r}" if files else f"--scale-ref {reference}"
        raise InputError(
            f"{what} cannot be used with panoramas, which are cut into several images first: omit it. For metres, give "
            "--scale-ref height=METRES, the height of the camera above the floor"
        )


def require_several(source: Recording, warn: Warn | None = None) -> None:
    """Raise InputError for a folder of one image; warn where images of a folder inside may be meant."""
    if not isinstance(source, FolderRecording):
        return
    hint = hint_at_inner_folder(source.path, source.expected_frames + 1)
    if len(source.headers.of) < 2:
        needed = f"holds one image only; a reconstruction needs several views of a scene{hint and ': '}{hint}"
        raise InputError(f"{source.path} {needed}")
    if hint and warn is not None:
        warn(f"{source.path} holds {source.expected_frames} images; {hint} if those are meant")
