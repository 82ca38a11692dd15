"""The state of a run before it was extended: the poses of its frames, its camera, its map.

`msgs-slam extend` leaves it in a folder of the run, extension_1 and so on, beside the longer list of sources that the
run is made from then on. So a stage finds it by the source that it is given, and makes the same of it however often.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import copy_file
from ...formats.errors import InputError
from ...formats.reading import file_sha256, resolve_own
from ...formats.textfile import read_json_object, write_json
from ..config import SOURCE_LIST
from ..types import Calibration, Frame
from .files import BACKBONE, CALIBRATION, EXPOSURE, FRAMES, MAP, TRAJECTORY
from .folder import RunFolder
from .schema import RunFile, dataclass_from_json, reading

if TYPE_CHECKING:
    from ..render.gaussian_map import GaussianMap

T = TypeVar("T")

CONTENTS = "before.json"
POSES: RunFile[dict[str, NDArray]] = RunFile(
    "frames.npz", (), "table of frames", dict, dict,
    {"source_index": "i N", "cam_from_world": "f N 4 4", "is_placed": "b N", "was_chosen": "b N"},
)  # fmt: skip
"""What was known of the frames."""
FINAL = "global_ba"
"""The stage whose poses and map are taken."""


@dataclass(frozen=True)
class ParentRun:
    """The files of one extension folder, each checked when it is opened."""

    folder: Path

    @cached_property
    def contents(self) -> Mapping[str, Any]:
        """{"camera", "files": name → sha256}."""
        return read_json_object(resolve_own(self.folder, CONTENTS))

    def _read(self, file: RunFile[T]) -> T:
        path = resolve_own(self.folder, file.name)
        if not path.is_file() or file_sha256(path) != self.contents["files"].get(file.name):
            raise InputError(
                f"{path} is gone or damaged: the run can no longer be extended from it. Reconstruct all videos into "
                "another folder with --out NEW"
            )
        return file.read(path)

    @cached_property
    def _frames(self) -> Mapping[str, NDArray]:
        return self._read(POSES)

    @property
    def camera(self) -> Calibration:
        """Calibration of the undistorted frames."""
        with reading(self.folder / CONTENTS, "table of an extended run"):
            return dataclass_from_json(Calibration, self.contents["camera"])

    def poses_of(self, frames: Sequence[Frame]) -> NDArray[np.float64]:
        """cam_from_world (F, 4, 4) of these frames, NaN of those that were not there or had no place."""
        place = {int(index): row for row, index in enumerate(self._frames["source_index"])}
        out = np.full((len(frames), 4, 4), np.nan)
        for k, frame in enumerate(frames):
            row = place.get(frame.source_index)
            if row is not None and self._frames["is_placed"][row]:
                out[k] = self._frames["cam_from_world"][row]
        return out

    def keyframes_of(self, frames: Sequence[Frame]) -> tuple[list[int], int]:
        """Numbers of the frames that were keyframes, and of the first frame behind all that were there."""
        known = self._frames["source_index"]
        chosen = set(known[self._frames["was_chosen"]].tolist())
        first_new = sum(f.source_index <= int(known.max(initial=-1)) for f in frames)
        return [k for k, f in enumerate(frames[:first_new]) if f.source_index in chosen], first_new

    def load_map(self, device: str = "cpu") -> GaussianMap:
        """Load the map onto a device."""
        return self._read(MAP).to(device)

    def exposures(self) -> dict[int, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Frame id → log gain (3,) and offset (3,)."""
        rows = self._read(EXPOSURE)
        return dict(zip(rows["frame_ids"].tolist(), zip(rows["log_gains"], rows["offsets"], strict=True), strict=True))


def parent_of(source: Path) -> ParentRun | None:
    """Find the earlier state of the run made from `source`; None where it was never extended."""
    is_extended = source.name == SOURCE_LIST and (source.parent / CONTENTS).is_file()
    return ParentRun(source.parent) if is_extended else None


def save_parent(run: RunFolder, folder: Path) -> None:
    """Write that state into a folder, the table of contents last. Raises InputError where the run is damaged."""
    frames, trajectory, backbone = run.load(FRAMES), run.load(TRAJECTORY, FINAL), run.find(BACKBONE)
    ids = trajectory.frame_ids.tolist()
    chosen = set(trajectory.frame_ids[trajectory.is_keyframe].tolist())
    chosen |= set() if backbone is None else set(backbone.frame_ids.tolist())
    arrays = {
        "source_index": np.array([frames[i].source_index for i in ids], np.int64),
        "cam_from_world": trajectory.cam_from_world,
        "is_placed": trajectory.is_placed,
        "was_chosen": np.array([i in chosen for i in ids], np.bool_),
    }
    POSES.save(folder, arrays)
    for name in (MAP.name, EXPOSURE.name):
        copy_file(run.file(FINAL, name), folder / name)
    files = {file.name: file_sha256(folder / file.name) for file in (POSES, MAP, EXPOSURE)}
    write_json(folder / CONTENTS, {"camera": asdict(run.load(CALIBRATION)), "files": files})
