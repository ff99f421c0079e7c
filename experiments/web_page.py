"""Does the page of `gsopt export RUN -o page.html` show what the rasterizer draws, and how large is it?

    python experiments/web_page.py RUN... [--draw] [--picture] [--split 1000000]

Wants a Chromium (software rendering, no network) and the extra `viewer`. For each run: PSNR of the page against
`gsopt render` at the poses of up to 6 input views, the page's size beside that of a .spz. `--draw` rewrites the table
of docs/howto/share.md and results/web_page.json; `--picture` draws docs/img/share.jpg and view.jpg of the first run.
`--split N` adds the first run with its splats split into N, and what the browser needs to load and to sort them.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import tempfile
import time
from pathlib import Path
from statistics import mean, median

import numpy as np
import torch
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests")]

from browser import Tab, tab  # noqa: E402

from gsopt.benchmark.machine import machine  # noqa: E402
from gsopt.benchmark.markdown import replace_block, table  # noqa: E402
from gsopt.data.scene import load_scene  # noqa: E402
from gsopt.events import write_atomic  # noqa: E402
from gsopt.formats import save_splats  # noqa: E402
from gsopt.gaussians import Gaussians  # noqa: E402
from gsopt.geometry.quats import rotation_matrices  # noqa: E402
from gsopt.results import viewer  # noqa: E402
from gsopt.results.finished_run import open_run  # noqa: E402
from gsopt.results.web import save_run_page  # noqa: E402

RESULT, PAGE = HERE / "results/web_page.json", HERE.parent / "docs/howto/share.md"
PICTURE, PICTURE_SIZE = HERE.parent / "docs/img/share.jpg", (1000, 620)
VIEW_PICTURE, VIEW_SIZE = HERE.parent / "docs/img/view.jpg", (1280, 720)
LOADED = 0.15
"""Share of the viewer's pixels that are not white when its splats have come."""
SETTLED = 10
"""Seconds after which the viewer's camera and colors stand still."""
VIEWS = 6
SORTS = 6
SPY = """
window.answers = [];
window.Worker = class extends Worker {
  postMessage(message, moved) { this.asked = performance.now(); super.postMessage(message, moved); }
  set onmessage(receive) {
    super.onmessage = event => {
      answers.push([event.data.shapes ? "unpack" : "sort", performance.now() - this.asked]);
      const begun = performance.now();
      receive(event);
      answers.push(["main", performance.now() - begun]);
    };
  }
};
"""
"""Notes, in milliseconds, how long the worker takes to answer and how long the page itself takes to use it."""
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


def viewer_screenshot(run: Path, browser: Tab) -> np.ndarray:
    """`gsopt view`, when the splats have come and stand still."""
    shown = viewer.SplatViewer("127.0.0.1", 0)
    try:
        next(viewer.view_run(shown, run))
        browser.open(f"http://127.0.0.1:{shown.port}", *VIEW_SIZE)
        browser.wait_for("document.querySelector('canvas') !== null")
        while (browser.screenshot()[:, :800] < 240).any(axis=2).mean() < LOADED:
            time.sleep(1)
        time.sleep(SETTLED)
        browser.value("document.querySelectorAll('.mantine-Notification-closeButton').forEach(one => one.click())")
        time.sleep(1)
        return browser.screenshot()
    finally:
        shown.stop()


def split(gaussians: Gaussians, count: int) -> Gaussians:
    """Splats drawn from the Gaussians themselves, smaller and fainter, `count` in all."""
    parts = -(-count // len(gaussians))
    few = gaussians.select(torch.arange(len(gaussians)).repeat_interleave(parts)[:count])
    offsets = few.log_scales.exp() * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    fainter = 1 - (1 - few.opacities.clamp(max=0.99)) ** (parts ** (-1 / 3))
    return Gaussians(
        **{
            **dict(few.items()),
            "means": few.means + 0.8 * (rotation_matrices(few.quats) @ offsets[..., None])[..., 0],
            "log_scales": few.log_scales - math.log(parts) / 3,
            "logit_opacities": torch.logit(fainter),
        }
    )


def split_run(run: Path, count: int, folder: Path) -> Path:
    """A copy of the run whose splats are split."""
    copy = folder / f"{run.name}-split"
    copy.mkdir()
    for name in ("config.json", "metrics.json", "splat.ply"):
        shutil.copy(run / name, copy / name)
    save_splats(copy / "splat.ply", split(open_run(run).gaussians, count))
    return copy


def work_of_the_browser(page: Path, browser: Tab) -> dict[str, object]:
    """Milliseconds of the worker and of the page's own thread, and the bytes of both heaps."""
    spy = browser.call("Page.addScriptToEvaluateOnNewDocument", source=SPY)["identifier"]
    screenshot(browser, page, "view=1&plain", 64, 64)
    for _ in range(SORTS):
        before = browser.value("answers.length")
        browser.value("document.querySelector('[data-part=after]').click()")
        browser.wait_for(f"answers.length >= {before + 2}")
    times = json.loads(browser.value("JSON.stringify(answers)"))
    heap = browser.call("Runtime.getHeapUsage")
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=spy)
    of = {kind: [round(ms) for name, ms in times if name == kind] for kind in ("unpack", "sort", "main")}
    return {
        "worker_unpacks_ms": of["unpack"][0],
        "worker_sorts_ms": median(of["sort"]),
        "page_takes_splats_ms": of["main"][0],
        "page_takes_order_ms": median(of["main"][1:]),
        "page_heap_bytes": heap["usedSize"] + heap["backingStorageSize"],
    }


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
    parser.add_argument("--split", type=int, default=0)
    flags = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, tab(Path(folder) / "profile") as browser:
        records = [measured(run, Path(folder), browser) for run in flags.runs]
        if flags.split:
            run = split_run(flags.runs[0], flags.split, Path(folder))
            records.append(measured(run, Path(folder), browser))
            records[-1] |= work_of_the_browser(Path(folder) / f"{run.name}.html", browser)
        for record in records:
            print(record)
        if flags.picture:
            page = Path(folder) / f"{flags.runs[0].name}.html"
            Image.fromarray(screenshot(browser, page, "", *PICTURE_SIZE)).save(PICTURE, quality=88)
            Image.fromarray(viewer_screenshot(flags.runs[0], browser)).save(VIEW_PICTURE, quality=88)
    if flags.draw:
        write_atomic(RESULT, (json.dumps({"machine": machine(), "runs": records}, indent=1) + "\n").encode())
        draw(records)


if __name__ == "__main__":
    main()
