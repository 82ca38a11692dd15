"""What a file or a list of files holds, as one hash."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def files_sha256(named: Iterable[tuple[str, Path]], head: bytes = b"") -> str:
    """Hex SHA-256 over `head` and the names and contents of files, wherever they lie."""
    digest = hashlib.sha256(head)
    for name, path in named:
        digest.update(f"{name}\0{file_sha256(path)}\n".encode())
    return digest.hexdigest()
