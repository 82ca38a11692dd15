"""Downloading a large file over a line that may break, from mirrors that may be gone.

A library such as pooch checks hashes and moves files into place, but knows one address, throws a broken download away
and fetches through requests. Resuming, mirrors and the checks of what a server sends would be ours all the same, as its
downloader: with them here, the few lines that are left to do cost less than the dependency.
"""

from __future__ import annotations

import http.client
import json
import os
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

from formats.digest import file_sha256
from formats.errors import DiskFullError, InputError
from pipelines.progress import log

_CHUNK = 1 << 18
_MAX_UNKNOWN = 1 << 30
_ATTEMPTS = 6
_TIMEOUT = 30.0
_SCHEMES = ("https://", "http://127.0.0.1", "http://localhost")


def fetch(urls: Sequence[str], target: Path, size: int, sha256: str, progress: Callable[[int, int], None]) -> str:
    """Download the first of `urls` that delivers `size` bytes of the right hash to `target`; returns the hash.

    What a broken line has delivered stays in `<target>.part` and is continued, also by a later call. A `size`
    of 0 is unknown, an empty `sha256` accepts any content. `progress(done, size)` is called as bytes arrive.
    Raises InputError when every mirror fails, with the reason of each.
    """
    part = target.with_name(target.name + ".part")
    target.parent.mkdir(parents=True, exist_ok=True)
    reasons = []
    for url in urls:
        if not url.startswith(_SCHEMES):
            raise InputError(f"{url}: only https addresses are downloaded from")
        reason = _fetch_one(url, part, size, progress)
        actual = "" if reason else file_sha256(part)
        if not reason and sha256 and actual != sha256:
            _discard(part)
            reason = f"sha256 is {actual}, expected {sha256}"
        if not reason:
            os.replace(part, target)
            _discard(part)
            return actual
        log.warning("%s: %s", url, reason)
        reasons.append(f"{url}: {reason}")
    raise InputError("no mirror delivered the file:\n  " + "\n  ".join(reasons) + "\nCheck the network and try again")


def _fetch_one(url: str, part: Path, size: int, progress: Callable[[int, int], None]) -> str:
    """Fill `part` from one address, with retries while it makes headway; returns why it failed, or ""."""
    reason = ""
    for _ in range(_ATTEMPTS):
        before = _length(part)
        if size and before == size:
            return ""
        try:
            size = _continue(url, part, size, progress)
        except urllib.error.HTTPError as error:
            if error.code == 416 and before:  # the part is longer than the file: it belongs to another one
                _discard(part)
                continue
            return f"the server says {error.code} {error.reason}"
        except OSError as error:
            if error.errno in (28, 122):
                raise DiskFullError(
                    f"the disk is full: {part.parent} needs {(size - _length(part)) / 1e6:.0f} MB more. Free some "
                    "space and pull again; what has arrived is kept"
                ) from error
            reason = str(getattr(error, "reason", error)) or type(error).__name__
        except http.client.HTTPException as error:
            reason = f"the line broke ({type(error).__name__})"
        except _NotTheFile as error:
            _discard(part)
            return str(error)
        if _length(part) <= before:
            return reason or "it sends nothing"
    return "" if size and _length(part) == size else reason or f"{_length(part)} of {size} bytes came"


class _NotTheFile(Exception):
    """The server sends something of another size."""


def _continue(url: str, part: Path, size: int, progress: Callable[[int, int], None]) -> int:
    """One request: the rest of the file, or all of it when the server cannot send a part. Returns its full size."""
    start, tag = _length(part), _read_tag(part)
    request = urllib.request.Request(url, headers={"User-Agent": "msgs-slam", "Accept-Encoding": "identity"})
    if start:
        request.add_header("Range", f"bytes={start}-")
        if tag:
            request.add_header("If-Range", tag)
    with urllib.request.urlopen(request, timeout=_TIMEOUT) as answer:
        continues = answer.status == 206
        done = start if continues else 0
        announced = answer.headers.get("Content-Length")
        total = done + int(announced) if announced is not None and announced.isdecimal() else size
        if size not in (0, total):
            raise _NotTheFile(f"the file there has {total} bytes, expected {size}")
        size = total
        _write_tag(part, answer.headers.get("ETag") or "")
        with part.open("ab" if continues else "wb") as stream:
            while chunk := answer.read(_CHUNK):
                done += len(chunk)
                if done > (size or _MAX_UNKNOWN):
                    raise _NotTheFile(f"more than the expected {size} bytes came")
                stream.write(chunk)
                progress(done, size)
    return size or done


def _length(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _tag_file(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _read_tag(part: Path) -> str:
    """The ETag under which the part was begun. A weak one is of no use for If-Range."""
    try:
        tag = json.loads(_tag_file(part).read_text(encoding="utf-8"))["etag"]
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    return tag if isinstance(tag, str) and not tag.startswith("W/") else ""


def _write_tag(part: Path, tag: str) -> None:
    _tag_file(part).write_text(json.dumps({"etag": tag}), encoding="utf-8")


def _discard(part: Path) -> None:
    part.unlink(missing_ok=True)
    _tag_file(part).unlink(missing_ok=True)
