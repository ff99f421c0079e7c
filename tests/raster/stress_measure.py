"""How far a backend is from the float64 reference on one stressful scene."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from jaxtyping import Bool
from raster_scenes import Case, undecided_pixels, weights_like
from tolerances import DECISION
from torch import Tensor

from gsopt.raster.backend import Backend, Gradients, RenderedFrame
from gsopt.raster.reference import ReferenceBackend

ORACLE = ReferenceBackend()
NOTHING = 1e-25
"""Gradients smaller than this count as zero: 1 - sigmoid(80) is 2e-35, which float64 rounds to 0 and we do not."""


@dataclass(frozen=True)
class Deviation:
    """What the comparison found; errors are infinite where something is not finite."""

    image: float
    """Largest error of a color or an alpha over the largest value or 1, or of a depth over the largest depth."""
    gradient: float
    """Relative error (L2) of the worst tensor of gradients."""
    worst: str
    """That tensor."""
    undecided: float
    """Share of the pixels left out, because float32 may decide differently there (`tolerances.DECISION`)."""


@dataclass(frozen=True)
class Truth:
    """What the reference made of a scene."""

    case: Case
    decided: Bool[Tensor, "H W"]
    frame: RenderedFrame
    weights: tuple[Tensor, Tensor, Tensor]
    """v_colors, v_alphas, v_depths; zero on pixels that rounding may tip."""
    gradients: Gradients

    @staticmethod
    def of(case: Case) -> Truth:
        decided = ~undecided_pixels(case, DECISION)
        frame = ORACLE.forward(case.gaussians, case.camera, case.settings, case.background, depth=True)
        v_colors, v_alphas, v_depths = weights_like(case)
        weights = v_colors * decided[..., None], v_alphas * decided, v_depths * decided
        return Truth(case, decided, frame, weights, ORACLE.backward(frame, *weights, absgrad=True))


def deviation(backend: Backend, truth: Truth) -> Deviation:
    """Draw and differentiate the truth's scene with a float32 backend."""
    case = truth.case
    single = case.gaussians.to(torch.float32).to(backend.device)
    frame = backend.forward(single, case.camera, case.settings, case.background, depth=True)
    weights = (weight.float().to(backend.device) for weight in truth.weights)
    gradients = here(backend.backward(frame, *weights, absgrad=True))
    frame = here(frame)
    errors = gradient_errors(gradients, truth.gradients, case)
    worst = max(errors, key=lambda name: errors[name])
    undecided = 1 - float(truth.decided.double().mean())
    return Deviation(image_error(frame, truth.frame, truth.decided), errors[worst], worst, undecided)


Record = TypeVar("Record", RenderedFrame, Gradients)


def here(record: Record) -> Record:
    """The same with its tensors on the CPU."""
    tensors = {f.name: getattr(record, f.name) for f in fields(record)}
    return replace(record, **{name: t.cpu() for name, t in tensors.items() if isinstance(t, Tensor)})


def image_error(got: RenderedFrame, truth: RenderedFrame, decided: Tensor) -> float:
    """The largest of colors, alphas and depths."""
    assert got.depths is not None
    assert truth.depths is not None
    parts = [(got.colors, truth.colors, 1.0), (got.alphas, truth.alphas, 1.0), (got.depths, truth.depths, 0.0)]
    errors = []
    for mine, true, least in parts:
        if not bool(torch.isfinite(mine).all()):
            return float("inf")
        error = float((mine - true).abs()[decided].max()) if bool(decided.any()) else 0.0
        scale = max(float(true.abs().max()), least)
        errors.append(error / scale if error > 0 else 0.0)
    return max(errors)


def gradient_errors(got: Gradients, truth: Gradients, case: Case) -> dict[str, float]:
    """|difference| / |truth| (L2) per tensor.

    Turning a sphere changes nothing, so of the quaternions' gradient only rounding is left: it is measured against
    what stretching does, which the same sums make.
    """
    stretch = float(torch.linalg.vector_norm(truth.log_scales))
    errors = {}
    for name in (field.name for field in fields(Gradients)):
        mine, true = getattr(got, name), getattr(truth, name)
        error, size = (float(torch.linalg.vector_norm(x.double())) for x in (mine - true, true))
        if name == "quats" and len(mine):
            size += stretch / float(case.gaussians.quats.norm(dim=1).min())
        finite = bool(torch.isfinite(mine).all())
        errors[name] = error / max(size, NOTHING) if finite else float("inf")
    return errors
