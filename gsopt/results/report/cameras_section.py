"""The report's section about cameras: poses found by `gsopt sfm`, and their refinement by training."""

from __future__ import annotations

import statistics
from html import escape
from pathlib import Path
from typing import Any

from gsopt.data.files import is_regular, read_json
from gsopt.errors import InputError
from gsopt.results.report.embedded_images import data_uri, read_image

IMAGE_SIDE = 1440
MAX_PIXELS = 4096 * 4096
MAX_LINES = 40


def cameras_section(dataset: Path, run: Path, messages: list[str]) -> str:
    """HTML, empty when the poses were given and kept; unreadable parts are left out and named in `messages`."""
    lines = [*_sfm_lines(dataset / "sfm.json", messages), *_refinement_lines(run / "poses.json", messages)]
    image = read_image(dataset / "sfm.png", IMAGE_SIDE, MAX_PIXELS)
    if not lines and image is None:
        return ""
    drawn = "" if image is None else f'<img src="{data_uri(image)}" style="width:100%" alt="Cameras and points">'
    return f"<section><h2>Cameras</h2>{''.join(f'<p>{escape(line)}</p>' for line in lines)}{drawn}</section>\n"


def _sfm_lines(path: Path, messages: list[str]) -> list[str]:
    """The report that `gsopt sfm` printed."""
    lines = _read(path, messages).get("report")
    return [line.strip() for line in lines[:MAX_LINES] if isinstance(line, str)] if isinstance(lines, list) else []


def _refinement_lines(path: Path, messages: list[str]) -> list[str]:
    views = _read(path, messages).get("views")
    turned = [_degrees(view) for view in views] if isinstance(views, list) else []
    if not turned:
        return []
    return [
        f"--refine-poses turned {len(turned)} input views by {statistics.median(turned):.3f} degrees (median), "
        f"{max(turned):.3f} at most."
    ]


def _degrees(view: object) -> float:
    value = view.get("turned_degrees") if isinstance(view, dict) else None
    return float(value) if isinstance(value, int | float) and abs(value) <= 180 else 0.0


def _read(path: Path, messages: list[str]) -> dict[str, Any]:
    if not is_regular(path):
        return {}
    try:
        document = read_json(path)
    except InputError as error:
        messages.append(f"The origin of the cameras is missing from this report. {error}")
        return {}
    return document if isinstance(document, dict) else {}
