"""Servers that mean no good, or are broken: what they send never hangs the downloader and never leads elsewhere."""

import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from msgs_slam.formats.errors import InputError
from msgs_slam.pipelines.networks import registry
from msgs_slam.pipelines.networks.registry import fetch

Serve = Callable[..., str]
OK = b"HTTP/1.1 200 OK\r\n"


@pytest.fixture
def serve() -> Iterator[Serve]:
    """A server that answers every request with these pieces."""
    listening: list[socket.socket] = []

    def start(*pieces: bytes) -> str:
        server = socket.create_server(("127.0.0.1", 0))
        listening.append(server)

        def answer() -> None:
            with suppress(OSError):
                while True:
                    line, _ = server.accept()
                    with suppress(OSError), line:
                        line.recv(65536)
                        for piece in pieces:
                            line.sendall(piece)

        threading.Thread(target=answer, daemon=True).start()
        return f"http://127.0.0.1:{server.getsockname()[1]}/m"

    yield start
    for server in listening:
        server.close()


def refused(urls: list[str], target: Path) -> str:
    with pytest.raises(InputError) as error:
        fetch(urls, target, 1000, "", lambda done, size: None)
    assert not target.is_file()
    return str(error.value)


@pytest.mark.parametrize(
    "location",
    [
        b"http://example.invalid/m", b"ftp://127.0.0.1/m", b"file:///etc/passwd", b"http://[::1/x y",
        b"http://127.0.0.1.example.invalid/m", b"data:,x",
    ],
)  # fmt: skip
def test_redirects_lead_to_https_only(serve: Serve, tmp_path: Path, location: bytes) -> None:
    url = serve(b"HTTP/1.1 302 Found\r\nLocation: " + location + b"\r\nContent-Length: 0\r\n\r\n")
    assert re.search("only https|Invalid", refused([url], tmp_path / "m"))


def test_this_machine_is_reached_from_itself_alone() -> None:
    assert registry._is_safe("http://localhost:8000/m")
    for url in (
        "http://127.0.0.1.example.invalid/m",
        "http://example.invalid/m",
        "ftp://example.invalid/m",
        "https://",
    ):
        assert not registry._is_safe(url)
    assert not registry._is_safe("http://localhost:8000/m", from_own_host=False)


@pytest.mark.parametrize(
    "answer",
    [
        OK + b"Transfer-Encoding: chunked\r\n\r\n-5\r\nabc\r\n",
        OK + b"Transfer-Encoding: chunked\r\n\r\n" + b"f" * 5000 + b"\r\n",
        OK + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\nabc",
        OK + b"Content-Length: -3\r\n\r\nabc",
        OK + b"X: 1\r\n" * 1000 + b"\r\n",
        b"HTTP/1.1 999999999999999999999 x\r\n\r\n",
        b"\xff" * 100_000,
        b"",
    ],
)
def test_answers_that_make_no_sense_are_reasons(serve: Serve, tmp_path: Path, answer: bytes) -> None:
    assert "could not be downloaded" in refused([serve(answer)], tmp_path / "m")


def test_folders_in_the_way(serve: Serve, tmp_path: Path) -> None:
    url = serve(OK + b"Content-Length: 1000\r\n\r\n" + b"x" * 1000)
    (tmp_path / "n").mkdir()
    assert "is a folder" in refused([url], tmp_path / "n")
    (tmp_path / "m").write_bytes(b"")
    assert "choose another cache" in refused([url], tmp_path / "m" / "below a file")


def test_a_server_that_sends_without_end_is_left(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_MAX_UNKNOWN", 1000)
    url = serve(OK + b"\r\n", *[b"x" * registry._CHUNK] * 4)
    with pytest.raises(InputError, match="more than the expected 1000 bytes"):
        fetch([url], tmp_path / "m", 0, "", lambda done, size: None)
    assert not list(tmp_path.iterdir())
