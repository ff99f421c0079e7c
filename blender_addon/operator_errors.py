"""Operators that end in a message: whatever a person can mend is reported and stays in the panel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy

from . import progress_timer
from .core.errors import GsoptError, printable

LONG = 24 * 3600.0
"""Seconds that an operator waits at most."""


class ReportingOperator:
    """Mixed into operators; they implement `do`, which may raise a GsoptError."""

    bl_options = {"REGISTER"}  # noqa: RUF012  Blender's way

    def execute(self, context: Any) -> set[str]:
        context.scene.gsopt.message = ""
        try:
            said = self.do(context)  # type: ignore[attr-defined]
        except (GsoptError, OSError) as error:
            context.scene.gsopt.message = printable(str(error))
            self.report({"ERROR"}, context.scene.gsopt.message)  # type: ignore[attr-defined]
            return {"CANCELLED"}
        if isinstance(said, str):
            self.report({"INFO"}, said)  # type: ignore[attr-defined]
        return {"FINISHED"}


class WaitingOperator(ReportingOperator):
    """Operators that start something: without a window they wait for its end, as scripts expect."""

    wait: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Wait", description="Return only when it is over; always so without a window", options={"SKIP_SAVE"}
    )

    @property
    def waits(self) -> bool:
        if self.properties.is_property_set("wait"):  # type: ignore[attr-defined]
            return bool(self.wait)
        return bool(bpy.app.background)

    def settle(self, going_on: Callable[[], bool], problem: Callable[[], str]) -> None:
        """Without a window: wait until it is over. GsoptError with the problem that ended it."""
        if self.waits:
            progress_timer.wait(lambda: not going_on(), LONG)
            if problem():
                raise GsoptError(problem())
