"""The state of guidance between two steps: all of it goes into checkpoints."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt.errors import InputError
from gsopt.sds.priors.protocol import Images


@dataclass
class Counts:
    """Outcomes of the steps that the schedule planned to guide."""

    guided: int = 0
    decided: int = 0
    """Left alone because the input views decide everywhere."""
    failed: int = 0
    """Left alone because the prior failed."""
    failed_in_a_row: int = 0
    ended: bool = False
    """After too many failures in a row."""


@dataclass(frozen=True)
class CoverageRecord:
    """Coverage of the Gaussians as they were at a step."""

    step: int
    covered: Float[Tensor, "N"]
    mean_u: Float[Tensor, "C"]
    """Mean uncertainty of the view of every candidate camera."""


@dataclass
class GuidanceMemory:
    """Counts, coverage and the cached targets of recon."""

    counts: Counts = field(default_factory=Counts)
    coverage: CoverageRecord | None = None
    """Unknown (None) after Gaussians came, went or changed places."""
    targets: dict[int, UInt8[Tensor, "2 3 S S"]] = field(default_factory=dict)
    """Per candidate, a render and the prior's answer to it."""
    target_steps: dict[int, int] = field(default_factory=dict)

    def has_target(self, index: int, step: int, refresh_every: int) -> bool:
        """True when the target of a candidate is not too old."""
        return index in self.targets and step - self.target_steps[index] < refresh_every

    def keep_target(self, index: int, step: int, render: Images, target: Images) -> None:
        """Caches both images rounded to 8 bit, as a checkpoint keeps them."""
        pair = torch.cat([render, target.to(render)]).cpu()
        self.targets[index] = (pair.clamp(0, 1) * 255).round().to(torch.uint8)
        self.target_steps[index] = step

    def target(self, index: int) -> tuple[Images, Images]:
        """The render that a candidate's target was made of, and the target."""
        render, target = (self.targets[index].float() / 255).split(1)
        return render, target

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """All that the next guided step depends on beside the Gaussians: tensors, and JSON values."""
        tensors = {f"target.{index}": target for index, target in self.targets.items()}
        known = self.coverage
        tensors |= {} if known is None else {"coverage": known.covered, "mean_u": known.mean_u}
        meta = {
            "counts": asdict(self.counts),
            "coverage_step": 0 if known is None else known.step,
            "target_steps": {str(index): step for index, step in self.target_steps.items()},
        }
        return tensors, meta

    @staticmethod
    def restored(tensors: dict[str, Tensor], meta: dict[str, Any]) -> GuidanceMemory:
        """Inverse of `state`. InputError for targets of another version."""
        targets = {int(k.removeprefix("target.")): v for k, v in tensors.items() if k.startswith("target.")}
        if any(target.shape[:-2] != (2, 3) for target in targets.values()):
            raise InputError("The checkpoint's guidance is of another version of gsopt. Start in another folder.")
        known = None
        if "coverage" in tensors:
            known = CoverageRecord(int(meta["coverage_step"]), tensors["coverage"], tensors["mean_u"])
        return GuidanceMemory(
            counts=Counts(**{item.name: meta["counts"][item.name] for item in fields(Counts)}),
            coverage=known,
            targets=targets,
            target_steps={int(index): int(step) for index, step in meta["target_steps"].items()},
        )
