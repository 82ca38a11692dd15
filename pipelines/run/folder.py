"""The run folder: where everything in a run lies, and whether it is as the program left it.

    video.msgs/
      run.toml        the complete settings; may be edited
      manifest.json   source; stage → fingerprint, files with sizes and checksums, settings, seconds, figures, warnings
      frames/  proxy/  tracking/  mapping/  global_ba/  export/
      <stage>.partial/   unfinished; renamed only when the stage ends well

`RunFolder` reads what finished stages have left, and only files that are still as they left them; what is written goes
into the folder of the running stage (`RunFile.save`). The table of the files is `run/files.py`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields, replace
from itertools import count, takewhile
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ...formats.atomic import write_text
from ...formats.errors import InputError
from ...formats.images import read_rgb
from ...formats.reading import file_sha256, require_no_link, resolve_own
from ...formats.textfile import read_toml
from ..config import EXTENSION, SOURCE_LIST, Config
from ..system.progress import log
from ..system.wording import quoted
from ..types import Frame, ProxyMaps, any_of
from .files import LEFT_OUT, PROXY_MAPS, SPARSE
from .manifest import Manifest, Source, previous_settings, read_manifest, recorded_config
from .reads import StageRecord, digest_of_result, note_result
from .schema import RunFile
from .settings import UnknownSettingError, config_to_toml, merge_known_settings

T = TypeVar("T")
Stamp = tuple[int, int, int]
"""Inode, bytes and time of change: another one means that the file may be another."""
_FIRST_LINE = "# The settings of this run: edit them here, or give --set or --config to `msgs-slam resume`.\n"
_LAST_LINE = "# End of run.toml.\n"


def _stamp(path: Path) -> Stamp:
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


@dataclass(frozen=True)
class RunFolder:
    """One run on disk: what its finished stages have left."""

    root: Path
    _manifest: dict[Stamp, Manifest] = field(default_factory=dict, init=False, compare=False, repr=False)
    _digests: dict[Path, tuple[Stamp, str]] = field(default_factory=dict, init=False, compare=False, repr=False)

    @property
    def place(self) -> Path:
        """The folder's whole path, which has a name: "." has none."""
        return Path(os.path.abspath(self.root))

    def required(self) -> RunFolder:
        """Return the run itself. Raises InputError where the folder holds none."""
        if self.manifest_file.exists():
            return self
        what = "does not exist" if not self.root.exists() else "is not a run folder (it has no manifest.json)"
        near = f"; did you mean {' or '.join(map(str, found))}?" if (found := self._near()) else "."
        raise InputError(f"{self.root} {what}{near} `msgs-slam reconstruct VIDEO` creates a run")

    def _near(self, limit: int = 3) -> list[Path]:
        """Runs that may be meant where this is none: in it, around it, of the video that it is, of a like name."""
        path = self.root
        inside = sorted(path.iterdir()) if path.is_dir() else []
        named = [path.with_suffix(".msgs"), Path(f"{path.stem}.msgs")] if path.name else []  # "." and "/" have no name
        places = dict.fromkeys([*inside, *named, *path.parents[:2]])
        return [p for p in places if RunFolder(p).manifest_file.is_file()][:limit]

    def path(self, *names: str) -> Path:
        """Return the path of a file or folder of the run, there or not. Raises InputError for one that would lie
        outside of it, by its name or by a link: the run may be anybody's."""
        return resolve_own(self.root, "/".join(names))

    def stage(self, name: str) -> Path:
        """Folder of a finished stage. Raises as `path`."""
        return self.path(name)

    def partial(self, name: str) -> Path:
        """Folder of an unfinished stage. Raises as `path`."""
        return self.path(f"{name}.partial")

    def piece(self, name: str) -> RunFolder:
        """Return the run inside this one that a disconnected component is. Raises as `path`."""
        return RunFolder(self.path(name))

    @property
    def settings_file(self) -> Path:
        return self.root / "run.toml"

    @property
    def manifest_file(self) -> Path:
        return self.root / "manifest.json"

    @property
    def evaluation_file(self) -> Path:
        return self.path("evaluation", "evaluation.json")

    @property
    def report_file(self) -> Path:
        return self.path("report.html")

    def manifest(self) -> Manifest | None:
        """None before there is any. Raises InputError for a damaged one."""
        if not self.manifest_file.exists():
            return None
        require_no_link(self.manifest_file)
        stamp = _stamp(self.manifest_file)
        if stamp not in self._manifest:
            manifest = read_manifest(self.manifest_file)
            self._manifest.clear()
            self._manifest[stamp] = manifest
        return self._manifest[stamp]

    @property
    def records(self) -> dict[str, StageRecord]:
        """The finished stages by name."""
        manifest = self.manifest()
        return {} if manifest is None else dict(manifest.records)

    @property
    def stale(self) -> dict[str, StageRecord]:
        """The stages whose results are of before a stage ahead of them was made again, by name."""
        manifest = self.manifest()
        return {} if manifest is None else dict(manifest.stale)

    @property
    def source(self) -> Source:
        """The source that the run is made from. Raises InputError for a folder that is not a run."""
        source = (self.manifest() or read_manifest(self.manifest_file)).source
        path = Path(source.path)
        if path.name != SOURCE_LIST:
            return source
        # The list of several videos is in the run, wherever that has been moved to.
        place = (path.parent.name, SOURCE_LIST) if path.parent.name.startswith(EXTENSION) else (SOURCE_LIST,)
        return replace(source, path=str(found)) if (found := self.path(*place)).is_file() else source

    def why_not_done(self, stage: str) -> str:
        """Say that a stage is not done, and how to come to its results: of one whose results are stale also the
        settings with which they count again."""
        resume = f"msgs-slam resume {quoted(self.root)}"
        if stage not in (stale := self.stale):
            return f"{stage} is not done. Run `{resume}` first"
        changed = previous_settings(stale[stage], self.settings())
        back = f", or go back with `{resume} {' '.join(f'--set {quoted(t)}' for t in changed)}`" if changed else ""
        return (
            f"{stage} is not done: what is in {self.stage(stage)} was made before the run was changed, and does not "
            f"belong to what it holds now. Run `{resume}` to make it again{back}"
        )

    def save_settings(self, config: Config) -> None:
        """Write run.toml, atomically, where it holds other settings. Raises InputError when the disk refuses."""
        if not self.settings_file.exists() or self.settings() != config:
            write_text(self.settings_file, _FIRST_LINE + config_to_toml(config) + _LAST_LINE)

    def settings(self) -> Config:
        """Load the settings with which the run goes on; the file may have been edited.

        Where it is gone, what the finished stages were made with is taken, and defaults for the others. Raises
        InputError where none is finished, for a file that is cut short, and for values that a setting cannot have.
        """
        file = self.settings_file
        if not file.exists():
            if not (records := self.records):
                raise InputError(
                    f"{self.root} was stopped before its settings were written, or {file.name} is gone, and nothing "
                    f"is finished: run `msgs-slam reconstruct {quoted(self.source.path)} --out {quoted(self.root)}` "
                    "with the options it had"
                )
            log.warning("%s is gone: stages that are not done get default settings", file)
            return recorded_config(records, Config())
        try:
            require_no_link(file)
            values = read_toml(file)
            is_complete = all(f.name in values.get(name, {}) for name, s in vars(Config()).items() for f in fields(s))
            if not is_complete and _LAST_LINE.encode().strip() not in file.read_bytes():
                raise InputError(f"{file} is cut short, for its last line is missing ({_LAST_LINE.strip()})")
            config, dropped = merge_known_settings(Config(), values, str(file))
            if wrong := next((error for error in dropped if not isinstance(error, UnknownSettingError)), None):
                raise wrong
        except InputError as error:
            raise InputError(
                f"{error}. Correct it, or delete it and run `msgs-slam resume {quoted(self.root)}`: what the finished "
                "stages were made with is kept in manifest.json"
            ) from error
        for unknown in dropped:  # of another version of the program, or mistyped
            log.warning("%s: it is ignored", unknown)
        return config

    def has(self, stage: str, name: str) -> bool:
        """Whether the finished stage has left a file of that name, be it there still or not."""
        manifest = self.manifest()
        if manifest is None:
            return self.path(stage, name).exists()
        if stage not in manifest.records:
            return False
        note_result(self.root, stage, name, lambda: digest_of_result(manifest.records[stage], name))
        return name in manifest.records[stage].files

    def file(self, stage: str, name: str) -> Path:
        """A file of a finished stage, for reading.

        Its checksum is taken when it is first used, and again when its inode, size or time of change is another: a
        megabyte takes a millisecond, which is less than anything that is done with it takes. Raises InputError when
        it is not as the stage left it. Without a manifest there is nothing to compare with, and no command goes on.
        """
        path, manifest = self.path(stage, name), self.manifest()
        if manifest is None:
            return path
        if stage not in manifest.records:
            raise InputError(f"{self.root}: {self.why_not_done(stage)}")
        note_result(self.root, stage, name, lambda: digest_of_result(manifest.records[stage], name))
        expected = manifest.records[stage].files.get(name)
        if expected is None or not self._is_intact(stage, name, *expected):
            what = "is gone" if not path.is_file() else "is not as the program left it: damaged or changed"
            raise InputError(
                f"{path} {what}. Run `msgs-slam resume {quoted(self.root)}`: {stage} and what follows are made again"
            )
        return path

    def damaged(self, stage: str) -> list[str]:
        """Names of the files of a finished stage, or a stale one, that are gone or not as it left them. Reads all of
        them. Those of the pieces, runs inside the run, count for the export, which makes them."""
        ended = {**self.stale, **self.records}
        files = ended[stage].files if stage in ended else {}
        own = [name for name, expected in files.items() if not self._is_intact(stage, name, *expected)]
        names = {name.partition("/")[0] for name in files if stage == "export" and name.startswith("piece_")}
        return own + [f"../{name}/{file}" for name in sorted(names) for file in self.piece(name)._wrong()]

    def _wrong(self) -> list[str]:
        """The same over all stages, inside the run."""
        if (manifest := self.manifest()) is None:
            return [self.manifest_file.name]
        return [f"{stage}/{name}" for stage in manifest.records for name in self.damaged(stage)]

    @property
    def is_piece(self) -> bool:
        """Whether this is a run inside another one."""
        return self.place.name.startswith("piece_") and RunFolder(self.place.parent).manifest_file.exists()

    def _is_intact(self, stage: str, name: str, size: int, digest: str) -> bool:
        try:
            path = self.path(stage, name)
            stamp = _stamp(path)
            if stamp[1] != size or not path.is_file():
                return False
            if (known := self._digests.get(path)) is None or known[0] != stamp:
                known = self._digests[path] = (stamp, file_sha256(path))
        except (OSError, InputError):
            return False
        return known[1] == digest

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
