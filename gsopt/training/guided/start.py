"""Before the first step: chooses the prior of a run and, by the guard, its weight. Decided once, then recorded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.init import first_gaussians
from gsopt.raster.backend import Backend
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.guidance_step import Guidance, GuidanceSetup
from gsopt.sds.load_prior import open_prior
from gsopt.sds.select_prior import select_prior
from gsopt.training.guided.choice import recorded_choice
from gsopt.training.guided.guard import Verdict, evaluate_guidance
from gsopt.training.guided.references import (
    CONDITIONING,
    FOLDER,
    front_camera,
    make_conditioning,
    read_guidance_prompts,
    reference_paths,
)
from gsopt.training.guided.session import RunGuidance
from gsopt.training.plan import RunPlan
from gsopt.training.run_directory import RunDirectory


def require_guidance(config: GuidanceConfig) -> None:
    """Raise InputError for a prompt that cannot be used, UsageError for guidance without a prior: before any work."""
    read_guidance_prompts(config)
    reference_paths(config)
    select_prior(config)


def start_guidance(
    config: TrainConfig, plan: RunPlan, scene: Scene, backend: Backend, directory: RunDirectory
) -> RunGuidance | None:
    """The guidance of this run, None for none. The choice and its reason stand in config.json and in `started`.

    A resumed run keeps the choice it began with. Raises UsageError and InputError before any training when the prior
    that was asked for cannot be had.
    """
    recorded = recorded_choice(plan, directory)
    if recorded["prior"] is None:
        return None
    setup = _opened(config, scene, recorded, directory)
    if "guard" not in recorded:
        verdict = _verdict(config, plan, scene, backend, setup)
        policy = plan.guidance.for_prior(setup.prior.aligned).policy
        recorded = {**recorded, **_record(verdict, setup.prior.name, policy)}
        directory.record(guidance=recorded)
        directory.emit("guidance", message=_sentence(verdict, setup.weight), **recorded["guard"])
    folder = directory.path / FOLDER
    folder.mkdir(exist_ok=True)
    allowed = replace(setup, weight=setup.weight * float(recorded["guard"]["factor"]))
    return RunGuidance(allowed.on(scene, backend, plan.guidance), folder, facts=recorded)


def _opened(config: TrainConfig, scene: Scene, recorded: dict[str, Any], directory: RunDirectory) -> GuidanceSetup:
    """The prior that was chosen, opened, with its conditioning; a resumed run keeps the conditioning it began with."""
    front = front_camera(config.guidance, scene)
    folder = directory.path / FOLDER
    prior = open_prior(recorded["prior"], config.guidance)
    directory.emit("guidance", message=f"prior {prior.name}, {recorded['reason']}", prior=prior.name)
    saved = folder / CONDITIONING
    if "guard" in recorded and saved.exists():
        conditioning = Conditioning.load(saved)
    else:  # a file without a verdict is of a run that was broken off, perhaps of other words
        conditioning = make_conditioning(config.guidance, scene, prior, folder, directory.warn)
    return GuidanceSetup(prior, conditioning, front, float(recorded["lambda_sds"]), directory.warn)


def _verdict(config: TrainConfig, plan: RunPlan, scene: Scene, backend: Backend, setup: GuidanceSetup) -> Verdict:
    if inputs_decide(plan, scene, setup.on(scene, backend, plan.guidance)):
        return Verdict(1.0, "not checked: the input views decide everywhere already", [])
    return evaluate_guidance(config, scene, backend, setup)


def inputs_decide(plan: RunPlan, scene: Scene, guidance: Guidance) -> bool:
    """True when the input views see the first Gaussians from everywhere: then no step would be guided."""
    least = guidance.plan.min_uncertainty
    if least == 0:
        return False
    gaussians, _ = first_gaussians(scene, plan.init, plan.schedule.max_sh_degree, plan.seed)
    return bool((guidance.observer.coverage(0, gaussians).mean_u < least).all())


def _record(verdict: Verdict, prior: str, policy: str) -> dict[str, Any]:
    guard = {"factor": verdict.factor, "reason": verdict.reason, "trials": verdict.trials}
    return {"model": prior, "policy": policy, "guard": guard}


def _sentence(verdict: Verdict, weight: float) -> str:
    lowered = "" if verdict.factor == 1 else f", lowered from {weight:g}"
    return f"lambda_sds {verdict.factor * weight:g}{lowered} ({verdict.reason})"
