"""`gsopt render` and `gsopt eval`: the right cameras, the right files, and errors that are not tracebacks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from finished_runs import HEIGHT, WIDTH, make_run
from PIL import Image

from gsopt.cli import eval as cli_eval
from gsopt.cli import render as cli_render
from gsopt.errors import InputError, UsageError
from gsopt.results.finished_run import cameras_along, open_run, to_bytes


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("run"))


def test_drawing_the_held_out_views_gives_back_the_truth(run: Path, tmp_path: Path) -> None:
    assert cli_render.main([str(run), "--path", "test", "-o", str(tmp_path / "frames")]) == 0
    written = sorted((tmp_path / "frames").iterdir())
    assert [path.name for path in written] == ["0000_r_0.png", "0001_r_1.png"]
    for index, path in enumerate(written):
        truth = Image.open(run.parent / "data" / "test" / f"r_{index}.png")
        assert np.array_equal(np.asarray(Image.open(path)), np.asarray(truth))


@pytest.mark.parametrize("path", ["orbit", "turntable", "ellipse", "interpolated"])
def test_a_film_path_has_the_frames_asked_for_and_the_subject_in_the_middle(run: Path, path: str) -> None:
    finished = open_run(run)
    shots = cameras_along(finished, path, 5, longest=20)
    assert [name for name, _ in shots] == ["0000", "0001", "0002", "0003", "0004"]
    for _, camera in shots:
        assert (camera.width, camera.height) == (20, 16)
        picture = finished.draw(camera)
        assert (picture[4:-4, 5:-5] < 250).any()


def test_a_film_goes_where_it_is_told(run: Path, tmp_path: Path) -> None:
    output = tmp_path / "turn.webp"
    assert cli_render.main([str(run), "--frames", "3", "--out", str(output), "--size", "16"]) == 0
    with Image.open(output) as film:
        assert (film.n_frames, film.size) == (3, (16, 13))


def test_frames_go_to_the_run_when_nothing_is_said_and_are_not_written_over(run: Path) -> None:
    assert cli_render.main([str(run), "--path", "train"]) == 0
    first = run / "frames" / "train" / "0000_r_0.png"
    assert Image.open(first).size == (WIDTH, HEIGHT)
    with pytest.raises(UsageError, match="--force"):
        cli_render.main([str(run), "--path", "train"])


def test_held_out_views_that_do_not_exist_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="held out no views"):
        cameras_along(open_run(make_run(tmp_path, train=1, test=0)), "test", 3)


def test_a_single_input_view_still_has_an_orbit(tmp_path: Path) -> None:
    shots = cameras_along(open_run(make_run(tmp_path, train=1, test=0)), "orbit", 4)
    assert all(torch.isfinite(camera.viewmats).all() for _, camera in shots)


def test_eval_prints_the_figures_and_writes_both_files(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli_eval.main([str(run)]) == 0
    printed = capsys.readouterr().out
    assert (
        "Held-out views (2): PSNR 100.00 dB, SSIM 1.0000, LPIPS (Alex) 0.0000, PSNR color-corrected 100.00 dB\n"
        in printed
    )
    assert json.loads((run / "metrics.json").read_text())["mean"]["psnr"] == 100
    assert (run / "report.html").is_file()


def test_colors_are_clamped_and_rounded() -> None:
    colors = torch.tensor([[[-0.5, 0.5 / 255 + 1e-4, 7.0]]])
    assert to_bytes(colors).tolist() == [[[0, 1, 255]]]
