"""Before the first step: which prior guides the run, and how much the guard lets it. Decided once, then kept."""

from __future__ import annotations

from typing import Any

from gsopt.config.guidance import settled, sure
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene
from gsopt.init import first_gaussians
from gsopt.raster.backend import Backend
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.coverage import coverage
from gsopt.sds.guidance_step import Guide
from gsopt.sds.load_prior import open_prior
from gsopt.sds.select_prior import choose, fitting
from gsopt.training import schedule
from gsopt.training.guided.guard import Verdict, evaluate_guidance
from gsopt.training.guided.session import CONDITIONING, FOLDER, RunGuidance, front_camera, make_conditioning, make_guide
from gsopt.training.run_directory import RunDirectory


def start_guidance(config: TrainConfig, scene: Scene, backend: Backend, directory: RunDirectory) -> RunGuidance | None:
    """What guides this run, None for nothing. The choice and its reason stand in config.json and in `started`.

    A resumed run keeps the choice it began with. Raises UsageError and InputError before any training when the prior
    that was asked for cannot be had.
    """
    recorded = directory.recorded("guidance")
    if recorded is None:
        choice = fitting(choose(config.guidance), config.guidance, len(scene.train), scene.has_alpha)
        recorded = {"prior": choice.prior, "lambda_sds": choice.weight, "reason": choice.reason}
        if choice.prior is None:
            directory.record(guidance=recorded)
    if recorded["prior"] is None:
        return None
    front = front_camera(config, scene)
    folder = directory.path / FOLDER
    prior = open_prior(recorded["prior"], config.guidance)
    directory.emit("guidance", message=f"prior {prior.name}, {recorded['reason']}", prior=prior.name)
    judged, saved = "guard" in recorded, folder / CONDITIONING
    if judged and saved.exists():
        conditioning = Conditioning.load(saved)
    else:  # what stands there without a verdict is of a run that was broken off, perhaps of other words
        conditioning = make_conditioning(config, scene, prior, folder, directory.warn)

    def guide(weight: float) -> Guide:
        return make_guide(config, scene, backend, prior, conditioning, weight, front, directory.warn)

    if not judged:
        weight = float(recorded["lambda_sds"])
        if decided(config, scene, guide(weight)):
            verdict = Verdict(1.0, "not checked: the input views decide everywhere already", [])
        else:
            verdict = evaluate_guidance(config, scene, backend, prior, conditioning, weight, front, directory.warn)
        recorded = {**recorded, **_told(verdict, prior.name, settled(config.guidance, prior.aligned).policy)}
        directory.record(guidance=recorded)
        directory.emit("guidance", message=_sentence(verdict, weight), **recorded["guard"])
    folder.mkdir(exist_ok=True)
    weight = float(recorded["lambda_sds"]) * float(recorded["guard"]["factor"])
    return RunGuidance(guide(weight), folder, facts=recorded)


def decided(config: TrainConfig, scene: Scene, guide: Guide) -> bool:
    """Whether the input views see the first Gaussians from everywhere: then no step would be guided."""
    least = sure(guide.config.min_uncertainty)
    if least == 0:
        return False
    degree = schedule.max_sh_degree(config, len(scene.train))
    gaussians, _ = first_gaussians(scene, config.init, degree, config.seed)
    covered = coverage(gaussians, guide.inputs, guide.backend)
    return bool((guide.mean_uncertainty(gaussians, covered) < least).all())


def _told(verdict: Verdict, prior: str, policy: str) -> dict[str, Any]:
    guard = {"factor": verdict.factor, "reason": verdict.reason, "trials": verdict.trials}
    return {"model": prior, "policy": policy, "guard": guard}


def _sentence(verdict: Verdict, weight: float) -> str:
    lowered = "" if verdict.factor == 1 else f", lowered from {weight:g}"
    return f"lambda_sds {verdict.factor * weight:g}{lowered} ({verdict.reason})"
