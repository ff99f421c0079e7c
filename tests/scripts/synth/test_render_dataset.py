"""Laws of a whole run, with a worker that only pretends: what is kept, what is refused, what a failure leaves."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import synth_views
from synth import render_dataset, render_object, worker_pool
from synth.mesh_items import Item
from synth.render_dataset import run
from synth.render_object import PARTIAL, RECORD, new_folder
from synth.settings import Settings
from synth.worker_pool import read_request, render_job

from gsopt.errors import InputError, UsageError
from gsopt.farm.local import LocalFarm

SETTINGS = Settings(threads=1, views=1, resolution=(8, 8), formats=("nerf", "colmap"), elevations=(0.0, 10.0))

PRETENDER = """
    import json, os, sys, time
    sys.path[:0] = {paths!r}
    from gsopt.errors import InputError
    from gsopt.farm.serve import serve
    from synth.worker_pool import read_request
    print("Blender talks", flush=True)
    def handle(request):
        item, settings, seed, out = read_request(request)
        print("Blender renders", flush=True)
        with open({calls!r}, "a") as calls:
            calls.write(item.id + "\\n")
        text = item.mesh.read_text()
        if text == "crash":
            os._exit(11)
        if text == "hang":
            time.sleep(600)
        if text == "bad":
            raise InputError("it is bad. Mend it.")
        out.mkdir(parents=True)
        sha = __import__("hashlib").sha256(text.encode()).hexdigest()
        record = {{"id": item.id, "seed": seed, "mesh_sha256": sha}}
        record["warnings"] = ["no texture"] if text == "lost" else []
        (out / "object.json").write_text(json.dumps(record))
        return {{"stage": 0.0, "render": 0.0, "write": 0.0}}
    serve(handle)
"""


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """File in which the fake workers record each job."""
    script, calls = tmp_path / "pretender.py", tmp_path / "calls.txt"
    calls.touch()
    paths = [str(worker_pool.SCRIPT.parent), str(worker_pool.SCRIPT.parent.parent)]
    script.write_text(textwrap.dedent(PRETENDER.format(paths=paths, calls=str(calls))))
    monkeypatch.setattr(worker_pool, "worker_command", lambda: (sys.executable, str(script)))
    return calls


def meshes(tmp_path: Path, **contents: str) -> list[Item]:
    for name, text in contents.items():
        (tmp_path / f"{name}.obj").write_text(text)
    return [Item(name, tmp_path / f"{name}.obj", license="CC0") for name in contents]


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def test_one_bad_mesh_never_stops_the_run(calls: Path, tmp_path: Path) -> None:
    items = meshes(tmp_path, a="x", b="bad", c="crash", d="y")
    assert run(items, SETTINGS, 0, tmp_path / "out", LocalFarm(2)) == 3
    failures = {f["id"]: f["reason"] for f in read(tmp_path / "out" / "failures.json")}
    assert list(failures) == ["b", "c"]
    assert "it is bad" in failures["b"]
    assert "crashed" in failures["c"]
    assert [o["id"] for o in read(tmp_path / "out" / "dataset.json")["objects"]] == ["a", "d"]


def test_a_mesh_that_takes_too_long_costs_no_other(calls: Path, tmp_path: Path) -> None:
    items = meshes(tmp_path, a="hang", b="x")
    assert run(items, SETTINGS, 0, tmp_path / "out", time_limit=2.0) == 3
    (lost,) = read(tmp_path / "out" / "failures.json")
    assert (lost["id"], "longer than 2 s" in lost["reason"]) == ("a", True)
    assert (tmp_path / "out" / "b" / RECORD).is_file()


def test_resume_renders_nothing_twice_and_tries_failures_again(calls: Path, tmp_path: Path) -> None:
    items = meshes(tmp_path, a="x", b="bad", c="y")
    assert run(items, SETTINGS, 0, tmp_path / "out") == 3
    before = (tmp_path / "out" / "a" / RECORD).stat().st_mtime_ns
    meshes(tmp_path, b="mended")
    calls.write_text("")
    assert run(items, SETTINGS, 0, tmp_path / "out", resume=True) == 0
    assert calls.read_text() == "b\n"
    assert (tmp_path / "out" / "a" / RECORD).stat().st_mtime_ns == before
    assert read(tmp_path / "out" / "failures.json") == []
    assert [o["id"] for o in read(tmp_path / "out" / "dataset.json")["objects"]] == ["a", "b", "c"]


def test_a_changed_mesh_is_told_and_its_views_are_kept(calls: Path, tmp_path: Path) -> None:
    items = meshes(tmp_path, a="x")
    run(items, SETTINGS, 0, tmp_path / "out")
    meshes(tmp_path, a="changed")
    assert run(items, SETTINGS, 0, tmp_path / "out", resume=True) == 3
    assert "changed" in read(tmp_path / "out" / "failures.json")[0]["reason"]
    assert (tmp_path / "out" / "a" / RECORD).is_file()


def test_what_is_recorded_does_not_depend_on_the_workers(calls: Path, tmp_path: Path) -> None:
    items = meshes(tmp_path, **{f"m{i}": str(i) for i in range(6)})
    for workers in (1, 3):
        run(items, SETTINGS, 4, tmp_path / str(workers), LocalFarm(workers))
    first, second = ((tmp_path / w / "dataset.json").read_bytes() for w in ("1", "3"))
    assert first == second
    assert len({o["seed"] for o in json.loads(first)["objects"]}) == 6


@pytest.mark.parametrize("held", ["another run", "the same run", "strange files", "a file"])
def test_a_folder_that_holds_something_is_left_alone(held: str, calls: Path, tmp_path: Path) -> None:
    out, items = tmp_path / "out", meshes(tmp_path, a="x")
    if held == "a file":
        out.write_text("mine")
    elif held == "strange files":
        out.mkdir()
        (out / "mine.txt").write_text("mine")
    else:
        run(items, SETTINGS, 7 if held == "another run" else 0, out)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(InputError, match="out"):
        run(items, SETTINGS, 0, out, resume=held != "the same run")
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_files_that_settings_name_are_read_first_and_watched(calls: Path, tmp_path: Path) -> None:
    sky, items = tmp_path / "sky.png", meshes(tmp_path, a="x")
    lit = replace(SETTINGS, lighting="hdri", hdri=str(sky))
    with pytest.raises(InputError, match="hdri"):
        run(items, lit, 0, tmp_path / "out")
    with pytest.raises(InputError, match="cameras"):
        run(items, replace(SETTINGS, layout="file", camera_file=str(sky)), 0, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    sky.write_text("day")
    assert run(items, lit, 0, tmp_path / "out") == 0
    assert run(items, lit, 0, tmp_path / "out", resume=True) == 0
    sky.write_text("night")
    with pytest.raises(InputError, match=r"other settings .*hdri"):
        run(items, lit, 0, tmp_path / "out", resume=True)


def test_warnings_are_told(calls: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(meshes(tmp_path, a="x", b="lost"), SETTINGS, 0, tmp_path / "out")
    assert [line for line in capsys.readouterr().err.splitlines() if "texture" in line] == [
        "[2/2] b: 0.0 s; no texture"
    ]


def test_what_a_killed_run_left_half_written_is_swept_away(calls: Path, tmp_path: Path) -> None:
    items = meshes(tmp_path, a="x", b="y")
    run(items[:1], SETTINGS, 0, tmp_path / "out")
    (tmp_path / "out" / f"{PARTIAL}123-b").mkdir()
    (tmp_path / "out" / f"{PARTIAL}123-b" / "half.png").touch()
    assert run(items, SETTINGS, 0, tmp_path / "out", resume=True) == 0
    assert not list((tmp_path / "out").rglob(PARTIAL + "*"))


def test_a_run_killed_at_its_first_write_goes_on(calls: Path, tmp_path: Path) -> None:
    out, items = tmp_path / "out", meshes(tmp_path, a="x")
    out.mkdir()
    (out / ".dataset.json.2147483646.tmp").write_text("{")
    assert run(items, SETTINGS, 0, out, resume=True) == 0
    assert [o["id"] for o in read(out / "dataset.json")["objects"]] == ["a"]
    (out / ".failures.json.2147483646.tmp").write_text("[")
    assert run(items, SETTINGS, 0, out, resume=True) == 0
    assert {path.name for path in out.iterdir()} == {"a", "dataset.json", "failures.json", "timings.json", "log.txt"}


def full_disk(descriptor: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("full", ["log.txt", "folder"])
def test_a_full_disk_ends_the_run_in_one_line(
    full: str, calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(synth_views, "require_blender", lambda: None)
    monkeypatch.setattr(synth_views.signal, "signal", lambda *_: None)
    meshes(tmp_path, a="x")
    command = ["x.py", str(tmp_path / "a.obj"), "-o", str(tmp_path / "out"), "--threads", "1", "--resume"]
    assert synth_views.main(command) == 0
    capsys.readouterr()
    if full == "log.txt":
        (tmp_path / "out" / "log.txt").unlink()
        (tmp_path / "out" / "log.txt").symlink_to("/dev/full")
        (tmp_path / "out" / "a").rename(tmp_path / "away")
    else:
        monkeypatch.setattr(os, "fsync", full_disk)
    assert synth_views.main(command) == 3
    assert "No space left" in capsys.readouterr().err


def test_an_interrupted_run_records_what_it_has(calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(text: str) -> None:
        if text.startswith("[1/"):
            raise KeyboardInterrupt

    monkeypatch.setattr(render_dataset, "report", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(meshes(tmp_path, a="x", b="y", c="z"), SETTINGS, 0, tmp_path / "out")
    monkeypatch.undo()
    assert len(read(tmp_path / "out" / "dataset.json")["objects"]) >= 1


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"

    def fail_halfway() -> None:
        with new_folder(out) as folder:
            (folder / "half").write_text("x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_halfway()
    assert list(out.parent.iterdir()) == []
    with new_folder(out) as folder:
        (folder / "all").write_text("x")
        assert not out.exists()
    assert [p.name for p in out.parent.rglob("*")] == ["out", "all"]
    with pytest.raises(InputError, match="exists"), new_folder(out):
        pytest.fail("entered an existing folder")
    assert (out / "all").read_text() == "x"


@pytest.mark.parametrize("blocker", ["file", "dangling link"])
def test_nothing_in_the_way_is_replaced(blocker: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if blocker == "file":
        out.write_text("mine")
    else:
        os.symlink(tmp_path / "nowhere", out)
    for place in (out, out / "below"):
        with pytest.raises(InputError), new_folder(place):
            pytest.fail("entered")
    assert out.is_symlink() or out.read_text() == "mine"


def test_an_object_survives_the_pipe() -> None:
    item = Item("стул 3", Path("/m/ü x.obj"), front=(0.0, 1.0))
    job = render_job(item, SETTINGS, 5, Path("/out/стул 3"), 60.0, None)
    assert read_request(json.loads(json.dumps(job.request))) == (item, SETTINGS, 5, Path("/out/стул 3"))


def test_a_machine_without_blender_is_named(two_balls: Path, tmp_path: Path) -> None:
    """A node of a farm that lacks `bpy` costs the objects it took, with the line that installs it; nothing is left."""
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.util as util\nfind = util.find_spec\n"
        "util.find_spec = lambda name, package=None: None if name == 'bpy' else find(name, package)\n"
    )
    job = render_job(Item("balls", two_balls), SETTINGS, 0, tmp_path / "out" / "balls", 60.0, None)
    (outcome,) = LocalFarm(1).run([replace(job, environment={"PYTHONPATH": str(tmp_path)})])
    assert outcome.ending != "done"
    assert "pip install bpy" in outcome.error
    assert list((tmp_path / "out").iterdir()) == []


# The command line


def test_arguments_after_the_dashes_are_ours() -> None:
    assert synth_views.own_arguments(["/opt/blender", "-b", "-P", "x.py", "--", "a.obj"]) == ["a.obj"]
    assert synth_views.own_arguments(["scripts/synth_views.py", "a.obj"]) == ["a.obj"]
    assert synth_views.own_arguments(["/opt/blender", "-b", "-P", "x.py"]) == []


def test_command_line_reaches_the_settings(tmp_path: Path) -> None:
    line = (
        "a.obj -o out --views 3 --test-views 2 --val-views 1 --resolution 320x200 --fov 30 --layout orbit "
        "--elevations 0 10 --radius 5 --lens-jitter 0.1 --samples 4 --lighting hdri sky.exr --background #102030 "
        "--normalize cube --depth --normals --masks --position --format nerf,colmap --points 10 --captions --preview "
        "--threads 3 --seed 4 --workers 2 --time-limit 60 --memory-limit 2GB --resume b.obj"
    )
    found, settings, how = synth_views.parse(line.split())
    assert [item.id for item in found] == ["a", "b"]
    assert str(how.pop("farm")) == "this machine, 6 cores"
    assert how == {"seed": 4, "out": Path("out"), "resume": True, "time_limit": 60.0, "memory_limit": 2_000_000_000}
    assert settings == Settings(
        views=3, test_views=2, val_views=1, resolution=(320, 200), fov=30.0, layout="orbit", elevations=(0.0, 10.0),
        radius=5.0, lens_jitter=0.1, samples=4, lighting="hdri", hdri="sky.exr", background="#102030",
        normalize="cube", depth=True, normals=True, masks=True, position=True, formats=("nerf", "colmap"), points=10,
        captions=True, preview=True, threads=3,
    )  # fmt: skip


def test_an_environment_wants_its_image() -> None:
    for line in ("a.obj -o out --lighting hdri", "a.obj --lighting hdri -o out", "--lighting hdri -o out -- a.obj"):
        with pytest.raises(UsageError, match="needs its image"):
            synth_views.parse(line.split())
    words = ["hdri", "--lighting", "hdri", "sky.hdr", "-o", "out"]
    assert synth_views.parse(words)[1].hdri == "sky.hdr"


def test_a_limit_takes_the_first_objects(tmp_path: Path) -> None:
    for name in ("c", "a", "b"):
        (tmp_path / f"{name}.stl").touch()
    found, _, _ = synth_views.parse([str(tmp_path), "-o", "out", "--limit", "2"])
    assert [item.id for item in found] == ["a", "b"]


@pytest.mark.parametrize(
    "wrong",
    ["--limit 0", "--workers 0", "--seed -1", "--synsets 1", "--time-limit nan", "--memory-limit much", "--farm slurm"],
)
def test_wrong_numbers_are_usage_errors(wrong: str) -> None:
    with pytest.raises(UsageError):
        synth_views.parse(["a.obj", "-o", "out", *wrong.split()])


def test_without_blender_one_line_says_what_to_install(
    calls: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(render_object, "find_spec", lambda name: None)
    monkeypatch.delitem(sys.modules, "bpy", raising=False)
    meshes(tmp_path, a="x")
    assert synth_views.main(["x.py", str(tmp_path / "a.obj"), "-o", str(tmp_path / "out")]) == 2
    assert "pip install bpy" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert calls.read_text() == ""


def test_a_missing_mesh_ends_with_its_name_and_exit_code_3(bpy: Any, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(worker_pool.SCRIPT), "стул 3.obj", "-o", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 3
    assert "стул 3" in done.stderr
    assert "Traceback" not in done.stderr
