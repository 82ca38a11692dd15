"""Masks of the frames: files of the user, read as the source reads its images, what stands still while the rest of the
image moves, and people found by networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.image_folder import frame_number, natural_key
from ...formats.images import image_size, read_rgb, to_grey
from ...formats.reading import files_sha256
from ..config import Config
from ..engine.stages import StageContext
from ..geometry.camera import ONE_CAMERA, Rig
from ..masks.people import PeopleCards, PeopleFinder, people_cards
from ..networks.registry import ModelStore
from ..run.files import LEFT_OUT
from ..source.opening import FolderSource, Source, VideoSource, open_source
from ..system.progress import Progress
from ..types import Frame, any_of

if TYPE_CHECKING:
    from ..sfm.flow import Picture
    from ..sfm.lens import Lens
    from ..source.faces import Faces

_LITTLE, _LOOKED_AT = 0.05, 40
"""Share of an image that masks leave, in the middle of so many, below which they are the reason where nothing is found.
"""


def mask_inputs(source: Path, config: Config) -> dict[str, str] | None:
    """Return digests of the user's masks and of the networks for people; None without any."""
    folder, cards = config.frames.masks, _cards(config)
    found = {"masks": open_masks(Path(folder), open_source(source, config.run.format)).digest()} if folder else {}
    return found | ({"people": cards.identity()} if cards else {}) or None


def check_masks(source: Path, config: Config) -> None:
    """InputError for masks of another name or size than the images, and networks that are not what they should be."""
    if config.frames.masks:
        open_masks(Path(config.frames.masks), open_source(source, config.run.format))
    if cards := _cards(config):
        PeopleFinder(cards, 1)


def _cards(config: Config) -> PeopleCards | None:
    return people_cards(ModelStore.open()) if config.frames.people == "auto" else None


class FrameMasks:
    """The user's masks of all frames, what stands still in them, and people in those in which they were looked for, all
    before undistortion.

    `folder` keeps what was found; `picked` names the image of a frame.
    """

    def __init__(
        self, config: Config, source: Source, folder: Path, picked: Path, threads: int,
        faces: Faces | None = None, rig: Rig = ONE_CAMERA,
    ) -> None:  # fmt: skip
        self._source = source
        self._files = open_masks(Path(config.frames.masks), source) if config.frames.masks else MaskFiles({})
        self._cards = _cards(config)
        self.folder, self._picked, self._threads = folder, picked, threads
        self._faces, self._rig = faces, rig

    def find_people(self, frames: Sequence[Frame], keyframes: Sequence[int], progress: Progress) -> None:
        """Look for people in the keyframes, and in every frame up to the next keyframe on either side of one that shows
        any; what is on disk stays."""
        if self._cards is None:
            return
        finder = PeopleFinder(self._cards, self._threads)
        self._search(finder, [frames[k] for k in keyframes], progress)
        shown = [i for i, k in enumerate(keyframes) if self._shows_people(frames[k])]
        ends = [0, *keyframes, len(frames) - 1]
        near = sorted({k for i in shown for k in range(ends[i], ends[i + 2] + 1)})
        self._search(finder, [frames[k] for k in near], progress)

    def _search(self, finder: PeopleFinder, frames: Sequence[Frame], progress: Progress) -> None:
        todo = [f for f in frames if LEFT_OUT.find(self.folder, f.name) is None]
        for frame in progress.track(todo, "people", len(todo)) if todo else ():
            LEFT_OUT.save(self.folder, finder.left_out(read_rgb(self._picked / frame.name)), frame.name)

    def _shows_people(self, frame: Frame) -> bool:
        found = LEFT_OUT.find(self.folder, frame.name)
        return found is not None and bool(found.any())

    def left_out(self, frame: Frame, width: int, height: int) -> NDArray[np.bool_] | None:
        """(height, width) of a picked frame; None where all of it is scene."""
        size = (width, height) if self._faces is None else self._faces.size
        given = any_of((self._files.left_out(frame.source_index, *size), self._transparent(frame.source_index, size)))
        if given is not None and self._faces is not None:
            given = self._faces.cut_mask(given, frame.id // self._rig.stations)
        found = any_of((given, self._still(frame, width, height), LEFT_OUT.find(self.folder, frame.name)))
        return found if found is not None and found.any() else None

    def save_still(self, left_out: NDArray[np.bool_], direction: int) -> None:
        """Leave out what stands still (h, w), of any size, in all frames of a direction of the rig."""
        LEFT_OUT.save(self.folder, left_out, _still_name(direction))

    def _still(self, frame: Frame, width: int, height: int) -> NDArray[np.bool_] | None:
        found = LEFT_OUT.find(self.folder, _still_name(frame.id // self._rig.stations))
        return None if found is None else reduce_mask(found, width, height)

    def _transparent(self, index: int, size: tuple[int, int]) -> NDArray[np.bool_] | None:
        """(height, width) of the source's image `index`, its transparent background at a size (width, height)."""
        clear = self._source.transparent(index)
        return None if clear is None else reduce_mask(clear, *size)

    def blame(self, frames: Sequence[Frame], width: int, height: int) -> str | None:
        """Return why nothing can be reconstructed of picked frames of this size, where masks leave next to nothing."""
        some = [self.left_out(f, width, height) for f in frames[:: -(-len(frames) // _LOOKED_AT)]]
        left = float(np.median([1.0 if m is None else 1 - m.mean() for m in some]))
        if left >= _LITTLE:
            return None
        by, rule = "the transparent backgrounds of the images", "Give the images without transparency"
        if self._files.paths:
            by = f"the masks of --masks {next(iter(self._files.paths.values())).parent}"
            rule = "Black (0) is left out, all else is kept: invert masks that mean the opposite, or omit --masks"
        return f"{by} leave only {left:.1%} of the images, too little for a reconstruction. {rule}"

    def write(self, folder: Path, frames: Sequence[Frame], lens: Lens) -> dict[str, Any]:
        """Write the masks of the undistorted frames that have any, or on which the lens folds over; how many leave out
        what the frame itself shows, and how much that is."""
        shares = []
        for frame in frames:
            left_out = self.left_out(frame, lens.pinhole.width, lens.pinhole.height)
            undistorted = None if left_out is None else lens.undistort_mask(left_out)
            if (unseen := any_of((undistorted, lens.folded))) is not None:
                LEFT_OUT.save(folder, unseen, frame.name)
            if left_out is not None:
                shares.append(float(left_out.mean()))
        return {"masked_frames": len(shares), "masked_share": round(float(np.mean(shares)), 4)} if shares else {}


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


def picked(context: StageContext, name: str) -> Path:
    """The file of an image."""
    return context.snapshot / "picked" / name


def grey_of(context: StageContext, masks: FrameMasks, frame: Frame) -> Picture:
    """Load a frame in grey, and its mask of pixels to leave out."""
    gray = to_grey(read_rgb(picked(context, frame.name)))
    return gray, masks.left_out(frame, gray.shape[1], gray.shape[0])


def _still_name(direction: int) -> str:
    return f"still_{direction}"


def masks_of(context: StageContext, source: Source, faces: Faces | None, rig: Rig) -> FrameMasks:
    """Return the masks of all frames; people only in frames that have been searched."""
    places = context.snapshot / "left_out", context.snapshot / "picked"
    return FrameMasks(context.config, source, *places, context.threads, faces, rig)
