"""Downloading a model's file from the first address that has it, checked by its hash."""

import errno
import urllib.parse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ...formats.errors import DiskFullError, InputError
from ...formats.reading import file_sha256
from ..system.progress import log

_CHUNK = 1 << 18
_MAX_UNKNOWN = 1 << 30
_TIMEOUT = 30.0
_ATTEMPTS = 3
_OWN_HOSTS = ("127.0.0.1", "localhost", "::1")


def fetch(urls: Sequence[str], target: Path, size: int, sha256: str, progress: Callable[[int, int], None]) -> str:
    """Download the first of `urls` that delivers `size` bytes of the right hash to `target`; returns the hash.

    A `size` of 0 is unknown, an empty `sha256` accepts any content. `progress(done, size)` is called as bytes arrive.
    Raises InputError when every mirror fails, with the reason of each.
    """
    if target.is_dir():
        raise InputError(f"{target} is a folder where a file should be: remove it, or choose another cache folder")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)  # without a known hash, pooch keeps what is there
    except OSError as error:
        raise InputError(f"cannot write {target.parent} ({error.strerror}): choose another cache folder") from error
    reasons: list[str] = []
    for url in urls:
        if not _is_safe(url):
            raise InputError(f"{url}: only https addresses are downloaded from")
        if not (reason := _fetch_one(url, target, size, sha256, progress)):
            if reasons:
                log.warning("%s came from %s: %s", target.name, url, "; ".join(reasons))
            return sha256 or file_sha256(target)
        reasons.append(f"{url}: {reason}")
    raise InputError(
        f"{target.name} could not be downloaded from any address:\n  "
        + "\n  ".join(reasons)
        + "\nCheck the network and try again, or download the file elsewhere into a folder, under any name, and then: "
        "msgs-slam models pull --from FOLDER"
    )


def _fetch_one(url: str, target: Path, size: int, sha256: str, progress: Callable[[int, int], None]) -> str:
    """Download from one address, again where the connection breaks; returns why it failed, or ""."""
    import pooch
    import requests

    known, reason = f"sha256:{sha256}" if sha256 else None, ""
    for _ in range(_ATTEMPTS):
        downloader = pooch.HTTPDownloader(
            progressbar=_Bar(size, progress), chunk_size=_CHUNK, timeout=_TIMEOUT, hooks={"response": _require_safe}
        )
        try:
            pooch.core.stream_download(url, target, known, downloader)
            return ""
        except requests.HTTPError as error:
            return f"the server answers {str(error).partition(' for url')[0]}"
        except requests.RequestException as error:
            reason = str(error)
        except (ValueError, InputError) as error:
            return str(error)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise
            raise DiskFullError(
                f"the disk is full: {target.parent} needs {size / 1e6:.0f} MB. Free some space and pull again"
            ) from error
    return reason


class _Bar:
    """Tell how far a download is, and end one that sends more than it should."""

    def __init__(self, size: int, progress: Callable[[int, int], None]) -> None:
        self.size, self.progress, self.total, self.done = size, progress, size, 0

    def update(self, count: int) -> None:
        if self.size and self.total not in (0, self.size):
            raise InputError(f"the file there has {self.total} bytes, expected {self.size}")
        self.done += count
        if self.done - _CHUNK > (self.size or _MAX_UNKNOWN):
            raise InputError(f"more than the expected {self.size or _MAX_UNKNOWN} bytes came")
        size = self.size or self.total or self.done
        self.progress(min(self.done, size), size)

    def reset(self) -> None:
        self.done = 0

    def close(self) -> None:
        pass


def _is_safe(url: str, from_own_host: bool = True) -> bool:
    """https, or plain http to this machine: no line in between, where anybody could change what comes."""
    try:
        parts = urllib.parse.urlsplit(url)
        host = parts.hostname or ""
    except ValueError:
        return False
    return bool(host) and (parts.scheme == "https" or (parts.scheme == "http" and host in _OWN_HOSTS and from_own_host))


def _require_safe(response: Any, *_: Any, **__: Any) -> None:
    """Follow redirects to where a download may begin; from elsewhere never to this machine."""
    location = urllib.parse.urljoin(response.url, response.headers.get("location", ""))
    own = (urllib.parse.urlsplit(response.url).hostname or "") in _OWN_HOSTS
    if response.is_redirect and not _is_safe(location, own):
        raise InputError(f"the server sends on to {location[:200]}; only https is followed")
