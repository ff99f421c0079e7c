"""Does the page of `gsopt export RUN -o page.html` show what the rasterizer draws, and how large is it?

    python experiments/web_page.py RUN... [--draw] [--picture]

Wants a Chromium (software rendering, no network) and the extra `viewer`. For each run: PSNR of the page against
`gsopt render` at the poses of up to 6 input views, the page's size beside that of a .spz. `--draw` rewrites the table
of docs/howto/share.md and results/web_page.json; `--picture` draws docs/img/share.jpg of the first run.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path
from statistics import mean

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

from browser import Tab, tab  # noqa: E402

from gsopt.benchmark.markdown import replace_block, table  # noqa: E402
from gsopt.data.scene import load_scene  # noqa: E402
from gsopt.events import write_atomic  # noqa: E402
from gsopt.formats import save_splats  # noqa: E402
from gsopt.results.finished_run import open_run  # noqa: E402
from gsopt.results.web import save_run_page  # noqa: E402

RESULT, PAGE = HERE / "results/web_page.json", HERE.parent / "docs/howto/share.md"
PICTURE, PICTURE_SIZE = HERE.parent / "docs/img/share.jpg", (1000, 620)
VIEWS = 6
DRAWN = "document.querySelector('.gsopt-viewer') && document.querySelector('.gsopt-viewer').dataset.drawn"


def screenshot(browser: Tab, page: Path, mark: str, width: int, height: int) -> np.ndarray:
    browser.open("about:blank", width, height)
    browser.open(f"{page.as_uri()}#{mark}", width, height)
    browser.wait_for(DRAWN)
    return browser.screenshot()


def measured(run: Path, folder: Path, browser: Tab) -> dict:
    finished = open_run(run)
    views = load_scene(finished.config.data).train
    page, spz = folder / f"{run.name}.html", folder / f"{run.name}.spz"
    save_run_page(page, run)
    save_splats(spz, finished.gaussians)
    figures = []
    for number in range(0, len(views), -(-len(views) // VIEWS)):
        camera = views[number].camera
        image = screenshot(browser, page, f"view={number + 1}&plain", camera.width, camera.height)
        error = np.square(image.astype(float) - finished.draw(camera).numpy()).mean()
        figures.append(round(10 * math.log10(255**2 / error), 2))
    sizes = {"page_bytes": page.stat().st_size, "spz_bytes": spz.stat().st_size}
    return {"run": run.name, "splats": len(finished.gaussians), "psnr": figures, **sizes}


def draw(records: list[dict]) -> None:
    rows = []
    for r in records:
        ratio = f"{(r['page_bytes'] - 100_000) / r['spz_bytes']:.2f}"
        psnr = f"{mean(r['psnr']):.1f} (least {min(r['psnr']):.1f})"
        rows.append([r["run"], f"{r['splats']:,}", psnr, f"{r['page_bytes']:,}", f"{r['spz_bytes']:,}", ratio])
    head = ["run", "splats", "PSNR of the page, dB", "page, bytes", "`.spz`, bytes", "(page - 100 kB) / `.spz`"]
    replace_block(PAGE, "web", table(head, rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--draw", action="store_true")
    parser.add_argument("--picture", action="store_true")
    flags = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, tab(Path(folder) / "profile") as browser:
        records = [measured(run, Path(folder), browser) for run in flags.runs]
        for record in records:
            print(record)
        if flags.picture:
            page = Path(folder) / f"{flags.runs[0].name}.html"
            Image.fromarray(screenshot(browser, page, "", *PICTURE_SIZE)).save(PICTURE, quality=88)
    if flags.draw:
        write_atomic(RESULT, (json.dumps(records, indent=1) + "\n").encode())
        draw(records)


if __name__ == "__main__":
    main()
