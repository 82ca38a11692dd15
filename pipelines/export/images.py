"""Images for trainers at the size of the source: structure from motion works on smaller ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ...formats.errors import InputError
from ...formats.images import write_rgb
from ...formats.video import VideoFrame
from ..compute.threads import get_threads
from ..outcome import Outcome
from ..run.files import LEFT_OUT
from ..run.folder import load_source
from ..sfm.lens import Lens, distorted_camera, make_lens, to_pycolmap
from ..source.recording import Recording, open_recording
from ..source.sharpness import reduce_image, reduced_size
from ..system.parallel import parallel_map
from ..types import Frame, Intrinsics

IMAGES = "images"
"""The folder of a data set's images by the name that trainers expect."""
_MOST_DIFFERENT = 8.0
"""Mean difference in grey levels between a frame and the image of the source that it was made from."""


def write_images(
    outcome: Outcome, frames: list[Frame], side: int, folder: Path, warn: Callable[[str], None]
) -> Intrinsics:
    """Write `images/` with the undistorted frames, and return their camera.

    They are read again from the source where that is larger than the frames, with a long side of at most `side` pixels;
    where it cannot be read, or is no longer what the frames were made from, they are the frames of the run, which is
    warned of.
    """
    camera = outcome.calibration.intrinsics
    try:
        if (larger := _larger(outcome, side)) is not None:
            source, lens = larger
            _write_larger(outcome, frames, source, lens, side, folder)
            return lens.pinhole
    except InputError as error:
        warn(f"images/ has the frames of the run, {camera.width}x{camera.height}, and none larger: {error}")
    for frame in frames:
        copy_file(outcome.run.image_file(frame), folder / IMAGES / frame.name)
    return camera


def write_masks(outcome: Outcome, frames: list[Frame], camera: Intrinsics, folder: Path) -> list[str]:
    """Write the masks of the frames, as large as their images, and return their names: of all frames where one has any,
    as nerfstudio reads them."""
    if all(outcome.run.left_out(frame) is None for frame in frames):
        return []
    size = (camera.width, camera.height)
    for frame in frames:
        left_out = outcome.run.left_out(frame)
        mask = np.zeros(size[::-1], np.uint8) if left_out is None else left_out.astype(np.uint8)
        LEFT_OUT.save(folder, cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0, frame.name)
    return [LEFT_OUT.name.format(frame.name) for frame in frames]


def _larger(outcome: Outcome, side: int) -> tuple[Recording, Lens] | None:
    """The source, and the lens of its images reduced to `side`; None where these are no larger than the frames, or the
    frames are no whole images of the source. Raises InputError where the source cannot be read."""
    calibration, most = outcome.calibration, outcome.config.frames.max_side
    k = calibration.intrinsics
    if calibration.directions > 1 or calibration.fisheye or max(k.width, k.height) < most:
        return None
    source = open_recording(Path(load_source(outcome.run).path), outcome.config.run.format)
    width, height = reduced_size(source.width, source.height, side)
    if reduced_size(source.width, source.height, most) != (k.width, k.height) or width <= k.width:
        return None
    x, y = width / k.width, height / k.height
    pinhole = Intrinsics(width, height, k.fx * x, k.fy * y, k.cx * x, k.cy * y)
    distorted = to_pycolmap(distorted_camera(calibration))
    straight = make_lens(distorted).is_straight
    distorted.rescale(width, height)
    return source, Lens(distorted, pinhole, 0.0 if straight else np.inf)


def _write_larger(
    outcome: Outcome, frames: list[Frame], source: Recording, lens: Lens, side: int, folder: Path
) -> None:
    by_index = {frame.source_index: frame for frame in frames}

    def write(picture: VideoFrame) -> None:
        frame = by_index[picture.source_index]
        reduced = reduce_image(picture.rgb, side)
        image = reduced if lens.is_straight else lens.undistort_image(reduced)
        _require_same(outcome.run.image(frame), image, source.path, frame)
        write_rgb(folder / IMAGES / frame.name, image)

    count = sum(1 for _ in parallel_map(write, source.read(by_index), get_threads()))
    if count < len(frames):
        raise InputError(f"only {count} of {len(frames)} frames could be read again from {source.path}")


def _require_same(frame: NDArray[np.uint8], image: NDArray[np.uint8], source: Path, about: Frame) -> None:
    small = cv2.resize(image, (frame.shape[1], frame.shape[0]), interpolation=cv2.INTER_AREA)
    if np.abs(small.astype(np.int16) - frame).mean() > _MOST_DIFFERENT:
        raise InputError(f"{source} has changed: its image {about.source_index} is not that of frame {about.id}")
