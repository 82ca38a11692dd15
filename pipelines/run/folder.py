"""The run folder: the only module that knows paths inside a run.

    video.msgs/
      run.toml        the complete settings
      manifest.json   source; stage → fingerprint, files with sizes and checksums, settings, seconds, figures, warnings
      frames/  proxy/  tracking/  mapping/  global_ba/  export/
      <stage>.partial/   unfinished; renamed only when the stage ends well

`RunFolder` reads what finished stages have left, and only files that are still as they left them; what is written goes
into the folder of the running stage (`RunFile.save`). The table of the files is `run/files.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...formats.images import read_rgb
from ..types import Frame, ProxyMaps, any_of
from .files import LEFT_OUT, PROXY_MAPS, SPARSE
from .finished_files import FinishedFiles
from .layouts import RunFile

T = TypeVar("T")


@dataclass(frozen=True)
class RunFolder(FinishedFiles):
    """One run on disk: what its finished stages have left."""

    def load(self, file: RunFile[T], stage: str = "", of: int | str = "", piece: str = "") -> T:
        """Load a file of the run's table (`run/files.py`) as a stage, without one the file's first, left it; `of` which
        frame, in the folder of which `piece`. Raises InputError where it left none, or the file has changed since."""
        return file.read(self.file(*_place(file, stage, of, piece)))

    def holds(self, file: RunFile[T], stage: str = "", of: int | str = "", piece: str = "") -> bool:
        """Whether the stage has left that file."""
        return self.has(*_place(file, stage, of, piece))

    def find(self, file: RunFile[T], stage: str = "", of: int | str = "", piece: str = "") -> T | None:
        """Load the file as `load` does; None where the stage has left none."""
        return self.load(file, stage, of, piece) if self.holds(file, stage, of, piece) else None

    def find_proxy(self, frame_id: int) -> ProxyMaps | None:
        """Proxy maps of one frame, None when it has none."""
        return self.find(PROXY_MAPS, of=frame_id)

    def image_file(self, frame: Frame) -> Path:
        """The image of a frame, undistorted."""
        return self.file("frames", frame.name)

    def image(self, frame: Frame) -> NDArray[np.uint8]:
        """(H, W, 3) RGB, undistorted."""
        return read_rgb(self.image_file(frame))

    def left_out(self, frame: Frame) -> NDArray[np.bool_] | None:
        """(H, W) what of the undistorted frame is no part of the scene; None where all of it is."""
        return any_of(self.find(LEFT_OUT, stage, frame.name) for stage in LEFT_OUT.stages)

    def pieces(self, stage: str) -> list[str]:
        """Folders inside `stage` ("frames", "tracking") of the disconnected components, largest first."""
        return list(takewhile(lambda piece: self.holds(SPARSE, stage, piece=piece), (f"piece_{n}" for n in count(2))))


def _place(file: RunFile[T], stage: str, of: int | str, piece: str) -> tuple[str, str]:
    """The stage, and the file's name in its folder."""
    return stage or file.stages[0], str(PurePosixPath(piece, file.name.format(of)))
