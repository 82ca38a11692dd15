"""Damage, made from a seed: what disks, transfers, editors and people with bad intent do to a file.

Each mutator takes a file's bytes and a `random.Random` and returns other bytes. Bytes alone rarely reach past a
checksum or a parser, so there are mutators that know words, JSON and the inside of an archive.
"""

import gzip
import io
import json
import os
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

Mutator = Callable[[bytes, Random], bytes]

WORDS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e400", b"1e308", b"-0.0", b"1e-320", b"18446744073709551615", b"1" * 5000,
    b"0x10", b"1_0", "٣".encode(), b"", b"x", b"x" * 5000, b"true", b"null", b"[]", b"{}", b"..", b"~", b"%s%n", b"\r",
    b"../../../../etc/passwd", b"/etc/passwd", b"\xff\xfe", b"a\0b", b'"', b"\\", b"2147483648", b"1e19", b"1e30",
)  # fmt: skip
NODES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1e308, 1 << 70, 10**400, float("nan"), float("inf"), "nan", "", "x", "../../etc/passwd",
    "a\0b", "\ud800", "\n", "1" * 3000, [], {}, [[]], [None], [1, 2, 3], {"a": 1}, 65536, 2**31,
)  # fmt: skip
_WORD = re.compile(rb"[^\s,\[\]{}:=\"]+")
_NUMBERS = (0, 1, 127, 128, 255, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**60, 2**63, 2**64 - 1)


def in_bytes(data: bytes, rng: Random) -> bytes:
    """Cut, flipped, overwritten with a telling number, shortened or lengthened somewhere."""
    if not data:
        return rng.randbytes(40)
    b, at = bytearray(data), rng.randrange(len(data))
    if rng.random() < 0.3:
        at = min(at, rng.randrange(128))  # headers say more than what follows them
    kind = rng.randrange(7)
    if kind == 0:
        return bytes(b[:at])
    if kind == 1:
        for _ in range(rng.choice((1, 2, 16))):
            b[rng.randrange(len(b))] ^= 1 << rng.randrange(8)
    if kind == 2:
        layout = rng.choice(("<B", "<H", "<I", "<Q", ">I"))
        size = struct.calcsize(layout)
        b[at : at + size] = struct.pack(layout, rng.choice(_NUMBERS) % (1 << (8 * size)))
    if kind == 3:
        value = rng.choice((float("nan"), float("inf"), -1.0, 0.0, 3e38, 1e-40))
        b[at - at % 4 : at - at % 4 + 4] = struct.pack("<f", value)
    if kind == 4:
        del b[at : at + rng.randrange(1, 64)]
    if kind == 5:
        b[at:at] = rng.randbytes(rng.randrange(1, 64)) if rng.random() < 0.5 else b[at : at + 200]
    if kind == 6:
        b[at : at + rng.randrange(1, 200)] = rng.choice((b"\0", b"\xff")) * rng.randrange(1, 200)
    return bytes(b)


def in_text(data: bytes, rng: Random) -> bytes:
    """A word replaced, a line lost, doubled or moved, another encoding or other line ends."""
    kind, lines = rng.randrange(10), data.split(b"\n")
    words = list(_WORD.finditer(data))
    if kind < 6 and words:
        for word in sorted(rng.sample(words, min(len(words), rng.choice((1, 1, 3)))), key=lambda w: -w.start()):
            data = data[: word.start()] + rng.choice(WORDS) + data[word.end() :]
        return data
    if kind == 6:
        lines.insert(rng.randrange(len(lines)), lines.pop(rng.randrange(len(lines))))
        return b"\n".join(lines * rng.choice((1, 2)))
    if kind == 7:
        return b"\n".join(line for line in lines if rng.random() < 0.8)
    if kind == 8:
        return data.decode("latin-1").encode(rng.choice(("utf-16", "utf-8-sig", "utf-32")))
    if kind == 9:
        return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b"", b"\xe2\x80\xa8")))
    return in_bytes(data, rng)


def in_json(data: bytes, rng: Random) -> bytes:
    """A node replaced by a stranger, or gone."""
    try:
        value = json.loads(data)
    except ValueError:
        return in_text(data, rng)
    places = list(_places(value))
    if not places or rng.random() < 0.3:
        return in_text(data, rng)
    for holder, key in rng.sample(places, min(len(places), rng.choice((1, 1, 2)))):
        if rng.random() < 0.25 and isinstance(holder, dict):
            holder.pop(key, None)
        else:
            holder[key] = rng.choice(NODES)
    return json.dumps(value).encode("utf-8", "surrogatepass")


def _places(value: Any) -> Any:
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def in_gzip(data: bytes, rng: Random) -> bytes:
    """Damage under the compression, where its checksum does not see it; anywhere in what is not compressed so."""
    outside = data[:2] != b"\x1f\x8b" or rng.random() < 0.4
    return in_bytes(data, rng) if outside else gzip.compress(in_bytes(gzip.decompress(data), rng), mtime=0)


def in_zip(data: bytes, rng: Random) -> bytes:
    """A member of another shape, another type, another name, or damaged inside a whole archive."""
    if rng.random() < 0.3:
        return in_bytes(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, kind = rng.choice(sorted(members)), rng.randrange(4)
    if kind == 0:
        shape = rng.choice((b"(4000000000000,)", b"(-5,)", b"()", b"(2, 2, 2)", b"(1e9,)", b"[20]", b"('a',)"))
        members[name] = re.sub(rb"'shape': \([^)]*\)", b"'shape': " + shape, members[name])
    elif kind == 1:
        dtype = rng.choice((b"'|O'", b"'<U99999999'", b"'xx'", b"[('a','<f8')]", b"'|V8'", b"'<M8[ns]'", b"'>f8'"))
        members[name] = re.sub(rb"'descr': '[^']*'", b"'descr': " + dtype, members[name])
    elif kind == 2:
        members[rng.choice(("../../x.npy", "a/", "b.npy", "é.npy"))] = members.pop(name)
    else:
        members[name] = in_bytes(members[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def in_ply(data: bytes, rng: Random) -> bytes:
    """Another count or type in the header, or a damaged body."""
    end = data.find(b"end_header")
    if end < 0 or rng.random() < 0.4:
        return in_bytes(data, rng)
    found = list(re.finditer(rb"(?<=element )\w+ \d+|(?<=property )(?:list \w+ \w+|\w+)", data[:end]))
    place = rng.choice(found)
    counts = (b"4000000000", b"-1", b"0", b"1", b"999999999999999", b"1e3")
    kinds = (b"char", b"uchar", b"ushort", b"int", b"double", b"list uchar float", b"list int int", b"quad")
    element = place.group().split(b" ")[0]
    new = element + b" " + rng.choice(counts) if b" " in place.group() and element != b"list" else rng.choice(kinds)
    return data[: place.start()] + new + data[place.end() :]


def with_json_head(start: int) -> Mutator:
    """For formats with a JSON header after its length at byte `start`: safetensors (8 bytes) and GLB (4 of 12)."""

    def mutate(data: bytes, rng: Random) -> bytes:
        if rng.random() < 0.4:
            return in_bytes(data, rng)
        width, first = (8, 8) if start == 0 else (4, 20)
        size = int.from_bytes(data[start : start + width], "little")
        head = in_json(data[first : first + size].rstrip(), rng)
        head = head.ljust((len(head) + 3) // 4 * 4)
        whole = data[:start] + len(head).to_bytes(width, "little") + data[start + width : first] + head
        return whole + data[first + size :]

    return mutate


def by_name(path: Path) -> Mutator:
    """The mutator that knows most of a file's kind."""
    suffix = path.suffix.lower()
    if suffix == ".json":
        return in_json
    if suffix in (".txt", ".csv", ".yaml", ".toml", ".tsv"):
        return in_text
    return {".npz": in_zip, ".pth": in_zip, ".spz": in_gzip, ".ply": in_ply}.get(suffix, in_bytes)


def on_disk(path: Path, rng: Random) -> str:
    """What happens to a file as a whole. Returns the kind of it."""
    kind = rng.choice(
        ("gone", "empty", "a folder", "a loop", "dangling", "a device", "a pipe", "long name", "no rights")
    )
    if kind in ("a pipe", "a device") and os.name == "nt":
        kind = "empty"
    path.chmod(0o600)
    if kind == "long name":
        path.rename(path.with_name("x" * 200 + "\n" + path.suffix))
    elif kind == "no rights":
        path.chmod(0)
    else:
        path.unlink()
    if kind == "empty":
        path.touch()
    if kind == "a folder":
        path.mkdir()
    if kind in ("a loop", "dangling", "a device"):
        path.symlink_to({"a loop": path.name, "dangling": "nowhere", "a device": "/dev/zero"}[kind])
    if kind == "a pipe":
        os.mkfifo(path)
    return kind


def damage(folder: Path, only: str, mutate: Mutator | None, rng: Random) -> str:
    """Damage one file of a folder (`only` that one, if named), by `mutate` or as its name suggests. Returns how."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and only in ("", p.name))
    texts = [p for p in files if p.suffix not in (".png", ".jpg")]
    path = rng.choice(texts if texts and rng.random() < 0.7 else files)
    name = str(path.relative_to(folder))
    if rng.random() < 0.12:
        return f"{name} is now {on_disk(path, rng)}"
    path.write_bytes((mutate or by_name(path))(path.read_bytes(), rng))
    return f"{name} is damaged"
