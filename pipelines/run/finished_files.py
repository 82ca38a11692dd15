"""Files of finished stages: their paths, and whether they are unchanged."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ...formats.digest import file_sha256
from ...formats.errors import InputError
from ..system.wording import quoted
from .records import Manifest, read_manifest

Stamp = tuple[int, int, int]
"""Inode, bytes and time of change: another one means that the file may be another."""


def _stamp(path: Path) -> Stamp:
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


@dataclass(frozen=True)
class FinishedFiles:
    """The files of one run on disk, and whether they are still what the finished stages left."""

    root: Path
    _manifest: dict[Stamp, Manifest] = field(default_factory=dict, init=False, compare=False, repr=False)
    _digests: dict[Path, tuple[Stamp, str]] = field(default_factory=dict, init=False, compare=False, repr=False)

    def stage(self, name: str) -> Path:
        """Folder of a finished stage."""
        return self.root / name

    def partial(self, name: str) -> Path:
        """Folder of an unfinished stage."""
        return self.root / f"{name}.partial"

    @property
    def settings_file(self) -> Path:
        return self.root / "run.toml"

    @property
    def manifest_file(self) -> Path:
        return self.root / "manifest.json"

    @property
    def evaluation_file(self) -> Path:
        return self.root / "evaluation" / "evaluation.json"

    @property
    def report_file(self) -> Path:
        return self.root / "report.html"

    def manifest(self) -> Manifest | None:
        """None before there is any. Raises InputError for a damaged one."""
        if not self.manifest_file.exists():
            return None
        stamp = _stamp(self.manifest_file)
        if stamp not in self._manifest:
            manifest = read_manifest(self.manifest_file)
            self._manifest.clear()
            self._manifest[stamp] = manifest
        return self._manifest[stamp]

    def has(self, stage: str, name: str) -> bool:
        """Whether the finished stage has left a file of that name, be it there still or not."""
        manifest = self.manifest()
        if manifest is None:
            return (self.stage(stage) / name).exists()
        return stage in manifest.records and name in manifest.records[stage].files

    def file(self, stage: str, name: str) -> Path:
        """A file of a finished stage, for reading.

        Its checksum is taken when it is first used, and again when its inode, size or time of change is another: a
        megabyte takes a millisecond, which is less than anything that is done with it takes. Raises InputError when
        it is not as the stage left it. Without a manifest there is nothing to compare with, and no command goes on.
        """
        path, manifest = self.stage(stage) / name, self.manifest()
        if manifest is None:
            return path
        if stage not in manifest.records:
            raise InputError(f"{self.root}: {stage} is not done. Run `msgs-slam resume {quoted(self.root)}` first")
        expected = manifest.records[stage].files.get(name)
        if expected is None or not self._is_intact(path, *expected):
            what = "is gone" if not path.is_file() else "is not as the program left it: damaged or changed"
            raise InputError(
                f"{path} {what}. Run `msgs-slam resume {quoted(self.root)}`: {stage} and what follows are made again"
            )
        return path

    def damaged(self, stage: str) -> list[str]:
        """Names of the files of a finished stage that are gone or not as it left them. Reads all of them. Those of the
        pieces, runs inside the run, count for the export, which makes them."""
        manifest = self.manifest()
        files = manifest.records[stage].files if manifest and stage in manifest.records else {}
        own = [name for name, expected in files.items() if not self._is_intact(self.stage(stage) / name, *expected)]
        names = {name.partition("/")[0] for name in files if stage == "export" and name.startswith("piece_")}
        return own + [f"../{name}/{file}" for name in sorted(names) for file in type(self)(self.root / name)._wrong()]

    def _wrong(self) -> list[str]:
        """The same over all stages, inside the run."""
        if (manifest := self.manifest()) is None:
            return [self.manifest_file.name]
        return [f"{stage}/{name}" for stage in manifest.records for name in self.damaged(stage)]

    @property
    def is_piece(self) -> bool:
        """Whether this is a run inside another one."""
        return self.root.name.startswith("piece_") and type(self)(self.root.parent).manifest_file.exists()

    def _is_intact(self, path: Path, size: int, digest: str) -> bool:
        try:
            stamp = _stamp(path)
            if stamp[1] != size or not path.is_file():
                return False
            if (known := self._digests.get(path)) is None or known[0] != stamp:
                known = self._digests[path] = (stamp, file_sha256(path))
        except OSError:
            return False
        return known[1] == digest
