"""Client of a language model with the OpenAI-compatible protocol: POST to URL/chat/completions. Standard library only.

The server is untrusted: no redirects (they could leak the key), bounded responses, and a deadline for the whole
exchange even if bytes arrive slowly. The key comes from the environment and is neither displayed nor saved.
"""

from __future__ import annotations

import contextlib
import http.client
import ipaddress
import json
import os
import queue
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gsopt.errors import InputError, UsageError
from gsopt.llm_prompts.sanitize import printable

MAX_RESPONSE_BYTES = 4 << 20
"""Size limit of an HTTP response, bytes."""
CHUNK = 1 << 16
KEY_VARIABLE = "GSOPT_LLM_KEY"
MAX_RETRY_WAIT = 20.0
"""Longest wait between two tries that a busy server may request, seconds."""
MAX_TRIES = 3
BUSY_STATUSES = (408, 429, 502, 503, 504)
REMEDY = "Check --llm and the server, or write prompts without a model: --llm none."
STATUS_ADVICE = {
    401: f"The key is missing or wrong: set the environment variable {KEY_VARIABLE}.",
    403: f"The key may not use this model: check {KEY_VARIABLE} and --model.",
    404: "The address or the model is unknown there: check --llm (it usually ends in /v1) and --model.",
    429: "Too many requests or no credit left: wait, or use another server.",
}


class ServerError(InputError):
    """The server returned no usable response."""

    def __init__(self, message: str, status: int | None = None, wait: float | None = None) -> None:
        super().__init__(message)
        self.status = status
        """HTTP status, or `None` without a response."""
        self.wait = wait
        """Wait requested by the server, seconds."""


@dataclass(frozen=True)
class Server:
    """Address, model and key of a server."""

    url: str
    """Base, e.g. http://localhost:11434/v1."""
    model: str
    deadline: float
    """Deadline of the whole exchange, in time.monotonic()."""
    key: str = field(default="", repr=False)


@dataclass(frozen=True)
class Completion:
    """One chat completion."""

    text: str
    tokens_in: int | None
    tokens_out: int | None
    finish: str
    """Finish reason: stop, length, ..."""
    seconds: float


def connect(url: str, model: str, timeout: float, environment: Mapping[str, str] = os.environ) -> Server:
    """Returns a server with checked address and known model; an empty `model` selects the only one it has.

    Raises UsageError for an invalid address or an ambiguous model, ServerError without a response.
    """
    base = read_url(url)
    server = Server(base, model, time.monotonic() + timeout, find_key(base, environment))
    return server if model else Server(base, _only_model(server), server.deadline, server.key)


def read_url(url: str) -> str:
    """Returns the base address without a final slash, with /v1 if it has no path."""
    parts = urllib.parse.SplitResult("", "", "", "", "")
    try:
        parts = urllib.parse.urlsplit(url.strip())
        sound = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        sound = False
    if not sound or any(c.isspace() for c in url.strip()):
        raise UsageError(
            f"`--llm` must be none or an http(s) address, got {url!r:.200}. Try http://localhost:11434/v1."
        )
    if parts.username or parts.password or parts.query or parts.fragment:
        raise UsageError(
            "`--llm` must not hold a name, a password, ? or #: such an address ends up in logs. "
            f"Put the key into the environment variable {KEY_VARIABLE}."
        )
    path = parts.path.rstrip("/").removesuffix("/chat/completions") or "/v1"
    return urllib.parse.urlunsplit((parts.scheme, parts.netloc, path, "", ""))


def find_key(base: str, environment: Mapping[str, str]) -> str:
    """Returns GSOPT_LLM_KEY, or OPENAI_API_KEY for OpenAI's own hosts. Raises UsageError instead of sending it in
    clear."""
    parts = urllib.parse.urlsplit(base)
    host = parts.hostname or ""
    key = environment.get(KEY_VARIABLE, "").strip()
    if not key and (host == "api.openai.com" or host.endswith(".openai.com")):
        key = environment.get("OPENAI_API_KEY", "").strip()
    if any(not 33 <= ord(c) <= 126 for c in key):
        raise UsageError(f"{KEY_VARIABLE} holds characters that no key has, such as spaces. Set it again.")
    if key and parts.scheme == "http" and not is_local(host):
        raise UsageError(
            f"{KEY_VARIABLE} would travel unencrypted to {host}, got an http address. Use https, or unset the variable."
        )
    return key


def is_local(host: str) -> bool:
    """True if the address is this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def chat(server: Server, body: Mapping[str, Any]) -> Completion:
    """One completion; a busy server (429, 503, ...) is asked up to TRIES times. Raises ServerError."""
    begin = time.monotonic()
    document = _with_retries(lambda: exchange(server, "/chat/completions", {"model": server.model, **body}), server)
    text, finish = _content(document, server)
    usage = document.get("usage")
    usage = usage if isinstance(usage, dict) else {}
    return Completion(
        text=redacted(text, server),
        tokens_in=_count(usage.get("prompt_tokens")),
        tokens_out=_count(usage.get("completion_tokens")),
        finish=finish,
        seconds=time.monotonic() - begin,
    )


def _with_retries(ask: Callable[[], dict[str, Any]], server: Server) -> dict[str, Any]:
    for attempt in range(MAX_TRIES):
        try:
            return ask()
        except ServerError as refusal:
            wait = min(MAX_RETRY_WAIT, refusal.wait if refusal.wait is not None else 2.0**attempt)
            over = time.monotonic() + wait >= server.deadline
            if refusal.status not in BUSY_STATUSES or attempt == MAX_TRIES - 1 or over:
                raise
            time.sleep(wait)
    raise AssertionError("the last attempt returns or raises")


def _content(document: dict[str, Any], server: Server) -> tuple[str, str]:
    """Returns the text of the first choice, possibly empty, and its finish reason."""
    choices = document.get("choices")
    choice = choices[0] if isinstance(choices, list) and choices else None
    message = choice.get("message") if isinstance(choice, dict) else None
    if not isinstance(choice, dict) or not isinstance(message, dict):
        raise ServerError(f"{server.url} answered JSON that is no chat completion: `choices` is missing. {REMEDY}")
    content = message.get("content")
    if isinstance(content, list):  # a list of parts, as from some servers
        content = "".join(str(part.get("text", "")) for part in content if isinstance(part, dict))
    return content if isinstance(content, str) else "", printable(str(choice.get("finish_reason")), 40)


def _count(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 40 else None


def _only_model(server: Server) -> str:
    """Returns the model of GET /models if it is the only one."""
    document = _with_retries(lambda: exchange(server, "/models", None), server)
    rows = document.get("data")
    names = [row.get("id") for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    models = [name for name in names if isinstance(name, str) and name]
    if len(models) == 1:
        return models[0]
    listed = ", ".join(printable(name, 60) for name in models[:10]) or "none"
    raise UsageError(f"`--model` is needed: {server.url} has {len(models)} models, got no choice. It lists: {listed}.")


def exchange(server: Server, path: str, body: Mapping[str, Any] | None) -> dict[str, Any]:
    """Sends a POST (a GET without body) and returns the JSON object of the response. Raises ServerError.

    Runs in a thread, so that the deadline also holds during name lookup and for a server that sends a byte a minute.
    """
    request = urllib.request.Request(
        server.url + path,
        data=None if body is None else json.dumps(body).encode(),
        headers={"Content-Type": "application/json", "Accept": "application/json", "Accept-Encoding": "identity"},
    )
    if server.key:
        request.add_unredirected_header("Authorization", f"Bearer {server.key}")
    answered: queue.SimpleQueue[bytes | ServerError] = queue.SimpleQueue()
    threading.Thread(target=lambda: answered.put(_send(request, server)), daemon=True).start()
    try:
        data = answered.get(timeout=max(0.01, server.deadline - time.monotonic()))
    except queue.Empty:
        data = ServerError(f"{server.url} did not answer in time. Give it longer with --timeout, or use --llm none.")
    if isinstance(data, ServerError):
        raise data
    return _object(data, server)


def _send(request: urllib.request.Request, server: Server) -> bytes | ServerError:
    local = is_local(urllib.parse.urlsplit(server.url).hostname or "")
    handlers: list[Any] = [_NoRedirect, urllib.request.ProxyHandler({})] if local else [_NoRedirect]
    remaining = max(0.01, server.deadline - time.monotonic())
    try:
        with urllib.request.build_opener(*handlers).open(request, timeout=remaining) as response:
            return _read_bounded(response, server)
    except urllib.error.HTTPError as error:
        return _server_error(error, server)
    except Exception as error:  # any exception must reach the waiting thread
        reason = getattr(error, "reason", None) or error
        text = printable(redacted(str(reason) or type(error).__name__, server), 200)
        return ServerError(f"No usable answer came from {server.url} ({text}). {REMEDY}")


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *args: Any, **kwargs: Any) -> None:
        return None


def _read_bounded(response: Any, server: Server) -> bytes | ServerError:
    data = bytearray()
    while chunk := response.read1(CHUNK):
        data += chunk
        if len(data) > MAX_RESPONSE_BYTES:
            return ServerError(
                f"{server.url} answered more than {MAX_RESPONSE_BYTES} bytes, which is no list of prompts. {REMEDY}"
            )
        if time.monotonic() > server.deadline:
            return ServerError(
                f"{server.url} did not finish in time. Give it longer with --timeout, or use --llm none."
            )
    if response.length:  # fewer bytes than announced
        return ServerError(f"{server.url} broke off in the middle of its answer, after {len(data)} bytes. {REMEDY}")
    return bytes(data)


def _server_error(error: urllib.error.HTTPError, server: Server) -> ServerError:
    """Returns the error for a status other than 2xx, with the server's reason."""
    body = b""
    with contextlib.suppress(OSError, http.client.HTTPException, ValueError):
        body = error.read(CHUNK)
    text = printable(redacted(_reason(body), server), 300)
    wait = None
    with contextlib.suppress(TypeError, ValueError):
        wait = max(0.0, float(error.headers["Retry-After"]))
    advice = STATUS_ADVICE.get(error.code, REMEDY)
    return ServerError(
        f"{server.url} answered HTTP {error.code} ({text or 'no reason given'}). {advice}", error.code, wait
    )


def _reason(body: bytes) -> str:
    """Returns the message of OpenAI's error object, else the text."""
    text = body.decode("utf-8", "replace")
    try:
        document = json.loads(text)
        error = document.get("error", document) if isinstance(document, dict) else text
        return str(error.get("message", error) if isinstance(error, dict) else error)
    except (ValueError, RecursionError):
        return text


def _object(data: bytes, server: Server) -> dict[str, Any]:
    try:
        document = json.loads(data)
        if isinstance(document, dict):
            return document
        what = "JSON that is no object"
    except (ValueError, RecursionError):
        begin = printable(redacted(data[:200].decode("utf-8", "replace"), server), 60)
        what = f"no JSON ({begin!r})" if data else "nothing"
    raise ServerError(f"{server.url} answered {what}: it does not speak the OpenAI-compatible protocol. {REMEDY}")


def redacted(text: str, server: Server) -> str:
    """Removes the key from text of the server."""
    return text.replace(server.key, "***") if server.key else text
