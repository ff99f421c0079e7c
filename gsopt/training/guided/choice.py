"""The prior of a run, decided once and recorded. A run that no prior guides imports no other part of guidance."""

from __future__ import annotations

from typing import Any

from gsopt.training.plan import RunPlan
from gsopt.training.run_directory import RunDirectory


def recorded_choice(plan: RunPlan, directory: RunDirectory) -> dict[str, Any]:
    """`prior` (null without one), `lambda_sds` and `reason`; what a resumed run began with. No prior is a
    final choice, recorded at once."""
    recorded: dict[str, Any] | None = directory.recorded("guidance")
    if recorded is not None:
        return recorded
    choice = {"prior": plan.prior.name, "lambda_sds": plan.prior.weight, "reason": plan.prior.reason}
    if plan.prior.name is None:
        directory.record(guidance=choice)
    return choice
