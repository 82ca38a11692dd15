"""GLB: glTF's document and its one buffer in a file."""

from __future__ import annotations

import json
import struct
from typing import Any

_JSON, _BINARY = 0x4E4F534A, 0x004E4942


def glb_bytes(document: dict[str, Any], binary: bytes) -> bytes:
    """The GLB of a document and its one buffer; both chunks padded to four bytes."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    return b"".join(
        [head, struct.pack("<II", len(text), _JSON), text, struct.pack("<II", len(binary), _BINARY), binary]
    )


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Inverse of `glb_bytes`. Raises ValueError, or what comes of missing bytes and keys, for another file."""
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
