"""One step of the trainer, part by part: what each part is given, when it is due, and what a checkpoint brings back."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import SIZE, cloud, tiny_config

from gsopt.config.train import DensityConfig, ScheduleConfig, SparseConfig
from gsopt.data.scene import Scene, load_scene
from gsopt.geometry.morton import morton_order
from gsopt.raster.api import make_backend
from gsopt.training import trainer as parts
from gsopt.training.checkpoint import Checkpoint
from gsopt.training.plan import RunPlan
from gsopt.training.schedule import Flatness
from gsopt.training.trainer import Trainer


@pytest.fixture(scope="module")
def scene(dataset: Path) -> Scene:
    return load_scene(str(dataset))


def made(scene: Scene, count: int = 30, **changes: Any) -> Trainer:
    """A trainer of many views whose plan has these fields changed."""
    config = tiny_config(Path("unused"), sparse=SparseConfig(below_views=0), schedule=ScheduleConfig(coarse_until=()))
    plan = replace(RunPlan.of(config, scene), **changes)
    return Trainer(plan, scene, cloud(count, seed=2), make_backend("cpu", 1))


class Told:
    """A stand-in that writes down what it is asked."""

    def __init__(self, **answers: Any) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._answers = answers

    def __getattr__(self, name: str) -> Any:
        def answer(*args: Any, **_: Any) -> Any:
            self.calls.append((name, *args))
            found = self._answers.get(name)
            return found(*args) if callable(found) else found

        return answer

    def named(self, name: str) -> list[tuple[Any, ...]]:
        return [call[1:] for call in self.calls if call[0] == name]


@torch.no_grad()
def test_density_control_sees_the_gradients_of_every_watched_step_by_the_whole_image(scene: Scene) -> None:
    trainer = made(scene)
    trainer._density = Told(refine=lambda step, model: model, watches=lambda step, count: step != 2)  # type: ignore[assignment]
    for seen in (1, 1, 2):
        trainer.advance()
        calls = trainer._density.named("after_backward")  # type: ignore[attr-defined]
        assert len(calls) == seen
        gradients, radii, width, height = calls[-1]
        assert (width, height) == (SIZE, SIZE)
        assert gradients is trainer._spent
        assert radii.shape == (30, 2)
    assert trainer._density.named("watches") == [(1, 30), (2, 30), (3, 30)]  # type: ignore[attr-defined]
    assert len(trainer._density.named("after_step")) == 3  # type: ignore[attr-defined]


def ending(step: int, **changes: Any) -> Any:
    """The trainer of a run of 100 steps that settles in 5 once its loss is flat."""
    schedule = SimpleNamespace(iterations=100, settling=5, is_complete=lambda at: at >= 30)
    fields = {"step": step, "_last": 100, "_schedule": schedule, "_flatness": Told(update=True)}
    return SimpleNamespace(**{**fields, "plan": SimpleNamespace(stop_when_flat=True), **changes})


@pytest.mark.parametrize(("step", "last"), [(30, 35), (94, 99), (95, 100), (99, 100), (29, 100)])
def test_a_flat_run_ends_when_it_has_settled_and_not_after_its_last_step(step: int, last: int) -> None:
    run = ending(step)
    Trainer._end_when_flat(run, 0.5)
    assert run._last == last
    assert run._flatness.named("update") == ([(0.5,)] if step >= 30 else [])


def test_a_run_that_is_not_flat_or_must_not_end_or_ends_already_goes_on() -> None:
    for changes in ({"_flatness": Told(update=False)}, {"plan": SimpleNamespace(stop_when_flat=False)}):
        run = ending(40, **changes)
        Trainer._end_when_flat(run, 0.5)
        assert run._last == 100
    settling = ending(40, _last=44)
    Trainer._end_when_flat(settling, 0.5)
    assert settling._last == 44
    assert settling._flatness.calls == []


@torch.no_grad()
def test_every_step_tells_its_loss_to_what_watches_it(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that rests too: it passes with the last loss of its view, and computes nothing."""
    flat: list[float] = []
    trainer = made(scene)
    monkeypatch.setattr(trainer, "_end_when_flat", flat.append)
    loss, name = trainer.advance()
    index = next(i for i, view in enumerate(scene.train) if view.name == name)
    assert flat == [loss]
    assert float(trainer._resting.last[index]) == loss
    before = trainer.model.gaussians.means.clone()
    monkeypatch.setattr(trainer, "_rests", lambda index: True)
    changed = Told()
    monkeypatch.setattr(trainer, "_change_set", lambda: changed.set())
    trainer._resting.last[:] = [0.0, 1.0, 2.0, 3.0, 4.0]
    loss, name = trainer.advance()
    assert scene.train[int(loss)].name == name
    assert flat[1:] == [loss]
    assert len(changed.calls) == 1
    assert torch.equal(trainer.model.gaussians.means, before)


@pytest.mark.parametrize("wanted", [False, True])
@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("settled", [False, True])
def test_a_view_rests_where_it_is_wanted_nobody_guides_and_the_set_is_settled(
    wanted: bool, guided: bool, settled: bool
) -> None:
    run: Any = SimpleNamespace(
        plan=SimpleNamespace(rest_converged=wanted),
        _guidance=object() if guided else None,
        step=7,
        _schedule=SimpleNamespace(is_settled=lambda step: settled and step == 7),
        _resting=Told(skips=True),
    )
    assert Trainer._rests(run, 3) == (wanted and settled and not guided)


def change(
    refined: bool,
    floaters: bool,
    *,
    guided: bool = True,
    residual: bool = True,
    turns: bool = False,
    alpha: bool = True,
    haze: bool = False,
    distance: float = 0.5,
) -> Any:
    """A run that changes its set of Gaussians in step 9, and all that it asked for."""
    old, new = (SimpleNamespace(gaussians=cloud(count, seed=count)) for count in (20, 25))
    log = Told(floater_sigmas=3.0, prunes_floaters=floaters, turns_over=turns, removes_haze=haze)
    log._answers["refine"] = lambda step, model: new if refined else model
    plan = SimpleNamespace(residual_bands=residual, antialiased=True, haze_distance=distance)
    run: Any = SimpleNamespace(plan=plan, step=9, _last=30, model=old, calls=log, backend=None)
    run._bands = run._schedule = run._density = log
    run._guidance = Told() if guided else None
    run._make_room = lambda: log.make_room()
    run._cameras, run.scene = lambda: ["the input views' cameras"], SimpleNamespace(has_alpha=alpha)
    run._remove_floaters = lambda: Trainer._remove_floaters(run)
    run._remove = lambda found: Trainer._remove(run, found)
    run._select = lambda rows: log.select(rows)
    Trainer._change_set(run)
    run.expected = new if refined else old
    return run


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize(("refined", "floaters"), [(False, False), (True, False), (False, True), (True, True)])
def test_gaussians_are_put_in_order_after_every_change_of_their_set_and_only_then(
    refined: bool, floaters: bool, alpha: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was summed over the rows before is forgotten then, by the bands and by the guidance."""
    alone = torch.zeros(25 if refined else 20, dtype=torch.bool)
    alone[3] = True
    asked: list[float] = []

    def found(gaussians: Any, sigmas: float, silhouettes: Any, backend: Any, *, antialiased: bool) -> torch.Tensor:
        assert silhouettes == ["the input views' cameras"] * alpha
        assert antialiased
        asked.append(sigmas)
        return alone

    monkeypatch.setattr(parts, "floaters", found)
    run = change(refined, floaters, alpha=alpha)
    moved = refined or floaters
    selects = [rows for (rows,) in run.calls.named("select")]
    assert len(selects) == int(floaters) + int(moved)
    if floaters:
        assert torch.equal(selects[0], ~alone)
        assert asked == [3.0]
    if moved:
        assert torch.equal(selects[-1], morton_order(run.expected.gaussians.means))
    assert len(run.calls.named("forget")) == len(run._guidance.named("forget")) == int(moved)
    assert run.model is run.expected


@pytest.mark.parametrize(("due", "distance"), [(True, 0.5), (False, 0.5), (True, 0.0)])
def test_haze_is_removed_where_it_is_due_and_cameras_look_at_one_place(
    due: bool, distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(gaussians: Any, cameras: Any, near: float) -> torch.Tensor:
        assert (cameras, near) == (["the input views' cameras"], distance)
        return torch.arange(20) == 4

    monkeypatch.setattr(parts, "haze", found)
    run = change(False, False, haze=due, distance=distance)
    selects = [rows for (rows,) in run.calls.named("select")]
    if not (due and distance > 0):
        assert selects == []
        return
    assert run.calls.named("removes_haze") == [(9, 30)]
    assert torch.equal(selects[0], torch.arange(20) != 4)
    assert torch.equal(selects[1], morton_order(run.expected.gaussians.means))


def test_bands_decide_and_room_is_made_where_they_are_due() -> None:
    asked = change(False, False, turns=True).calls
    assert asked.named("decide") == [(9,)]
    assert asked.named("make_room") == [()]
    asked = change(True, False, residual=False, guided=False).calls
    assert asked.named("decide") == asked.named("make_room") == []


@pytest.mark.parametrize(("count", "turnover", "made_room"), [(99, 0.2, True), (98, 0.2, False), (100, 0.0, False)])
def test_room_is_made_where_99_of_100_places_are_taken(
    count: int, turnover: float, made_room: bool, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    def add(gaussians: Any, cameras: list[Any], backend: Any, *, antialiased: bool) -> str:
        seen.extend(cameras)
        return "values"

    monkeypatch.setattr(parts, "contributions", add)
    monkeypatch.setattr(parts, "least", lambda values, share: torch.tensor([values == "values", share != 0.2]))
    chosen: list[Any] = []
    run: Any = SimpleNamespace(
        plan=SimpleNamespace(density=SimpleNamespace(turnover=turnover, max_gaussians=100), antialiased=False),
        model=SimpleNamespace(gaussians=None, __len__=None),
        scene=scene,
        backend=None,
        _select=lambda rows: chosen.append(rows.tolist()),
    )
    run.model = type("Model", (), {"gaussians": None, "__len__": lambda self: count})()
    run._cameras = lambda: Trainer._cameras(run)
    Trainer._make_room(run)
    assert chosen == ([[False, True]] if made_room else [])
    assert len(seen) == (len(scene.train) if made_room else 0)


def test_views_and_mirror_images_have_their_place_in_order_and_rest(scene: Scene) -> None:
    """Two of the three images are drawn in an epoch; a window of flatness is whole epochs, 100 steps at least."""
    images = tuple(replace(view, mirrored=True, name=f"m{view.name}") for view in scene.train[:3])
    trainer = made(replace(scene, mirrored=images), extra_per_epoch=2)
    assert len(trainer._resting.last) == len(trainer._resting.resting) == 8
    assert trainer._flatness == Flatness.of(7) == Flatness(window=105)
    epoch = [trainer._order.next() for _ in range(7)]
    assert set(range(5)) < set(epoch) < set(range(8))
    assert len(set(epoch)) == 7


@torch.no_grad()
@pytest.mark.parametrize(("weight", "known", "asked"), [(0.5, True, True), (0.0, True, False), (0.5, False, False)])
def test_depths_are_drawn_where_they_are_weighed_and_known(
    scene: Scene, weight: float, known: bool, asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped = tuple(replace(view, depth=torch.rand(4, 4) if known else None) for view in scene.train)
    given = replace(scene, train=mapped)
    trainer = made(given)
    trainer.plan = replace(trainer.plan, weights=replace(trainer.plan.weights, depth=weight))
    wanted: list[bool] = []
    forward = trainer.backend.forward

    def note(*args: Any, depth: bool = False, **named: Any) -> Any:
        wanted.append(depth)
        return forward(*args, depth=depth, **named)

    monkeypatch.setattr(trainer.backend, "forward", note)
    trainer.advance()
    assert wanted == [asked]


@torch.no_grad()
def test_agreed_depths_are_drawn_up_to_their_last_step(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = made(replace(scene, train=tuple(replace(view, depth=torch.rand(4, 4)) for view in scene.train)))
    weights = replace(trainer.plan.weights, depth=0.0, agreed=0.1)
    trainer.plan = replace(trainer.plan, weights=weights)
    trainer._schedule = replace(trainer._schedule, agreed_until=2)
    wanted: list[bool] = []
    forward = trainer.backend.forward
    monkeypatch.setattr(
        trainer.backend, "forward", lambda *args, depth: wanted.append(depth) or forward(*args, depth=depth)
    )
    for _ in range(4):
        trainer.advance()
    assert wanted == [True, True, False, False]


@torch.no_grad()
@pytest.mark.parametrize("distance", [0.0, 2.5])
def test_gradients_weaken_near_a_camera_where_a_distance_is_set(
    scene: Scene, distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    monkeypatch.setattr(parts, "weaken_near", lambda gradients, means, camera, near: asked.append(near))
    made(scene, near_distance=distance).advance()
    assert asked == [distance] * (distance > 0)


@torch.no_grad()
@pytest.mark.parametrize(("absgrad", "watches"), list(itertools.product([True, False], repeat=2)))
def test_absolute_gradients_are_computed_for_watched_steps_that_want_them(
    scene: Scene, absgrad: bool, watches: bool
) -> None:
    trainer = made(scene)
    trainer.plan = replace(trainer.plan, density=replace(trainer.plan.density, absgrad=absgrad))
    trainer._density = Told(refine=lambda step, model: model, watches=watches)  # type: ignore[assignment]
    trainer.advance()
    assert trainer._spent is not None
    assert (trainer._spent.means2d_abs is not None) == (absgrad and watches)


@torch.no_grad()
@pytest.mark.parametrize(("color", "shown"), [(1.0, True), (0.3, False)])
def test_only_photos_count_in_the_shown_loss(scene: Scene, color: float, shown: bool) -> None:
    dim = replace(scene, train=tuple(replace(view, color=color) for view in scene.train))
    trainer = made(dim)
    trainer.advance()
    assert (trainer.means.loss is not None) == shown


@torch.no_grad()
def test_the_bands_drawn_are_those_of_the_schedule_or_of_the_residual(scene: Scene) -> None:
    trainer = made(scene, residual_bands=False)
    trainer.step = 1001
    assert trainer.settings().sh_degree == trainer._schedule.sh_degree(1001) > 0
    residual = made(scene, residual_bands=True)
    residual.step = 1001
    assert residual.settings().sh_degree == 0
    residual._bands.degree = 2
    assert residual.settings().sh_degree == 2


@torch.no_grad()
def test_the_first_gaussians_keep_to_the_budget_and_stand_in_order(scene: Scene) -> None:
    density = DensityConfig(max_gaussians=25)
    config = tiny_config(Path("unused"), density=density, sparse=SparseConfig(below_views=0))
    for count in (24, 25, 26):
        trainer = Trainer(RunPlan.of(config, scene), scene, cloud(count, seed=2), make_backend("cpu", 1))
        means = trainer.model.gaussians.means
        assert len(means) == min(count, 25)
        assert torch.equal(morton_order(means), torch.arange(len(means)))


@torch.no_grad()
def test_a_resumed_trainer_has_all_that_the_next_step_depends_on(scene: Scene) -> None:
    """Also what a short run hardly shows: resting views, the window of flatness, bands, the shown loss."""
    trainer = made(scene, stop_when_flat=True, residual_bands=True)
    for _ in range(7):
        trainer.advance()
    trainer._resting.resting[2] = True
    trainer._resting.last[:] = [0.0, 1.0, 2.0, 3.0, 4.0]
    trainer._flatness.total, trainer._flatness.count, trainer._flatness.stale = 3.5, 4, 2
    trainer._flatness.best, trainer._last = 0.25, 21
    tensors, meta = trainer.state()
    kept = {name: tensor.clone() for name, tensor in tensors.items()}
    again = Trainer.resumed(trainer.plan, scene, trainer.backend, Checkpoint(Path("a"), kept, meta))
    found, noted = again.state()
    assert noted == meta
    assert set(found) == set(tensors)
    for name, tensor in found.items():
        assert torch.equal(tensor, tensors[name]), name
    assert again._flatness == trainer._flatness
    assert (again.step, again._last, again.finished) == (7, 21, False)
    assert again.means == trainer.means
    for one in (trainer, again):
        one.step = 20
        assert not one.finished
        one.step = 21
        assert one.finished


@torch.no_grad()
@pytest.mark.parametrize("weights", list(itertools.product([0.0, 0.01], [0.0, 0.02], [0.0, 0.03])))
def test_haze_and_size_are_weighed_by_their_own_weights(
    scene: Scene, weights: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, asked = made(scene), dict[str, float]()
    monkeypatch.setattr(parts, "add_opacity_gradient", lambda v, logits, weight: asked.update(opacity=weight))
    monkeypatch.setattr(parts, "add_scale_gradient", lambda v, logs, weight: asked.update(scale=weight))
    monkeypatch.setattr(parts, "add_area_gradient", lambda v, logs, weight: asked.update(area=weight))
    given = dict(zip(("opacity", "scale", "area"), weights, strict=True))
    trainer.plan = replace(trainer.plan, weights=replace(trainer.plan.weights, **given))
    trainer.advance()
    assert asked == {name: weight for name, weight in given.items() if weight}
