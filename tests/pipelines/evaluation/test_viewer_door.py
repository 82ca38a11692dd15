"""Who may open the viewer's WebSocket and its pages, asked of a real server over real connections."""

import http.client
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from msgs_slam.formats.gaussians import isotropic_cloud
from msgs_slam.formats.ply import write_gaussian_ply
from msgs_slam.pipelines.viewer.request_guard import is_same_origin

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from msgs_slam.pipelines.viewer.server import open_viewer

    path = tmp_path_factory.mktemp("scene") / "<img src=x onerror=alert(1)>{1+1}`.ply"
    rng = np.random.default_rng(0)
    means, colors = rng.normal(size=(9, 3)).astype(np.float32), rng.random((9, 3)).astype(np.float32)
    write_gaussian_ply(path, isotropic_cloud(means, np.full(9, -3, np.float32), np.zeros(9, np.float32), colors))
    opened = open_viewer(path, port=0)
    yield opened
    opened.stop()


def page(port: int, path: str, **headers: str) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    return connection.getresponse().status


@pytest.mark.parametrize(
    ("host", "origin", "welcome"),
    [
        ("127.0.0.1:{}", "http://127.0.0.1:{}", True),
        ("localhost:{}", "http://localhost:{}", True),
        ("127.0.0.1:{}", None, True),
        ("127.0.0.1:{}", "http://evil.example", False),
        ("127.0.0.1:{}", "http://127.0.0.1:1", False),
        ("127.0.0.1:{}", "http://127.0.0.1:{}.evil.example", False),
        ("127.0.0.1:{}", "null", False),
        ("evil.example:{}", "http://evil.example:{}", False),
        ("127.0.0.1@evil.example", None, False),
        ("", None, False),
    ],
)
def test_only_its_own_pages_may_ask(viewer: Any, host: str, origin: str | None, welcome: bool) -> None:
    port = viewer.server.get_port()
    host, origin = host.format(port), origin and origin.format(port)
    headers = {"Host": host} | ({"Origin": origin} if origin else {})
    assert page(port, "/", **headers) == (200 if welcome else 403)
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    upgrade["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
    assert page(port, "/", **headers, **upgrade) == (101 if welcome else 403)


def test_it_serves_this_machine_alone_and_nothing_outside_its_pages(viewer: Any) -> None:
    assert viewer.url.startswith("http://127.0.0.1:")
    port = viewer.server.get_port()
    for path in ("/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..%5c..%5cetc/passwd"):
        assert page(port, path, Host=f"127.0.0.1:{port}") == 404


def test_names_reach_the_page_without_markup(viewer: Any) -> None:
    shown = [m for m in viewer.server._websock_server._broadcast_buffer.message_from_id.values()]
    text = "".join(str(vars(m).get("props", "")) for m in shown if "Markdown" in type(m).__name__)
    assert "9 Gaussians" in text
    assert not set("<>{}`=") & set(text.split("**")[1])


def test_a_name_of_this_machine_or_an_address_is_welcome_where_it_was_asked_to_serve() -> None:
    assert is_same_origin("192.168.0.7:8080", "http://192.168.0.7:8080", "0.0.0.0")
    assert is_same_origin("[::1]:8080", "http://[::1]:8080", "::1")
    assert is_same_origin("lab.example:8080", "http://lab.example:8080", "lab.example")
    assert not is_same_origin("lab.example:8080", "http://lab.example:8080", "0.0.0.0")
