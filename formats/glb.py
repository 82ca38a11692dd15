"""GLB: glTF's document and its one buffer in a file."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import atomic_path

_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def write_glb(path: Path, document: dict[str, Any], parts: Sequence[bytes | NDArray[Any]]) -> None:
    """A document and its one buffer, the parts one after the other, without a copy of them, atomically; both chunks are
    padded to four bytes. Raises InputError when the disk refuses."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    length = sum(len(part) if isinstance(part, bytes) else part.nbytes for part in parts)
    padding = b"\0" * (-length % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + length + len(padding))
    with atomic_path(Path(path)) as temporary, temporary.open("wb") as file:
        file.write(head + struct.pack("<II", len(text), _JSON) + text)
        file.write(struct.pack("<II", length + len(padding), _BINARY))
        for part in (*parts, padding):
            file.write(part if isinstance(part, bytes) else np.ascontiguousarray(part).data)


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Inverse of `write_glb`, of a file's bytes. Raises ValueError, or what comes of missing bytes and keys, for
    another file."""
    magic, version, _ = struct.unpack_from("<4sII", data)
    if magic != b"glTF" or version != 2:
        raise ValueError("it does not begin like a GLB of version 2")
    length, kind = struct.unpack_from("<II", data, 12)
    document = json.loads(data[20 : 20 + length])
    after = 20 + length
    binary_length, binary_kind = struct.unpack_from("<II", data, after)
    if (kind, binary_kind) != (_JSON, _BINARY):
        raise ValueError("its two parts are not the document and its bytes")
    return document, data[after + 8 : after + 8 + binary_length]
