"""The viewer's server answers its own page only, and opens no tunnel."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from gsopt.errors import InputError
from gsopt.results import viewer_server

msgspec = pytest.importorskip("msgspec")
viser = pytest.importorskip("viser")


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    running = viewer_server.start_server("127.0.0.1", 0)
    yield running
    running.stop()


def request(port: int, host: str, origin: str | None, *, websocket: bool = True) -> socket.socket:
    """A connection on which a request with these headers was sent."""
    lines = ["GET / HTTP/1.1", f"Host: {host}"] + ([] if origin is None else [f"Origin: {origin}"])
    if websocket:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", f"Sec-WebSocket-Protocol: viser-v{viser.__version__}"]
    connection = socket.create_connection(("127.0.0.1", port), timeout=10)
    connection.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
    return connection


def status(connection: socket.socket) -> int:
    with connection, connection.makefile("rb") as answer:
        return int(answer.readline().split()[1])


@pytest.mark.parametrize(
    ("host", "origin", "allowed"),
    [
        ("127.0.0.1:PORT", "http://127.0.0.1:PORT", True),
        ("localhost:PORT", "http://localhost:PORT", True),
        ("localhost:9000", "http://localhost:9000", True),  # a forwarded port
        ("[::1]:PORT", "http://[::1]:PORT", True),
        ("192.168.1.2:PORT", None, True),  # a program
        ("127.0.0.1:PORT", "https://evil.example", False),
        ("127.0.0.1:PORT", "http://127.0.0.1:1", False),
        ("127.0.0.1:PORT", "null", False),
        ("evil.example:PORT", "http://evil.example:PORT", False),  # a rebound name
        ("evil.example:PORT", None, False),
        ("localhost.evil.example:PORT", "http://localhost.evil.example:PORT", False),
        ("127.0.0.1:PORT\r\nHost: evil.example", "http://127.0.0.1:PORT", False),
        ("[", None, False),
    ],
)
@pytest.mark.parametrize("websocket", [True, False])
def test_only_the_own_page_is_answered(
    server: Any, host: str, origin: str | None, allowed: bool, websocket: bool
) -> None:
    port = server.get_port()
    host, origin = host.replace("PORT", str(port)), origin and origin.replace("PORT", str(port))
    got = status(request(port, host, origin, websocket=websocket))
    assert got == ((101 if websocket else 200) if allowed else 403)


def test_the_name_given_as_host_is_allowed_and_no_other() -> None:
    assert viewer_server.is_own_page("scans.lan:8080", "http://scans.lan:8080", "scans.lan")
    assert not viewer_server.is_own_page("scans.lan:8080", "http://scans.lan:8080", "0.0.0.0")
    assert viewer_server.is_own_page(f"{socket.gethostname()}:80", None, "0.0.0.0")


def test_no_client_opens_a_share_tunnel(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = threading.Event()
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_: opened.set())
    websockets = pytest.importorskip("websockets.sync.client")
    protocol = f"viser-v{viser.__version__}"
    url = f"ws://127.0.0.1:{server.get_port()}"
    with websockets.connect(url, subprotocols=[protocol], max_size=None) as client:
        client.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        assert not opened.wait(0.5)


def test_a_viser_that_would_listen_unguarded_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = []

    class Unguarded:
        def __init__(self, **_: object) -> None: ...

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Unguarded)
    with pytest.raises(InputError, match="unguarded"):
        viewer_server.start_server("127.0.0.1", 0)
    assert stopped
