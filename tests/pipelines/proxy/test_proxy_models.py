"""The table of models and the downloader, against a server of the test's own on loopback."""

import hashlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs_slam.formats.errors import DiskFullError, InputError
from msgs_slam.pipelines.config import ProxyConfig
from msgs_slam.pipelines.networks import registry
from msgs_slam.pipelines.networks.registry import Model, ModelStore, fetch
from msgs_slam.pipelines.proxy.selection import choose_depth
from msgs_slam.pipelines.run.settings import load_config

DATA = np.random.default_rng(0).bytes(700_000)
SHA = hashlib.sha256(DATA).hexdigest()


@dataclass
class Behaviour:
    """What the server does with the next requests, and what it saw."""

    cuts: list[int] = field(default_factory=list)
    missing: tuple[str, ...] = ()
    requests: list[str] = field(default_factory=list)


@pytest.fixture
def server() -> Iterator[tuple[str, Behaviour]]:
    behaviour = Behaviour()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            behaviour.requests.append(self.path)
            if self.path in behaviour.missing:
                self.send_error(404)
                return
            body = DATA
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if behaviour.cuts:
                body = body[: behaviour.cuts.pop(0)]
                self.close_connection = True
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            pass

    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=httpd.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_port}", behaviour
    httpd.shutdown()
    thread.join()
    httpd.server_close()


def silent(done: int, size: int) -> None:
    assert 0 < done <= size


@pytest.mark.parametrize("size", [len(DATA), 0])
def test_a_broken_line_is_tried_again(server: tuple[str, Behaviour], tmp_path: Path, size: int) -> None:
    url, behaviour = server
    behaviour.cuts = [300_000, 200_000]
    assert fetch([f"{url}/m"], tmp_path / "m.onnx", size, SHA if size else "", silent) == SHA
    assert (tmp_path / "m.onnx").read_bytes() == DATA
    assert [p.name for p in tmp_path.iterdir()] == ["m.onnx"]


def test_404_and_a_wrong_hash_go_to_the_next_mirror(
    server: tuple[str, Behaviour], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    url, behaviour = server
    behaviour.missing = ("/gone",)
    fetch([f"{url}/gone", f"{url}/m"], tmp_path / "m.onnx", len(DATA), SHA, silent)
    assert behaviour.requests == ["/gone", "/m"]
    assert [r.getMessage().count("404 Client Error: Not Found") for r in caplog.records] == [1]
    with pytest.raises(InputError, match=r"does not match"):
        fetch([f"{url}/m"], tmp_path / "n.onnx", len(DATA), "0" * 64, silent)
    assert not list(tmp_path.glob("n.onnx*"))
    caplog.clear()
    with pytest.raises(
        InputError, match=r"^n\.onnx could not be downloaded from any address:\n  .*/gone: .*404"
    ) as failed:
        fetch([f"{url}/gone"], tmp_path / "n.onnx", len(DATA), SHA, silent)
    assert str(failed.value).count("/gone") == 1
    assert not caplog.records, "the error names the address"


def test_another_size_is_refused_(server: tuple[str, Behaviour], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="700000 bytes, expected 5"):
        fetch([f"{server[0]}/m"], tmp_path / "m.onnx", 5, SHA, silent)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_nothing(server: tuple[str, Behaviour], tmp_path: Path) -> None:
    def full(done: int, size: int) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(DiskFullError, match="disk is full"):
        fetch([f"{server[0]}/m"], tmp_path / "m.onnx", len(DATA), SHA, full)
    assert not list(tmp_path.iterdir())


def test_only_https_is_downloaded_from(tmp_path: Path) -> None:
    for url in ("file:///etc/passwd", "http://example.org/m", "ftp://example.org/m"):
        with pytest.raises(InputError, match="only https"):
            fetch([url], tmp_path / "m", 5, SHA, silent)


def store(folder: Path, url: str, sha256: str = SHA) -> ModelStore:
    model = Model("net", "metric3d-community", len(DATA), sha256, "MIT", True, (f"{url}/m",))
    return ModelStore(folder, (model,), ModelStore.open(folder).families)


def test_pull_mends_a_corrupted_file_and_offline_says_what_is_missing(
    server: tuple[str, Behaviour], tmp_path: Path
) -> None:
    url, behaviour = server
    models = store(tmp_path, url)
    model = models.get("net")
    with pytest.raises(InputError, match="offline"):
        models.pull(model, silent, offline=True)
    assert models.first_here("depth") is None
    path = models.pull(model, silent)
    assert models.pull(model, silent, offline=True) == path
    assert len(behaviour.requests) == 1
    assert models.first_here("depth") == model
    assert models.card(model).canonical_focal == 1000
    path.write_bytes(DATA[:-1] + b"?")
    assert "damaged" in models.verify()["net"]
    models.pull(model, silent)
    assert models.verify() == {"net": "ok"}


def test_an_unknown_hash_is_refused_unless_trusted_and_then_recorded(
    server: tuple[str, Behaviour], tmp_path: Path
) -> None:
    models = store(tmp_path, server[0], sha256="")
    with pytest.raises(InputError, match="--trust"):
        models.pull(models.get("net"), silent)
    assert server[1].requests == []
    models.pull(models.get("net"), silent, trust=True)
    assert models._load_own().pinned == {"net": SHA}


def test_a_replaced_file_is_refused_and_said_to_be_replaced(server: tuple[str, Behaviour], tmp_path: Path) -> None:
    models = store(tmp_path, server[0], sha256="0" * 64)
    with pytest.raises(InputError, match="have replaced the file"):
        models.pull(models.get("net"), silent)
    pinned = replace(models.get("net"), revision="8b1f705a")
    with pytest.raises(InputError, match="expected sha256:0000") as raised:
        models.pull(pinned, silent)
    assert "replaced" not in str(raised.value)


def test_the_table_is_complete_and_every_family_makes_a_card(tmp_path: Path) -> None:
    models = ModelStore.open(tmp_path)
    assert {"metric3d-small", "metric3d-large", "moge2-small"} <= {m.name for m in models.models}
    for model in models.models:
        assert len(model.sha256) == 64 or model.family == "head"
        assert model.licence
        assert all(u.startswith("https://") for u in model.urls)
        assert all((model.revision or "main") in u for u in model.urls if "/resolve/" in u)
        assert "{" not in "".join(model.urls)
        if "input" in models.families[model.family]:
            assert models.card(model).task in ("depth", "segmentation", "person")
    with pytest.raises(InputError, match="known: metric3d"):
        models.get("metric4d")


def test_one_word_pulls_what_a_room_needs(tmp_path: Path) -> None:
    models = ModelStore.open(tmp_path)
    best = ["moge2-small", "ade20k-small", "fast-depth", "person"]
    assert [m.name for m in models.with_needed((), best=True)] == best
    small = models.with_needed(())
    assert [m.name for m in small] == ["ade20k-small", "fast-depth", "person"]
    assert sum(m.bytes for m in small) < 5e6
    for model in models.with_needed([m.name for m in models.models if m.pull]):
        assert model.bytes > 0
        assert len(model.sha256) == 64
        assert model.commercial, "free for all uses"
    assert [m.name for m in models.with_needed(("dinov2-small", "dinov2-small-head"))] == [
        "dinov2-small",
        "dinov2-small-head",
    ]


def test_own_files_are_added_checked_and_used_first(shared_data: Path, tmp_path: Path) -> None:
    models = ModelStore.open(tmp_path)
    toy = shared_data / "models" / "toy_metric3d.onnx"
    with pytest.raises(InputError, match="inputs are pixel_values"):
        models.add(toy, "metric3d-official")
    with pytest.raises(InputError, match="no name for a model"):
        models.add(toy, "metric3d-community", "../escape")
    with pytest.raises(InputError, match="known model"):
        models.add(toy, "metric3d-community", "moge2-small")
    added = models.add(toy, "metric3d-community", "toy")
    again = ModelStore.open(tmp_path)
    assert again.first_here("depth") == again.get("toy") == added
    assert again.verify()["toy"] == "ok"


def test_the_small_depth_network_comes_before_the_large_one_but_for_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MSGS_SLAM_CACHE", str(tmp_path))
    assert choose_depth(ProxyConfig(depth="best")).kind == "multiview"
    models = ModelStore.open(tmp_path)
    large, small = models.get("metric3d-large"), models.get("metric3d-small")
    for model in (large, small):
        with models.path(model).open("wb") as file:
            file.truncate(model.bytes)  # a sparse file
        assert models.first_here("depth") == model
    names = [choose_depth(load_config(quality=q).proxy).card for q in ("normal", "best")]
    assert [card.name for card in names if card is not None] == ["onnx:metric3d-small", "onnx:metric3d-large"]


def test_a_model_that_needs_another_is_here_when_both_are(server: tuple[str, Behaviour], tmp_path: Path) -> None:
    models = ModelStore.open(tmp_path)
    dino = models.get("dinov2-small")
    card = models.card(dino)
    assert len(card.classes) == len(card.groups) == 150
    assert card.classes[0] == "wall"
    assert card.labels[0] == "wall"
    assert {"floor", "ceiling", "seating", "table", "other"} <= set(card.labels)
    assert len(card.labels) == 18
    head = Model("head", "head", 0, "", "MIT", True, (f"{server[0]}/head",))
    body = Model("net", "dinov2-ade20k", len(DATA), SHA, "MIT", True, (f"{server[0]}/m",), needs="head")
    pair = ModelStore(tmp_path, (body, head), models.families)
    pair.pull(body, silent)
    assert pair.first_here("segmentation") is None
    pair.pull(head, silent, trust=True)
    pinned = Model("head", "head", 0, SHA, "MIT", True, head.urls)
    assert ModelStore(tmp_path, (body, pinned), models.families).first_here("segmentation") == body


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
