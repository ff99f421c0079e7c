"""The viewer's web server: viser, closed to other sites' pages and without public share tunnels.

A page of any site can open a websocket to this machine and, by rebinding its own host name, even load pages from it.
Such a request gives itself away: its Host is the site's name, or its Origin is not the address it talks to.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from gsopt._optional import require
from gsopt.errors import InputError

_REFUSAL = "Open the viewer by an address such as http://127.0.0.1:8080, as localhost or by the name given to --host.\n"


def start_server(host: str, port: int) -> Any:
    """A running viser server on `host`, port `port` or the next free one. Raises MissingDependency without viser."""
    viser = require("viser", "viewer", "The web viewer")
    closed = type("ClosedServer", (viser.ViserServer,), {"request_share_url": _no_tunnel})
    with _checked_handshakes(host) as guarded:
        server = closed(host=host, port=port, verbose=False)
    if not guarded:
        server.stop()
        raise InputError("This version of viser opens its port unguarded, got no check. Install viser 1.1.")
    server.gui.configure_theme(show_share_button=False)
    return server


def is_own_page(host_header: str, origin: str | None, host: str) -> bool:
    """True when the Host is an address, this machine's name or `host`, and the Origin, if any, is that same place.

    A program sends no Origin; a browser always does for a websocket.
    """
    name = _host_name(f"//{host_header}")
    machine = socket.gethostname().lower()
    if name is None or not (_is_address(name) or name in {"localhost", host.lower(), machine, f"{machine}.local"}):
        return False
    return origin is None or origin.lower() in {f"{scheme}://{host_header.lower()}" for scheme in ("http", "https")}


def _host_name(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _no_tunnel(server: object, verbose: bool = True) -> None:
    """Replaces viser's request_share_url, which any client may call: a scan is never made public."""


@contextmanager
def _checked_handshakes(host: str) -> Iterator[list[int]]:
    """Within the block, websocket servers that start refuse requests of other sites; yields the guarded ports.

    viser has no hook for handshakes and starts its server in a thread, which it waits for.
    """
    websockets: Any = require("websockets.asyncio.server", "viewer", "The web viewer")
    serve, guarded = websockets.serve, []

    def guarded_serve(handler: Any, address: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if _is_allowed(request.headers, host):
                return process_request(connection, request)
            return connection.respond(403, _REFUSAL)

        guarded.append(port)
        return serve(handler, address, port, process_request=process, **options)

    websockets.serve = guarded_serve
    try:
        yield guarded
    finally:
        websockets.serve = serve


def _is_allowed(headers: Any, host: str) -> bool:
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    return len(hosts) == 1 and len(origins) <= 1 and is_own_page(hosts[0], next(iter(origins), None), host)
