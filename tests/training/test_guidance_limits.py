"""Guidance of a run at its limits: which pictures a report gets, which views the guard leaves out, what it asks for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scenes import ring

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.errors import InputError, NumericalError, UsageError
from gsopt.sds.prompts import Prompt, write_prompts
from gsopt.training.guided import guard, references
from gsopt.training.guided.compare_prompts import Arm, Outcome, compare_prompts
from gsopt.training.guided.session import RunGuidance, report_counts


@pytest.mark.parametrize(
    ("planned", "counts"),
    [(0, {1}), (1, {1}), (2, {1, 2}), (4, {1, 2, 3, 4}), (13, {1, 5, 9, 13}), (100, {1, 34, 67, 100})],
)
def test_pictures_are_of_the_first_guided_step_and_three_more(planned: int, counts: set[int]) -> None:
    assert report_counts(planned) == counts


def test_the_report_shows_three_uncertain_views_from_different_sides() -> None:
    """Directions at 0, 40, 50, 100, 160 and 230 degrees: cosines below 0.7 are more than 45.6 degrees apart."""
    angles = torch.tensor([0.0, 40, 50, 100, 160, 230]).deg2rad()
    forwards = torch.stack([angles.cos(), angles.sin(), torch.zeros(6)], dim=1)
    guidance: Any = SimpleNamespace(
        plan=SimpleNamespace(guided_steps=4),
        observer=SimpleNamespace(cameras=SimpleNamespace(candidates=SimpleNamespace(forwards=forwards))),
    )
    known: Any = SimpleNamespace(mean_u=torch.tensor([0.9, 0.8, 0.7, 0.6, 0.9, 0.5]))
    assert RunGuidance(guidance)._report_views(known) == [0, 4, 2]


@dataclass(frozen=True)
class _Scene:
    """The views that the guard looks at."""

    train: tuple[Any, ...]
    mirrored: tuple[Any, ...]


def held_out(count: int) -> list[Any]:
    return [SimpleNamespace(scene=None, view=SimpleNamespace(name=f"{i}")) for i in range(count)]


def asked(gains: list[float]) -> tuple[guard.Verdict, list[int]]:
    """The verdict on predictions with these gains of each left-out view, and the steps they were made for."""
    seen: list[int] = []
    left = iter(gains)

    def repair(step: int, *_: Any) -> float:
        seen.append(step)
        return next(left)

    guidance = SimpleNamespace(plan=SimpleNamespace(first_step=100, last_step=1000), repair=repair)
    trained = SimpleNamespace(
        plan=SimpleNamespace(guidance=None), model=SimpleNamespace(gaussians=None), settings=lambda: None
    )
    short: Any = SimpleNamespace(trained=lambda *_: trained, backend=None)
    setup: Any = SimpleNamespace(on=lambda *_: guidance)
    return guard._check_predictions(short, held_out(len(gains) // 4), setup), seen


@pytest.mark.parametrize(("gain", "factor"), [(0.5, 1.0), (0.499, 0.0), (-3.0, 0.0)])
def test_predictions_must_be_half_a_decibel_closer(gain: float, factor: float) -> None:
    verdict, steps = asked([gain] * 8)
    assert verdict.factor == factor
    assert steps == [100, 400, 700, 1000] * 2
    assert verdict.trials == [{"view": "0", "repair": gain}, {"view": "1", "repair": gain}]
    assert f"{gain:+.2f} dB" in verdict.reason
    assert ("0.5 are asked for" in verdict.reason) == (factor == 0)


def test_the_guard_decides_by_the_mean_of_all_views_and_levels() -> None:
    verdict, _ = asked([0.0, 0.0, 0.0, 2.0, 1.0, 1.0, 0.0, 0.0])
    assert [trial["repair"] for trial in verdict.trials] == [0.5, 0.5]
    assert verdict.factor == 1.0


def test_a_prior_that_fails_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(step: int, *_: Any) -> float:
        raise NumericalError("no number")

    guidance = SimpleNamespace(plan=SimpleNamespace(first_step=1, last_step=9), repair=fails)
    trained = SimpleNamespace(
        plan=SimpleNamespace(guidance=None), model=SimpleNamespace(gaussians=None), settings=lambda: None
    )
    short: Any = SimpleNamespace(trained=lambda *_: trained, backend=None)
    verdict = guard._check_predictions(short, held_out(1), SimpleNamespace(on=lambda *_: guidance))  # type: ignore[arg-type]
    assert (verdict.factor, verdict.reason) == (0.0, "the prior failed: no number")


@pytest.mark.parametrize(
    ("views", "guard_views", "aligned", "factor", "reason"),
    [
        (3, 0, True, 1.0, "not checked: --guidance.guard-views is 0"),
        (1, 2, True, 0.0, "off: one input view"),
        (1, 2, False, 1.0, "not checked: one input view"),
        (2, 1, True, 0.25, "asked"),
    ],
)
def test_the_guard_needs_a_view_to_leave_out(
    monkeypatch: pytest.MonkeyPatch, views: int, guard_views: int, aligned: bool, factor: float, reason: str
) -> None:
    left_out: list[str] = []

    def check(short: Any, held_out: list[Any], setup: Any) -> guard.Verdict:
        left_out.extend(one.view.name for one in held_out)
        return guard.Verdict(0.25, "asked", [])

    monkeypatch.setattr(guard, "_check_predictions", check)
    monkeypatch.setattr(guard, "short_config", lambda *_: TrainConfig())
    monkeypatch.setattr(guard, "without", lambda scene, index: SimpleNamespace(view=scene.train[index]))
    cameras = ring(views, 1.0)
    train = [SimpleNamespace(name=f"{i}", camera=cameras[i]) for i in range(views)]
    setup: Any = SimpleNamespace(prior=SimpleNamespace(aligned=aligned))
    config = TrainConfig(guidance=GuidanceConfig(guard_views=guard_views))
    verdict = guard.evaluate_guidance(config, SimpleNamespace(train=train), None, setup)  # type: ignore[arg-type]
    assert verdict.factor == factor
    assert verdict.reason.startswith(reason)
    assert len(left_out) == (guard_views if reason == "asked" else 0)


def test_the_views_that_are_left_out_are_far_from_each_other() -> None:
    cameras = ring(8, 1.0)
    scene: Any = SimpleNamespace(train=[SimpleNamespace(camera=cameras[i]) for i in range(8)])
    first, second = guard.spread_views(scene, 2)
    assert abs(first - second) == 4
    assert guard.spread_views(scene, 99) == list(range(8))


@pytest.mark.parametrize(("steps", "every", "fresh"), [(48, 2, 6), (24, 1, 3), (7, 1, 1), (240, 10, 30)])
def test_a_short_run_is_guided_24_times_at_least(steps: int, every: int, fresh: int) -> None:
    cameras = ring(1, 1.0)
    scene: Any = SimpleNamespace(train=[SimpleNamespace(camera=cameras[0])])
    config = TrainConfig(guidance=GuidanceConfig(guard_steps=steps, every=10))
    short = guard.short_config(config, scene, view_conditioned=True)
    assert (short.guidance.every, short.guidance.refresh_every, short.iterations) == (every, fresh, steps)
    assert (short.checkpoint_every, short.preview_every) == (0, 0)


def test_the_front_is_an_input_view() -> None:
    scene: Any = SimpleNamespace(train=[SimpleNamespace(camera=i) for i in range(3)])
    for named, camera in ((None, 0), (0, 0), (2, 2)):
        assert references.front_camera(GuidanceConfig(front_view=named), scene) == camera
    with pytest.raises(UsageError, match="must be below 3"):
        references.front_camera(GuidanceConfig(front_view=3), scene)


@pytest.mark.parametrize("size", [(90, 30), (30, 90), (31, 90)])
def test_a_reference_is_its_middle_square_on_white(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    pixels = np.zeros((height, width, 4), np.uint8)
    top, left, side = (height - min(size)) // 2, (width - min(size)) // 2, min(size)
    pixels[top : top + side, left : left + side] = [255, 0, 0, 255]
    Image.fromarray(pixels).save(tmp_path / "a.png")
    (found,) = references.read_references((str(tmp_path / "a.png"),), 10)
    assert found.amin((1, 2)).tolist() == pytest.approx([1, 0, 0], abs=0.1)
    assert found.amax((1, 2)).tolist() == pytest.approx([1, 0, 0], abs=0.1)  # its neighbors shine in a little
    Image.new("RGBA", (20, 20), (0, 0, 0, 0)).save(tmp_path / "b.png")
    assert float(references.read_references((str(tmp_path / "b.png"),), 10).min()) == 1.0
    assert references.read_references((), 10).shape == (0, 3, 10, 10)


def test_a_reference_of_the_largest_size_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Image.new("RGB", (20, 20)).save(tmp_path / "a.png")
    monkeypatch.setattr(references, "MAX_REFERENCE_PIXELS", 400)
    assert len(references.read_references((str(tmp_path / "a.png"),), 5)) == 1
    monkeypatch.setattr(references, "MAX_REFERENCE_PIXELS", 399)
    with pytest.raises(InputError, match="too large"):
        references.read_references((str(tmp_path / "a.png"),), 5)


@pytest.mark.parametrize(
    ("views", "rows"), [(1, [0]), (8, list(range(8))), (9, [0, 2, 4, 6, 8]), (17, [0, 3, 6, 9, 12, 15])]
)
def test_up_to_eight_input_views_are_embedded(monkeypatch: pytest.MonkeyPatch, views: int, rows: list[int]) -> None:
    seen: list[int] = []
    images = SimpleNamespace(images=None)
    monkeypatch.setattr(references, "square_views", lambda chosen, size, color: seen.extend(chosen) or images)
    monkeypatch.setattr(references, "encode", lambda *args: args[-2])
    prior: Any = SimpleNamespace(size=8, encoder=lambda: None, class_embedding_width=None)
    scene: Any = SimpleNamespace(train=tuple(range(views)))
    assert references.encoded(0.7, scene, prior, (), torch.empty(0)) == 0.7
    assert seen == rows


def test_the_mean_of_left_out_views_is_a_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = torch.zeros(2, 2, 3)
    renders = iter([(truth + 0.1, truth), (truth + 0.01, truth)])
    short: Any = SimpleNamespace(render=lambda *_: next(renders))
    assert guard._mean_psnr(short, held_out(2), None) == pytest.approx(30.0, abs=1e-3)


def test_a_left_out_view_takes_its_mirror_images_along() -> None:
    views = [SimpleNamespace(index=i) for i in range(3)]
    scene = _Scene(tuple(views), tuple(SimpleNamespace(index=i, turn=t) for t in range(2) for i in range(3)))
    left_out = guard.without(scene, 1)  # type: ignore[arg-type]
    assert left_out.view is views[1]
    assert [view.index for view in left_out.scene.train] == [0, 2]
    assert [image.index for image in left_out.scene.mirrored] == [0, 2, 0, 2]


def test_prompts_are_compared_from_two_views_on_and_with_a_prior_that_takes_words() -> None:
    """A prior without words and arms without prompts get past both: the next thing that is asked for is the scene."""
    mute: Any = SimpleNamespace(name="mute", encoder=lambda: None, aligned=False)
    words, none = Arm("words", (Prompt("a chair", source="user"),)), Arm("none", ())
    given: Any = {count: SimpleNamespace(train=[None] * count) for count in (1, 2)}
    nothing: Any = None
    with pytest.raises(UsageError, match="at least 2 input views, got 1"):
        compare_prompts(TrainConfig(), given[1], nothing, mute, [none], print)
    with pytest.raises(UsageError, match="The prior mute takes no words"):
        compare_prompts(TrainConfig(), given[2], nothing, mute, [none, words], print)
    with pytest.raises(AttributeError):
        compare_prompts(TrainConfig(), given[2], nothing, mute, [none], print)


@pytest.mark.parametrize(
    ("sides", "named", "warned"),
    [(("all", "front"), None, True), (("all", "top"), None, False), (("back", "all"), 0, False), ((), None, False)],
)
def test_prompts_for_one_side_ask_for_a_named_front(
    sides: tuple[Any, ...], named: int | None, warned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was encoded is saved beside the prompts, and its notes are told."""
    prompts, told, saved = [Prompt("a chair", view=side) for side in sides], [], []
    made = SimpleNamespace(prompts=prompts, notes=("a note",), save=saved.append)
    monkeypatch.setattr(references, "read_guidance_prompts", lambda config: prompts)
    monkeypatch.setattr(references, "encoded", lambda *_: made)
    scene: Any = SimpleNamespace(train=[SimpleNamespace(name="a.png")])
    prior: Any = SimpleNamespace(size=8)
    folder = tmp_path / "guidance"
    found = references.make_conditioning(GuidanceConfig(front_view=named), scene, prior, folder, told.append)
    assert found is made
    assert saved == [folder / "conditioning.safetensors"]
    assert (folder / "prompts.json").is_file()
    assert told[0] == "a note"
    assert [("a.png is taken for it" in text) for text in told[1:]] == [True] * warned


def test_prompts_are_those_of_the_flags_then_those_of_the_file(tmp_path: Path) -> None:
    write_prompts(tmp_path / "prompts.json", [Prompt("an oak chair", source="template")])
    config = GuidanceConfig(prior="sd21", prompt=("a", "b"), negative=("c",), prompts=str(tmp_path / "prompts.json"))
    found = references.read_guidance_prompts(config)
    assert [(one.text, one.polarity) for one in found] == [
        ("a", "positive"), ("b", "positive"), ("c", "negative"), ("an oak chair", "positive"),
    ]  # fmt: skip


def test_the_mean_of_an_arm_is_that_of_its_views() -> None:
    assert Outcome(Arm("a", ()), (20.0, 23.0, 26.0), (), None).mean == pytest.approx(23.0)
    assert Arm("a", ()).weight == 0.2
