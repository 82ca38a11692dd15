"""Who may talk to the viewer: pages that it served itself, under a name that means this server.

Browsers let any page open a WebSocket to any address, so without this a page from the web could read the scene of
whoever looks at one (cross-site WebSocket hijacking), and under a name of its own that it points to this machine it
could read the pages too (DNS rebinding). viser 1.1 checks neither.
"""

import functools
import http
import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from ...formats.errors import InputError, install_command


def is_same_origin(host_header: str, origin: str | None, served_host: str) -> bool:
    """Whether a request may be answered, by its Host header, its Origin (None: no browser's page sends it), and the
    address that the server was told to serve on.

    Host must be an address (no name of others can be pointed here), localhost, this machine's own name or
    `served_host`; an Origin must be that same host and port.
    """
    name = _host(host_header)
    own_names = {"localhost", socket.gethostname().lower(), served_host.lower()}
    if name is None or not (_is_address(name) or name in own_names):
        return False
    return origin is None or origin.lower() in (f"http://{host_header.lower()}", f"https://{host_header.lower()}")


@contextmanager
def guard_server(served_host: str) -> Iterator[None]:
    """Around the making of a viser server: whatever it serves meanwhile is asked through `is_same_origin` first.

    viser has no way to say so. It hands its own answers to `websockets.asyncio.server.serve`, which is replaced here
    for as long as the server starts. Raises InputError when viser started without it, as another version may.
    """
    import websockets.asyncio.server as ws

    original, used = ws.serve, []

    @functools.wraps(original)
    def serve(*args: Any, process_request: Callable[..., Any] | None = None, **kwargs: Any) -> Any:
        used.append(True)

        def answer(connection: Any, request: Any) -> Any:
            hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
            alone = len(hosts) == 1 and len(origins) <= 1
            if not alone or not is_same_origin(hosts[0], origins[0] if origins else None, served_host):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is not from this viewer.\n")
            return process_request(connection, request) if process_request is not None else None

        return original(*args, process_request=answer, **kwargs)

    ws.serve = serve  # type: ignore[misc, assignment, unused-ignore]
    try:
        yield
    finally:
        ws.serve = original  # type: ignore[misc, unused-ignore]
    if not used:
        fix = install_command("viser==1.1.1")
        raise InputError(f"this version of viser cannot be guarded against other pages: {fix}")


def _host(header: str) -> str | None:
    try:
        parts = urlsplit(f"//{header}")
        return None if parts.path or parts.username is not None else (parts.hostname or "").lower()
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False
