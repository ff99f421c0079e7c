"""From a shape library to a shape prior: samples, an exact resumption, the folder, the command and the experiment."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gsopt.cli import main
from gsopt.errors import InputError, UsageError
from gsopt.finetune.shapes import evaluation
from gsopt.finetune.shapes.run import ShapeTraining, find_device, finetune_shapes
from gsopt.finetune.shapes.samples import Samples, drawn_cameras, drawn_samples, word_rows
from gsopt.finetune.shapes.trainer import squared_error
from gsopt.finetune.shapes.training_config import ShapeTrainingConfig
from gsopt.finetune.shapes.volumes import ShapeVolumes, continued, split
from gsopt.finetune.trainer import STATE
from gsopt.sds.noise import generator
from gsopt.shape_library.entry import Entry, Shape
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary, packed, write_library
from gsopt.shape_prior.diffusion import signal
from gsopt.shape_prior.folder import CARD_FILE, read_prior

CONFIG = ShapeTrainingConfig(steps=6, batch=2, side=16, widths=(8, 16), blocks=1, image_side=16, save_every=2, lr=2e-3)
ROOT = Path(__file__).resolve().parents[2]
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ShapeLibrary:
    """Eight boxes of two kinds and colors."""
    shapes = []
    for i in range(8):
        occupied = np.zeros((48, 48, 48), bool)
        occupied[4 + i : 44 - i, 10:38, 0:48] = True
        occupied[:, :, : 6 * (i % 2)] = True
        colors = np.zeros((12, 12, 12, 3), np.uint8)
        colors[2:10, 2:10] = (200, 40 * (i % 2), 30)
        shapes.append(Shape(occupied, colors, np.array([1, 0.8, 0.9], np.float32)))
    entries = [Entry(f"box{i}", name="low bench" if i % 2 else "tall tower", license="CC0-1.0") for i in range(8)]
    path = tmp_path_factory.mktemp("shapes") / "library.safetensors"
    write_library(path, entries, [packed(shape) for shape in shapes], [shape.sizes for shape in shapes])
    return ShapeLibrary(path)


@pytest.fixture
def training(library: ShapeLibrary) -> ShapeTraining:
    return ShapeTraining(library, ("box6", "box7"), CONFIG, CPU)


def test_entries_are_held_out_by_id_and_never_trained_on(library: ShapeLibrary, training: ShapeTraining) -> None:
    assert split(library, ("box6", "box7")) == (list(range(6)), [6, 7])
    train, held = split(ShapeLibrary(BUNDLED), ())
    assert not set(train) & set(held)
    assert 30 < len(held) < 90
    _, shapes, vocabulary = training.trainer()
    assert {entry.id for entry in shapes.entries} == {f"box{i}" for i in range(6)}
    assert vocabulary == ("bench", "tower")
    with pytest.raises(UsageError, match="boxx"):
        split(library, ("boxx",))
    with pytest.raises(InputError, match="all of them held out"):
        split(library, [f"box{i}" for i in range(8)])


def test_cells_without_a_surface_continue_the_colors_around_them() -> None:
    colors = torch.zeros(2, 3, 6, 6, 6)
    colors[0, :, 2, 2, 2] = torch.tensor([0.5, 0.25, 1.0])
    filled = continued(colors)
    expected = torch.tensor([0.5, 0.25, 1.0]).view(3, 1, 1, 1)
    torch.testing.assert_close(filled[0], expected.expand(3, 6, 6, 6))
    assert float((filled[1] - 0.5).abs().max()) == 0


def test_cameras_stand_as_users_hold_them_and_look_at_the_object() -> None:
    heights, views = [], set()
    for seed in range(40):
        cameras = drawn_cameras(8, torch.Generator().manual_seed(seed))
        viewmats = cameras.viewmats()
        views.add(viewmats.shape[1])
        ahead = viewmats[..., 2, 3]
        aside = viewmats[..., :2, 3].norm(dim=-1)
        assert bool((aside / ahead < 0.3).all())
        assert bool((ahead > 1).all())
        heights.append(cameras.height.rad2deg().flatten())
    usual = torch.cat(heights)
    assert views == {1, 2, 3}
    assert 0.75 < float(((usual >= 15) & (usual <= 45)).float().mean()) < 0.95


def test_the_same_generator_draws_the_same_samples_with_conditions_left_out(training: ShapeTraining) -> None:
    trainer, shapes, _ = training.trainer()
    first, again = (drawn_samples(shapes, trainer.words, 4, 16, 16, generator(0, 3, 0, "x")) for _ in range(2))
    for a, b in zip(vars(first).values(), vars(again).values(), strict=True):
        assert torch.equal(a, b)
    many = [drawn_samples(shapes, trainer.words, 8, 8, 16, generator(0, i, 0, "x")) for i in range(12)]
    silent = torch.cat([one.words.eq(0).all(1) for one in many]).float().mean()
    blind = torch.cat([one.known.flatten(1).eq(0).all(1) for one in many]).float().mean()
    assert 0.2 < float(silent) < 0.8
    assert float(blind) < 0.15


def test_no_operation_of_a_step_mixes_tensors_of_two_places(training: ShapeTraining) -> None:
    """On `meta`, as on a GPU, an operation refuses tensors that lie elsewhere."""
    trainer, shapes, vocabulary = training.trainer()
    there = ShapeVolumes(*(tensor.to("meta") for tensor in list(vars(shapes).values())[:3]), shapes.entries)
    words = word_rows(there, vocabulary)
    for seed in range(6):  # one, two and three views
        batch = drawn_samples(there, words, 2, 16, 16, generator(seed, 0, 0, "x"))
    level = torch.rand(2, device="meta")
    answer = trainer.unet.to("meta")(batch.x0 * signal(level), level, batch.known, batch.words)
    squared_error(answer, batch).backward()
    assert answer.device.type == trainer.unet.enter.weight.grad.device.type == "meta"


def test_the_error_of_a_perfect_answer_is_zero_and_occupancy_counts_most(training: ShapeTraining) -> None:
    trainer, shapes, _ = training.trainer()
    batch = drawn_samples(shapes, trainer.words, 2, 16, 16, generator(0, 0, 0, "x"))
    assert float(squared_error(batch.x0, batch)) == 0
    worse = [batch.x0.clone() for _ in range(2)]
    worse[0][:, 0] += 0.1
    worse[1][:, 1] += 0.1
    shape, color = (float(squared_error(one, batch)) for one in worse)
    assert shape == pytest.approx(0.01, rel=1e-3)
    assert color == pytest.approx(0.003, rel=1e-3)
    nothing = Samples(batch.x0, torch.zeros_like(batch.known), batch.words)
    assert float(squared_error(worse[0], nothing)) == pytest.approx(0.01, rel=1e-3)


def test_noise_rises_from_none_to_all() -> None:
    share = signal(torch.tensor([0.0, 0.5, 1.0])).flatten()
    torch.testing.assert_close(share, torch.tensor([1.0, 0.5, 0.0]), atol=1e-6, rtol=0)


def test_a_training_that_was_cut_ends_with_the_same_bits(training: ShapeTraining, tmp_path: Path) -> None:
    whole, shapes, _ = training.trainer()
    whole.run(shapes, tmp_path, lambda step, loss: None)
    expected = {name: value.clone() for name, value in whole.average.items()}
    (tmp_path / STATE).unlink()
    first, _, _ = training.trainer()
    for _ in range(3):
        first.advance(shapes)
    first.save(tmp_path / STATE)
    second, _, _ = replace(training, config=replace(CONFIG, seed=0)).trainer()
    second.restore(tmp_path / STATE)
    assert second.step == 3
    second.run(shapes, tmp_path, lambda step, loss: None)
    for name, value in second.average.items():
        assert torch.equal(value, expected[name]), name
    other, _, _ = replace(training, config=replace(CONFIG, batch=3)).trainer()
    with pytest.raises(InputError, match="Cannot continue"):
        other.restore(tmp_path / STATE)


def test_training_lowers_the_error_on_shapes_that_it_saw(library: ShapeLibrary) -> None:
    training = ShapeTraining(library, ("box6",), replace(CONFIG, steps=60, batch=4), CPU)
    trainer, shapes, _ = training.trainer()
    batch = drawn_samples(shapes, word_rows(shapes, ("bench", "tower")), 8, 16, 16, generator(9, 0, 0, "judge"))
    noise = torch.randn(batch.x0.shape, generator=torch.Generator().manual_seed(0))

    def error() -> float:
        with torch.no_grad():
            answer = trainer.unet(noise, torch.ones(8), batch.known, batch.words)
        return float(squared_error(answer, batch))

    before = error()
    for _ in range(60):
        trainer.advance(shapes)
    assert error() < 0.8 * before


def test_the_command_makes_a_prior_judges_it_and_does_nothing_twice(
    library: ShapeLibrary, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "COMMON_SIDE", 24)
    monkeypatch.setattr(evaluation, "UNSEEN_SIDE", 16)
    out = tmp_path / "prior"
    sizes = "--side 16 --widths 8 16 --blocks 1 --image-side 16 --batch 2 --steps 4 --threads 1 --val box6"
    command = ["finetune", "--shape", str(library.path), "-o", str(out), *sizes.split()]
    assert main([*command, "--pause-after", "0"]) == 0
    assert not (out / CARD_FILE).exists()
    assert "paused after step 0" in capsys.readouterr().out
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "inflated: IoU" in printed
    assert "prior without words: IoU" in printed
    assert f"--prior shape:{out}" in printed
    measured = json.loads((out / CARD_FILE).read_text())["measured"]
    assert [row["id"] for row in measured["rows"]] == ["box6"]
    assert all(0 <= way["iou"] <= 1 for way in measured["mean"].values())
    assert json.loads((out / "train.jsonl").read_text().splitlines()[-1])["step"] == 4
    assert "CC0-1.0" in (out / "README.md").read_text()
    assert read_prior(out).vocabulary == ("bench", "tower")
    before = (out / "weights_00.safetensors").stat().st_mtime_ns
    assert main(command) == 0
    assert (out / "weights_00.safetensors").stat().st_mtime_ns == before
    assert main([*command, "--seed", "1"]) == 3
    assert "another library or flags" in capsys.readouterr().err


def test_a_folder_of_something_else_is_left_alone(training: ShapeTraining, tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="not empty"):
        finetune_shapes(training, tmp_path, print)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_a_pause_keeps_the_steps_that_were_made(training: ShapeTraining, tmp_path: Path) -> None:
    trainer, shapes, _ = training.trainer()
    trainer.run(shapes, tmp_path, lambda step, loss: time.sleep(0.02), time.monotonic() + 0.01)
    again, _, _ = training.trainer()
    again.restore(tmp_path / STATE)
    assert 1 <= again.step == trainer.step < CONFIG.steps


@pytest.mark.parametrize(
    "flags", ["--side 20", "--widths 9", "--image-side 17", "--blocks 0", "--device tpu", "--pause-after nan"]
)
def test_settings_that_no_network_has_are_one_line(
    flags: str, library: ShapeLibrary, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["finetune", "--shape", str(library.path), "-o", str(out), *flags.split()]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not out.exists()


def test_a_gpu_that_is_not_there_is_named() -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    assert find_device("auto") == CPU
    with pytest.raises(UsageError, match="finds no GPU"):
        find_device("cuda")


def test_the_experiment_plans_pauses_trains_and_judges(tmp_path: Path) -> None:
    script = ROOT / "experiments" / "gpu_shape.py"
    command = [sys.executable, str(script), "--tiny", "--minutes", "1", "--out", str(tmp_path / "out")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for flags in (["--pause-after", "0"], []):
        subprocess.run([*command, *flags], env=environment, check=True, stdout=subprocess.DEVNULL)
        assert (tmp_path / "out" / "result.json").exists() == (not flags)
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert result["config"]["steps"] == min(plan["config"]["steps"], 12) >= 1
    assert set(result["measured"]["mean"]) == {"inflated", "library", "prior", "prior without words"}
    assert read_prior(tmp_path / "out" / "prior").config.side == 16
