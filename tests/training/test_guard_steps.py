"""The guard and the comparison of prompts, with stand-ins for their short runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.errors import UsageError
from gsopt.sds.prompts import Prompt
from gsopt.training.guided import compare_prompts as comparing
from gsopt.training.guided import guard
from gsopt.training.guided.compare_prompts import Arm, compare_prompts
from gsopt.training.guided.guard import ShortRun


@dataclass(frozen=True)
class Setup:
    weight: float
    conditioning: Any = None


@pytest.mark.parametrize(
    ("guided", "factor", "tried"),
    [
        ([30.0], 1.0, [1.0]),
        ([29.9, 30.5], 0.5, [1.0, 0.5]),
        ([29.9, 29.99, 30.0], 0.25, [1.0, 0.5, 0.25]),
        ([29.9, 29.9, 29.9], 0.0, [1.0, 0.5, 0.25]),
    ],
)
def test_the_weight_is_halved_until_guided_runs_are_no_worse(
    guided: list[float], factor: float, tried: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against runs without guidance at 30 dB; the weights that were tried are shares of the run's own."""
    left, weights = iter(guided), list[float | None]()

    def mean(short: Any, held_out: Any, setup: Setup | None) -> float:
        weights.append(None if setup is None else setup.weight)
        return 30.0 if setup is None else next(left)

    monkeypatch.setattr(guard, "_mean_psnr", mean)
    views: Any = [SimpleNamespace(view=SimpleNamespace(name=name)) for name in "ab"]
    verdict = guard._check_guided_runs(None, views, Setup(0.2))  # type: ignore[arg-type]
    assert verdict.factor == factor
    assert weights == [None, *(pytest.approx(0.2 * share) for share in tried)]
    assert verdict.trials == [
        {"factor": share, "plain": 30.0, "guided": value} for share, value in zip(tried, guided, strict=True)
    ]
    assert ("a, b when left out" in verdict.reason) == (factor > 0)
    if factor:
        assert verdict.reason.startswith(f"{guided[-1] - 30:+.2f} dB")


def test_a_short_run_takes_all_its_steps_with_or_without_guidance(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []

    class Steps:
        def __init__(self, plan: Any, scene: Any, gaussians: Any, backend: Any, guidance: Any) -> None:
            self.step, self.plan = 0, plan
            made.append((gaussians, guidance))

        def advance(self) -> None:
            self.step += 1

    plan = SimpleNamespace(
        init="init", schedule=SimpleNamespace(max_sh_degree=1, iterations=7), seed=3, guidance="plans"
    )
    monkeypatch.setattr(guard.RunPlan, "of", staticmethod(lambda config, scene: plan))
    monkeypatch.setattr(guard, "first_gaussians", lambda scene, init, degree, seed: ((init, degree, seed), "said"))
    monkeypatch.setattr(guard, "RunGuidance", lambda guidance: ("guided by", guidance))
    monkeypatch.setattr(guard, "Trainer", Steps)
    setup: Any = SimpleNamespace(on=lambda scene, backend, plans: (scene, plans))
    short = ShortRun(TrainConfig(), "backend")  # type: ignore[arg-type]
    assert short.trained("scene", None).step == 7  # type: ignore[arg-type]
    assert short.trained("scene", setup).step == 7  # type: ignore[arg-type]
    assert made == [(("init", 1, 3), None), (("init", 1, 3), ("guided by", ("scene", "plans")))]


def test_a_left_out_view_is_drawn_at_the_resolution_of_the_short_run_on_white(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    trainer = SimpleNamespace(
        plan=SimpleNamespace(schedule=SimpleNamespace(downscale=lambda step: 4 if step == 1 else 1)),
        model=SimpleNamespace(gaussians="splats"),
        settings=lambda: "settings",
    )

    class Images:
        def __init__(self, views: Any, fixed: torch.Tensor, budget: int) -> None:
            asked.append((views, fixed.tolist(), budget))

        def get(self, index: int, factor: int, background: torch.Tensor) -> Any:
            asked.append((index, factor, background.tolist()))
            return SimpleNamespace(camera="camera", colors="photo")

    frame = SimpleNamespace(colors=torch.tensor([[[-0.5, 0.5, 1.5]]]))
    backend: Any = SimpleNamespace(forward=lambda *args: (asked.append(args[:3]), frame)[1])
    monkeypatch.setattr(guard, "Targets", Images)
    monkeypatch.setattr(ShortRun, "trained", lambda self, scene, setup: trainer)
    left_out: Any = SimpleNamespace(scene="others", view="view")
    picture, photo = ShortRun(TrainConfig(), backend).render(left_out, None)
    assert picture.flatten().tolist() == [0.0, 0.5, 1.0]
    assert photo == "photo"
    assert asked == [(["view"], [1, 1, 1], 0), (0, 4, [1, 1, 1]), ("splats", "camera", "settings")]


def compared(arms: list[Arm], views: int, guard_views: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, list[str]]:
    """Arms on a scene of so many views; an arm's renders are off by a tenth of its weight."""
    told: list[str] = []

    def render(self: Any, left_out: Any, setup: Setup | None) -> tuple[torch.Tensor, torch.Tensor]:
        truth = torch.full((2, 2, 3), 0.5)
        return truth + 0.1 * (1.0 if setup is None else setup.weight), truth

    def setup(config: Any, scene: Any, prior: Any, arm: Arm, report: Any) -> Setup:
        prompts = [SimpleNamespace(score=score) for score in (0.25, 0.75, None)]
        return Setup(arm.weight, SimpleNamespace(prompts=prompts if arm.prompts else []))

    monkeypatch.setattr(comparing, "with_mirrors", lambda config, scene: scene)
    monkeypatch.setattr(comparing, "short_config", lambda *_: TrainConfig())
    monkeypatch.setattr(comparing, "spread_views", lambda scene, count: list(range(count)))
    monkeypatch.setattr(
        comparing, "without", lambda scene, i: SimpleNamespace(view=SimpleNamespace(name=f"{i}"), scene=None)
    )
    monkeypatch.setattr(comparing.ShortRun, "render", render)
    monkeypatch.setattr(comparing, "_setup", setup)
    config = TrainConfig(guidance=GuidanceConfig(guard_views=guard_views))
    prior: Any = SimpleNamespace(name="p", encoder=lambda: "encoder", aligned=False)
    scene: Any = SimpleNamespace(train=[None] * views)
    return compare_prompts(config, scene, None, prior, arms, told.append), told  # type: ignore[arg-type]


@pytest.mark.parametrize(("guard_views", "views"), [(0, 1), (1, 1), (3, 3)])
def test_every_arm_meets_the_same_left_out_views(guard_views: int, views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One at least; an arm of weight 0 is not guided and has no score, another one the mean of its known scores."""
    words = (Prompt("a chair", source="user"),)
    arms = [Arm("none", (), weight=0.0), Arm("words", words, weight=0.1), Arm("bare", (), weight=0.01)]
    found, told = compared(arms, 5, guard_views, monkeypatch)
    assert found.views == tuple(f"{i}" for i in range(views))
    assert len(found.truths) == views
    assert [len(outcome.psnrs) for outcome in found.outcomes] == [views] * 3
    assert [len(outcome.pictures) for outcome in found.outcomes] == [views] * 3
    assert [outcome.mean for outcome in found.outcomes] == pytest.approx([20, 40, 60], abs=0.01)
    assert [outcome.alignment for outcome in found.outcomes] == [None, 0.5, None]
    assert told[0] == f"none: 20.00 dB on {views} left-out views"


def test_two_views_are_enough_to_compare_and_one_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert compared([Arm("none", ())], 2, 1, monkeypatch)[0].views == ("0",)
    with pytest.raises(UsageError, match="at least 2 input views, got 1"):
        compared([Arm("none", ())], 1, 1, monkeypatch)


def test_an_arm_is_encoded_without_the_view_that_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(comparing, "read_references", lambda paths, size: (paths, size))
    monkeypatch.setattr(comparing, "encoded", lambda *args: (asked.append(args), "conditioning")[1])
    monkeypatch.setattr(comparing, "front_camera", lambda config, scene: f"front of {scene}")
    prior: Any = SimpleNamespace(size=16)
    config = replace(GuidanceConfig(), image_weight=0.75)
    arm = Arm("a", (Prompt("a chair", source="user"),), ("ref.png",), 0.4)
    found = comparing._setup(config, "others", prior, arm, print)  # type: ignore[arg-type]
    assert asked == [(0.75, "others", prior, arm.prompts, (("ref.png",), 16))]
    assert (found.weight, found.front, found.conditioning) == (0.4, "front of others", "conditioning")
