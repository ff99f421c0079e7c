"""Cleaning leaves out what no input view needs, nothing that one needs, and can be undone."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from finished_runs import make_run, splats
from PIL import Image

import gsopt
from gsopt.cli import main
from gsopt.data.scene import load_scene
from gsopt.formats import load_splats, save_splats
from gsopt.formats.ply import ply_antialiased
from gsopt.gaussians import Gaussians
from gsopt.results import clean, clean_files
from gsopt.results.evaluation import evaluate
from gsopt.results.finished_run import FinishedRun, open_run

GOOD = 12
"""Splats that made the views."""


def blob(position: tuple[float, float, float], size: float, opacity: float) -> Gaussians:
    return Gaussians(
        means=torch.tensor([position]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(size)),
        logit_opacities=torch.tensor([math.log(opacity / (1 - opacity))]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )


def dirty_run(folder: Path, extra: Gaussians, views: int = 8) -> FinishedRun:
    return open_run(make_run(folder, train=views, test=3, learned=splats().append(extra)))


def views_of(run: FinishedRun, split: str = "train"):
    return getattr(load_scene(run.config.data), split)


def named(found: list[clean.Finding], rule: str) -> list[int]:
    return [row for f in found if f.rule == rule for row in torch.nonzero(f.splats)[:, 0].tolist()]


def test_the_weight_of_a_splat_is_its_share_of_the_pixels(tmp_path: Path) -> None:
    """All weights of a view sum up to its alphas."""
    run = open_run(make_run(tmp_path, train=3))
    views = views_of(run)
    seen = clean.observe(run.gaussians, views, run.backend)
    alphas = sum(float(run.backend.forward(run.gaussians, v.camera, run.settings).alphas.sum()) for v in views)
    assert float(seen.weight.sum()) == pytest.approx(alphas, rel=1e-4)
    assert bool((seen.views <= 3).all())


def test_splats_that_made_the_views_stay(tmp_path: Path) -> None:
    run = open_run(make_run(tmp_path, train=8))
    assert bool(clean.kept(clean.findings(run, views_of(run)), GOOD).all())


def test_a_splat_inside_others_or_behind_all_cameras_is_unseen(tmp_path: Path) -> None:
    hidden = blob((0.0, 0.0, 90.0), 0.01, 0.9)
    run = dirty_run(tmp_path, hidden)
    found = clean.findings(run, views_of(run))
    assert named(found, "unseen") == [GOOD]


def test_haze_before_one_camera_goes_and_held_out_views_do_not_lose(tmp_path: Path) -> None:
    """A faint veil right before the first camera (at 4, 0, 1.5)."""
    run = dirty_run(tmp_path, blob((3.5, 0.0, 1.3), 0.02, 0.05))
    found = clean.findings(run, views_of(run))
    assert named(found, "haze") == [GOOD]
    keep = clean.kept(found, len(run.gaussians))
    test = views_of(run, "test")
    assert clean.input_psnr(run, run.gaussians.select(keep), test) >= clean.input_psnr(run, run.gaussians, test) - 1e-6


def test_haze_is_what_at_most_two_views_see_before_half_of_the_depth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = open_run(make_run(tmp_path, train=6))
    views, nearness = torch.full((GOOD,), 6.0), torch.ones(GOOD)
    views[:4], nearness[:4] = torch.tensor([1.0, 2, 3, 2]), torch.tensor([0.4, 0.49, 0.4, 0.5])
    seen = clean.Observation(torch.ones(GOOD), torch.zeros(GOOD), views, nearness)
    monkeypatch.setattr(clean, "observe", lambda *_: seen)
    assert named(clean.findings(run, views_of(run)), "haze") == [0, 1]


def test_what_the_input_views_need_is_kept_whatever_a_rule_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = open_run(make_run(tmp_path, train=8))
    monkeypatch.setattr(clean, "UNSEEN_WEIGHT", 1e6)  # names every splat
    (found,) = clean.findings(run, views_of(run))[:1]
    assert bool(found.splats.all())
    assert not found.followed
    assert bool(clean.kept([found], GOOD).all())


@pytest.mark.parametrize("solid", [True, False])
def test_splats_on_the_background_of_masks_go(tmp_path: Path, solid: bool) -> None:
    """Masks that hold the whole image name no splat; masks that hold nothing name every one that a view sees."""
    folder = make_run(tmp_path, train=4)
    for file in (tmp_path / "data").rglob("*.png"):
        image = Image.open(file).convert("RGB")
        image.putalpha(255 if solid else 0)
        image.save(file)
    run = open_run(folder)
    found = clean.findings(run, views_of(run))
    visible = clean.observe(run.gaussians, views_of(run), run.backend).weight > 4 * clean.UNSEEN_WEIGHT
    assert len(named(found, "outside the masks")) == (0 if solid else int(visible.sum()))


def test_a_box_is_followed_also_where_it_costs(tmp_path: Path) -> None:
    run = open_run(make_run(tmp_path, train=4))
    found = clean.findings(run, views_of(run), box=(-0.3, -9, -9, 0.3, 9, 9))
    keep = clean.kept(found, GOOD)
    assert bool((run.gaussians.means[keep][:, 0].abs() <= 0.3).all())
    assert 0 < int(keep.sum()) < GOOD


def test_a_run_is_cleaned_and_brought_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = dirty_run(tmp_path, blob((0.0, 0.0, 90.0), 0.01, 0.9)).path
    before = (run / "splat.ply").read_bytes()
    assert main(["clean", str(run), "--dry-run"]) == 0
    assert (run / "splat.ply").read_bytes() == before
    assert "unseen: 1 splats" in capsys.readouterr().out
    assert Image.open(run / "clean.png").size[0] > 100
    for _ in range(2):  # the second cleaning keeps the first original
        assert main(["clean", str(run)]) == 0
        assert len(load_splats(run / "splat.ply")) == GOOD
        assert (run / "splat.before-clean.ply").read_bytes() == before
    assert not ply_antialiased(run / "splat.ply")
    assert main(["clean", str(run), "--undo"]) == 0
    assert (run / "splat.ply").read_bytes() == before
    assert main(["clean", str(run), "--undo"]) == 2


def test_the_metrics_of_a_cleaned_run_are_those_of_its_splats(tmp_path: Path) -> None:
    """A box takes half of the splats away: the figures fall, and are the first again when it is undone."""
    run = make_run(tmp_path, train=4, test=2)
    evaluate(run)
    first = (run / "metrics.json").read_bytes()
    for _ in range(2):
        assert main(["clean", str(run), "--box", "0", "-9", "-9", "9", "9", "9"]) == 0
    cleaned = json.loads((run / "metrics.json").read_text())
    assert cleaned["mean"]["psnr"] < json.loads(first)["mean"]["psnr"] - 1
    assert cleaned == evaluate(run) | {"protocol": cleaned["protocol"]}
    assert main(["clean", str(run), "--undo"]) == 0
    assert (run / "metrics.json").read_bytes() == first


def test_views_without_a_part_in_the_decision_judge_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A splat that nobody sees may go. Where every splat is named and no input view objects, those left out do."""
    run = dirty_run(tmp_path, blob((0.0, 0.0, 90.0), 0.01, 0.9))
    assert abs(clean.left_out_change(run, views_of(run))) < 1e-6
    assert math.isnan(clean.left_out_change(run, views_of(run)[:1]))
    monkeypatch.setattr(clean, "UNSEEN_WEIGHT", 1e6)
    monkeypatch.setattr(clean, "MAX_COST", math.inf)
    assert clean.left_out_change(run, views_of(run)) < -1
    cleaning, change = clean_files.clean_where_it_helps(run.path)
    assert cleaning is None
    assert change < -1
    assert len(load_splats(run.path / "splat.ply")) == GOOD + 1


def test_python_cleans_as_the_command_does(tmp_path: Path) -> None:
    run = dirty_run(tmp_path, blob((0.0, 0.0, 90.0), 0.01, 0.9)).path
    assert (gsopt.clean(run, dry_run=True).left_out, len(load_splats(run / "splat.ply"))) == (1, GOOD + 1)
    found = gsopt.clean(run)
    assert (found.left_out, len(found.gaussians), len(load_splats(run / "splat.ply"))) == (1, GOOD, GOOD)
    assert main(["clean", str(run), "--undo"]) == 0
    assert len(load_splats(run / "splat.ply")) == GOOD + 1


def test_undo_measures_a_run_that_was_cleaned_before_it_was_evaluated(tmp_path: Path) -> None:
    run = dirty_run(tmp_path, blob((0.0, 0.0, 90.0), 0.01, 0.9)).path
    assert clean_files.clean_where_it_helps(run)[0] is not None
    evaluate(run)
    assert main(["clean", str(run), "--undo"]) == 0
    assert json.loads((run / "metrics.json").read_text())["n_gaussians"] == GOOD + 1


def test_a_file_loses_what_nobody_can_see(tmp_path: Path) -> None:
    save_splats(tmp_path / "a.ply", splats().append(blob((0.0, 0, 0), 0.5, 0.001)))
    assert main(["clean", str(tmp_path / "a.ply")]) == 2  # where to?
    assert main(["clean", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.ply")]) == 0
    assert len(load_splats(tmp_path / "b.ply")) == GOOD
    assert main(["clean", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.ply")]) == 2  # exists
    box = ["--box", "0", "-9", "-9", "9", "9", "9"]
    assert main(["clean", str(tmp_path / "a.ply"), "-o", str(tmp_path / "c.ply"), *box]) == 0
    assert bool((load_splats(tmp_path / "c.ply").means[:, 0] >= 0).all())


def test_bad_sources_are_one_line_and_code_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nrubbish")
    (tmp_path / "empty").mkdir()
    for source in ("bad.ply", "absent.ply", "empty"):
        assert main(["clean", str(tmp_path / source), "-o", str(tmp_path / "o.ply")]) == 3
        assert len(capsys.readouterr().err.splitlines()) == 1
