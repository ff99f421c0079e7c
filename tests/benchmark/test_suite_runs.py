"""The runs of `gsopt bench --suite`: executed once, resumed after a kill, reproducible; smoke trains for real."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from finished_runs import FOV, HEIGHT, WHITE, WIDTH, ring, splats
from in_process_farm import InProcess
from PIL import Image
from pretend_gpu import pretend_gpu
from simt_runtime import SimtRuntime, simt_backend
from suite_records import MACHINE, record

from gsopt import cli
from gsopt.benchmark.suite import definition, estimate, result_file, run_figures, run_key, runner, single_run
from gsopt.benchmark.suite.single_run import RunFailed, SuiteContext
from gsopt.config.train import TrainConfig
from gsopt.data.scene import load_scene
from gsopt.geometry import quats
from gsopt.raster.backend import Backend, RasterSettings
from gsopt.raster.device.backend import DeviceBackend
from gsopt.raster.reference import ReferenceBackend
from gsopt.results.finished_run import FinishedRun, draw
from gsopt.sds.prompts import Prompt, PromptSet, write_set

CASES = [
    definition.Case("objects-4", f"objects/{name}", "4", arm, 2000, 0, ("--lambda-sds", "0", name, arm))
    for name in ("a", "b")
    for arm in ("3dgs", "ours-0")
]
DIFFERENT = ("setup_cpu_seconds", "train_cpu_seconds", "peak_memory_mb", "load", "curve", "machine")
"""Times, memory, and the commit, which may move while the tests run."""


class Killed(BaseException):
    """A signal that no code catches."""


@pytest.fixture
def context(tmp_path: Path) -> SuiteContext:
    """Two scenes of one file each."""
    for name in ("a", "b"):
        (tmp_path / "root" / "objects" / name).mkdir(parents=True)
        (tmp_path / "root" / "objects" / name / "image.png").write_text(name)
    run_key.folder_hash.cache_clear()
    return SuiteContext(tmp_path / "root", tmp_path / "r-runs", 1)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Ids of the executed runs, in order: a record with the case's name replaces training."""
    ids: list[str] = []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        case = definition.Case(**request["case"])
        ids.append(case.id)
        named = {**record(case.arm, 20.0, case.scene, case.seed), "key": request["key"]}
        return {"record": named, "protocol": "protocol", "images": {case.id: {"render": "r"}}, "machine": MACHINE}

    monkeypatch.setattr(single_run, "answer", answer)
    return ids


def go(tmp_path: Path, context: SuiteContext, cases: list[definition.Case] = CASES) -> list[str]:
    run_key.folder_hash.cache_clear()
    suite, farm = definition.load("sparse"), InProcess(lambda request: single_run.answer(dict(request)))
    return runner.run_suite(tmp_path / "r.json", suite, "c", cases, context, lambda text: None, farm)


def test_nothing_is_made_twice(tmp_path: Path, context: SuiteContext, made: list[str]) -> None:
    go(tmp_path, context, CASES[:2])
    before = (tmp_path / "r.json").read_bytes()
    go(tmp_path, context, CASES[:2])
    assert (tmp_path / "r.json").read_bytes() == before
    go(tmp_path, context)
    assert made == [case.id for case in CASES]
    assert set(result_file.read_images(tmp_path / "r.json")) == set(made)


@pytest.mark.parametrize("what", ["settings", "data", "code"])
def test_what_changed_is_made_again_and_replaces_its_record(
    tmp_path: Path, context: SuiteContext, made: list[str], monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    go(tmp_path, context)
    cases = list(CASES)
    if what == "settings":
        cases[1] = replace(cases[1], flags=(*cases[1].flags, "--antialiased"))
    elif what == "data":
        (context.root / "objects" / "b" / "image.png").write_text("changed")
    else:
        monkeypatch.setattr(run_key, "code_hash", lambda: "other")
    go(tmp_path, context, cases)
    again = {"settings": cases[1:2], "data": cases[2:], "code": cases}[what]
    assert made[4:] == [case.id for case in again]
    assert len(result_file.read(tmp_path / "r.json")["runs"]) == 4


@pytest.mark.parametrize("stage", ["answer", "write", "write_images", "replace"])
@pytest.mark.parametrize("number", [0, 2])
def test_a_kill_loses_at_most_the_run_being_made(
    tmp_path: Path, context: SuiteContext, made: list[str], stage: str, number: int
) -> None:
    """Killed in a run, before or while its record is written, before its pictures are."""
    owner: Any = {"answer": single_run, "write": result_file, "write_images": result_file, "replace": None}[stage]
    with pytest.MonkeyPatch.context() as patch:
        if owner is None:
            patch.setattr("os.replace", after(number * 2, shutil.move))  # pictures, then the record
        else:
            patch.setattr(owner, stage, after(number, getattr(owner, stage)))
        with pytest.raises(Killed):
            go(tmp_path, context)
    kept = result_file.read(tmp_path / "r.json")["runs"] if number else []
    assert [result_file.run_id(run) for run in kept] == [case.id for case in CASES[:number]]
    done = len(made)
    (context.work / "run-killed").mkdir(parents=True, exist_ok=True)
    go(tmp_path, context)
    assert made[done:] == [case.id for case in CASES[number:]]
    assert len(result_file.read(tmp_path / "r.json")["runs"]) == 4
    assert not (context.work / "run-killed").exists()


def after(count: int, real: Callable[..., Any]) -> Callable[..., Any]:
    """`real` for so many calls, then a kill."""
    calls: list[int] = []

    def call(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        if len(calls) > count:
            raise Killed
        return real(*args, **kwargs)

    return call


def test_a_run_that_fails_is_reported_and_the_others_are_made(
    tmp_path: Path, context: SuiteContext, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = single_run.answer

    def answer(request: dict[str, Any]) -> Any:
        if definition.Case(**request["case"]) == replace(CASES[1], flags=request["case"]["flags"]):
            raise RunFailed("`x` ended with exit code 4. Mend that.")
        return real(request)

    monkeypatch.setattr(single_run, "answer", answer)
    assert go(tmp_path, context) == [CASES[1].id]
    assert len(made) == 3
    monkeypatch.setattr(single_run, "answer", real)
    assert go(tmp_path, context) == []
    assert made[3:] == [CASES[1].id]


def test_a_record_outlives_a_machine_that_cannot_make_it(
    tmp_path: Path, context: SuiteContext, made: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    go(tmp_path, context)
    before = (tmp_path / "r.json").read_bytes()
    monkeypatch.setattr(single_run, "reason_to_skip", lambda case, context: "no prior at hand")
    go(tmp_path, context)
    assert (tmp_path / "r.json").read_bytes() == before


def test_training_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(RunFailed, match=r"exit code 2: .*--iterations.*at least 1, got 0"):
        single_run.call(["train", "x", "-m", str(tmp_path / "run"), "--iterations", "0"])


# Figures beside metrics.json


def test_prompts_are_made_again_for_another_model_and_a_template_lies_beside_the_notes(
    context: SuiteContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def call(arguments: list[str]) -> None:
        asked.append(arguments)
        write_set(Path(arguments[arguments.index("-o") + 1]), PromptSet((Prompt("a cup", source="llm:m"),)))

    monkeypatch.setattr(single_run, "call", call)
    note = {"notes": "a cup", "domain": "cups.md"}
    (context.root / "notes.json").write_text(json.dumps({"objects/a": note}))
    (context.root / "cups.md").write_text("")
    case = replace(CASES[0], arm="ours-llm")
    first, again, other = (single_run.prompts(case, replace(context, llm="http://x", model=m)) for m in ("m", "m", "n"))
    assert first == again != other
    assert [arguments[arguments.index("--model") + 1] for arguments in asked] == ["m", "n"]
    assert asked[0][asked[0].index("--domain") + 1] == str(context.root / "cups.md")


def test_overlap_of_silhouettes() -> None:
    a, b = torch.zeros(4, 4, dtype=torch.bool), torch.zeros(4, 4, dtype=torch.bool)
    assert run_figures.overlap(a, b) == 1
    a[:2], b[1:3] = True, True
    assert run_figures.overlap(a, b) == pytest.approx(4 / 12, abs=1e-6)


def test_silhouettes_and_depths_of_a_gpu_are_compared_here(tmp_path: Path) -> None:
    pixels = torch.full((HEIGHT, WIDTH, 4), 255, dtype=torch.uint8)
    view: Any = SimpleNamespace(name="v.png", camera=ring(1), pixels=lambda: pixels)
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth" / "v.npy", np.full((HEIGHT, WIDTH), 4.0))
    scene: Any = SimpleNamespace(test=[view], path=tmp_path)

    def shape(backend: Backend) -> dict[str, list[float | None]]:
        settings = RasterSettings(sh_degree=0)
        finished = FinishedRun(tmp_path, TrainConfig(), splats(), backend, settings, torch.zeros(3))
        return run_figures.shape(finished, scene)

    expected = shape(simt_backend())
    with pretend_gpu():
        assert shape(DeviceBackend(SimtRuntime(device="cuda:0"))) == expected
    (iou,), (error,) = expected["mask_iou"], expected["depth_error"]
    assert iou is not None
    assert 0 < iou < 1
    assert error is not None


def test_depth_is_read_where_it_fits_and_is_a_plain_array(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    view: Any = SimpleNamespace(name="images/v.png", camera=SimpleNamespace(width=3, height=2))
    file = tmp_path / "depth" / "v.npy"
    assert run_figures.read_depth(tmp_path, view) is None
    for bad in (b"", b"\x93NUMPY", b"text"):
        file.write_bytes(bad)
        assert run_figures.read_depth(tmp_path, view) is None
    np.save(file, np.array([{}]))  # needs pickle, which is never read
    assert run_figures.read_depth(tmp_path, view) is None
    np.save(file, np.ones((3, 2)))
    assert run_figures.read_depth(tmp_path, view) is None
    np.save(file, np.full((2, 3), 1.5))
    found = run_figures.read_depth(tmp_path, view)
    assert found is not None
    assert found.tolist() == [[1.5] * 3] * 2


def test_the_view_of_the_grid_is_the_one_farthest_from_all_inputs() -> None:
    scene = load_scene(str(definition.PACKAGE / "demo"))
    far, near = run_figures.remote_view(scene)

    def distance(view: Any) -> float:
        return min(float((view.camera.centers - one.camera.centers).norm()) for one in scene.train)

    assert distance(far) == max(distance(view) for view in scene.test)
    assert float((far.camera.centers - near.camera.centers).norm()) == pytest.approx(distance(far))


# For real


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suite `smoke` by its command, as CI runs it; the test session has no prior at hand."""
    file = tmp_path_factory.mktemp("smoke") / "smoke.json"
    assert cli.main(["bench", "--suite", "smoke", "--seeds", "1", "-o", str(file)]) == 0
    return file


def test_smoke_trains_evaluates_and_draws(smoke: Path) -> None:
    found = result_file.read(smoke)
    assert [run["arm"] for run in found["runs"]] == ["3dgs", "ours-0"]
    assert {skip["arm"] for skip in found["skipped"]} == {"ours", "ours-template"}
    assert all("no prior at hand" in skip["reason"] for skip in found["skipped"])
    for run in found["runs"]:
        assert len(run["views_out"]) == len(run["per_view"]["psnr"]) == 12
        assert run["mean"]["psnr"] == pytest.approx(sum(run["per_view"]["psnr"]) / 12, abs=1e-5)
        assert [point["step"] for point in run["curve"]] == [8, 16, 24, 32, 40]
        times = [run["setup_cpu_seconds"], *(point["cpu_seconds"] for point in run["curve"])]
        assert times == sorted(times)
        assert 0.3 < run["mean"]["mask_iou"] < 1
    assert "data:image/webp" in smoke.with_suffix(".html").read_text()
    assert list(runner.work_folder(smoke).glob("run-*")) == []


def test_an_estimate_tries_every_scene_and_makes_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "smoke.json"
    assert (
        cli.main(["bench", "--suite", "smoke", "--seeds", "2", "--arms", "ours-0", "-o", str(file), "--estimate"]) == 0
    )
    *lines, last = capsys.readouterr().out.splitlines()
    assert [line.split(", ")[2] for line in lines] == ["unguided: 2 runs"] * len(lines)
    assert last.startswith(f"{2 * len(lines)} runs are due: at least 0:0")
    assert not file.exists() or result_file.read(file)["runs"] == []
    assert list(runner.work_folder(file).glob("run-*")) == []


def test_a_trial_is_scaled_to_the_steps_of_a_run() -> None:
    assert estimate.Trial(setup=2.0, step=0.01, memory_mb=0.0).seconds(7000) == 72.0
    assert [estimate.hours(seconds) for seconds in (0, 89, 90, 90_061)] == ["0:00 h", "0:01 h", "0:02 h", "25:01 h"]


def test_the_same_run_gives_the_same_figures(smoke: Path, tmp_path: Path) -> None:
    file = tmp_path / "again.json"
    assert cli.main(["bench", "--suite", "smoke", "--seeds", "1", "--arms", "ours-0", "-o", str(file)]) == 0
    first = next(run for run in result_file.read(smoke)["runs"] if run["arm"] == "ours-0")
    (second,) = result_file.read(file)["runs"]
    assert [{k: v for k, v in run.items() if k not in DIFFERENT} for run in (first, second)] == [
        {k: v for k, v in first.items() if k not in DIFFERENT}
    ] * 2
    assert [point["psnr"] for point in first["curve"]] == [point["psnr"] for point in second["curve"]]
    images = [result_file.read_images(path) for path in (smoke, file)]
    assert all(images[0][name] == value for name, value in images[1].items())


def published(folder: Path, count: int) -> Path:
    """images/ and sparse/0/, as tandt/train comes: photos of a few blobs, no split, no alpha."""
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    cameras, blobs, lines = ring(count), splats(), []
    for index in range(count):
        picture = draw(blobs, cameras[index], ReferenceBackend(), RasterSettings(sh_degree=0), WHITE)
        Image.fromarray(picture.numpy()).save(folder / "images" / f"{index:05d}.jpg", quality=95)
        viewmat = cameras.viewmats[index]
        pose = [*quats.from_rotation_matrices(viewmat[None, :3, :3])[0].tolist(), *viewmat[:3, 3].tolist()]
        lines.append(f"{index + 1} {' '.join(map(str, pose))} 1 {index:05d}.jpg\n\n")
    focal = WIDTH / (2 * math.tan(FOV / 2))
    text = {
        "cameras": f"1 PINHOLE {WIDTH} {HEIGHT} {focal} {focal} {WIDTH / 2} {HEIGHT / 2}\n",
        "images": "".join(lines),
        "points3D": "".join(
            f"{i} {x} {y} {z} 128 128 128 0.5\n" for i, (x, y, z) in enumerate(blobs.means.repeat(40, 1).tolist())
        ),
    }
    for name, body in text.items():
        (folder / "sparse" / "0" / f"{name}.txt").write_text(body)
    return folder


def test_the_published_layout_is_trained_and_evaluated_on_every_eighth_image(tmp_path: Path) -> None:
    published(tmp_path / "root" / "tandt" / "train", 10)
    case = next(definition.cases(definition.load("paper"), 1))
    assert case.scene == "tandt/train"
    case = replace(case, iterations=10, flags=(*case.flags, "--iterations", "10"))
    context = SuiteContext(tmp_path / "root", tmp_path / "work", 1)
    context.work.mkdir()
    found = single_run.answer(single_run.run_job(case, context, "k").request)
    made, protocol = found["record"], found["protocol"]
    assert made["views_in"] == 8
    assert made["views_out"] == ["images/00000.jpg", "images/00008.jpg"]
    assert made["per_view"]["mask_iou"] == [None, None]
    assert made["n_gaussians"] == 12 * 40
    assert "split: trained on 8 views, held out 2" in protocol
    assert "not guided" in (single_run.reason_to_skip(replace(case, arm="ours"), context) or "")
