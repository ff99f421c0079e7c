"""One optimization, step by step, and everything that a checkpoint must carry to continue it bit for bit."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.scene import Scene
from gsopt.errors import InputError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.morton import morton_order
from gsopt.raster.backend import Backend, Gradients, RasterSettings
from gsopt.training.averaging import RunningAverage
from gsopt.training.checkpoint import Checkpoint
from gsopt.training.content_window import draws_whole
from gsopt.training.density import at_least_one, is_full, make_density
from gsopt.training.density.contribution import contributions, least
from gsopt.training.exposure import Exposure
from gsopt.training.floaters import floaters, haze
from gsopt.training.frame_loss import frame_loss
from gsopt.training.optimizer import OptimizedGaussians, adam_step
from gsopt.training.plan import RunPlan
from gsopt.training.poses import PoseRefinement
from gsopt.training.regularizers import (
    Dropout,
    add_area_gradient,
    add_opacity_gradient,
    add_scale_gradient,
    weaken_near,
)
from gsopt.training.running_means import RunningMeans
from gsopt.training.schedule import Flatness
from gsopt.training.skipping import Bands, Resting
from gsopt.training.targets import Target, Targets
from gsopt.training.unseen_views import UnseenViews
from gsopt.training.view_order import ViewOrder, generators

if TYPE_CHECKING:
    from gsopt.training.guided.session import RunGuidance

# The parts of a model that a checkpoint carries.
RECORDS = ("gaussians", "exp_avg", "exp_avg_sq")


class Trainer:
    """Owns the model, its density control and all random numbers of one run."""

    def __init__(
        self, plan: RunPlan, scene: Scene, gaussians: Gaussians, backend: Backend, guidance: RunGuidance | None = None
    ) -> None:
        """`guidance` None: learn from the input views alone."""
        self.plan = plan
        self.scene = scene
        self.backend = backend
        self.step = 0
        self.means = RunningMeans()
        self._spent: Gradients | None = None  # the last step's gradients: their memory serves again
        self._guidance = guidance
        self._schedule = plan.schedule
        self._last = plan.schedule.iterations
        self.poses = PoseRefinement(plan.poses, scene, self._last) if plan.poses.refine else None
        self.exposure = Exposure(plan.exposure, scene, self._last) if plan.exposure.learn else None
        self._average = RunningAverage(plan.schedule.averages_after) if plan.opaque else None
        self._unseen = UnseenViews.of(scene, plan.weights.unseen, self._last)
        self._generators = generators(plan.seed)
        views, images = len(scene.train), len(scene.drawn) - len(scene.train)
        self._order = ViewOrder(views, self._generators["views"], images, plan.extra_per_epoch)
        self._flatness = Flatness.of(views + plan.extra_per_epoch)
        self._resting = Resting(views + images)
        self._bands = Bands(plan.schedule.sh_degree_every, plan.schedule.max_sh_degree)
        cache = int(plan.target_cache_mb * 1e6)
        self._targets = Targets(scene.drawn, plan.background.constant(), cache, backend.device)
        self.model = OptimizedGaussians.start(self._first(gaussians).to(backend.device))
        self._density = make_density(
            plan.density, plan.schedule, len(self.model), self._generators["density"], backend.device
        )

    def _first(self, gaussians: Gaussians) -> Gaussians:
        """The first Gaussians within the budget, in Morton order, as float32 with the run's bands."""
        gaussians = gaussians.to(torch.float32).with_sh_degree(self._schedule.max_sh_degree)
        if len(gaussians) > self.plan.density.max_gaussians:
            chosen = torch.randperm(len(gaussians), generator=self._generators["density"])
            gaussians = gaussians.select(chosen[: self.plan.density.max_gaussians])
        return gaussians.select(morton_order(gaussians.means))

    def advance(self) -> tuple[float, str]:
        """Take one step; returns its photometric loss and the name of its view."""
        self.step += 1
        index = self._order.next()
        if self._rests(index):
            return self._passed(index)
        background = self.plan.background.drawn(self._generators["background"])
        factor = self._schedule.downscale(self.step)
        whole = not self.plan.crop_masked or draws_whole(self.step)
        target = self._targets.get(index, factor, background, whole=whole)
        settings = self.settings()
        if self.poses is not None:
            target = replace(target, camera=self.poses.camera(index, target.camera))
        loss, gradients = self._gradients(index, target, background, settings)
        if self.poses is not None:
            self.poses.update(index, self.step, self.model.gaussians, gradients, settings.sh_degree)
        if self._guidance is not None:
            self._guidance.add(self.step, self.model.gaussians, settings, gradients)
        if self._unseen is not None:
            self._unseen.add(self.step, self.model.gaussians, self.backend, gradients)
        self._update(gradients, target.camera, settings)
        self._change_set()
        if self._average is not None:
            self._average.note(self.step, self.model.gaussians)
        self._resting.note(index, loss)
        self._end_when_flat(loss)
        return loss, self.scene.drawn[index].name

    def _rests(self, index: int) -> bool:
        """True when this step's view has converged and is left out; only once the set of Gaussians is settled, and
        never with guidance, which counts the steps it is called for."""
        wanted = self.plan.rest_converged and self._guidance is None
        return wanted and self._schedule.is_settled(self.step) and self._resting.skips(index)

    def _passed(self, index: int) -> tuple[float, str]:
        """A step that computes nothing: its view's last loss, and its name."""
        loss = self._resting.last[index]
        self._change_set()
        self._end_when_flat(loss)
        return loss, self.scene.drawn[index].name

    def settings(self) -> RasterSettings:
        """The rasterizer's settings for the current step."""
        degree = self._bands.degree if self.plan.residual_bands else self._schedule.sh_degree(self.step)
        return RasterSettings(sh_degree=degree, antialiased=self.plan.antialiased)

    def _gradients(
        self, index: int, target: Target, background: Float[Tensor, "3"], settings: RasterSettings
    ) -> tuple[float, Gradients]:
        """Forward, loss, backward, regularizers; density control takes note."""
        dropout = self._dropout()
        drawn = self.model.gaussians if dropout is None else dropout.drawn
        weights = self.plan.weights
        wanted = weights.depth > 0 or (weights.agreed > 0 and self.step <= self._schedule.agreed_until)
        depth = wanted and target.inverse_depths is not None
        frame = self.backend.forward(drawn, target.camera, settings, background, depth=depth)
        row = None if self.exposure is None else self.exposure.row(index)
        loss = frame_loss(self.backend, frame, target, weights, background, self.exposure, row, self.step)
        bands = self._guidance is not None and self._guidance.is_due(self.step)  # which adds its own to them
        watches = self._density.watches(self.step, len(self.model))
        absgrad = watches and self.plan.density.absgrad
        through = loss.v_colors, loss.v_alphas, loss.v_depths
        gradients = self.backend.backward(frame, *through, absgrad=absgrad, bands=bands, into=self._spent)
        self._spent = gradients
        if self.plan.near_distance > 0:
            weaken_near(gradients, self.model.gaussians.means, target.camera, self.plan.near_distance)
        if watches:
            self._density.after_backward(gradients, frame.radii, target.size[1], target.size[0])
        if self.plan.residual_bands and self._bands.watches(self.step):
            self._bands.note(self.model.gaussians, target.camera, gradients)
        if target.color == 1:
            self.means.update(self.step, loss.photometric, frame.colors, target)
        return loss.photometric, self._regularized(gradients, dropout)

    def _dropout(self) -> Dropout | None:
        """With few views a step draws a random part of the Gaussians."""
        rate = self._schedule.dropout(self.step)
        return Dropout.of(self.model.gaussians, rate, self._generators["dropout"]) if rate > 0 else None

    def _regularized(self, gradients: Gradients, dropout: Dropout | None) -> Gradients:
        """Gradients of the stored parameters, terms beside the photometric loss included."""
        gaussians, weights = self.model.gaussians, self.plan.weights
        if dropout is not None:
            gradients.logit_opacities.mul_(dropout.slope)
        if weights.opacity > 0:
            add_opacity_gradient(gradients.logit_opacities, gaussians.logit_opacities, weights.opacity)
        if weights.scale > 0:
            add_scale_gradient(gradients.log_scales, gaussians.log_scales, weights.scale)
        if weights.area > 0:
            add_area_gradient(gradients.log_scales, gaussians.log_scales, weights.area)
        return gradients

    def _update(self, gradients: Gradients, camera: Cameras, settings: RasterSettings) -> None:
        """Adam, then what density control adds to a step."""
        rates = self._schedule.learning_rates(self.step, self._last)
        adam_step(self.model, gradients, rates, self._schedule.optimizer, self.backend, camera, settings)
        self._density.after_step(self.model, rates["means"])

    def _change_set(self) -> None:
        """Add, remove and reorder Gaussians where this step asks for it, and take the next band when it is due."""
        if self.plan.residual_bands:
            self._bands.decide(self.step)
        if self._schedule.turns_over(self.step):
            self._make_room()
        refined = self._density.refine(self.step, self.model)
        moved = refined is not self.model
        self.model = refined
        if self._schedule.prunes_floaters(self.step):
            self._remove_floaters()
            moved = True
        if self.plan.haze_distance > 0 and self._schedule.removes_haze(self.step, self._last):
            self._remove(haze(self.model.gaussians, self._cameras(), self.plan.haze_distance))
            moved = True
        if moved:
            self._select(morton_order(self.model.gaussians.means))
            self._bands.forget()
            if self._guidance is not None:
                self._guidance.forget()

    def _make_room(self) -> None:
        """Remove what adds least to the input views where nothing can grow for want of room."""
        density = self.plan.density
        if density.turnover > 0 and is_full(len(self.model), density):
            gaussians = self.model.gaussians
            values = contributions(gaussians, self._cameras(), self.backend, antialiased=self.plan.antialiased)
            self._select(~least(values, density.turnover))

    def _remove_floaters(self) -> None:
        gaussians, sigmas = self.model.gaussians, self._schedule.floater_sigmas(self.step)
        silhouettes = self._cameras() if self.scene.has_alpha else []
        found = floaters(gaussians, sigmas, silhouettes, self.backend, antialiased=self.plan.antialiased)
        self._remove(found)

    def _remove(self, found: Tensor) -> None:
        self._select(at_least_one(~found, self.model.gaussians.logit_opacities))

    def _cameras(self) -> list[Cameras]:
        """Those of the input views, as the rasterizer takes them."""
        return [view.camera.to(torch.float32) for view in self.scene.train]

    def _select(self, rows: Tensor) -> None:
        self.model = self.model.select(rows)
        self._density.select(rows)
        if self._average is not None:
            self._average.select(rows)

    @property
    def result(self) -> Gaussians:
        """The Gaussians that a run hands on: with few opaque photos their mean over the last steps."""
        return self.model.gaussians if self._average is None else self._average.of(self.model.gaussians)

    @property
    def finished(self) -> bool:
        """True when the run is over, by its steps or by a flat loss."""
        return self.step >= self._last

    def _end_when_flat(self, loss: float) -> None:
        """Let the run settle and end once its loss is flat; counts only after the last refinement and band."""
        iterations = self._schedule.iterations
        if not self.plan.stop_when_flat or self._last < iterations:
            return
        if self._schedule.is_complete(self.step) and self._flatness.update(loss):
            self._last = min(iterations, self.step + self._schedule.settling)

    @staticmethod
    def resumed(
        plan: RunPlan, scene: Scene, backend: Backend, checkpoint: Checkpoint, guidance: RunGuidance | None = None
    ) -> Trainer:
        """A trainer as it was when the checkpoint was written; InputError when that belongs to another run."""
        try:
            trainer = Trainer(plan, scene, _record(checkpoint.tensors, "gaussians"), backend, guidance)
            trainer._restore(checkpoint.tensors, checkpoint.meta)
        except (LookupError, ArithmeticError, AttributeError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(
                f"The checkpoint {checkpoint.path} lacks or garbles {error}. Remove it, or start in another folder."
            ) from error
        return trainer

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All that the next step depends on: tensors, and what JSON can hold exactly."""
        tensors = {f"{kind}.{name}": t for kind in RECORDS for name, t in getattr(self.model, kind).items()}
        tensors |= {f"density.{name}": tensor for name, tensor in self._density.tensors().items()}
        tensors |= {f"rng.{name}": generator.get_state() for name, generator in self._generators.items()}
        tensors["epoch.order"] = self._order.order
        tensors |= {f"resting.{name}": tensor for name, tensor in self._resting.tensors().items()}
        tensors |= {f"bands.{name}": tensor for name, tensor in self._bands.tensors().items()}
        meta = {
            "step": self.step,
            "adam_steps": self.model.steps,
            "epoch_position": self._order.position,
            "flatness": {field.name: getattr(self._flatness, field.name) for field in fields(self._flatness)},
            "last": self._last,
            "shown": {"loss": self.means.loss, "mse": self.means.mse},
        }
        if self._guidance is not None:
            guiding, meta["guidance"] = self._guidance.state()
            tensors |= {f"guidance.{name}": tensor for name, tensor in guiding.items()}
        if self.poses is not None:
            tensors |= {f"poses.{name}": tensor for name, tensor in self.poses.tensors().items()}
        if self._average is not None:
            tensors |= {f"average.{name}": tensor for name, tensor in self._average.tensors().items()}
        if self.exposure is not None:
            tensors |= {f"exposure.{name}": tensor for name, tensor in self.exposure.tensors().items()}
        return tensors, meta

    def _restore(self, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        """Inverse of `state`."""
        _require_alike(tensors, self.state()[0])
        self.step = _whole("step", meta["step"], self._schedule.iterations)
        self._last = _whole("last", meta["last"], self._schedule.iterations)
        for name in PARAMETERS:
            _whole(f"adam_steps.{name}", meta["adam_steps"][name], self.step)
        gaussians, exp_avg, exp_avg_sq = (_record(tensors, kind).to(self.backend.device) for kind in RECORDS)
        gaussians.validate()
        self.model = OptimizedGaussians(
            gaussians, exp_avg, exp_avg_sq, {name: int(meta["adam_steps"][name]) for name in PARAMETERS}
        )
        self._density.restore(_part(tensors, "density."))
        self._resting.restore(_part(tensors, "resting."))
        self._bands.restore(_part(tensors, "bands."), len(gaussians), self.backend.device)
        if self._guidance is not None:
            self._guidance.restore(_part(tensors, "guidance."), meta["guidance"])
        if self.poses is not None:
            self.poses.restore(_part(tensors, "poses."))
        if self._average is not None:
            self._average.restore(_part(tensors, "average."), gaussians)
        if self.exposure is not None:
            self.exposure.restore(_part(tensors, "exposure."))
        for name, generator in self._generators.items():
            generator.set_state(tensors[f"rng.{name}"])
        order = _views(tensors["epoch.order"], len(self.scene.drawn))
        self._order.restore(order, _whole("epoch_position", meta["epoch_position"], len(order)))
        self._flatness = Flatness(**_numbers(meta["flatness"]))
        self.means = RunningMeans(**_numbers(meta["shown"]))


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _record(tensors: dict[str, Tensor], kind: str) -> Gaussians:
    return Gaussians(**{name: tensors[f"{kind}.{name}"] for name in PARAMETERS})


def _require_alike(tensors: dict[str, Tensor], own: dict[str, Tensor]) -> None:
    """Dtypes and shapes of a fresh trainer with as many Gaussians; those of the epoch and of guidance vary."""
    for name, tensor in own.items():
        varies = name == "epoch.order" or name.startswith(("guidance.", "average."))
        if not varies and (tensors[name].dtype, tensors[name].shape) != (tensor.dtype, tensor.shape):
            raise ValueError(f"the shape of {name}")


def _whole(name: str, value: object, most: int) -> int:
    if type(value) is not int or not 0 <= value <= most:
        raise ValueError(name)
    return value


def _views(order: Tensor, count: int) -> Tensor:
    if order.dtype != torch.int64 or order.ndim != 1 or ((order < 0) | (order >= count)).any():
        raise ValueError("the order of the epoch")
    return order


def _numbers(values: dict[str, Any]) -> dict[str, Any]:
    for name, value in values.items():
        if value is not None and (type(value) not in (int, float) or not abs(value) < 1e300):
            raise ValueError(name)
    return values
