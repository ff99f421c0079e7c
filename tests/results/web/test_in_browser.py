"""The page in headless Chromium with software rendering: the same image as the rasterizer's, and controls that work."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import PATIENCE, Tab, tab
from finished_runs import WIDTH, make_run, splats

from gsopt.cli import main
from gsopt.data.scene import load_scene
from gsopt.events import EventWriter
from gsopt.gaussians import Gaussians
from gsopt.results.camera_path_file import read_camera_path
from gsopt.results.finished_run import open_run
from gsopt.results.measure import units_of
from gsopt.results.picking import surface_along
from gsopt.results.web import save_run_page

DRAWN = "document.querySelector('.gsopt-viewer').dataset.drawn"
CLOSE = 35.0
"""dB between page and rasterizer: the codes of the splats have 8 bits."""


def many_splats() -> Gaussians:
    """Blobs of all sizes and opacities whose colors change with the direction."""
    few = splats(400)
    generator = torch.Generator().manual_seed(3)
    few.log_scales[:] = torch.rand(400, 3, generator=generator) * 4 - 5
    few.logit_opacities[:] = torch.rand(400, generator=generator) * 10 - 5
    return Gaussians(**{**dict(few.items()), "shN": torch.rand(400, 15, 3, generator=generator) * 0.6 - 0.3})


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("browser"), train=3, test=1, learned=many_splats())
    save_run_page(run / "page.html", run)
    return run


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with tab(tmp_path_factory.mktemp("profile") / "chromium") as opened:
        yield opened


def shown(browser: Tab, page: Path, mark: str, scale: int = 5) -> np.ndarray:
    """The drawn page in a window of `scale` times the views' size."""
    browser.open("about:blank", WIDTH * scale, 32 * scale)
    browser.open(f"{page.as_uri()}#{mark}", WIDTH * scale, 32 * scale)
    browser.wait_for(f"document.querySelector('.gsopt-viewer') && {DRAWN}")
    return browser.screenshot()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = float(np.square(a.astype(float) - b).mean())
    return 99.0 if error == 0 else 10 * math.log10(255**2 / error)


@pytest.mark.parametrize("number", [1, 2, 4])
def test_a_page_shows_what_the_rasterizer_draws(browser: Tab, run: Path, number: int) -> None:
    finished = open_run(run)
    scene = load_scene(finished.config.data)
    camera = (*scene.train, *scene.test)[number - 1].camera
    camera = camera.resized(5 * camera.width, 5 * camera.height)
    image = shown(browser, run / "page.html", f"view={number}&plain")
    assert psnr(image, finished.draw(camera).numpy()) > CLOSE
    assert browser.complaints == []


def changed(browser: Tab, script: str) -> np.ndarray:
    """The page after a script, when it has been drawn again."""
    browser.value(f"delete document.querySelector('.gsopt-viewer').dataset.drawn; {script}; 0")
    browser.wait_for(DRAWN)
    return browser.screenshot()


def slid(part: str, value: str) -> str:
    element = f"document.querySelector('[data-part={part}]')"
    return f"{element}.value = '{value}'; {element}.dispatchEvent(new Event('input'))"


def test_controls_change_the_image(browser: Tab, run: Path) -> None:
    before = shown(browser, run / "page.html", "view=1&plain")
    points = changed(browser, slid("scale", "0"))
    assert (points > 250).all(axis=2).mean() > (before > 250).all(axis=2).mean()  # more of the white background
    plain = changed(browser, f"{slid('scale', '1')}; {slid('degree', '0')}")
    assert 10 < psnr(plain, before) < 45
    assert psnr(changed(browser, slid("degree", "3")), before) > 60
    dark = changed(browser, slid("background", "#000000"))
    assert dark.mean() < before.mean()
    cameras = "document.querySelector('[data-part=cameras]')"
    wired = changed(browser, f"{cameras}.checked = true; {cameras}.dispatchEvent(new Event('change'))")
    assert psnr(wired, dark) < 60


def test_the_mouse_turns_and_keys_step_through_the_views(browser: Tab, run: Path) -> None:
    before = shown(browser, run / "page.html", "view=1&plain")
    for kind, x in (("mousePressed", 50), ("mouseMoved", 90), ("mouseReleased", 90)):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=60, button="left", buttons=1, clickCount=1)
    browser.wait_for(f"{DRAWN} && performance.now()")
    turned = browser.screenshot()
    assert psnr(turned, before) < 30
    again = changed(browser, "document.querySelector('[data-part=after]').click()")
    expected = shown(browser, run / "page.html", "view=2&plain")
    assert psnr(again, expected) > 60


def test_the_image_turns_while_the_worker_sorts(browser: Tab, run: Path, tmp_path: Path) -> None:
    """The second sort of this page never ends; what is drawn follows the mouse all the same."""
    text = (run / "page.html").read_text(encoding="utf-8")
    call = "const { order, n } = sorted("
    assert text.count(call) == 1
    stuck = tmp_path / "stuck.html"
    stuck.write_text(text.replace(call, f"while (self.sortedOnce); self.sortedOnce = true; {call}"), encoding="utf-8")
    images = [shown(browser, stuck, "view=1&plain")]
    for x in (90, 130):
        for kind, place in (("mousePressed", x - 40), ("mouseMoved", x), ("mouseReleased", x)):
            browser.call("Input.dispatchMouseEvent", type=kind, x=place, y=60, button="left", buttons=1, clickCount=1)
        end = time.monotonic() + PATIENCE
        while psnr(image := browser.screenshot(), images[-1]) > 30:
            assert time.monotonic() < end, "the image stands still"
        images.append(image)
    assert browser.value(DRAWN) == "1"  # of the first view: nothing was marked as sorted and drawn since


def clicked(part: str) -> str:
    return f"document.querySelector('[data-part={part}]').click()"


def test_keyframes_are_played_and_saved_as_a_path_that_render_reads(browser: Tab, run: Path, tmp_path: Path) -> None:
    """The path goes through the three input cameras in their order, and the page plays it in place of the turntable."""
    shown(browser, run / "page.html", "view=1")
    browser.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    saving = "document.querySelector('[data-part=save]').disabled"
    assert browser.value(saving) is True
    for _ in range(3):
        browser.value(clicked("keyframe"))
        browser.value(clicked("after"))
    browser.value(clicked("keyframe"))
    browser.value(clicked("undo"))
    assert browser.value("document.querySelector('[data-part=path]').textContent") == "3 keyframes, 4 s"
    browser.value(clicked("save"))
    end = time.monotonic() + PATIENCE
    while not (tmp_path / "camera-path.json").is_file():
        assert time.monotonic() < end, "nothing was downloaded"
        time.sleep(0.1)
    cameras = read_camera_path(tmp_path / "camera-path.json")
    views = load_scene(open_run(run).config.data).train
    assert len(cameras) == 97
    for view, camera in zip(views, (cameras[0], cameras[48], cameras[96]), strict=True):
        torch.testing.assert_close(camera.viewmats, view.camera.viewmats, atol=1e-4, rtol=0)
        torch.testing.assert_close(camera.Ks, view.camera.Ks.to(camera.Ks), atol=1e-3, rtol=0)
    smooth = torch.stack([camera.centers[0] for camera in cameras]).diff(dim=0).norm(dim=1)
    assert smooth.max() < 2.5 * smooth.mean()
    browser.value(clicked("play"))
    browser.wait_for("document.querySelector('[data-part=play]').textContent === 'Stop'")
    assert changed(browser, clicked("play")).std() > 10
    assert browser.complaints == []


def pressed(browser: Tab, x: float, y: float) -> None:
    for kind in ("mousePressed", "mouseReleased"):
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)


def test_two_picked_points_show_their_distance_and_the_command_for_the_scale(
    browser: Tab, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page picks the points that gsopt's own function finds along the same rays, up to the codes of the splats."""
    shown(browser, run / "page.html", "view=1", scale=20)
    browser.value(clicked("measure"))
    part = "document.querySelector('[data-part={}]')"
    assert browser.value(part.format("length") + ".textContent") == "Click two points."
    finished = open_run(run)
    camera = load_scene(finished.config.data).train[0].camera
    points = []
    for x, y in ((380.0, 300.0), (300.0, 380.0)):
        before = len(points)
        pressed(browser, x, y)
        browser.wait_for(f"document.querySelectorAll('circle[r=\"5\"]').length === {before + 1}")
        pixel = torch.tensor([x / 20, y / 20, 1.0])
        ray = camera.viewmats[0, :3, :3].T @ torch.linalg.solve(camera.Ks[0], pixel)
        points.append(surface_along(finished.gaussians, camera.centers[0], ray, 20 * float(camera.Ks[0, 0, 0])))
    distance = float((points[1] - points[0]).norm())
    words = browser.value(part.format("length") + ".textContent").split()
    assert words[1] == "units"
    assert float(words[0]) == pytest.approx(distance, abs=0.02)
    browser.value(f"{part.format('known')}.value = '50 cm'; {part.format('known')}.dispatchEvent(new Event('input'))")
    assert browser.value(part.format("length") + ".textContent") == "50 cm"
    assert browser.value("document.querySelector('svg text').textContent") == "50 cm"
    command = browser.value(part.format("command") + ".value").split()
    other = make_run(tmp_path)
    assert main(["measure", str(other), *command[3:]]) == 0
    scale = float(capsys.readouterr().out.split(" scene unit is ")[1].split()[0])
    assert scale == pytest.approx(0.5 / distance, rel=0.05)
    save_run_page(tmp_path / "a.html", other)
    assert f'"metersPerUnit":{units_of(other).meters_per_unit}' in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_the_report_shows_the_splats(browser: Tab, run: Path) -> None:
    from gsopt.results.report import write_report

    browser.open(write_report(run).as_uri(), 1200, 800)
    browser.wait_for(f"document.querySelector('.gsopt-viewer') && {DRAWN}")
    assert browser.screenshot().std() > 10


def test_a_hostile_name_stays_a_name(browser: Tab, tmp_path: Path) -> None:
    run = make_run(tmp_path / "<img src=x onerror=window.hacked=1>", train=2, test=0)
    assert main(["export", str(run), "-o", str(tmp_path / "a.html")]) == 0
    shown(browser, tmp_path / "a.html", "")
    assert browser.value("window.hacked === undefined && document.images.length") == 0


def test_gsopt_view_opens_with_splats_that_fill_the_window(browser: Tab, run: Path) -> None:
    pytest.importorskip("viser")
    from gsopt.results import viewer

    shown = viewer.SplatViewer("127.0.0.1", 0)
    try:
        emit_done(run)
        next(viewer.view_run(shown, run))
        browser.open(f"http://127.0.0.1:{shown.port}", 640, 480)
        browser.wait_for("document.querySelector('canvas') !== null")
        end = time.monotonic() + PATIENCE
        while (inside := (browser.screenshot()[:, :440] < 240).any(axis=2)).mean() < 0.2:
            assert time.monotonic() < end, inside.mean()
            time.sleep(0.5)
        rows = np.flatnonzero(inside.mean(axis=1) > 0.05)
        assert rows[-1] - rows[0] > 0.6 * 480
    finally:
        shown.stop()


def emit_done(run: Path) -> None:
    writer = EventWriter(run)
    writer.emit("started", total=100)
    writer.emit("done", step=100)
    writer.close()
