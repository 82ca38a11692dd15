"""Digest of the program that made a result: it cannot be forgotten when the code changes.

Libraries are not part of it: another numpy or COLMAP may give other bytes, and does not make a run out of date.
"""

import functools
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("formats", "pipelines")
"""Folders of `ROOT` that results depend on; the command line is not one of them."""


@functools.cache
def package_digest(root: Path = ROOT) -> str:
    """Compute the digest of all sources and data (weights, tables, pages) of `ROOMS`, as they were when first asked
    for. A comment counts as a change: a stage that runs once too often does no harm."""
    return digest_of((path for room in ROOMS for path in (root / room).rglob("*") if _is_part(path, root)), root)


def _is_part(path: Path, root: Path) -> bool:
    hidden = any(part.startswith((".", "__pycache__")) for part in path.relative_to(root).parts)
    return path.is_file() and not hidden


def digest_of(files: Iterable[Path], root: Path = ROOT) -> str:
    """Compute the digest of files' names below `root` and contents; line ends do not count, as git may change them."""
    digest = hashlib.sha256()
    for name, path in sorted((os.path.relpath(path, root).replace(os.sep, "/"), path) for path in files):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode())
    return digest.hexdigest()[:16]
