"""One guided step: look where the inputs say little, ask the prior, and turn its answer into gradients of Gaussians."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.config.guidance import GuidanceConfig, settled, sure
from gsopt.data.scene import Scene, View
from gsopt.errors import InputError, NumericalError
from gsopt.events import Report
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.metrics import capped_psnr
from gsopt.raster.api import expected_depth
from gsopt.raster.backend import Backend, Gradients, RasterSettings, RenderedFrame
from gsopt.sds import coverage, policies, schedule
from gsopt.sds.candidate_views import draw_candidate, guidance_cameras, nearest, square_views
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.noise import Latents, generator
from gsopt.sds.priors.protocol import Condition, Images, Pair, Prior, References, Scale

COVERAGE_EVERY = 100
"""Steps after which coverage is taken anew even if no Gaussian came or went."""
MAX_FAILURES = 3
"""Failed calls in a row after which the run goes on without guidance."""
SMALLEST = 0.05
"""Share of the picture below which a subject counts as filling this much."""
MAX_PSNR = 60.0
"""dB; from there on images are the same."""
GEOMETRY = ("means", "quats", "log_scales", "logit_opacities")


@dataclass
class Counts:
    """What became of the steps that the schedule wanted guided."""

    guided: int = 0
    decided: int = 0
    """Left alone because the input views decide everywhere."""
    failed: int = 0
    """Left alone because the prior failed."""
    failed_in_a_row: int = 0
    ended: bool = False
    """After too many failures in a row."""


@dataclass(frozen=True)
class Sample:
    """What one guided step saw, for the report."""

    step: int
    view: int
    text: str
    render: Float[Tensor, "3 S S"]
    uncertainty: Float[Tensor, "S S"]
    x0: Latents | None
    """The prior's estimate in its own space; None where `target` is it."""
    target: Float[Tensor, "3 S S"] | None


@dataclass(frozen=True)
class ObservedRender:
    """A render that is to be judged, and what is known about it."""

    camera: Cameras
    images: Images
    """One, 0..1."""
    alphas: Float[Tensor, "S S"]
    uncertainty: Float[Tensor, "S S"]
    depth: Float[Tensor, "S S"] | None = None
    references: References | None = None


@dataclass
class Memory:
    """What a guide remembers between two steps: all of it goes into checkpoints."""

    coverage: Float[Tensor, "N"] | None = None
    """Of the current Gaussians; None when they have changed."""
    mean_u: Float[Tensor, "C"] | None = None
    """Mean uncertainty of every candidate camera, as old as `coverage`."""
    coverage_step: int = 0
    targets: dict[int, Tensor] = field(default_factory=dict)
    """recon: uint8 [2, 3, S, S] per candidate, a render and what the prior made of it."""
    target_steps: dict[int, int] = field(default_factory=dict)


class Guide:
    """Holds a prior, what the expert knows, and the cameras to look from. Its steps depend on nothing but their number,
    the Gaussians and `Memory`, so that a resumed run has the same bits."""

    def __init__(
        self,
        prior: Prior,
        conditioning: Conditioning,
        config: GuidanceConfig,
        scene: Scene,
        backend: Backend,
        *,
        weight: float,
        front: Cameras,
        iterations: int,
        seed: int,
        background: Float[Tensor, "3"] | None,
        warn: Report,
    ) -> None:
        """`weight` is lambda after the guard; `front` the camera whose side is the front; `background` None draws a
        color per step, as the training does."""
        self.prior, self.conditioning, self.backend = prior, conditioning, backend
        self.config = settled(config, prior.aligned)
        self.weight, self.iterations, self.seed, self.background = weight, iterations, seed, background
        self.warn = warn
        self.inputs = [view.camera for view in scene.drawn]
        self.cameras = guidance_cameras(self.inputs, scene.extent, prior.size, front)
        self.references = square_views(scene.train, prior.size, torch.ones(3) if background is None else background)
        self.counts = Counts()
        self.memory = Memory()
        self.sample: Sample | None = None
        """The last guided step."""

    def is_due(self, step: int) -> bool:
        """Whether this step may be guided; coverage or a failure may still leave it without."""
        on = self.weight != 0 and not self.counts.ended
        return on and schedule.is_guided(step, self.config, self.iterations)

    def gradients(self, step: int, gaussians: Gaussians, settings: RasterSettings) -> Gradients | None:
        """Gradients of lambda times the guidance loss, or None for a step without guidance."""
        if not self.is_due(step):
            return None
        self._look_around(step, gaussians)
        assert self.memory.mean_u is not None
        index = draw_candidate(self.memory.mean_u, sure(self.config.min_uncertainty), self._random(step, 0, "camera"))
        if index is None:
            self.counts.decided += 1
            return None
        try:
            gradients = self._guided(step, index, gaussians, settings)
        except (NumericalError, torch.OutOfMemoryError) as error:
            self._fail(step, error)
            return None
        self.counts.guided += 1
        self.counts.failed_in_a_row = 0
        return gradients

    def forget(self) -> None:
        """Gaussians came, went or changed places: their coverage is no longer known."""
        self.memory.coverage = None

    def _look_around(self, step: int, gaussians: Gaussians) -> None:
        """Coverage of the Gaussians, and how uncertain each candidate camera's view is."""
        memory = self.memory
        if memory.coverage is not None and step - memory.coverage_step < COVERAGE_EVERY:
            return
        memory.coverage = coverage.coverage(gaussians, self.inputs, self.backend)
        memory.mean_u = self.mean_uncertainty(gaussians, memory.coverage)
        memory.coverage_step = step

    def mean_uncertainty(self, gaussians: Gaussians, covered: Float[Tensor, "N"]) -> Float[Tensor, "C"]:
        """Of every candidate's view, at a low resolution."""
        small = self.cameras.candidates.resized(32, 32)
        return coverage.mean_uncertainty(gaussians, coverage.uncertainty(covered), small, self.backend)

    def _guided(self, step: int, index: int, gaussians: Gaussians, settings: RasterSettings) -> Gradients:
        """Render, ask, and carry the answer back to the parameters."""
        # recon compares with a target of an earlier step: neither camera nor background may have changed since.
        still = self.config.policy == "recon"
        camera = self.cameras.camera(index, None if still else self._random(step, index, "jitter"))
        background = self._background(index if still else step)
        frame, seen = self._see(camera, background, gaussians, settings)
        v_images = self.weight * self.image_gradient(step, index, seen)
        if not bool(torch.isfinite(v_images).all()):
            raise NumericalError(
                f"The gradient of the guidance in step {step} is not finite. Choose --guidance.dtype float32."
            )
        gradients = self.backend.backward(frame, v_images[0].permute(1, 2, 0).contiguous())
        for name in GEOMETRY:
            getattr(gradients, name).mul_(self.config.geometry)
        return gradients

    def _see(
        self, camera: Cameras, background: Float[Tensor, "3"], gaussians: Gaussians, settings: RasterSettings
    ) -> tuple[RenderedFrame, ObservedRender]:
        """A render, and what is known about it."""
        assert self.memory.coverage is not None
        frame = self.backend.forward(gaussians, camera, settings, background, depth=self.prior.aligned)
        u = coverage.uncertainty(self.memory.coverage)
        return frame, ObservedRender(
            camera=camera,
            images=frame.colors.detach().permute(2, 0, 1)[None],
            alphas=frame.alphas.detach(),
            uncertainty=coverage.uncertainty_map(gaussians, u, camera, self.backend),
            depth=None if frame.depths is None else expected_depth(frame.depths.detach(), frame.alphas.detach()),
            references=self._references(gaussians, camera),
        )

    def repair(self, step: int, view: View, gaussians: Gaussians, settings: RasterSettings) -> float:
        """By how many dB the prior's answer, asked as in this step, is closer to a view than the render is."""
        self._look_around(step, gaussians)
        background = self._background(step)
        truth = square_views([view], self.prior.size, background)
        _, seen = self._see(truth.cameras, background, gaussians, settings)
        answer = self._answer(step, 0, seen)
        before, after = (
            capped_psnr(images.clamp(0, 1).permute(0, 2, 3, 1), truth.images.permute(0, 2, 3, 1), MAX_PSNR)
            for images in (seen.images, answer)
        )
        return float(after - before)

    def _references(self, gaussians: Gaussians, camera: Cameras) -> References | None:
        """The input views nearest to a camera, with the depth of the current Gaussians in them."""
        chosen = nearest(self.references, camera, self.config.references)
        if chosen is None or not self.prior.aligned:
            return chosen
        depths = [depth_in(gaussians, chosen.cameras[k], self.backend) for k in range(len(chosen.cameras))]
        return replace(chosen, depths=torch.stack(depths))

    def image_gradient(self, step: int, index: int, seen: ObservedRender) -> Images:
        """dL/d(images) of the policy's loss, lambda left out."""
        images, weights = seen.images, self._weights(seen)
        if self.config.policy == "recon":
            asked, target = self._target(step, index, seen)
            self._remember(step, index, "", seen, None, target[0])
            # A mean over the subject's pixels: how much of the picture it fills does not matter.
            weights = weights / seen.alphas.mean().clamp_min(SMALLEST)
            return policies.pixel_gradient(images, target, weights * policies.wanted(images, asked, target))
        with torch.enable_grad():
            leaf = images.clone().requires_grad_()
            z = self.prior.encode(leaf)
        drawn, noise = self._noise_sample(step, index, seen, z)
        if self.config.policy == "sdi":
            pull = policies.sdi(self.prior, z, noise, self.config.inversion_steps)
        else:
            pull = policies.sds(self.prior, z, noise)
        self._remember(step, index, drawn, seen, pull.x0, None)
        # Divided by numel only after the encoder's backward pass: half precision would lose so small a gradient.
        (v_images,) = torch.autograd.grad(z, leaf, policies.resized(weights, z) * pull.g)
        return v_images / z.numel()

    def _weights(self, seen: ObservedRender) -> Float[Tensor, "S S"]:
        """Of every pixel: `certain_weight` where the inputs decide, 1 where they say nothing, 0 beside the subject."""
        certain = sure(self.config.certain_weight)
        return certain * seen.alphas + (1 - certain) * seen.uncertainty

    def _target(self, step: int, index: int, seen: ObservedRender) -> tuple[Images, Images]:
        """recon's target for a candidate and the render it was made of: made anew when it is too old, rounded to what
        a checkpoint keeps."""
        memory = self.memory
        if index not in memory.targets or step - memory.target_steps[index] >= self.config.refresh_every:
            target = self._answer(step, index, seen)
            if not bool(torch.isfinite(target).all()):
                raise NumericalError(
                    f"The decoded target of step {step} is not finite. Choose --guidance.dtype float32."
                )
            pair = torch.cat([seen.images, target.to(seen.images)]).cpu()
            memory.targets[index] = (pair.clamp(0, 1) * 255).round().to(torch.uint8)
            memory.target_steps[index] = step
        asked, target = (memory.targets[index].float() / 255).split(1)
        return asked, target

    @torch.no_grad()
    def _answer(self, step: int, index: int, seen: ObservedRender) -> Images:
        """The image that the prior thinks should be there."""
        z = self.prior.encode(seen.images)
        _, noise = self._noise_sample(step, index, seen, z)
        return self.prior.decode(policies.denoised(self.prior, z, noise, sure(self.config.denoise_steps)))

    def _noise_sample(
        self, step: int, index: int, seen: ObservedRender, z: Latents
    ) -> tuple[str, policies.NoiseSample]:
        """This step's noise level, noise and conditions, and the text among the latter."""
        random = self._random(step, index, "noise")
        least, most = schedule.noise_range(step, self.config, self.iterations)
        share = least + (most - least) * float(torch.rand(1, generator=random, dtype=torch.float64))
        side = self.cameras.side(seen.camera, self._front_known())
        drawn = self.conditioning.draw(side, self._random(step, index, "prompt"))
        positive = Condition(
            tokens=drawn.positive,
            class_embedding=drawn.class_embedding,
            render=torch.cat([seen.images[0].clamp(0, 1), seen.alphas[None]]),
            depth=seen.depth,
            uncertainty=seen.uncertainty,
            camera=seen.camera,
            references=seen.references,
        )
        negative = replace(positive, tokens=drawn.negative, class_embedding=None, references=None)
        return drawn.text, policies.NoiseSample(
            t=self.prior.schedule.step(share),
            eps=torch.randn(z.shape, generator=random).to(z),
            pair=Pair(positive, negative),
            scale=Scale(sure(self.config.guidance_scale), self.config.rescale, self.config.sequential),
            weighting=self.config.weighting,
            clip_rms=self.config.clip_rms,
        )

    def _front_known(self) -> bool:
        """Sides are named where the user named the front, or wrote prompts for sides."""
        return self.config.front_view is not None or any(
            p.view not in ("all", "top") for p in self.conditioning.prompts
        )

    def _background(self, number: int) -> Float[Tensor, "3"]:
        if self.background is not None:
            return self.background
        return torch.rand(3, generator=self._random(number, 0, "background"))

    def _random(self, step: int, view: int, purpose: str) -> torch.Generator:
        return generator(self.seed, step, view, purpose)

    def _fail(self, step: int, error: Exception) -> None:
        counts = self.counts
        counts.failed += 1
        counts.failed_in_a_row += 1
        counts.ended = counts.failed_in_a_row >= MAX_FAILURES
        end = f" That was failure {MAX_FAILURES} in a row: the run goes on without guidance." if counts.ended else ""
        self.warn(f"Step {step} is not guided: {error}{end}")

    def _remember(
        self,
        step: int,
        index: int,
        text: str,
        seen: ObservedRender,
        x0: Latents | None,
        target: Float[Tensor, "3 S S"] | None,
    ) -> None:
        self.sample = Sample(step, index, text, seen.images[0], seen.uncertainty, x0, target)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All that the next guided step depends on beside the Gaussians: tensors, and what JSON can hold."""
        memory = self.memory
        tensors = {f"target.{index}": target for index, target in memory.targets.items()}
        tensors |= {name: tensor for name in ("coverage", "mean_u") if (tensor := getattr(memory, name)) is not None}
        meta = {
            "counts": asdict(self.counts),
            "coverage_step": memory.coverage_step,
            "target_steps": {str(index): step for index, step in memory.target_steps.items()},
        }
        return tensors, meta

    def restore(self, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        """Inverse of `state`. InputError for targets of another version."""
        targets = {int(k.removeprefix("target.")): v for k, v in tensors.items() if k.startswith("target.")}
        if any(target.shape[:-2] != (2, 3) for target in targets.values()):
            raise InputError("The checkpoint's guidance is of another version of gsopt. Start in another folder.")
        self.counts = Counts(**{item.name: meta["counts"][item.name] for item in fields(Counts)})
        self.memory = Memory(
            coverage=tensors.get("coverage"),
            mean_u=tensors.get("mean_u"),
            coverage_step=int(meta["coverage_step"]),
            targets=targets,
            target_steps={int(index): int(step) for index, step in meta["target_steps"].items()},
        )


def depth_in(gaussians: Gaussians, camera: Cameras, backend: Backend) -> Float[Tensor, "H W"]:
    """Expected z of the Gaussians, 0 where there is nothing."""
    frame = backend.forward(gaussians, camera, coverage.PLAIN, depth=True)
    assert frame.depths is not None
    return expected_depth(frame.depths, frame.alphas)
