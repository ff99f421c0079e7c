"""One guided step: choose an uncertain view, query the prior, and turn its answer into gradients of the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.scene import Scene, View
from gsopt.errors import NumericalError
from gsopt.events import Report
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.metrics import capped_psnr
from gsopt.raster.backend import Backend, Gradients, RasterSettings
from gsopt.sds import policies
from gsopt.sds.candidate_views import draw_candidate, square_views
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.guidance_memory import CoverageRecord, GuidanceMemory
from gsopt.sds.guidance_plan import GuidancePlan, GuidancePlans
from gsopt.sds.noise import Latents, generator
from gsopt.sds.observed_render import ObservedRender, Observer
from gsopt.sds.priors.protocol import Condition, Images, Pair, Prior, Scale

COVERAGE_EVERY = 100
"""Steps after which coverage is taken anew even if no Gaussian came or went."""
MAX_FAILURES = 3
"""Failed calls in a row after which the run goes on without guidance."""
MIN_OBJECT_SHARE = 0.05
"""Share of the picture below which an object counts as filling this much."""
MAX_PSNR = 60.0
"""dB; from there on images are the same."""
GEOMETRY = ("means", "quats", "log_scales", "logit_opacities")


@dataclass(frozen=True)
class GuidanceSetup:
    """A prior and what it is given: everything of guidance that does not depend on the input views."""

    prior: Prior
    conditioning: Conditioning
    front: Cameras
    """The camera that shows the front."""
    weight: float
    """lambda."""
    warn: Report

    def on(self, scene: Scene, backend: Backend, plans: GuidancePlans) -> Guidance:
        """Guidance of a run on a scene."""
        return Guidance(self, plans.for_prior(self.prior.aligned), scene, backend)


@dataclass(frozen=True)
class StepRecord:
    """One guided step, for the report."""

    step: int
    view: int
    text: str
    render: Float[Tensor, "3 S S"]
    uncertainty: Float[Tensor, "S S"]
    estimate: Tensor
    """The prior's clean image: latents [1, c, h, w], or an image [3, S, S]."""

    def proposal(self, prior: Prior) -> Float[Tensor, "3 S S"]:
        """The estimate as an image."""
        return prior.decode(self.estimate)[0] if self.estimate.ndim == 4 else self.estimate


class Guidance:
    """Guides the steps of one run. They depend on nothing but their number, the Gaussians and `memory`, so that a
    resumed run has the same bits."""

    def __init__(self, setup: GuidanceSetup, plan: GuidancePlan, scene: Scene, backend: Backend) -> None:
        self.prior, self.conditioning = setup.prior, setup.conditioning
        self.weight, self._warn = setup.weight, setup.warn
        self.plan = plan
        self.observer = Observer(scene, backend, setup.prior, plan, setup.front)
        self.memory = GuidanceMemory()
        self.last: StepRecord | None = None
        """The last guided step."""

    def is_due(self, step: int) -> bool:
        """True when this step may be guided; coverage or a failure may still leave it without."""
        return self.weight != 0 and not self.memory.counts.ended and self.plan.is_guided(step)

    def gradients(self, step: int, gaussians: Gaussians, settings: RasterSettings) -> Gradients | None:
        """Gradients of lambda times the guidance loss, or None for a step without guidance."""
        if not self.is_due(step):
            return None
        known, counts = self._coverage(step, gaussians), self.memory.counts
        index = draw_candidate(known.mean_u, self.plan.min_uncertainty, self._random(step, 0, "camera"))
        if index is None:
            counts.decided += 1
            return None
        try:
            gradients = self._guided(step, index, gaussians, settings, known)
        except (NumericalError, torch.OutOfMemoryError) as error:
            self._fail(step, error)
            return None
        counts.guided += 1
        counts.failed_in_a_row = 0
        return gradients

    def forget(self) -> None:
        """Gaussians came, went or changed places: their coverage is no longer known."""
        self.memory.coverage = None

    def _coverage(self, step: int, gaussians: Gaussians) -> CoverageRecord:
        """Coverage of the Gaussians, at most COVERAGE_EVERY steps old."""
        known = self.memory.coverage
        if known is None or step - known.step >= COVERAGE_EVERY:
            known = self.memory.coverage = self.observer.coverage(step, gaussians)
        return known

    def _guided(
        self, step: int, index: int, gaussians: Gaussians, settings: RasterSettings, known: CoverageRecord
    ) -> Gradients:
        """Render, query, and carry the answer back to the parameters."""
        # recon compares with a target of an earlier step: neither camera nor background may have changed since.
        still = self.plan.policy == "recon"
        camera = self.observer.cameras.camera(index, None if still else self._random(step, index, "jitter"))
        background = self._background(index if still else step)
        frame, render = self.observer.draw(gaussians, camera, background, settings, known.covered)
        v_images = self.weight * self.image_gradient(step, index, render)
        if not bool(torch.isfinite(v_images).all()):
            raise NumericalError(
                f"The gradient of the guidance in step {step} is not finite. Choose --guidance.dtype float32."
            )
        backend = self.observer.backend
        gradients = backend.backward(frame, v_images[0].permute(1, 2, 0).to(backend.device).contiguous())
        for name in GEOMETRY:
            getattr(gradients, name).mul_(self.plan.geometry)
        return gradients

    def repair(self, step: int, view: View, gaussians: Gaussians, settings: RasterSettings) -> float:
        """PSNR gain, in dB, of the prior's prediction over the current render, measured on a held-out view."""
        covered = self._coverage(step, gaussians).covered
        background = self._background(step)
        truth = square_views([view], self.prior.size, background)
        _, render = self.observer.draw(gaussians, truth.cameras, background, settings, covered)
        answer = self._answer(step, 0, render)
        before, after = (
            capped_psnr(images.clamp(0, 1).permute(0, 2, 3, 1), truth.images.permute(0, 2, 3, 1), MAX_PSNR)
            for images in (render.images, answer)
        )
        return float(after - before)

    def image_gradient(self, step: int, index: int, render: ObservedRender) -> Images:
        """dL/d(images) of the policy's loss, lambda left out."""
        images, weights = render.images, self._weights(render)
        if self.plan.policy == "recon":
            before, target = self._target(step, index, render)
            self._record(step, index, "", render, target[0])
            # A mean over the object's pixels: how much of the picture it fills does not matter.
            weights = weights / render.alphas.mean().clamp_min(MIN_OBJECT_SHARE)
            return policies.pixel_gradient(images, target, weights * policies.wanted(images, before, target))
        with torch.enable_grad():
            leaf = images.clone().requires_grad_()
            z = self.prior.encode(leaf)
        text, noise = self._noise_sample(step, index, render, z)
        if self.plan.policy == "sdi":
            gradient = policies.sdi(self.prior, z, noise, self.plan.inversion_steps)
        else:
            gradient = policies.sds(self.prior, z, noise)
        self._record(step, index, text, render, gradient.x0)
        # Divided by numel only after the encoder's backward pass: half precision would lose so small a gradient.
        (v_images,) = torch.autograd.grad(z, leaf, policies.resized(weights, z) * gradient.g)
        return v_images / z.numel()

    def _weights(self, render: ObservedRender) -> Float[Tensor, "S S"]:
        """Pixel weights: `certain_weight` where the inputs decide, 1 where they do not, 0 beside the object."""
        certain = self.plan.certain_weight
        return certain * render.alphas + (1 - certain) * render.uncertainty

    def _target(self, step: int, index: int, render: ObservedRender) -> tuple[Images, Images]:
        """The render that recon's target for a candidate was made of, and the target: made anew when it is too old."""
        if not self.memory.has_target(index, step, self.plan.refresh_every):
            target = self._answer(step, index, render)
            if not bool(torch.isfinite(target).all()):
                raise NumericalError(
                    f"The decoded target of step {step} is not finite. Choose --guidance.dtype float32."
                )
            self.memory.keep_target(index, step, render.images, target)
        return self.memory.target(index)

    @torch.no_grad()
    def _answer(self, step: int, index: int, render: ObservedRender) -> Images:
        """The prior's prediction of the image."""
        z = self.prior.encode(render.images)
        _, noise = self._noise_sample(step, index, render, z)
        return self.prior.decode(policies.denoised(self.prior, z, noise, self.plan.denoise_steps))

    def _noise_sample(
        self, step: int, index: int, render: ObservedRender, z: Latents
    ) -> tuple[str, policies.NoiseSample]:
        """This step's noise level, noise and conditions, and the text among the latter."""
        random, plan = self._random(step, index, "noise"), self.plan
        least, most = plan.noise_range(step)
        share = least + (most - least) * float(torch.rand(1, generator=random, dtype=torch.float64))
        text, pair = self._conditions(step, index, render)
        return text, policies.NoiseSample(
            t=self.prior.schedule.step(share),
            eps=torch.randn(z.shape, generator=random).to(z),
            pair=pair,
            scale=Scale(plan.guidance_scale, plan.rescale, plan.sequential),
            weighting=plan.weighting,
            clip_rms=plan.clip_rms,
        )

    def _conditions(self, step: int, index: int, render: ObservedRender) -> tuple[str, Pair]:
        """The prompt drawn for this step, and the positive and the negative condition."""
        side = self.observer.cameras.side(render.camera, self._front_known())
        prompt = self.conditioning.draw(side, self._random(step, index, "prompt"))
        positive = Condition(
            tokens=prompt.positive,
            class_embedding=prompt.class_embedding,
            render=torch.cat([render.images[0].clamp(0, 1), render.alphas[None]]),
            depth=render.depth,
            uncertainty=render.uncertainty,
            camera=render.camera,
            references=render.references,
        )
        return prompt.text, Pair(
            positive, replace(positive, tokens=prompt.negative, class_embedding=None, references=None)
        )

    def _front_known(self) -> bool:
        """True when the user named the front, or wrote prompts for sides."""
        return self.plan.front_named or any(p.view not in ("all", "top") for p in self.conditioning.prompts)

    def _background(self, number: int) -> Float[Tensor, "3"]:
        return self.plan.background.drawn(self._random(number, 0, "background"))

    def _random(self, step: int, view: int, purpose: str) -> torch.Generator:
        return generator(self.plan.seed, step, view, purpose)

    def _fail(self, step: int, error: Exception) -> None:
        counts = self.memory.counts
        counts.failed += 1
        counts.failed_in_a_row += 1
        counts.ended = counts.failed_in_a_row >= MAX_FAILURES
        end = f" That was failure {MAX_FAILURES} in a row: the run goes on without guidance." if counts.ended else ""
        self._warn(f"Step {step} is not guided: {error}{end}")

    def _record(self, step: int, index: int, text: str, render: ObservedRender, estimate: Tensor) -> None:
        self.last = StepRecord(step, index, text, render.images[0], render.uncertainty, estimate)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        return self.memory.state()

    def restore(self, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        self.memory = GuidanceMemory.restored(tensors, meta)
