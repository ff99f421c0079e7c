"""Rules of cleaning at their limits, with stand-ins for what views see: what is named, followed and shown."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from finished_runs import make_run, splats
from PIL import Image

from gsopt.errors import InputError, UsageError
from gsopt.geometry.sh import rgb_from_sh0
from gsopt.results import clean, clean_files
from gsopt.results.clean import Finding, Observation, findings, findings_without_views, kept, left_out_change, observe


def seen(count: int = 4, **changes: Any) -> Observation:
    """Splats that every rule lets stay, but for what is changed."""
    fields = {"weight": 100.0, "outside": 0.0, "views": 6.0, "nearness": 1.0}
    return Observation(**{name: torch.full((count,), changes.get(name, value)) for name, value in fields.items()})


def named(
    observed: Observation, views: int, monkeypatch: pytest.MonkeyPatch, psnr: Any = None, box: Any = None
) -> list[Finding]:
    """The findings on such splats in a run of so many views, at a PSNR by the number of splats left."""
    asked: list[int] = []
    monkeypatch.setattr(clean, "observe", lambda *_: observed)

    def quality(run: Any, gaussians: Any, views: Any) -> float:
        asked.append(len(views))
        return 30.0 if psnr is None else psnr(len(gaussians))

    monkeypatch.setattr(clean, "input_psnr", quality)
    run: Any = SimpleNamespace(gaussians=splats(len(observed.weight)), backend=None)
    found = findings(run, list(range(views)), box)  # type: ignore[arg-type]
    assert set(asked) == {len(range(views)[:: -(-views // 24)])}
    return found


@pytest.mark.parametrize(
    ("views", "changes", "rules"),
    [
        (8, {"weight": 0.0399}, ["unseen"]),
        (8, {"weight": 0.0401}, []),
        (6, {"nearness": 0.49, "views": 2.0}, ["haze"]),
        (5, {"nearness": 0.49, "views": 2.0}, []),
        (6, {"nearness": 0.51, "views": 2.0}, []),
        (6, {"nearness": 0.49, "views": 3.0}, []),
        (8, {"outside": 80.1}, ["outside the masks"]),
        (8, {"outside": 79.9}, []),
        (8, {"weight": 0.03, "outside": 0.03}, ["unseen"]),
        (25, {"weight": 0.124}, ["unseen"]),
        (60, {"weight": 0.299}, ["unseen"]),
    ],
)
def test_a_splat_is_named_once_by_the_first_rule_that_fits(
    views: int, changes: dict[str, float], rules: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unseen below 0.005 px a view; haze before half of the depth in two of six views; 0.8 of the weight outside."""
    assert [finding.rule for finding in named(seen(**changes), views, monkeypatch)] == rules


@pytest.mark.parametrize(("cost", "followed"), [(0.0199, True), (0.0201, False), (-1.0, True)])
def test_a_rule_may_cost_a_fiftieth_of_a_decibel(cost: float, followed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    observed = seen()
    observed.weight[0], observed.outside[1] = 0.0, 100.0
    found = named(observed, 8, monkeypatch, lambda count: 30.0 - cost * (4 - count))
    assert [one.rule for one in found] == ["unseen", "outside the masks"]
    assert [one.followed for one in found] == [followed] * 2
    assert found[0].change == pytest.approx(-cost)
    assert found[1].change == pytest.approx(-cost), "a rule is judged beside those that were followed before it"
    assert kept(found, 4).tolist() == [not followed, not followed, True, True]


def test_a_box_is_followed_whatever_it_costs_and_holds_its_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    means = splats(4).means
    low, high = means[2:].amin(0), means[2:].amax(0)
    box = (*low.tolist(), *high.tolist())
    outside = clean.outside_box(splats(4), box)
    assert outside[2:].tolist() == [False, False]
    (found,) = named(seen(), 8, monkeypatch, lambda count: 30.0 if count == 4 else 0.0, box)
    assert (found.rule, found.followed) == ("outside the box", True)
    assert torch.equal(found.splats, outside)
    assert found.change == -30.0


def test_a_view_sees_half_a_pixel_and_nears_by_a_twentieth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of 0.5 px are no view yet, those of 0.05 px have no depth yet."""
    weights = {0: [0.5, 0.51, 0.05, 0.051], 1: [1.0, 0.1, 0.0, 0.2]}
    depths = {0: [0.4, 0.6, 0.1, 0.2], 1: [0.3, 0.9, 0.1, 0.5]}

    def sums(splats: Any, view: int, backend: Any) -> tuple[torch.Tensor, ...]:
        weight = torch.tensor(weights[view])
        return weight, weight / 4, torch.tensor(depths[view])

    monkeypatch.setattr(clean, "_weights", sums)
    found = observe(splats(4), [0, 1], None)  # type: ignore[arg-type,list-item]
    assert found.views.tolist() == [1, 1, 0, 0]
    assert found.weight.tolist() == pytest.approx([1.5, 0.61, 0.05, 0.251])
    assert found.outside.tolist() == pytest.approx([0.375, 0.1525, 0.0125, 0.06275])
    assert found.nearness.tolist() == pytest.approx([0.3, 0.6, math.inf, 0.2])


@pytest.mark.parametrize(
    ("views", "left_out"), [(2, [0, 1]), (8, list(range(8))), (9, [0, 2, 4, 6, 8]), (17, [0, 3, 6, 9, 12, 15])]
)
def test_up_to_eight_views_are_left_out_one_after_the_other(
    views: int, left_out: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[int] = []

    def decide(run: Any, others: list[int]) -> list[Finding]:
        (out,) = set(range(views)) - set(others)
        return [Finding("unseen", torch.tensor([True, False, False, False]), 0.0, out % 2 == 0)]

    def quality(run: Any, gaussians: Any, shown: list[int]) -> float:
        judged.extend(shown)
        return 10.0 * len(gaussians)

    monkeypatch.setattr(clean, "findings", decide)
    monkeypatch.setattr(clean, "input_psnr", quality)
    run: Any = SimpleNamespace(gaussians=splats(4))
    change = left_out_change(run, list(range(views)))  # type: ignore[arg-type]
    assert judged[::2] == judged[1::2] == left_out
    assert change == pytest.approx(-10 * sum(out % 2 == 0 for out in left_out) / len(left_out))
    assert math.isnan(left_out_change(run, [0]))  # type: ignore[list-item]


def test_the_quality_of_input_views_is_the_mean_of_their_capped_psnr(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = [torch.full((4, 4, 3), value, dtype=torch.uint8) for value in (255, 51)]
    monkeypatch.setattr(clean, "draw", lambda gaussians, camera, *_: pictures[camera])
    monkeypatch.setattr(clean, "truth", lambda view, background: pictures[0])
    run: Any = SimpleNamespace(backend=None, settings=None, background=None)
    views: Any = [SimpleNamespace(camera=i) for i in range(2)]
    same, other = (clean.input_psnr(run, splats(1), [view]) for view in views)
    assert same == float(clean.capped_psnr(torch.ones(1, 2, 2, 3), torch.ones(1, 2, 2, 3)))
    assert other == pytest.approx(-20 * math.log10(0.8), abs=1e-4)
    assert clean.input_psnr(run, splats(1), views) == pytest.approx((same + other) / 2)
    assert clean.input_psnr(run, splats(1), []) == 0.0


def test_a_file_loses_what_is_fainter_than_the_least_alpha() -> None:
    model = replace(splats(4), logit_opacities=torch.logit(torch.tensor([1 / 256, 1 / 254, 0.5, 0.5])))
    (faint,) = findings_without_views(model)
    assert (faint.rule, faint.splats.tolist(), faint.followed) == ("invisible", [True, False, False, False], True)
    everything = (-99.0,) * 3 + (-98.0,) * 3
    _, box = findings_without_views(model, everything)
    assert (box.rule, box.splats.tolist()) == ("outside the box", [False, True, True, True])
    assert findings_without_views(model.select(torch.tensor([2]))) == []


@pytest.mark.parametrize(("change", "cleaned"), [(-0.02, True), (-0.0201, False), (0.5, True), (math.nan, False)])
def test_a_run_is_cleaned_where_left_out_views_lose_a_fiftieth_at_most(
    change: float, cleaned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clean_files, "open_run", lambda run: "run")
    monkeypatch.setattr(clean_files, "input_views", lambda run: ())
    monkeypatch.setattr(clean_files, "left_out_change", lambda run, views: change)
    monkeypatch.setattr(clean_files, "clean", lambda run: "cleaned")
    found, told = clean_files.clean_where_it_helps(Path("run"))
    assert found == ("cleaned" if cleaned else None)
    assert told == change or math.isnan(change)


@pytest.mark.parametrize("dry", [False, True])
def test_a_dry_run_and_one_that_finds_nothing_write_nothing(dry: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    wrote: list[list[bool]] = []
    run: Any = SimpleNamespace(gaussians=splats(3))
    monkeypatch.setattr(clean_files, "FinishedRun", SimpleNamespace)
    monkeypatch.setattr(clean_files, "input_views", lambda run: ())
    monkeypatch.setattr(clean_files, "replace_splats", lambda run, keep: wrote.append(keep.tolist()))
    for gone in ([True, False, False], [False] * 3):
        monkeypatch.setattr(
            clean_files, "findings", lambda *_, gone=gone: [Finding("x", torch.tensor(gone), 0.0, True)]
        )
        found = clean_files.clean(run, dry_run=dry)
        assert (found.left_out, len(found.gaussians)) == (sum(gone), 3 - sum(gone))
    assert wrote == ([] if dry else [[False, True, True]])


def test_the_first_splats_and_figures_are_kept_whatever_is_cleaned_later(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    asked: list[Path] = []
    (run / "metrics.json").write_text("first")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clean_files, "evaluate_again", asked.append)
        clean_files.measure_again(run)
        (run / "metrics.json").unlink()
        (run / "metrics.json").write_text("second")
        clean_files.measure_again(run)
        assert (run / "metrics.before-clean.json").read_text() == "first"
        (run / "splat.ply").write_text("clean")
        with pytest.raises(UsageError, match="was not cleaned"):
            clean_files.undo(run)
        (run / "splat.before-clean.ply").write_text("whole")
        clean_files.undo(run)
        assert ((run / "splat.ply").read_text(), (run / "metrics.json").read_text()) == ("whole", "first")
        assert asked == [run, run]
        (run / "splat.before-clean.ply").write_text("whole")
        clean_files.undo(run)
        assert asked == [run, run, run]


def test_a_run_is_evaluated_again_by_the_networks_it_had_and_reported_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[object] = []
    monkeypatch.setattr(clean_files, "evaluate", lambda run, vgg: done.append(vgg))
    monkeypatch.setattr(clean_files, "write_report", lambda run: done.append("report"))
    for mean in ({"lpips_vgg": 0.1}, {"lpips_vgg": None}, {}, None):
        monkeypatch.setattr(clean_files, "read_metrics", lambda run, mean=mean: {"mean": mean})
        clean_files.evaluate_again(tmp_path)
        (tmp_path / "metrics.json").touch()
        clean_files.evaluate_again(tmp_path)
        (tmp_path / "metrics.json").unlink()
    assert done == [True, False, False, False]
    (tmp_path / "metrics.json").touch()
    (tmp_path / "report.html").touch()
    clean_files.evaluate_again(tmp_path)
    assert done[4:] == [False, "report"]


def test_a_link_in_the_place_of_the_first_splats_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clean_files, "is_antialiased", lambda path: False)
    (tmp_path / "splat.before-clean.ply").symlink_to(tmp_path / "elsewhere")
    run: Any = SimpleNamespace(path=tmp_path, gaussians=splats(2))
    with pytest.raises(InputError, match="must not be a symbolic link"):
        clean_files.replace_splats(run, torch.tensor([True, False]))
    assert not (tmp_path / "splat.ply").exists()
    with pytest.raises(UsageError, match="was not cleaned"):
        clean_files.undo(tmp_path)


def test_what_goes_is_drawn_in_opaque_red() -> None:
    found = clean_files.marked(replace(splats(3), shN=torch.ones(3, 8, 3)))
    torch.testing.assert_close(rgb_from_sh0(found.sh0[:, 0]), torch.tensor([0.85, 0.1, 0.1]).expand(3, 3))
    assert float(found.opacities.min()) > 0.95
    assert not bool(found.shN.any())


def test_the_picture_shows_before_after_and_what_goes_from_three_places(tmp_path: Path) -> None:
    run = clean_files.open_run(make_run(tmp_path))
    views = clean_files.input_views(run)
    keep = torch.arange(len(run.gaussians)) > 0
    clean_files.write_picture(run, keep, views)
    with Image.open(run.path / "clean.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    height, width = 288, 360
    assert pixels.shape == (3 * height + 16, 3 * width + 16, 3)
    for gap in (slice(width, width + 8), slice(2 * width + 8, 2 * width + 16)):
        assert (pixels[:, gap] == 255).all()
    rows = [pixels[y * (height + 8) :][:height] for y in range(3)]
    panes = [[row[:, x * (width + 8) :][:, :width] for x in range(3)] for row in rows]
    assert all(np.abs(row[0] - row[1]).max() > 20 for row in panes[:1])
    assert np.abs(panes[0][0] - panes[1][0]).max() > 20
    assert np.abs(panes[1][0] - panes[2][0]).max() > 20
    red = (panes[0][2][..., 0] > 150) & (panes[0][2][..., 1] < 120)
    assert red.any()
