"""The k-th change of the disk fails, for every k: killed, full, broken, half written. Resuming loses nothing.

An ordinary run of the tests takes a sample of the k; GSOPT_EVERY_WRITE=full takes every one (`make every-write`), with
every fault, or, for a work of many calls, with one of the faults in turn. GSOPT_EVERY_WRITE=all leaves nothing out.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import textured_room as room
from faulty_disk import FAULTS, Fault, FaultyDisk, compiler, faulty_disk
from tiny_scenes import cloud, write_dataset

from gsopt.events import TEMPORARY, read_events
from gsopt.farm.job import PARTIAL
from gsopt.formats import load_splats, save_splats
from gsopt.training.checkpoint import load_newest

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs Linux and a C compiler")

SAMPLED = 12
"""Calls at which a work is made to fail in an ordinary run."""
MANY_CALLS = 300
"""From here on, and where a child takes part, each call meets one fault."""
FULL = os.environ.get("GSOPT_EVERY_WRITE") in ("full", "all")
ALL = os.environ.get("GSOPT_EVERY_WRITE") == "all"
CHECKPOINT_EVERY = 7
Files = dict[str, bytes]


@dataclass(frozen=True)
class Work:
    """A command that writes into a folder, the command that goes on with it, and what must be the same afterwards."""

    arguments: Callable[[Path], list[str]]
    resume: Callable[[Path], list[str]]
    """What is added to go on; none for the same command again."""
    products: Callable[[Path], Files]
    prepare: Callable[[Path], None]
    check: Callable[[Path], None]
    """What holds right after the fault, before anything is resumed."""
    slow: bool = False
    """Left out of an ordinary run."""
    has_child: bool = False
    """A child process does part of it: when that is killed, the command ends as for unusable input. The command given
    again refuses what is complete."""


def same_command(folder: Path) -> list[str]:
    """The same command goes on; nothing is added to it."""
    return []


def named(*patterns: str) -> Callable[[Path], Files]:
    """A reader of the files of these names."""
    return lambda folder: {
        str(path.relative_to(folder)): path.read_bytes()
        for name in patterns
        for path in sorted(folder.glob(name))
        if path.is_file()
    }


def nothing(folder: Path) -> None:
    """There is nothing to check."""


def no_step_is_lost(folder: Path) -> None:
    """The newest checkpoint is no further back than the run said when it announced its progress."""
    log = folder / "run" / "events.jsonl"
    events = read_events(log)[0] if log.exists() else []
    reached = max((event.get("step", 0) for event in events if event["kind"] != "done"), default=0)
    due = (reached - 1) // CHECKPOINT_EVERY * CHECKPOINT_EVERY
    if due > 0 and not any(event["kind"] == "error" for event in events):
        checkpoint = load_newest(folder / "run" / "checkpoints", pytest.fail)
        assert checkpoint is not None
        assert int(checkpoint.path.stem.removeprefix("step_")) >= due


def old_or_new(folder: Path) -> None:
    """An exported file that was there before is the old one or the new one."""
    assert len(load_splats(folder / "out.spz")) in (5, 40)


def whole_or_absent(folder: Path) -> None:
    """A posed scene is there with its last file, or not at all."""
    assert not (folder / "scene").exists() or (folder / "scene" / "sfm.json").exists()


def objects_are_whole(folder: Path) -> None:
    """An object's folder is there with its record and all files that this lists, or not at all."""
    for made in (folder / "out").glob("[!.]*/"):
        record = json.loads((made / "object.json").read_text())
        digest = hashlib.sha256()
        for path in sorted(path for path in made.rglob("*") if path.is_file() and path.name != "object.json"):
            digest.update(path.relative_to(made).as_posix().encode() + b"\0" + path.read_bytes())
        assert digest.hexdigest() == record["files_sha256"], f"{made.name} is not what was rendered"


def figures(folder: Path) -> Files:
    """The figures of a suite, without times and memory."""
    document = json.loads((folder / "found.json").read_text()) if (folder / "found.json").exists() else {"runs": []}
    kept = ("arm", "seed", "mean", "per_view", "n_gaussians")
    return {run["scene"]: json.dumps([run[name] for name in kept]).encode() for run in document["runs"]}


def works(inputs: Path) -> dict[str, Work]:
    scenes, photos, splats = inputs / "scenes", inputs / "photos", inputs / "splats.ply"
    sfm = shlex.split("--features sift --matching exhaustive --max-features 120 --max-size 100 --threads 1")
    finetune = shlex.split("--val two --fits 1 --size 64 --steps 2 --batch 2 --threads 1")
    train = shlex.split("--init random --init-count 60 --iterations 20 --preview-every 5 --lambda-sds 0 --threads 1")
    synth = shlex.split("--views 2 --test-views 1 --resolution 8 --samples 1 --points 20 --depth --masks --threads 1")
    suite = ["--suite", str(inputs / "one.toml"), "--root", str(scenes), "--seeds", "1"]
    train += ["--checkpoint-every", str(CHECKPOINT_EVERY)]
    return {
        "train": Work(
            lambda folder: ["train", str(scenes / "one"), "-m", str(folder / "run"), *train],
            lambda folder: ["--resume"],
            named("run/splat.ply", "run/previews/*", "run/renders/test/*"),
            nothing,
            no_step_is_lost,
        ),
        "export": Work(
            lambda folder: ["export", str(splats), "-o", str(folder / "out.spz"), "--force"],
            same_command,
            named("out.spz"),
            lambda folder: save_splats(folder / "out.spz", cloud(5, seed=0)),
            old_or_new,
        ),
        "sfm": Work(
            lambda folder: ["sfm", str(photos), "-o", str(folder / "scene"), *sfm],
            same_command,
            named("scene/transforms.json", "scene/points.ply", "scene/images/*"),
            nothing,
            whole_or_absent,
            slow=True,
            has_child=True,
        ),
        "finetune": Work(
            lambda folder: ["finetune", str(scenes), "-o", str(folder / "prior"), *finetune],
            same_command,
            named("prior/unet/*"),
            nothing,
            nothing,
            slow=True,
        ),
        "suite": Work(
            lambda folder: ["bench", *suite, "-o", str(folder / "found.json")],
            same_command,
            figures,
            nothing,
            nothing,
            slow=True,
            has_child=True,
        ),
        "synth_views": Work(
            lambda folder: [SYNTH_VIEWS, str(inputs / "meshes"), "-o", str(folder / "out"), *synth],
            lambda folder: ["--resume"],
            lambda folder: {name: data for name, data in named("out/**/*")(folder).items() if name not in NOT_SAME},
            nothing,
            objects_are_whole,
            slow=True,
            has_child=True,
        ),
    }


NAMES = ("train", "export", "sfm", "finetune", "suite", "synth_views")
SYNTH_VIEWS = str(Path(__file__).resolve().parents[2] / "scripts" / "synth_views.py")
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
NOT_SAME = ("out/timings.json", "out/log.txt")
"""Files that depend on the course of a run."""
SUITE = """
title = "One"
about = "One run."
[[groups]]
name = "tiny"
title = "Tiny"
why = "Too short."
scenes = ["one"]
views = [4]
runs = ["ours-0 2"]
flags = ["--init", "random", "--init-count", "60", "--lambda-sds", "0", "--sparse.symmetry", "off"]
get = "Made here."
"""


@pytest.fixture(scope="module")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FaultyDisk]:
    with faulty_disk(tmp_path_factory.mktemp("library")) as disk:
        yield disk


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    save_splats(folder / "splats.ply", cloud(40, seed=0))
    write_dataset(folder / "scenes" / "one", train=6)
    if FULL:
        write_dataset(folder / "scenes" / "two", train=6)
        room.photograph(folder / "photos", room.arc(3, spread=14.0))
        (folder / "one.toml").write_text(SUITE)
        (folder / "meshes").mkdir()
        for name in ("a", "b"):
            (folder / "meshes" / f"{name}.obj").write_text(TETRAHEDRON)
    return folder


def faults_of(calls: int, in_turn: bool) -> Iterator[tuple[int, Fault]]:
    """Pairs of a call and a fault: all of them, or a sample in which every fault occurs."""
    if FULL and (in_turn or calls >= MANY_CALLS):
        for turn in range(len(FAULTS) if ALL else 1):  # the second term: programs repeat themselves every few calls
            yield from ((at, FAULTS[(at + at // len(FAULTS) + turn) % len(FAULTS)]) for at in range(1, calls + 1))
    elif FULL:
        yield from ((at, fault) for at in range(1, calls + 1) for fault in FAULTS)
    else:
        stride = max(calls // SAMPLED, 1)
        yield from ((at, FAULTS[i % len(FAULTS)]) for i, at in enumerate(range(1, calls + 1, stride)))


@pytest.mark.parametrize("name", NAMES)
def test_the_work_survives_a_fault_at_any_write(name: str, disk: FaultyDisk, inputs: Path, tmp_path: Path) -> None:
    work = works(inputs)[name]
    if work.slow and not FULL:
        pytest.skip("minutes: make every-write")
    whole, whole_folder = fresh(tmp_path / "whole", work), tmp_path / "whole"
    healthy = disk.run(work.arguments(whole), whole)
    assert healthy.code == 0, disk.log.read_text()
    assert healthy.calls > 3
    products = work.products(whole_folder)
    cases, defects = list(faults_of(healthy.calls, work.has_child)), []
    for done, (at, fault) in enumerate(cases):
        if FULL and done % 50 == 0:
            print(f"{name}: {done} of {len(cases)} cases, {len(defects)} failed", flush=True)
        try:
            survives(work, disk, fault, at, fresh(tmp_path / "faulty", work), products)
        except AssertionError as error:
            defects.append(str(error))
            print(error, flush=True)
    print(f"{name}: {healthy.calls} calls, {len(cases)} cases, {len(defects)} failed")
    assert not defects, "\n".join(defects)


def fresh(folder: Path, work: Work) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    work.prepare(folder)
    return folder


def survives(work: Work, disk: FaultyDisk, fault: Fault, at: int, folder: Path, products: Files) -> None:
    """A command that meets the fault ends clearly and loses nothing; given again, it writes the same bytes."""
    where = f"{fault} at call {at}"
    outcome = disk.run(work.arguments(folder), folder, fault, at)
    log = disk.log.read_text()
    assert outcome.happened or fault.kind == "fail from here", where  # where no later call needs space
    allowed = {"kill": (-9, 3) if work.has_child else (-9,), "short": (0,)}.get(fault.kind, (0, 3))
    assert outcome.code in allowed, f"{where}: exit code {outcome.code}\n{log}"
    assert "Traceback" not in log, f"{where}\n{log}"
    work.check(folder)
    if fault.kind == "kill" or work.products(folder) != products:
        again = disk.run([*work.arguments(folder), *work.resume(folder)], folder)
        complete = work.has_child and again.code == 2 and work.products(folder) == products
        assert again.code == 0 or complete, f"{where}, then resumed: {disk.log.read_text()}"
    assert work.products(folder) == products, where
    assert strays(folder) == [], where


def strays(folder: Path) -> list[str]:
    """Names of half-written files and folders."""
    half = (path for path in folder.rglob("*") if TEMPORARY.fullmatch(path.name) or path.name.startswith(PARTIAL))
    return [str(path.relative_to(folder)) for path in half]
