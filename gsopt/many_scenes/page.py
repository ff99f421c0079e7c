"""The page about all scenes, a row each, and the picture of a row."""

from __future__ import annotations

import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import torch
from PIL import Image

from gsopt.data.scene import load_scene
from gsopt.events import write_atomic
from gsopt.results.finished_run import open_run, truth
from gsopt.results.report.embedded_images import WEBP_QUALITY, shrunk
from gsopt.results.report.page import NO_VALUE, html_document
from gsopt.results.report.values import number
from gsopt.results.video import as_image

SIDE = 220
"""Longer side of each half of a picture, px."""
HEAD = ("scene", "truth and render", "PSNR", "SSIM", "LPIPS", "Gaussians", "minutes", "memory, MB", "machine")
STYLE = "td,th{padding:8px 12px;text-align:left;vertical-align:middle}td img{border-radius:8px}table{width:100%}"
POLICY = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'"


@torch.no_grad()
def write_picture(run: Path, path: Path) -> None:
    """Writes truth and render of the first held-out view side by side, or of the first input view without any."""
    finished = open_run(run)
    scene = load_scene(finished.config.data)
    view = (scene.test or scene.train)[0]
    halves = [
        shrunk(as_image(pixels), SIDE) for pixels in (truth(view, finished.background), finished.draw(view.camera))
    ]
    sheet = Image.new("RGB", (halves[0].width * 2, halves[0].height))
    for column, half in enumerate(halves):
        sheet.paste(half, (column * half.width, 0))
    buffer = io.BytesIO()
    sheet.save(buffer, format="WEBP", quality=WEBP_QUALITY)
    write_atomic(path, buffer.getvalue())


def write_page(records: Sequence[dict[str, Any]], count: int, path: Path, picture: str) -> None:
    """Writes the page of `count` scenes, of which `records` are finished or failed."""
    done = [record for record in records if record["state"] == "done"]
    failed = [record for record in records if record["state"] != "done"]
    head = "".join(f"<th>{name}</th>" for name in HEAD)
    rows = "".join(_row(record, picture) for record in done)
    losses = "".join(f"<li><b>{escape(str(r['name']))}</b>: {escape(str(r.get('reason')))}</li>" for r in failed)
    missing = f"<section><h2>Failed</h2><ul>{losses}</ul></section>" if failed else ""
    title = f"{len(done)} of {count} scenes"
    body = (
        f"<main><header><p class='eyebrow'>gsopt train-many</p><h1>{title}</h1><p class='muted'>{_mean(done)}</p>"
        f"</header>{missing}<section><table><tr>{head}</tr>{rows}</table></section></main>"
    )
    write_atomic(path, html_document(title, body, STYLE, POLICY).encode("utf-8", "backslashreplace"))


def _mean(done: Sequence[dict[str, Any]]) -> str:
    judged = (number(record.get("psnr")) for record in done if record.get("held_out"))
    held_out = [value for value in judged if value is not None]
    if not held_out:
        return "No scene has held-out views: figures are of the input views. Train with --eval."
    count = f"{len(held_out)} scene{'s' * (len(held_out) != 1)}"
    return f"Mean PSNR of held-out views {sum(held_out) / len(held_out):.2f} dB over {count}."


def _row(record: dict[str, Any], picture: str) -> str:
    name = str(record["name"])
    link = quote(name)
    image = f'<img loading="lazy" src="{link}/{picture}" alt="{escape(name)}: truth, render">'
    psnr, ssim, lpips = (number(record.get(key)) for key in ("psnr", "ssim", "lpips_alex"))
    cells = [
        f'<a href="{link}/report.html">{escape(name)}</a>' + ("" if record.get("held_out") else "<br>input views"),
        image,
        NO_VALUE if psnr is None else f"{psnr:.2f}",
        NO_VALUE if ssim is None else f"{ssim:.4f}",
        NO_VALUE if lpips is None else f"{lpips:.4f}",
        f"{number(record.get('n_gaussians')) or 0:,.0f}",
        f"{(number(record.get('seconds')) or 0) / 60:.1f}",
        f"{(number(record.get('peak_memory')) or 0) / 1e6:,.0f}",
        escape(str(record.get("host", ""))),
    ]
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
