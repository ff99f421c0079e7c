"""`gsopt train-many`: a run per scene, failures listed, the same command goes on; one page about all."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from tiny_scenes import write_dataset

from gsopt import cli
from gsopt.errors import InputError
from gsopt.many_scenes.scenes import read_scenes
from gsopt.many_scenes.train_scenes import PAGE, PICTURE, RECORDS

FLAGS = ["--iterations", "12", "--lambda-sds", "0", "--init", "random"]


def train_many(scenes: Path, out: Path, *more: str, flags: list[str] = FLAGS) -> int:
    return cli.main(["train-many", str(scenes), "-o", str(out), *more, "--", *flags])


def records(out: Path) -> dict[str, Any]:
    return {row["name"]: row for row in json.loads((out / RECORDS).read_bytes())["scenes"]}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, one whose image is broken, and a folder that is no scene."""
    folder = tmp_path_factory.mktemp("scenes")
    whole = write_dataset(folder / "chair é")
    for name in ("<b>bad", "lamp"):
        shutil.copytree(whole, folder / name)
    (folder / "<b>bad" / "train" / "r_1.png").write_bytes(b"no image")
    (folder / "notes").mkdir()
    return folder


@pytest.fixture(scope="module")
def runs(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "runs"
    assert train_many(scenes, out, "--farm", "local:2") == InputError.exit_code
    return out


def test_a_broken_scene_is_listed_and_the_others_are_trained(runs: Path) -> None:
    found = records(runs)
    states = {"<b>bad": "failed", "chair é": "done", "lamp": "done"}
    assert {name: row["state"] for name, row in found.items()} == states
    assert "r_1.png" in found["<b>bad"]["reason"]
    assert found["lamp"]["held_out"]
    assert found["lamp"]["threads"] == 1
    assert found["lamp"]["isa"]
    assert (runs / "lamp" / "splat.ply").read_bytes() == (runs / "chair é" / "splat.ply").read_bytes()  # same photos


def test_the_page_has_a_row_a_picture_and_a_link_per_scene(runs: Path) -> None:
    page = (runs / PAGE).read_text(encoding="utf-8")
    assert "2 of 3 scenes" in page
    assert "&lt;b&gt;bad" in page
    assert "<b>bad" not in page
    for link in re.findall(r'(?:href|src)="([^"]+)"', page)[1:]:
        path = runs / link.replace("%20", " ").replace("%C3%A9", "é")
        assert path.is_file(), link
    with Image.open(runs / "lamp" / PICTURE, formats=("WEBP",)) as picture:
        assert picture.size == (48, 24)


def test_the_same_command_makes_only_what_is_missing(runs: Path, scenes: Path, tmp_path: Path) -> None:
    out, mended = tmp_path / "runs", tmp_path / "scenes"
    shutil.copytree(runs, out)
    shutil.copytree(scenes, mended)
    shutil.copy(mended / "lamp" / "train" / "r_1.png", mended / "<b>bad" / "train")
    manifest = tmp_path / "all.json"
    rows = [{"name": name, "data": str((scenes if name != "<b>bad" else mended) / name)} for name in records(out)]
    manifest.write_text(json.dumps({"scenes": rows}))
    before = (out / "lamp" / "metrics.json").stat().st_mtime_ns
    (out / "<b>bad" / "config.json").unlink()  # of another folder of data
    assert train_many(manifest, out) == 0
    assert (out / "lamp" / "metrics.json").stat().st_mtime_ns == before
    assert (out / "<b>bad" / "splat.ply").read_bytes() == (out / "lamp" / "splat.ply").read_bytes()
    assert "Failed" not in (out / PAGE).read_text(encoding="utf-8")


def test_a_finished_run_is_not_trained_again_with_other_flags(runs: Path, scenes: Path, tmp_path: Path) -> None:
    out = tmp_path / "runs"
    shutil.copytree(runs, out)
    splats = (out / "lamp" / "splat.ply").read_bytes()
    manifest = tmp_path / "one.json"
    manifest.write_text(json.dumps({"scenes": [{"data": str(scenes / "lamp"), "flags": ["--seed", "5"]}]}))
    assert train_many(manifest, out) == InputError.exit_code
    assert "seed" in records(out)["lamp"]["reason"]
    assert (out / "lamp" / "splat.ply").read_bytes() == splats
    assert records(out)["chair é"]["state"] == "done"


def test_a_killed_driver_goes_on_to_the_same_bits(runs: Path, scenes: Path, tmp_path: Path) -> None:
    manifest, out = tmp_path / "one.json", tmp_path / "runs"
    manifest.write_text(json.dumps({"scenes": [{"data": str(scenes / name)} for name in ("lamp", "chair é")]}))
    words = ["train-many", str(manifest), "-o", str(out), "--farm", "local:1", "--", *FLAGS]
    driver = subprocess.Popen([sys.executable, "-m", "gsopt", *words], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (out / "chair é" / "config.json").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    kept = (out / "lamp" / "metrics.json").stat().st_mtime_ns
    assert train_many(manifest, out) == 0
    assert (out / "lamp" / "metrics.json").stat().st_mtime_ns == kept
    assert (out / "chair é" / "splat.ply").read_bytes() == (runs / "lamp" / "splat.ply").read_bytes()


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"scenes": 3}',
        '{"scenes": []}',
        '{"scenes": [3]}',
        '{"scenes": [{"data": ""}]}',
        '{"scenes": [{"data": "a", "name": "../b"}]}',
        '{"scenes": [{"data": "a", "name": ".partial-b"}]}',
        '{"scenes": [{"data": "a", "flags": "--eval"}]}',
        '{"scenes": [{"data": "a", "flags": ["-m", "/elsewhere"]}]}',
        '{"scenes": [{"data": "a", "flags": ["--run=/elsewhere"]}]}',
        '{"scenes": [{"data": "a"}, {"data": "b/a"}]}',
    ],
)
def test_a_bad_manifest_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "all.json").write_text(text)
    with pytest.raises(InputError):
        read_scenes(tmp_path / "all.json")


def test_a_wrong_flag_or_folder_is_noticed_before_any_work(scenes: Path, tmp_path: Path, capsys: Any) -> None:
    assert train_many(scenes, tmp_path / "new", flags=["--iterations", "0"]) == 2
    assert "--iterations" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    assert train_many(scenes, tmp_path / "mine") == InputError.exit_code
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]
