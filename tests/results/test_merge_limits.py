"""Steps of a merge at their limits: which photos align two runs, whose views judge which splats, where cells lie."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from finished_runs import splats

from gsopt.data.sfm.placement import Similarity
from gsopt.errors import InputError
from gsopt.results import merge
from gsopt.results.merge import Alignment, align_by_photos, better, cells_of


@pytest.mark.parametrize(
    ("degrees", "shift", "fine"),
    [(2.0, 0.0, True), (2.001, 0.0, False), (0.0, 0.05, True), (0.0, 0.0501, False), (math.nan, 0.0, False)],
)
def test_the_median_photo_stands_alike_within_two_degrees_and_a_twentieth_of_the_radius(
    degrees: float, shift: float, fine: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = SimpleNamespace(rotation_degrees=np.full(3, degrees), position=np.full(3, shift))
    monkeypatch.setattr(merge, "compare", lambda poses, fixed: error)
    monkeypatch.setattr(merge, "align", lambda poses, fixed: Similarity.identity())
    views = [SimpleNamespace(name=f"{i}", camera=SimpleNamespace(viewmats=torch.eye(4)[None])) for i in range(3)]
    first: Any = SimpleNamespace(train=views[:2], test=views[2:])
    second: Any = SimpleNamespace(train=views[2:], test=views[:2])
    if fine:
        found = align_by_photos(first, second)
        assert (found.photos, found.degrees, found.shift) == (3, degrees, shift)
    else:
        with pytest.raises(InputError, match="stand otherwise in each"):
            align_by_photos(first, second)
    with pytest.raises(InputError, match="must share 3 photos to be merged, got 2"):
        align_by_photos(first, SimpleNamespace(train=views[2:], test=views[:1]))  # type: ignore[arg-type]


def test_each_runs_own_views_judge_the_splats_of_both_in_their_own_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the second run twice as large and moved; what stays is counted."""
    alignment = Alignment(Similarity(2.0, np.eye(3), np.array([1.0, 0, 0])), 3, 0.0, 0.0)
    models = [splats(6, seed) for seed in (1, 2)]
    runs: Any = [
        SimpleNamespace(settings=SimpleNamespace(antialiased=False), gaussians=model, path=Path(name),
                        config=SimpleNamespace(data=name))
        for name, model in zip("ab", models, strict=True)
    ]  # fmt: skip
    asked: list[tuple[str, str, torch.Tensor]] = []

    def sums(run: Any, views: str, gaussians: Any) -> torch.Tensor:
        asked.append((run.path.name, views, gaussians.means))
        return torch.ones(len(gaussians), 2)

    monkeypatch.setattr(merge, "FinishedRun", SimpleNamespace)
    monkeypatch.setattr(merge, "load_scene", lambda data: SimpleNamespace(train=f"views of {data}"))
    monkeypatch.setattr(merge, "with_refined_poses", lambda scene, path: scene)
    monkeypatch.setattr(merge, "align_by_photos", lambda first, second: alignment)
    monkeypatch.setattr(merge, "error_sums", sums)
    half = torch.arange(6) < 2
    monkeypatch.setattr(merge, "better", lambda a, b, sums_a, sums_b: (half, ~half))
    found = merge.merge(*runs)
    one, two = (model.means for model in models)
    expected = [("a", "views of a", one), ("b", "views of b", (one - torch.tensor([1.0, 0, 0])) / 2)]
    expected += [("a", "views of a", 2 * two + torch.tensor([1.0, 0, 0])), ("b", "views of b", two)]
    assert [call[:2] for call in asked] == [call[:2] for call in expected]
    for (*_, means), (*_, wanted) in zip(asked, expected, strict=True):
        torch.testing.assert_close(means, wanted)
    assert found.kept == (2, 4)
    torch.testing.assert_close(found.gaussians.means, torch.cat([one[:2], 2 * two[2:] + torch.tensor([1.0, 0, 0])]))
    runs[1].settings = SimpleNamespace(antialiased=True)
    with pytest.raises(InputError, match="Train both alike"):
        merge.merge(*runs)


@pytest.mark.parametrize(("weight", "stays"), [(0.0, False), (1e-3, True), (0.5, True), (9.0, True)])
def test_a_splat_of_the_second_run_that_any_view_sees_stays_where_it_is_better(weight: float, stays: bool) -> None:
    a, b = splats(1, 1), splats(1, 1)
    kept_a, kept_b = better(a, b, torch.tensor([[4.0, 2.0]]), torch.tensor([[weight, weight * 0.25]]))
    assert (kept_a.tolist(), kept_b.tolist()) == ([not stays], [stays])


def test_a_splat_that_few_pixels_show_is_judged_by_its_mean_error_too() -> None:
    a, b = splats(1, 1), splats(1, 1)
    kept_a, kept_b = better(a, b, torch.tensor([[4.0, 2.0]]), torch.tensor([[0.5, 0.375]]))
    assert (kept_a.tolist(), kept_b.tolist()) == ([True], [False])


def test_a_draw_goes_to_the_first_run() -> None:
    a, b = splats(1, 1), splats(1, 1)
    for error, second in ((0.5, False), (0.5 * (1 - 0.9e-6), False), (0.5 * (1 - 2e-6), True)):
        kept_a, kept_b = better(a, b, torch.tensor([[1.0, 0.5]]).double(), torch.tensor([[1.0, error]]).double())
        assert (kept_a.tolist(), kept_b.tolist()) == ([not second], [second])


def test_twelve_cells_lie_along_the_largest_side_of_the_solid_splats_wherever_these_are() -> None:
    solid = torch.cartesian_prod(torch.linspace(0, 12, 25), torch.linspace(0, 3, 7), torch.zeros(1)).double()
    edge = float(cells_of(solid[:, :1].expand(-1, 3), solid)[:, 0].max())
    assert 12 <= edge <= 13
    cells = cells_of(solid, solid)
    for away in (torch.tensor([64.0, -32.0, 128.0]), torch.tensor([-512.0, 0.0, 4.0])):
        assert torch.equal(cells_of(solid + away, solid + away), cells)
    assert torch.equal(cells_of(64 * solid, 64 * solid), cells)
    assert cells_of(solid[:1], solid[:0]).tolist() == [[0, 0, 0]]


def test_the_farthest_hundredth_of_the_solid_splats_at_either_end_decides_no_cell() -> None:
    line = torch.zeros(100, 3, dtype=torch.float64)
    line[:, 0] = torch.linspace(0, 99, 100)
    far = line.clone()
    far[99, 0], far[0, 0] = 1e6, -1e6
    assert torch.equal(cells_of(line[1:99], far), cells_of(line[1:99], line))
    far[98, 0] = 1e6
    assert not torch.equal(cells_of(line[1:98], far), cells_of(line[1:98], line))
