"""The page's text. Names and numbers enter it as escaped text or as JSON without `<`; the only script is our own."""

from __future__ import annotations

import base64
import hashlib
import json
from html import escape
from importlib import resources
from string import Template

from gsopt.results.web.payload import Payload
from gsopt.results.web.scene import WebScene

PROGRAM = ("shaders.js", "renderer.js", "keyframes.js", "picking.js", "viewer.js")
STYLE = "html, body { margin: 0; height: 100%; } .gsopt-viewer { height: 100%; }\n"


def viewer_page(scene: WebScene, payload: Payload) -> str:
    """A document that is the viewer alone."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy()}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<title>{escape(scene.title)}</title><style>\n{style()}{STYLE}</style></head>\n"
        f"<body>{viewer_element(scene, payload)}</body></html>\n"
    )


def viewer_element(scene: WebScene, payload: Payload, *, opened: bool = True) -> str:
    """The viewer in any page that carries `style()` and is under `policy()`; `opened`: with its controls."""
    shape = {
        "count": payload.count,
        "degree": payload.sh_degree,
        "fractionBits": payload.fraction_bits,
        "colorStride": payload.color_stride,
    }
    parts = {
        "title": escape(scene.title),
        "open": " open" if opened else "",
        "scene": _json_in_html({**scene.to_json(), **shape}),
        "splats": base64.b64encode(payload.data).decode(),
        "worker": _resource("worker.js"),
        "program": _program(),
    }
    return f'<div class="gsopt-viewer">{Template(_resource("viewer.html")).substitute(parts)}</div>'


def style() -> str:
    return _resource("viewer.css")


def policy() -> str:
    """The Content-Security-Policy: nothing from anywhere, no script but the viewer's, known by its hash."""
    digest = base64.b64encode(hashlib.sha256(_program().encode()).digest()).decode()
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}' blob:; "
        "worker-src blob:"
    )


def _program() -> str:
    return "".join(map(_resource, PROGRAM))


def _resource(name: str) -> str:
    return (resources.files("gsopt.results.web") / name).read_text(encoding="utf-8")


def _json_in_html(value: object) -> str:
    """JSON in which no text can end the element around it."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
