"""One self-contained page of a suite: tables, charts and the grid of renders."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

from gsopt._version import __version__
from gsopt.benchmark.suite import definition as declared
from gsopt.benchmark.suite.aggregate import Variant
from gsopt.benchmark.suite.tables import GroupSection, about, group_sections, missing
from gsopt.errors import InputError
from gsopt.events import encoded, write_atomic
from gsopt.results.report.page import html_document

STYLE = (
    ".grid{border-spacing:6px;border-collapse:separate}.grid td{padding:0;vertical-align:top;text-align:center}"
    ".grid img{display:block;width:150px;height:auto}.grid td.none{color:#888}svg{max-width:540px;height:auto}"
    ".charts{display:flex;flex-wrap:wrap;gap:1rem}"
)
WEBP_PREFIX = "data:image/webp;base64,"
CELL_SIDE, CELL_GAP, JPEG_QUALITY = 150, 6, 85


def write_html(document: dict[str, Any], images: dict[str, Any], path: Path) -> None:
    """Write the page."""
    write_atomic(path, encoded(page(document, images)))


def page(document: dict[str, Any], images: dict[str, Any]) -> str:
    suite = declared.of_document(document)
    lines = "".join(f"<p>{marked(line)}</p>" for line in about(document))
    sections = "".join(section_html(section, images) for section in group_sections(document))
    rest = "".join(f"<li>{marked(line)}</li>" for line in missing(document))
    return html_document(
        f"{suite.title} · gsopt bench",
        f"<main><header><p class='eyebrow'>gsopt bench --suite {escape(suite.name)}</p>"
        f"<h1>{escape(suite.title)}</h1></header>{lines}{sections}"
        f"<section><h2>Missing runs</h2><ul>{rest or '<li>None.</li>'}</ul></section></main>"
        f"<footer><p>gsopt {__version__}</p></footer>",
        STYLE,
    )


def marked(text: str) -> str:
    """Escaped text, with code between backticks."""
    return re.sub("`([^`]*)`", r"<code>\1</code>", escape(text))


def section_html(section: GroupSection, images: dict[str, Any]) -> str:
    """A group's tables, charts and renders."""
    out = [f"<section><h2>{escape(section.title)}</h2><p>{marked(' '.join(section.lines))}</p>"]
    for note, (head, rows) in section.tables:
        cells = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
        out.append(f"<p class='muted'>{escape(note)}</p>")
        out.append(f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>')
    out.append(f'<div class="charts">{"".join(section.charts.values())}</div>')
    return "".join(out) + grid(section, images) + "</section>\n"


def grid(section: GroupSection, images: dict[str, Any]) -> str:
    """Rows of input, every arm with its error below, truth; empty without images."""
    rows = "".join(grid_row(section, scene, images) for scene in section.scenes)
    if not rows:
        return ""
    names = "".join(f"<th>{escape(arm)}<br>{steps:,}</th>" for arm, steps in section.variants)
    note = (
        "The held-out view farthest from all input views, chosen before any result, and the input view nearest to "
        "it; below each render its error (dark: none, bright: a quarter of the range and more). Seed 0."
    )
    head = f"<tr><th></th><th>nearest input</th>{names}<th>truth</th></tr>"
    return f"<p class='muted'>{note}</p><div class='scroll'><table class='grid'>{head}{rows}</table></div>"


def grid_row(section: GroupSection, scene: str, images: dict[str, Any]) -> str:
    shared = images.get(f"{scene}|{section.views}")
    if not isinstance(shared, dict):
        return ""
    cells = [f"<td>{escape(scene.rpartition('/')[2])}</td>", _cell(shared, "input")]
    for one in section.variants:
        found = find(images, scene, section.views, one)
        cells.append("<td class='none'>no run</td>" if found is None else _cell(found, "render", "error"))
    return f"<tr>{''.join(cells)}{_cell(shared, 'truth')}</tr>"


def find(images: dict[str, Any], scene: str, views: str, one: Variant) -> dict[str, Any] | None:
    """Images of a run of seed 0 in any group."""
    ending = f"|{scene}|{views}|{one[0]}|{one[1]}|0"
    return next((value for key, value in images.items() if key.endswith(ending)), None)


def _cell(found: dict[str, Any], *names: str) -> str:
    sources = [str(found.get(name, "")) for name in names]
    shown = "".join(f'<img loading="lazy" src="{escape(s)}" alt="">' for s in sources if s.startswith(WEBP_PREFIX))
    return f"<td>{shown}</td>"


def write_grid(document: dict[str, Any], images: dict[str, Any], path: Path, max_rows: int = 12) -> bool:
    """The rows of the first part that have all of input, 3dgs, ours-0, ours, truth and the error of ours, as one JPEG;
    False when there is none."""
    for section in group_sections(document):
        rows = [row for scene in section.scenes if (row := _row_images(section, scene, images))][:max_rows]
        if rows:
            sheet = Image.new(
                "RGB", (len(rows[0]) * (CELL_SIDE + CELL_GAP), len(rows) * (CELL_SIDE + CELL_GAP)), "white"
            )
            for y, row in enumerate(rows):
                for x, uri in enumerate(row):
                    sheet.paste(
                        decoded(uri).resize((CELL_SIDE, CELL_SIDE)),
                        (x * (CELL_SIDE + CELL_GAP), y * (CELL_SIDE + CELL_GAP)),
                    )
            buffer = io.BytesIO()
            sheet.save(buffer, format="JPEG", quality=JPEG_QUALITY)
            write_atomic(path, buffer.getvalue())
            return True
    return False


def _row_images(section: GroupSection, scene: str, images: dict[str, Any]) -> Sequence[str]:
    """Data URIs of a whole row, empty when one is missing."""
    steps = section.variants[0][1]
    shared = images.get(f"{scene}|{section.views}")
    found = [find(images, scene, section.views, (arm, steps)) for arm in ("3dgs", "ours-0", "ours")]
    if not isinstance(shared, dict) or not all(isinstance(one, dict) for one in found):
        return ()
    renders = [str(one["render"]) for one in found if one is not None]
    return [str(shared["input"]), *renders, str(shared["truth"]), str((found[-1] or {})["error"])]


def decoded(uri: str) -> Image.Image:
    """The image of a data URI that `gsopt bench` wrote; InputError for anything else."""
    try:
        if not uri.startswith(WEBP_PREFIX):
            raise ValueError("no WebP data URI")
        with Image.open(
            io.BytesIO(base64.b64decode(uri[len(WEBP_PREFIX) :], validate=True)), formats=("WEBP",)
        ) as image:
            return image.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"An image of the suite cannot be read: {error}. Execute its runs again.") from error
