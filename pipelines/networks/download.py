"""Downloading a large file over a line that may break, from mirrors that may be gone.

A library such as pooch checks hashes and moves files into place, but knows one address, throws a broken download away
and fetches through requests. Resuming, mirrors and the checks of what a server sends would be ours all the same, as its
downloader: with them here, the few lines that are left to do cost less than the dependency.
"""

import errno
import http.client
import json
import os
import re
import socket
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ...formats.errors import DiskFullError, InputError
from ...formats.reading import file_sha256
from ..system.progress import log

_CHUNK = 1 << 18
_MAX_UNKNOWN = 1 << 30
_ATTEMPTS = 6
_TIMEOUT = 30.0
_OWN_HOSTS = ("127.0.0.1", "localhost", "::1")
_ANSWER_SECONDS = 60.0
_SLOWEST, _WINDOW = 1000, 60.0
"""Bytes a second over so many seconds: a server that sends less holds the line, not the file."""
_ETAG = re.compile(r'"[!#-~]{0,200}"')


def fetch(urls: Sequence[str], target: Path, size: int, sha256: str, progress: Callable[[int, int], None]) -> str:
    """Download the first of `urls` that delivers `size` bytes of the right hash to `target`; returns the hash.

    What a broken line has delivered stays in `<target>.part` and is continued, also by a later call. A `size`
    of 0 is unknown, an empty `sha256` accepts any content. `progress(done, size)` is called as bytes arrive.
    Raises InputError when every mirror fails, with the reason of each.
    """
    part = target.with_name(target.name + ".part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {target.parent} ({error.strerror}): choose another cache folder") from error
    for path in (target, part, _tag_file(part)):
        if path.is_dir():
            raise InputError(f"{path} is a folder where a file should be: remove it, or choose another cache folder")
    reasons: list[str] = []
    for url in urls:
        if not _is_safe(url):
            raise InputError(f"{url}: only https addresses are downloaded from")
        reason = _fetch_one(url, part, size, progress)
        actual = "" if reason else file_sha256(part)
        if not reason and sha256 and actual != sha256:
            _discard(part)
            reason = f"sha256 is {actual}, expected {sha256}"
        if not reason:
            os.replace(part, target)
            _discard(part)
            if reasons:
                log.warning("%s came from %s: %s", target.name, url, "; ".join(reasons))
            return actual
        reasons.append(f"{url}: {reason}")
    raise InputError(
        f"{target.name} could not be downloaded from any address:\n  "
        + "\n  ".join(reasons)
        + "\nCheck the network and try again, or download the file elsewhere into a folder, under any name, and then: "
        "msgs-slam models pull --from FOLDER"
    )


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
            return f"the server answers {error.code} {error.reason}"
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise DiskFullError(
                    f"the disk is full: {part.parent} needs {(size - _length(part)) / 1e6:.0f} MB more. Free some "
                    "space and pull again; what has arrived is kept"
                ) from error
            reason = str(getattr(error, "reason", error)) or type(error).__name__
        except http.client.HTTPException as error:
            reason = f"the line broke ({type(error).__name__})"
        except ValueError as error:  # of a length, an address or a header that is none
            return f"the server's answer makes no sense ({str(error)[:80]})"
        except _NotTheFile as error:
            _discard(part)
            return str(error)
        if _length(part) <= before:
            return reason or "it sends nothing"
    return "" if size and _length(part) == size else reason or f"{_length(part)} of {size} bytes came"


class _NotTheFile(Exception):
    """The server sends something of another size, or points to where nothing is fetched from."""


def _is_safe(url: str, from_own_host: bool = True) -> bool:
    """https, or plain http to this machine: no line in between, where anybody could change what comes."""
    try:
        parts = urllib.parse.urlsplit(url)
        host = parts.hostname or ""
    except ValueError:
        return False
    return bool(host) and (parts.scheme == "https" or (parts.scheme == "http" and host in _OWN_HOSTS and from_own_host))


class _SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Follows to where a download may begin; from elsewhere never to this machine."""

    def redirect_request(
        self, req: urllib.request.Request, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        own = (urllib.parse.urlsplit(req.full_url).hostname or "") in _OWN_HOSTS
        if not _is_safe(newurl, own):
            raise _NotTheFile(f"the server sends on to {newurl[:200]}; only https is followed")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


class _TimeoutConnection(http.client.HTTPConnection):
    """Gives up on an answer whose head does not come: the timeout of a socket begins anew with every byte."""

    def getresponse(self) -> http.client.HTTPResponse:
        timer = threading.Timer(_ANSWER_SECONDS, self._cut)
        timer.daemon = True
        timer.start()
        try:
            return super().getresponse()
        finally:
            timer.cancel()

    def _cut(self) -> None:
        with suppress(OSError, AttributeError):
            self.sock.shutdown(socket.SHUT_RDWR)


class _TimeoutTlsConnection(_TimeoutConnection, http.client.HTTPSConnection):
    """The same over TLS."""


class _Http(urllib.request.HTTPHandler):
    def http_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_TimeoutConnection, req)


class _Https(urllib.request.HTTPSHandler):
    def https_open(self, req: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_TimeoutTlsConnection, req)


def _opener() -> urllib.request.OpenerDirector:
    """Of http and https alone: urllib's own would open ftp, files and data too."""
    opener = urllib.request.OpenerDirector()
    handlers = (
        urllib.request.ProxyHandler(), _Http(), _Https(), _SafeRedirects(), urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(), urllib.request.UnknownHandler(),
    )  # fmt: skip
    for handler in handlers:
        opener.add_handler(handler)
    return opener


def _chunks(answer: http.client.HTTPResponse) -> Iterator[bytes]:
    """What comes, as it comes. Raises TimeoutError when too little does."""
    began, came = time.monotonic(), 0
    while chunk := answer.read1(_CHUNK):
        yield chunk
        came += len(chunk)
        if (seconds := time.monotonic() - began) > _WINDOW:
            if came < _SLOWEST * seconds:
                raise TimeoutError(f"it sends less than {_SLOWEST} bytes a second")
            began, came = time.monotonic(), 0


def _continue(url: str, part: Path, size: int, progress: Callable[[int, int], None]) -> int:
    """One request: the rest of the file, or all of it when the server cannot send a part. Returns its full size."""
    start, tag = _length(part), _read_tag(part)
    request = urllib.request.Request(url, headers={"User-Agent": "msgs-slam", "Accept-Encoding": "identity"})
    if start:
        request.add_header("Range", f"bytes={start}-")
        if tag:
            request.add_header("If-Range", tag)
    with _opener().open(request, timeout=_TIMEOUT) as answer:
        continues = answer.status == 206
        done = start if continues else 0
        announced = answer.headers.get("Content-Length")
        total = done + int(announced) if announced is not None and announced.isdecimal() else size
        if size not in (0, total):
            raise _NotTheFile(f"the file there has {total} bytes, expected {size}")
        size = total
        _tag_file(part).write_text(json.dumps({"etag": answer.headers.get("ETag") or ""}), encoding="utf-8")
        with part.open("ab" if continues else "wb") as stream:
            for chunk in _chunks(answer):
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
    """The ETag of the partial download. A weak or malformed one is useless for If-Range."""
    try:
        tag = json.loads(_tag_file(part).read_text(encoding="utf-8"))["etag"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""
    return tag if isinstance(tag, str) and _ETAG.fullmatch(tag) else ""


def _discard(part: Path) -> None:
    part.unlink(missing_ok=True)
    _tag_file(part).unlink(missing_ok=True)
