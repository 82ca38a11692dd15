"""The user's masks: one PNG an image, black is left out (the convention of COLMAP's image reader)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.digest import files_sha256
from ...formats.errors import InputError
from ...formats.image_times import frame_number
from ...formats.images import image_size, natural_key, read_rgb
from ..source.opening import FolderSource, Source, VideoSource


@dataclass(frozen=True)
class MaskFiles:
    """paths: index of an image in the source → its mask; turns: the anticlockwise quarter turns that make it lie as the
    image is read, of those that need any."""

    paths: dict[int, Path]
    turns: dict[int, int] = field(default_factory=dict)

    def left_out(self, index: int, width: int, height: int) -> NDArray[np.bool_] | None:
        """(height, width) of the source's image `index`; None where it has no mask. What is black in half of a pixel
        is left out."""
        path = self.paths.get(index)
        if path is None:
            return None
        return reduce_mask(np.rot90(read_rgb(path).max(-1) == 0, self.turns.get(index, 0)), width, height)

    def digest(self) -> str:
        """Changes with the names and contents."""
        return files_sha256((p.name, p) for p in self.paths.values())


def reduce_mask(left_out: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """(height, width) of a mask of another size. What is left out in half of a pixel is left out."""
    scene = (~left_out).astype(np.float32)
    return np.asarray(cv2.resize(scene, (width, height), interpolation=cv2.INTER_AREA) <= 0.5)


def open_masks(folder: Path, source: Source) -> MaskFiles:
    """The masks of a source's images: NAME.jpg.png or NAME.png for the image NAME.jpg, or the number of the frame in
    the video (from 0). Not every image needs one.

    Raises InputError for a folder without any, a mask that belongs to no image, and one of another size.
    """
    if not folder.is_dir():
        raise InputError(f"--masks {folder}: there is no such folder")
    files = sorted((p for p in folder.glob("*.png") if p.is_file()), key=lambda p: natural_key(p.name))
    if not files:
        raise InputError(f"--masks {folder}: holds no PNG files. A mask is an 8 bit PNG, black is left out")
    paths, strangers = _by_number(files, source) if isinstance(source, VideoSource) else _by_name(files, source)
    if strangers:
        rule = (
            "the number of the frame in the video, the first is 0"
            if isinstance(source, VideoSource)
            else "that of the image with .png after it"
        )
        raise InputError(
            f"--masks {folder}: {len(strangers)} of {len(files)} files belong to no image, the first is "
            f"{strangers[0].name}. The name of a mask is {rule}"
        )
    turns = {}
    for index, path in paths.items():
        turn = source.turns_from_upright(index) if isinstance(source, FolderSource) else 0
        size = image_size(path)
        if turn == 2 or (turn and size == (source.height, source.width)):
            turns[index], size = turn, (source.width, source.height)
        if size != (source.width, source.height):
            raise InputError(
                f"{path} is {size[0]}x{size[1]}, the images are {source.width}x{source.height}: make masks of the "
                "same size"
            )
    return MaskFiles(paths, turns)


def _by_number(files: list[Path], source: Source) -> tuple[dict[int, Path], list[Path]]:
    last = source.expected_frames or 1 << 62
    paths = {n: p for p in files if (n := frame_number(p)) is not None and n < last}
    return paths, [p for p in files if (n := frame_number(p)) is None or n >= last]


def _by_name(files: list[Path], source: Source) -> tuple[dict[int, Path], list[Path]]:
    names = [source.name(i, i) for i in range(source.expected_frames)]
    whose = {f"{Path(n).stem}.png": i for i, n in enumerate(names)} | {f"{n}.png": i for i, n in enumerate(names)}
    return {whose[p.name]: p for p in files if p.name in whose}, [p for p in files if p.name not in whose]
