"""Runs that are guided: the same bits after a resume, statistics untouched, and nothing loaded where lambda is 0."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic_priors import PixelPrior, gaussian_posterior
from tiny_scenes import tiny_config, write_dataset

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig, OptimizerConfig, TrainConfig
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.events import read_events
from gsopt.sds.candidate_views import square_views
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.priors.protocol import Condition
from gsopt.training.guided import start
from gsopt.training.loop import train
from gsopt.training.plan import RunPlan
from gsopt.training.trainer import Trainer

GUIDANCE = GuidanceConfig(
    prior="toy/prior", start=0.2, stop=1.0, every=2, min_uncertainty=0.0, guard_views=0, guidance_scale=1.0
)


@pytest.fixture
def prior(monkeypatch: pytest.MonkeyPatch) -> PixelPrior:
    toy = PixelPrior(gaussian_posterior(0.2, 0.5), size=16)
    monkeypatch.setattr(start, "open_prior", lambda name, config: toy)
    return toy


def config(dataset: Path, **changes: object) -> TrainConfig:
    return tiny_config(dataset, guidance=replace(GUIDANCE, **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("policy", ["sds", "recon", "sdi"])
def test_stopped_and_resumed_is_the_run_that_never_stopped(
    policy: str, dataset: Path, tmp_path: Path, prior: PixelPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    guided = config(dataset, policy=policy)
    train(guided, tmp_path / "whole")
    original = Trainer._update

    def update(trainer: Trainer, *args) -> None:
        if trainer.step == 17:
            (tmp_path / "run" / "stop").touch()
        original(trainer, *args)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_update", update)
        assert train(guided, tmp_path / "run").stopped
    train(guided, tmp_path / "run", resume=True)
    whole, resumed = ((tmp_path / name / "splat.ply").read_bytes() for name in ("whole", "run"))
    assert whole == resumed
    train(tiny_config(dataset, guidance=GuidanceConfig(lambda_sds=0)), tmp_path / "plain")
    assert (tmp_path / "plain" / "splat.ply").read_bytes() != whole


def test_guidance_reaches_the_parameters_and_not_the_statistics(
    dataset: Path, tmp_path: Path, prior: PixelPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Density control takes note before guidance is added, and guidance leaves means2d as it is."""
    from gsopt.training.guided.session import RunGuidance

    original, seen = RunGuidance.add, []

    def add(guidance, step, gaussians, settings, gradients) -> None:
        before = gradients.means2d.clone(), gradients.sh0.clone()
        original(guidance, step, gaussians, settings, gradients)
        seen.append((torch.equal(gradients.means2d, before[0]), torch.equal(gradients.sh0, before[1])))

    monkeypatch.setattr(RunGuidance, "add", add)
    train(config(dataset), tmp_path / "run")
    assert all(statistics for statistics, _ in seen)
    assert sum(not same for _, same in seen) == 13


def test_the_run_keeps_what_guided_it(dataset: Path, tmp_path: Path, prior: PixelPrior) -> None:
    train(config(dataset), tmp_path / "run")
    folder = tmp_path / "run" / "guidance"
    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["guided"], summary["wanted"], summary["lambda_sds"]) == (13, 13, 0.2)
    assert (folder / "conditioning.safetensors").is_file()
    assert len(list(folder.glob("before_*.png"))) == len(list(folder.glob("after_*.png"))) > 0
    assert len(list(folder.glob("step_*_proposal.png"))) == 4
    told = [event for event in read_events(tmp_path / "run" / "events.jsonl")[0] if event["kind"] == "started"]
    assert told[0]["guidance"]["prior"] == "toy/prior"


def test_a_prior_that_answers_nan_never_loses_the_reconstruction(
    dataset: Path, tmp_path: Path, prior: PixelPrior
) -> None:
    prior.answer = lambda x_t, a, c: torch.full_like(x_t, float("nan"))
    bands = OptimizerConfig(sh_degree_every=9)
    assert train(replace(config(dataset), optimizer=bands), tmp_path / "run").steps == 30
    train(tiny_config(dataset, optimizer=bands), tmp_path / "plain")
    guided, plain = ((tmp_path / name / "splat.ply").read_bytes() for name in ("run", "plain"))
    assert guided == plain
    assert "without guidance" in (tmp_path / "run" / "events.jsonl").read_text()


def test_a_refused_run_is_the_unguided_one(dataset: Path, tmp_path: Path, prior: PixelPrior) -> None:
    prior.answer = lambda x_t, a, c: 2 * c.render[:3] - 1  # knows nothing more
    bands = OptimizerConfig(sh_degree_every=9)
    train(replace(config(dataset, guard_views=1, guard_steps=20), optimizer=bands), tmp_path / "run")
    assert guard_of(tmp_path / "run")["factor"] == 0
    train(tiny_config(dataset, optimizer=bands), tmp_path / "plain")
    guided, plain = ((tmp_path / name / "splat.ply").read_bytes() for name in ("run", "plain"))
    assert guided == plain


def guard_of(run: Path) -> dict:
    return json.loads((run / "config.json").read_text())["guidance"]["guard"]


def test_the_guard_lowers_what_makes_short_runs_worse(dataset: Path, tmp_path: Path, prior: PixelPrior) -> None:
    """A text-to-image prior is weighed by guided short runs."""
    prior.aligned = False
    prior.answer = lambda x_t, a, c: -torch.ones_like(x_t)  # everything is black
    hurting = config(dataset, guard_views=1, guard_steps=40, lambda_sds=50.0, weighting="x0", clip_rms=0.0)
    train(hurting, tmp_path / "run")
    guard = guard_of(tmp_path / "run")
    assert guard["factor"] < 1
    assert guard["trials"][0]["guided"] < guard["trials"][0]["plain"]


@pytest.mark.parametrize(("share", "factor"), [(0.5, 1.0), (0.01, 0.0), (-0.1, 0.0)])
def test_the_guard_asks_a_view_conditioned_prior_about_left_out_views(
    share: float, factor: float, dataset: Path, tmp_path: Path, prior: PixelPrior
) -> None:
    """One that takes this share of a render's error away repairs by -20 log10(1 - share) dB: enough or not."""
    views = load_scene(DataConfig(path=str(dataset))).train

    def answer(x_t: torch.Tensor, a: torch.Tensor, condition: Condition) -> torch.Tensor:
        assert condition.render is not None
        assert condition.camera is not None
        same = [v for v in views if torch.allclose(v.camera.viewmats, condition.camera.viewmats)]
        render = condition.render[:3]
        truth = square_views(same, 16, torch.ones(3)).images[0] if same else render
        return 2 * (render + share * (truth - render)) - 1

    prior.answer = answer
    train(config(dataset, guard_views=2, guard_steps=20), tmp_path / "run")
    guard = guard_of(tmp_path / "run")
    assert guard["factor"] == factor
    assert len(guard["trials"]) == 2
    for trial in guard["trials"]:
        assert trial["repair"] == pytest.approx(-20 * math.log10(1 - share), abs=0.05)
    guided = json.loads((tmp_path / "run" / "guidance" / "summary.json").read_text())["guided"]
    assert (guided > 0) == (factor > 0)


def test_with_one_input_view_no_one_can_say_whether_a_view_conditioned_prior_helps(
    dataset: Path, tmp_path: Path, prior: PixelPrior
) -> None:
    one = config(dataset, guard_views=2)
    train(replace(one, data=replace(one.data, views=1)), tmp_path / "run")
    assert guard_of(tmp_path / "run")["factor"] == 0


def test_a_prior_that_fails_the_guard_by_failing_is_off(dataset: Path, tmp_path: Path, prior: PixelPrior) -> None:
    prior.answer = lambda x_t, a, c: torch.full_like(x_t, float("nan"))
    train(config(dataset, guard_views=1, guard_steps=20), tmp_path / "run")
    guard = guard_of(tmp_path / "run")
    assert guard["factor"] == 0
    assert "not finite" in guard["reason"] or "predicted nan" in guard["reason"]


def test_a_corrupt_reference_image_stops_before_any_training(dataset: Path, tmp_path: Path, prior: PixelPrior) -> None:
    (tmp_path / "ref.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    with pytest.raises(InputError, match=r"ref\.png"):
        train(config(dataset, ref_image=(str(tmp_path / "ref.png"),)), tmp_path / "run")


@pytest.mark.parametrize(("asked", "reason"), [(0.0, "lambda_sds is 0"), (None, "nobody asked for a prior")])
def test_where_nobody_asks_nothing_of_diffusion_is_loaded_and_the_reason_is_told(
    asked: float | None, reason: str, dataset: Path, tmp_path: Path
) -> None:
    import subprocess

    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from pathlib import Path\nfrom tiny_scenes import tiny_config\nfrom gsopt.training.loop import train\n"
        "from gsopt.config.guidance import GuidanceConfig\n"
        f"config = tiny_config(Path({str(dataset)!r}), iterations=2, guidance=GuidanceConfig(lambda_sds={asked}))\n"
        f"train(config, Path({str(tmp_path / 'run')!r}))\n"
        "assert not {'diffusers', 'transformers', 'huggingface_hub'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    started = read_events(tmp_path / "run" / "events.jsonl")[0][0]
    assert started["guidance"]["prior"] is None
    assert reason in started["guidance"]["reason"]
    plan = json.loads((tmp_path / "run" / "config.json").read_text())["plan"]
    assert plan["prior"] == {"name": None, "weight": 0.0, "reason": started["guidance"]["reason"]}


@pytest.mark.usefixtures("embedded")
@pytest.mark.parametrize("views", [4, 6, 8])
def test_a_run_that_nobody_asked_to_guide_has_the_bits_of_lambda_0(views: int, tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "scene", train=views)
    for name, guidance in (("default", GuidanceConfig()), ("zero", GuidanceConfig(lambda_sds=0.0))):
        train(tiny_config(data, guidance=guidance), tmp_path / name)
    default, zero = ((tmp_path / name / "splat.ply").read_bytes() for name in ("default", "zero"))
    assert default == zero


def test_words_of_a_run_that_was_broken_off_do_not_guide_the_next_one(
    dataset: Path, tmp_path: Path, prior: PixelPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(start, "evaluate_guidance", lambda *rest: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train(config(dataset, prompt=("a cat",)), tmp_path / "run")
    train(config(dataset, prompt=("a dog",)), tmp_path / "run")
    folder = tmp_path / "run" / "guidance"
    assert [prompt.text for prompt in Conditioning.load(folder / "conditioning.safetensors").prompts] == ["a dog"]


def test_a_run_that_is_stopped_while_the_guard_works_ends_at_step_0_and_can_be_resumed(
    dataset: Path, tmp_path: Path, prior: PixelPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    guided = config(dataset, guard_views=1, guard_steps=20)
    original = start.evaluate_guidance

    def evaluate(*args):
        (tmp_path / "run" / "stop").touch()
        return original(*args)

    with monkeypatch.context() as patch:
        patch.setattr(start, "evaluate_guidance", evaluate)
        assert train(guided, tmp_path / "run").stopped
    last = read_events(tmp_path / "run" / "events.jsonl")[0][-1]
    assert (last["kind"], last["step"]) == ("stopped", 0)
    train(guided, tmp_path / "run", resume=True)
    train(guided, tmp_path / "whole")
    whole, resumed = ((tmp_path / name / "splat.ply").read_bytes() for name in ("whole", "run"))
    assert whole == resumed


def test_the_resolved_plan_stands_in_config_json(dataset: Path, tmp_path: Path, prior: PixelPrior) -> None:
    train(config(dataset), tmp_path / "run")
    document = json.loads((tmp_path / "run" / "config.json").read_text())
    plan = RunPlan.of(config(dataset), load_scene(DataConfig(path=str(dataset))))
    assert document["plan"] == plan.to_dict()
    assert None not in _leaves(document["plan"])


def _leaves(value: object) -> list[object]:
    if isinstance(value, dict):
        value = list(value.values())
    return [leaf for item in value for leaf in _leaves(item)] if isinstance(value, list) else [value]
