"""Hashes of a file's content, or of a list of files."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

from .reading import opened


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file's bytes. Raises InputError when it cannot be read."""
    with opened(path, any_content=True) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def files_sha256(named: Iterable[tuple[str, Path]], head: bytes = b"") -> str:
    """Hex SHA-256 over `head` and the names and contents of files, wherever they are. Raises as `file_sha256`."""
    digest = hashlib.sha256(head)
    for name, path in named:
        digest.update(f"{name}\0{file_sha256(path)}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()
