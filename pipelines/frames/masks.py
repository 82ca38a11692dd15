"""Masks of the frames: files of the user, read as the source reads its images, what stands still while the rest of the
image moves, and people found by networks."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ...formats.image_folder import frame_number, match_names, natural_key
from ...formats.images import image_size, read_rgb, to_grey
from ...formats.reading import note_read
from ...formats.textfile import read_json, write_json
from ..config import Config
from ..geometry.camera import ONE_CAMERA, Rig
from ..masks.people import PeopleCards, PeopleFinder, people_cards
from ..masks.still import SAMPLED, find_still
from ..networks.registry import ModelStore
from ..run.files import LEFT_OUT
from ..run.stages import StageContext
from ..source.recording import Recording, VideoRecording, open_recording
from ..system.progress import Progress
from ..types import Frame, any_of

if TYPE_CHECKING:
    from ..masks.static import Parts
    from ..sfm.flow import Picture
    from ..sfm.lens import Lens
    from ..source.faces import Faces

_MOST = 0.65
"""Share of the image beyond which a camera that stands before something that moves is as likely as one that moves."""
_LITTLE, _LOOKED_AT = 0.05, 40
"""Share of an image that masks leave, in the middle of so many, below which they are the reason where nothing is found.
"""


def check_masks(source: Path, config: Config) -> None:
    """InputError for masks of another name or size than the images, and networks that are not what they should be."""
    masks_for(config, open_recording(source, config.run.format))
    if cards := _cards(config):
        PeopleFinder(cards, 1)


def _cards(config: Config) -> PeopleCards | None:
    return people_cards(ModelStore.open()) if config.frames.people != "keep" else None


class FrameMasks:
    """The user's masks of all frames, what stands still in them, and people in those in which they were looked for, all
    before undistortion.

    `folder` keeps what the networks name, and `folder / "moving"` what of it is left out: what moves, or all of it with
    `frames.people=mask`; `chosen` names the image of a frame.
    """

    def __init__(
        self, config: Config, source: Recording, folder: Path, chosen: Path, threads: int,
        faces: Faces | None = None, rig: Rig = ONE_CAMERA,
    ) -> None:  # fmt: skip
        self._source, self._are_given = source, bool(config.frames.masks)
        self._files = masks_for(config, source)
        self._cards, self._is_forced = _cards(config), config.frames.people == "mask"
        self.folder, self._picked, self._threads = folder, chosen, threads
        self._faces, self._rig = faces, rig

    def find_people(self, frames: Sequence[Frame], keyframes: Sequence[int], progress: Progress) -> None:
        """Look for people in the keyframes; what is on disk stays."""
        if self._cards is not None:
            self._search([frames[k] for k in keyframes], progress)
            if self._is_forced and self.judged is None:
                self.leave_out(frames, keyframes, None, 0, progress)

    @property
    def _table(self) -> Path:
        return self.folder / "moving" / "judged.json"

    @property
    def judged(self) -> dict[str, int] | None:
        """Counts of the regions of keyframes that the networks name, of those that stand still and of those that surely
        move, and the `matches` of keyframes with all of them; None before `leave_out`."""
        return read_json(self._table) if self._table.exists() else None

    @property
    def any_moves(self) -> bool:
        """Whether people move, so that structure from motion is made without them."""
        return (found := self.judged) is not None and found["moving"] > 0

    def regions(self, frames: Sequence[Frame], numbers: Iterable[int]) -> list[NDArray[np.int32]]:
        """(h, w) the regions that the networks name in each of these frames, which were searched (see `regions_of`);
        nothing without networks."""
        from ..masks.static import regions_of  # imports pycolmap

        found = (LEFT_OUT.find(self.folder, frames[k].name) for k in numbers if self._cards is not None)
        return [regions_of(named) for named in found if named is not None]

    def leave_out(
        self,
        frames: Sequence[Frame],
        keyframes: Sequence[int],
        judged: Sequence[Parts] | None,
        matches: int,
        progress: Progress,
    ) -> None:
        """Leave out what does not stand still in the keyframes (`judged`: as of `find_still`, None: all that is named
        moves), and in every frame up to the next keyframe on either side of one that shows such, what is not nearer to
        what stands still there."""
        if judged is None:
            judged = [
                (r, np.where(np.arange(r.max() + 1) == 0, 1, -1).astype(np.int8))
                for r in self.regions(frames, keyframes)
            ]
        kept = [(verdict[parts] > 0) & (parts > 0) for parts, verdict in judged]
        moving = [verdict[parts] <= 0 for parts, verdict in judged]
        for k, area in zip(keyframes, moving, strict=True):
            self._save_moving(frames[k], area)
        ends = [0, *keyframes, len(frames) - 1]
        near = {k for i, area in enumerate(moving) if area.any() for k in range(ends[i], ends[i + 2] + 1)}
        self._search([frames[k] for k in sorted(near)], progress)
        for k in sorted(near - set(keyframes)):
            nearest = slice(max(bisect(keyframes, k) - 1, 0), bisect(keyframes, k) + 1)
            self._save_moving(frames[k], ~_nearer(*(reduce(np.logical_or, areas[nearest]) for areas in (kept, moving))))
        verdicts = np.concatenate([verdict[np.unique(parts[parts > 0])] for parts, verdict in judged])
        counts = {"named": len(verdicts), "still": int((verdicts > 0).sum()), "moving": int((verdicts < 0).sum())}
        write_json(self._table, counts | {"matches": matches})

    def _search(self, frames: Sequence[Frame], progress: Progress) -> None:
        todo = [f for f in frames if LEFT_OUT.find(self.folder, f.name) is None]
        if not todo or self._cards is None:
            return
        finder = PeopleFinder(self._cards, self._threads)
        for frame in progress.track(todo, "people", len(todo)):
            LEFT_OUT.save(self.folder, finder.left_out(read_rgb(self._picked / frame.name)), frame.name)

    def _save_moving(self, frame: Frame, reduced: NDArray[np.bool_]) -> None:
        """Leave out what is named of a frame inside of a reduced mask."""
        named = LEFT_OUT.find(self.folder, frame.name)
        if named is not None and reduced.any():
            size = named.shape[1], named.shape[0]
            inside = cv2.resize(reduced.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            LEFT_OUT.save(self.folder / "moving", named & inside, frame.name)

    def left_out(self, frame: Frame, width: int, height: int) -> NDArray[np.bool_] | None:
        """(height, width) of a picked frame; None where all of it is scene."""
        size = (width, height) if self._faces is None else self._faces.size
        given = any_of((self._files.left_out(frame.source_index, *size), self._transparent(frame.source_index, size)))
        if given is not None and self._faces is not None:
            given = self._faces.cut_mask(given, frame.id // self._rig.stations)
        moving = LEFT_OUT.find(self.folder / "moving", frame.name) if self._table.exists() else None
        found = any_of((given, self._still(frame, width, height), moving))
        return found if found is not None and found.any() else None

    def grey(self, frame: Frame) -> Picture:
        """Load a picked frame in grey, and its mask of pixels to leave out."""
        gray = to_grey(read_rgb(self._picked / frame.name))
        return gray, self.left_out(frame, gray.shape[1], gray.shape[0])

    def leave_out_still(self, context: StageContext, frames: Sequence[Frame]) -> StillShare:
        """Find what stands still, once, so that it is left out from then on; warn of it.

        Raises InputError where it is most of the image and no poses are known.
        """
        if context.config.frames.still == "keep":
            return StillShare()
        table = self.folder / "still.json"
        if not table.exists():
            write_json(table, asdict(self._find_still(frames, context.progress)))
        still = StillShare(**read_json(table, None))
        if still.left_out > _MOST and not context.config.frames.poses:
            from ..sfm.two_views import HOW_TO_FILM  # imports pycolmap

            raise InputError(
                f"{_percent(still.left_out)} of the image stands still while the rest moves. If the scene is what "
                "moves, as on a turntable or in a small part of a screen, leave out all else with --masks FOLDER. "
                "Otherwise the camera stands still and there is no parallax: "
                f"{HOW_TO_FILM[0].lower()}{HOW_TO_FILM[1:]}"
            )
        for warning in still.warnings:
            context.warn(warning)
        return still

    def _find_still(self, frames: Sequence[Frame], progress: Progress) -> StillShare:
        """What stands still in each direction of the rig, kept in the folder; its share of all."""
        shares, veils = [], []
        for direction in range(len(self._rig)):
            own = [f for f in frames if f.id // self._rig.stations == direction]
            rows = np.unique(np.linspace(0, len(own) - 1, min(SAMPLED, len(own))).round().astype(int))
            still = find_still(self.grey(own[i]) for i in progress.track(rows.tolist(), "still parts", len(rows)))
            if still is not None and still.left_out.any():
                LEFT_OUT.save(self.folder, still.left_out, _still_name(direction))
            shares.append(0.0 if still is None else float(still.left_out.mean()))
            veils.append(0.0 if still is None else still.veil)
        return StillShare(float(np.mean(shares)), float(np.mean(veils)))

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
            folder = next(iter(self._files.paths.values())).parent
            by = f"the masks of {'--masks' if self._are_given else 'the data set,'} {folder}"
            rule = "Black (0) is left out, all else is kept: invert masks that mean the opposite, or omit them"
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
        judged = self.judged or {}
        found: dict[str, Any] = {f"people_{name}": judged[name] for name in ("named", "still") if judged}
        if shares:
            found |= {"masked_frames": len(shares), "masked_share": round(float(np.mean(shares)), 4)}
        return found


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


def _nearer(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(h, w) the pixels that are nearer to one area (h, w) than to another."""
    away = [cv2.distanceTransform((~a).astype(np.uint8), cv2.DIST_L2, 3) for a in (first, second)]
    return np.asarray(away[0] < away[1])


def reduce_mask(left_out: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """(height, width) of a mask of another size. What is left out in half of a pixel is left out."""
    scene = (~left_out).astype(np.float32)
    return np.asarray(cv2.resize(scene, (width, height), interpolation=cv2.INTER_AREA) <= 0.5)


def masks_for(config: Config, source: Recording) -> MaskFiles:
    """Return the masks of --masks, else those that the source names itself. Raises InputError as `open_masks`."""
    if config.frames.masks:
        return open_masks(Path(config.frames.masks), source)
    return _of_one_size(source.masks(), source)


def open_masks(folder: Path, source: Recording) -> MaskFiles:
    """The masks of a source's images: NAME.jpg.png or NAME.png for the image NAME.jpg, or the number of the frame in
    the video (from 0). Not every image needs one.

    Raises InputError for a folder without any, a mask that belongs to no image, and one of another size.
    """
    if not folder.is_dir():
        raise InputError(f"--masks {folder}: there is no such folder")
    files = sorted((p for p in folder.rglob("*.png") if p.is_file()), key=lambda p: natural_key(p.name))
    for place in (folder, *(p for p in folder.rglob("*") if p.is_dir())):
        note_read(place)
    if not files:
        raise InputError(f"--masks {folder}: holds no PNG files. A mask is an 8 bit PNG, black is left out")
    paths, strangers = _by_number(files, source) if isinstance(source, VideoRecording) else _by_name(files, source)
    if strangers:
        rule = (
            "the number of the frame in the video, the first is 0"
            if isinstance(source, VideoRecording)
            else "that of the image with .png after it"
        )
        raise InputError(
            f"--masks {folder}: {len(strangers)} of {len(files)} files belong to no image, the first is "
            f"{strangers[0].name}. The name of a mask is {rule}"
        )
    return _of_one_size(paths, source)


def _of_one_size(paths: dict[int, Path], source: Recording) -> MaskFiles:
    turns = {}
    for index, path in paths.items():
        turn = source.turns_from_upright(index)
        size = image_size(path)
        if turn == 2 or (turn and size == (source.height, source.width)):
            turns[index], size = turn, (source.width, source.height)
        if size != (source.width, source.height):
            raise InputError(
                f"{path} is {size[0]}x{size[1]}, the images are {source.width}x{source.height}: make masks of the "
                "same size"
            )
    return MaskFiles(paths, turns)


def _by_number(files: list[Path], source: Recording) -> tuple[dict[int, Path], list[Path]]:
    last = source.expected_frames or 1 << 62
    paths = {n: p for p in files if (n := frame_number(p)) is not None and n < last}
    return paths, [p for p in files if (n := frame_number(p)) is None or n >= last]


def _by_name(files: list[Path], source: Recording) -> tuple[dict[int, Path], list[Path]]:
    places = [source.place(i) for i in range(source.expected_frames)]
    found = match_names([str(p.with_suffix("")) for p in files], places)
    paths = {i: p for i, p in zip(found, files, strict=True) if i is not None}
    return paths, [p for i, p in zip(found, files, strict=True) if i is None]


def _still_name(direction: int) -> str:
    return f"still_{direction}"


def masks_of(context: StageContext, source: Recording, faces: Faces | None, rig: Rig) -> FrameMasks:
    """Return the masks of all frames; people only in frames that have been searched."""
    from .keyframes import PICKED  # imports pycolmap

    places = context.snapshot / "left_out", context.snapshot / PICKED
    return FrameMasks(context.config, source, *places, context.threads, faces, rig)


@dataclass(frozen=True)
class StillShare:
    """Shares of the image: what stands still and is left out, and over what a reflection does, which cannot be."""

    left_out: float = 0.0
    veil: float = 0.0

    @property
    def warnings(self) -> list[str]:
        """Say what was found, and what to do."""
        said = []
        if self.left_out:
            said.append(
                f"{_percent(self.left_out)} of the image stands still while the rest moves (a bonnet, a display, a "
                "frame around the view?): it is left out, like what --masks leaves out. To take it for scene: "
                "--set frames.still=keep"
            )
        if self.veil:
            said.append(
                f"something translucent, such as a reflection, stands still over {_percent(self.veil)} of the image "
                "while what is behind it moves: poses and focal length may be wrong. Leave the worst of it out with "
                "--masks, or film again without a pane, or with the lens close to it"
            )
        return said

    @property
    def note(self) -> str:
        """Sentence for the end of another message whose cause it may be; "" where nothing was found."""
        noted = []
        if self.left_out:
            noted.append(f"{_percent(self.left_out)} of the image stands still while the rest moves and is left out")
        if self.veil:
            noted.append(f"a reflection or the like stands still over {_percent(self.veil)} of the image")
        return f". Note that {' and '.join(noted)}" if noted else ""

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the stage."""
        return {f"still_{name}": round(share, 4) for name, share in asdict(self).items() if share}


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else f"{share:.1%}"
