"""The page of `gsopt export -o page.html`: alone, small, harmless, and the same splats as in the run."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from finished_runs import make_run, splats

import gsopt
from gsopt.cli import main
from gsopt.formats.spz import save_spz
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras, look_at
from gsopt.results.report import write_report
from gsopt.results.web import page as web_page
from gsopt.results.web import save_page, scene_of_splats
from gsopt.results.web.payload import packed_splats, planes
from gsopt.results.web.scene import framed, pose

EVIL = "</script><script>alert('x')</script><img src=x onerror=alert(1)>&\"'\u2028"


class Scripts(HTMLParser):
    """All tags, and the text of every script element by its type."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.scripts: list[tuple[str, str]] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs
        if tag == "script":
            self.scripts.append((dict(attrs).get("type") or "", ""))

    def handle_data(self, data: str) -> None:
        if self.cdata_elem == "script":
            kind, text = self.scripts[-1]
            self.scripts[-1] = (kind, text + data)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("web"), train=3, test=1)


@pytest.fixture(scope="module")
def text(run: Path) -> str:
    assert main(["export", str(run), "-o", str(run / "page.html")]) == 0
    return (run / "page.html").read_text(encoding="utf-8")


def scene_in(text: str) -> dict[str, Any]:
    (scene,) = (body for kind, body in Scripts(text).scripts if kind == "application/json")
    found: dict[str, Any] = json.loads(scene)
    return found


def test_the_page_needs_nothing_from_anywhere(text: str) -> None:
    assert not re.search(r"https?:|//cdn|@import|fetch\(|XMLHttpRequest|WebSocket|importScripts|eval\(", text)
    addresses = [value for key, value in Scripts(text).attributes if key in ("src", "href", "srcset", "action")]
    assert addresses == ["data:,"]


def test_the_policy_knows_the_only_script_by_its_hash(text: str) -> None:
    (program,) = (body for kind, body in Scripts(text).scripts if not kind)
    digest = base64.b64encode(hashlib.sha256(program.encode()).digest()).decode()
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert f"script-src 'sha256-{digest}' blob:" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy.replace("style-src 'unsafe-inline'", "")


def test_hostile_names_never_become_script(tmp_path: Path) -> None:
    scene = scene_of_splats(splats(), EVIL)
    scene.views[0] = (EVIL, scene.views[0][1])
    save_page(tmp_path / "a.html", splats(), scene)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "img" not in Scripts(text).tags
    assert [kind for kind, _ in Scripts(text).scripts] == ["application/json", "text/plain", "text/plain", ""]
    assert scene_in(text)["views"][0]["name"] == EVIL


def test_the_scene_has_the_views_of_the_run(run: Path, text: str) -> None:
    scene = scene_in(text)
    names = [view["name"] for view in scene["views"]]
    assert (scene["inputs"], len(names), scene["count"]) == (3, 4, 12)
    assert names[3].endswith("(held out)")
    data = gsopt.load_scene(gsopt.DataConfig(path=str(run.parent / "data")))
    for view, shown in zip((*data.train, *data.test), scene["views"], strict=True):
        right, down, forward = np.array(shown["axes"]).reshape(3, 3)
        np.testing.assert_allclose(view.camera.viewmats[0, :3, :3], [right, down, forward], atol=1e-6)
        np.testing.assert_allclose(view.camera.centers[0], shown["eye"], atol=1e-5)
    assert len(scene["path"]) == 72


def test_a_run_whose_photos_are_gone_and_a_file_are_shown_alone(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=2, test=0)
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    for source in (run, run / "splat.ply"):
        assert main(["export", str(source), "-o", str(tmp_path / "a.html"), "--force"]) == 0
        scene = scene_in((tmp_path / "a.html").read_text(encoding="utf-8"))
        assert (scene["inputs"], len(scene["views"]), scene["path"]) == (0, 1, [])


def test_the_opening_view_is_filled(run: Path) -> None:
    """A small blob in the corner of the image ends up in its middle, magnified; a wall stays as it is."""
    K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    camera = Cameras(torch.eye(4)[None], K[None], 100, 100)
    blob = splats(200)
    blob.means[:] = blob.means * 0.02 + torch.tensor([0.3, -0.3, 1.0])
    zoomed = framed(blob, camera)
    pixel = (zoomed.Ks[0] @ torch.tensor([0.3, -0.3, 1.0]))[:2]
    assert float(zoomed.Ks[0, 0, 0]) > 200
    torch.testing.assert_close(pixel, torch.tensor([50.0, 50]), atol=8, rtol=0)
    faint = replace(blob, logit_opacities=torch.full((200,), -1.0))
    faint.logit_opacities[:10] = 1.0  # these alone would be magnified more
    assert torch.equal(framed(faint, camera).Ks, framed(replace(blob, logit_opacities=torch.ones(200)), camera).Ks)
    wall = splats(2000)
    wall.means[:] = torch.rand(2000, 3, generator=torch.manual_seed(0)) * 2 - 1 + torch.tensor([0.0, 0, 1])
    wall.means[:, 2] = 1
    assert torch.equal(framed(wall, camera).Ks, camera.Ks)


def unpacked(data: bytes, count: int) -> np.ndarray:
    """The planes, as worker.js takes them apart."""
    return np.frombuffer(zlib.decompress(data), np.uint8).reshape(-1, count)


@pytest.mark.parametrize("degree", range(4))
def test_planes_hold_the_codes_of_a_spz(tmp_path: Path, degree: int) -> None:
    gaussians = Gaussians(**{**dict(splats(50).items()), "shN": torch.rand(50, (degree + 1) ** 2 - 1, 3) - 0.5})
    payload = packed_splats(gaussians, tmp_path / "a.html")
    rows = unpacked(payload.data, payload.count).astype(np.int64)
    assert len(rows) == 9 + 3 + 4 + 3 + 1 + 3 * (payload.color_stride - 1)
    codes = np.stack([np.cumsum(rows[3 * a] + (rows[3 * a + 1] << 8) + (rows[3 * a + 2] << 16)) for a in range(3)])
    means = ((codes + (1 << 23)) % (1 << 24) - (1 << 23)).T / 2**payload.fraction_bits
    nearest = np.linalg.norm(means[:, None] - gaussians.means.numpy()[None], axis=2).min(axis=1)
    assert nearest.max() < 2.0**-payload.fraction_bits
    assert next(planes([b""] * 6, 0)).size == 0


def test_the_page_is_hardly_larger_than_a_spz(tmp_path: Path, run: Path) -> None:
    """At most 1.3 times a .spz of the same splats and 100 kB, on splats as they come out of training."""
    gaussians = gsopt.load_splats(shipped_splats(tmp_path))
    save_page(tmp_path / "a.html", gaussians, scene_of_splats(gaussians, "a"))
    save_spz(tmp_path / "a.spz", gaussians)
    assert (tmp_path / "a.html").stat().st_size <= 1.3 * (tmp_path / "a.spz").stat().st_size + 100_000


def shipped_splats(folder: Path) -> Path:
    """200 steps on the bundled scene: neighbors are alike, as everywhere in a scene."""
    demo = Path(gsopt.__file__).parent / "demo"
    return gsopt.reconstruct(str(demo), folder / "run", iterations=200, seed=1).run / "splat.ply"


def test_the_report_opens_with_the_viewer(run: Path) -> None:
    text = write_report(run).read_text(encoding="utf-8")
    page = Scripts(text)
    assert text.count('class="gsopt-viewer"') == 1
    assert web_page.policy() in text
    assert [kind for kind, _ in page.scripts].count("") == 1


def test_a_report_of_many_splats_shows_a_turntable(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["gsopt.results.report.read_run"], "MAX_VIEWER", 10)
    text = write_report(run).read_text(encoding="utf-8")
    assert Scripts(text).scripts == []
    assert "Turntable of the result" in text


def test_the_page_gets_the_axes_of_a_camera_one_after_the_other() -> None:
    """viewer.js takes right, down and forward as three numbers each."""
    viewmats = look_at(torch.tensor([[3.0, 1.0, -2.0]]), torch.zeros(3), torch.tensor([0.0, 0, 1]))
    found = pose(Cameras(viewmats, torch.tensor([[[50.0, 0, 16], [0, 60, 12], [0, 0, 1]]]), 32, 24))
    right, down, forward = (torch.tensor(found["axes"][3 * i : 3 * i + 3]) for i in range(3))
    assert len(found["axes"]) == 9
    eye = torch.tensor(found["eye"])
    torch.testing.assert_close(forward, -eye / eye.norm(), rtol=0, atol=1e-4)  # rounded for the page
    torch.testing.assert_close(torch.linalg.cross(right, down), forward, rtol=0, atol=1e-4)
    assert found["lens"] == [50, 60, 16, 12, 32, 24]
