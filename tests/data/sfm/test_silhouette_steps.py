"""Steps of the search for coherent silhouettes, on problems whose answers are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from gsopt.data.sfm.silhouettes import Coherence, CoherentPoses, _refined
from gsopt.geometry.rigid_motion import rigid_motion

TURN, SHIFT = math.radians(1) ** -2, 0.02**-2
"""Weights of the prior: one over the variance of a turn and of a shift."""


class Problem:
    """Rays whose misses are known functions of the motions of one camera; its pose holds their sum."""

    def __init__(self, misses: Callable[[torch.Tensor], torch.Tensor], slopes: torch.Tensor) -> None:
        self.misses, self._slopes, self.asked = misses, slopes, 0
        self.viewmats = torch.zeros(1, 6, dtype=torch.float64)

    def near_optima(self, motions: torch.Tensor) -> torch.Tensor:
        return motions[0]

    def distances(self, motions: torch.Tensor, depths: torch.Tensor) -> torch.Tensor:
        assert depths is motions[0] or torch.equal(depths, motions[0])
        return motions[0]

    def jacobian(self, motions: torch.Tensor, depths: torch.Tensor, distances: torch.Tensor) -> torch.Tensor:
        assert torch.equal(depths, motions[0])
        assert torch.equal(distances, motions[0])
        self.asked += 1
        return self._slopes

    def moved(self, motions: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return motions + step


def solved(problem: Any) -> CoherentPoses:
    return _refined(problem)


def linear(first: list[float], slopes: list[float], axis: int) -> Problem:
    """Misses that change evenly with one of the six motions."""
    start, rise = (torch.tensor(values, dtype=torch.float64) for values in (first, slopes))
    matrix = torch.zeros(len(first), 6, dtype=torch.float64)
    matrix[:, axis] = rise
    return Problem(lambda motions: start + rise * motions[axis], matrix)


@pytest.mark.parametrize(("axis", "prior"), [(0, TURN), (2, TURN), (3, SHIFT), (5, SHIFT)])
def test_small_misses_are_balanced_with_the_prior(axis: int, prior: float) -> None:
    """The least of 0.05 sum (m + s x)^2 + p x^2 / 2 is at x = -0.1 sum s m / (0.1 sum s^2 + p)."""
    misses, slopes = [1.5, 1.0, 0.5], [-100.0, -200.0, 50.0]
    found = solved(linear(misses, slopes, axis))
    rays = list(zip(misses, slopes, strict=True))
    best = -0.1 * sum(m * s for m, s in rays) / (0.1 * sum(s * s for s in slopes) + prior)
    assert found.viewmats[0, axis].item() == pytest.approx(best, rel=1e-3)
    assert found.viewmats[0].count_nonzero() == 1
    assert found.before == pytest.approx(math.sqrt(sum(m * m for m in misses) / 3))
    assert found.after == pytest.approx(math.sqrt(sum((m + s * best) ** 2 for m, s in rays) / 3), rel=1e-3)


@pytest.mark.parametrize(("axis", "prior"), [(1, TURN), (4, SHIFT)])
def test_a_miss_beyond_two_px_pulls_as_one_of_two_px(axis: int, prior: float) -> None:
    """One ray misses by 10 px, less 100 a unit: 0.1 * 2 * 100 = p x."""
    found = solved(linear([10.0], [-100.0], axis))
    assert found.viewmats[0, axis].item() == pytest.approx(20 / prior, rel=0.01)


def test_poses_with_small_misses_are_not_searched() -> None:
    problem = linear([0.29, -0.29], [-100.0, 0.0], 0)
    found = solved(problem)
    assert (problem.asked, found.before, found.after) == (0, pytest.approx(0.29), pytest.approx(0.29))
    assert found.viewmats is problem.viewmats
    problem = linear([0.31, -0.31], [-100.0, 0.0], 0)
    solved(problem)
    assert problem.asked > 0


def jumping(limit: float) -> tuple[Problem, float]:
    """A problem in which a step above a share of the whole way lands where all is worse; and that way."""
    whole = 0.1 * 100 / (0.1 * 100**2 + TURN)
    last = [0.0]

    def misses(motions: torch.Tensor) -> torch.Tensor:
        place = motions[0].item()
        if abs(place - last[0]) > limit * whole:
            return torch.tensor([50.0], dtype=torch.float64)
        last[0] = place
        return torch.tensor([1.0 - 100 * place], dtype=torch.float64)

    matrix = torch.zeros(1, 6, dtype=torch.float64)
    matrix[0, 0] = -100
    return Problem(misses, matrix), whole


def test_a_step_that_leads_astray_is_tried_again_up_to_five_times_and_always_shorter() -> None:
    """Dampings are 0.01, 0.04, 0.16, 0.64 and 2.56: the last one takes 1 / 3.56 of the way, and the next 0.64 again."""
    problem, whole = jumping(0.45)
    assert solved(problem).viewmats[0, 0].item() == pytest.approx(whole, rel=0.03)
    problem, _ = jumping(0.27)
    found = solved(problem)
    assert (found.viewmats.count_nonzero(), problem.asked) == (0, 1)
    assert found.after == found.before == pytest.approx(1)


def test_the_search_ends_where_a_thousandth_of_the_cost_is_not_gained() -> None:
    """Here the first step takes 99 % of the way, and what the second one gains is less."""
    problem = linear([1.5], [-100.0], 0)
    solved(problem)
    assert problem.asked == 2


def test_a_search_has_25_steps() -> None:
    """Misses that fall by a hundredth with each step, whatever its length."""
    left = [20.0]

    def misses(motions: torch.Tensor) -> torch.Tensor:
        left[0] *= 0.98
        return torch.tensor([left[0]], dtype=torch.float64)

    problem = Problem(misses, torch.zeros(1, 6, dtype=torch.float64))
    solved(problem)
    assert problem.asked == 25


def coherence(center: tuple[float, float, float] = (1.0, 2.0, 3.0), radius: float = 2.0) -> Coherence:
    """One whose outlines nobody asks for."""
    made = object.__new__(Coherence)
    made.center, made.radius = torch.tensor(center, dtype=torch.float64), radius
    return made


def camera() -> torch.Tensor:
    viewmat = rigid_motion(torch.tensor([0.3, -0.5, 0.2, 0.1, 0.2, 0.3], dtype=torch.float64))
    viewmat[:3, 3] = torch.tensor([0.5, -1.0, 7.0], dtype=torch.float64)
    return viewmat


def test_a_turn_leaves_the_middle_of_the_object_where_it_is_seen_and_a_shift_moves_it_in_radii() -> None:
    made, viewmats = coherence(), torch.stack([camera(), torch.eye(4, dtype=torch.float64)])
    motions = torch.tensor([[0.2, -0.1, 0.3, 0, 0, 0], [0, 0, 0, 0.1, -0.2, 0.5]], dtype=torch.float64)
    turned, shifted = made.moved(viewmats, motions.flatten())
    before, after = (viewmat[:3, :3] @ made.center + viewmat[:3, 3] for viewmat in (viewmats[0], turned))
    torch.testing.assert_close(after, before)
    turn = rigid_motion(motions[0])[:3, :3]
    torch.testing.assert_close(turned[:3, :3], turn @ viewmats[0, :3, :3])
    assert (turned[:3, :3] - viewmats[0, :3, :3]).abs().max() > 0.1
    assert shifted[:3, 3].tolist() == pytest.approx([0.2, -0.4, 1.0])
    assert shifted[:3, :3].tolist() == torch.eye(3).tolist()


def test_the_depths_of_a_finer_look_lie_one_coarse_step_around_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step is 2.6 radii over 63. The best point of a ray is the one that the photo which excludes it most, excludes
    least."""
    made = coherence(radius=6.3)
    depths = torch.tensor([[1.0, 2, 3], [4, 5, 6]], dtype=torch.float64)
    distances = torch.tensor([[[0.0, 9, 9], [5, 1, 2]], [[9, -1, 5], [5, 9, 3]]], dtype=torch.float64)
    monkeypatch.setattr(made, "across", lambda viewmats: depths)
    monkeypatch.setattr(made, "distances", lambda viewmats, given: distances)
    found = made.near_optima(torch.eye(4)[None])
    assert found.shape == (2, 17)
    assert found[:, 8].tolist() == pytest.approx([3, 4])
    assert found[:, 0].tolist() == pytest.approx([3 - 0.26, 4 - 0.26])
    assert found[:, 16].tolist() == pytest.approx([3 + 0.26, 4 + 0.26])
