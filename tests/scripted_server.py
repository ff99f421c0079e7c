"""A server on this machine that says, one after the other, what a test wrote down for it."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any


@dataclass
class Says:
    """One HTTP answer."""

    body: bytes = b""
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    wait: float = 0.0
    """Seconds before the first byte."""
    drip: float = 0.0
    """Seconds between two bytes of the body."""
    announced: int | None = None
    """Content-Length, where it is not the truth."""
    raw: bytes | None = None
    """Instead of HTTP."""
    only_without: str = ""
    """A field of the request: 400 as long as it is there."""


def completion(text: Any, finish: str = "stop", usage: bool = True) -> Says:
    """A chat completion with this content."""
    document: dict[str, Any] = {
        "choices": [{"message": {"role": "assistant", "content": text}, "finish_reason": finish}]
    }
    if usage:
        document["usage"] = {"prompt_tokens": 100, "completion_tokens": 20}
    return Says(json.dumps(document).encode())


def error(status: int, message: str, **headers: str) -> Says:
    """An OpenAI-style error."""
    body = json.dumps({"error": {"message": message, "type": "invalid_request_error"}}).encode()
    return Says(body, status, {name.replace("_", "-"): value for name, value in headers.items()})


@dataclass
class Running:
    """A started server."""

    url: str
    asked: list[dict[str, Any]]
    """Per request: path, headers, body."""


@contextmanager
def serving(script: Sequence[Says]) -> Iterator[Running]:
    """Serves the script; the last entry again and again. Stops, slow answers included, when the block is left."""
    asked: list[dict[str, Any]] = []
    over = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            length = int(self.headers.get("Content-Length", 0))
            body = json.loads(self.rfile.read(length)) if length else None
            asked.append({"path": self.path, "headers": dict(self.headers), "body": body})
            entry = script[min(len(asked), len(script)) - 1]
            if entry.only_without and body is not None and entry.only_without in json.dumps(body):
                asked.pop()
                entry = error(400, f"unknown field {entry.only_without}")
            with suppress(OSError):
                _say(self, entry, over.wait)

        do_GET = do_POST

        def log_message(self, *args: Any) -> None:
            return

    class Server(ThreadingHTTPServer):
        def server_bind(self) -> None:
            """Without the look-up of this machine's name, which can take seconds."""
            TCPServer.server_bind(self)
            self.server_name, self.server_port = "127.0.0.1", self.server_address[1]

    server = Server(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield Running(f"http://127.0.0.1:{server.server_address[1]}/v1", asked)
    finally:
        over.set()
        server.shutdown()
        server.server_close()
        thread.join()


def _say(handler: BaseHTTPRequestHandler, entry: Says, pause: Callable[[float], Any]) -> None:
    pause(entry.wait)
    if entry.raw is not None:
        handler.wfile.write(entry.raw)
        handler.close_connection = True
        return
    handler.send_response(entry.status)
    for name, value in entry.headers.items():
        handler.send_header(name, value)
    handler.send_header("Content-Length", str(len(entry.body) if entry.announced is None else entry.announced))
    handler.end_headers()
    if not entry.drip:
        handler.wfile.write(entry.body)
        return
    begin = time.monotonic()
    for byte in entry.body:
        if pause(entry.drip) or time.monotonic() - begin > 30:
            return
        handler.wfile.write(bytes([byte]))
        handler.wfile.flush()


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
