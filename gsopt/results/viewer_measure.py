"""Lengths in the web viewer: two clicked points, their distance, and the command that gives a run its scale."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from gsopt.errors import UsageError
from gsopt.formats.units import UNKNOWN, Units
from gsopt.gaussians import Gaussians
from gsopt.results.measure import meters
from gsopt.results.picking import surface_along

COLOR = (242, 153, 46)
THICKNESS = 3.0
"""Width of the line, px."""
EXAMPLE = "0.25m"


class MeasureControls:
    """A box to tick; then two clicks on the splats show their distance, a third one begins anew."""

    def __init__(self, server: Any, splats: Callable[[], Gaussians | None]) -> None:
        self._server, self._splats = server, splats
        self.units: Units = UNKNOWN
        """Scale of the run, where it is known."""
        self._points: list[torch.Tensor] = []
        self._marks: list[Any] = []
        with server.gui.add_folder("measure", expand_by_default=False):
            self._on = server.gui.add_checkbox("click two points", initial_value=False)
            self._distance = server.gui.add_text("distance", "", disabled=True)
            self._known = server.gui.add_text("true length", "", hint="such as 0.25m; asks for the command below")
            self._command = server.gui.add_text("scale", "", hint="gives the run its scale", disabled=True)
        self._on.on_update(lambda _: self.turn(bool(self._on.value)))
        self._known.on_update(lambda _: self._show())

    def turn(self, on: bool) -> None:
        """Listens to clicks, or no longer; forgets the points."""
        self._points.clear()
        self._show()
        if on:
            self._server.scene.on_click()(self.click)
        else:
            self._server.scene.remove_click_callback(self.click)

    def click(self, event: Any) -> None:
        """Adds what a visitor's click meets."""
        gaussians = self._splats()
        if gaussians is None:
            return
        camera = event.client.camera
        focal = camera.image_height / 2 / math.tan(camera.fov / 2)
        eye, ray = (torch.tensor(vector) for vector in (event.ray_origin, event.ray_direction))
        point = surface_along(gaussians, eye, ray, focal)
        if point is not None:
            self._points = [*self._points[2 * (len(self._points) == 2) :], point]
        self._show("" if point is not None else "there is no surface")

    def _show(self, complaint: str = "") -> None:
        for mark in self._marks:
            mark.remove()
        self._marks = self._drawn() if self._points else []
        self._distance.value = complaint or self._text()
        self._command.value = self._line()

    def _drawn(self) -> list[Any]:
        ends = np.stack([point.numpy() for point in self._points])
        scene, screen = self._server.scene, {"thickness": THICKNESS, "thickness_units": "screen"}
        dots = scene.add_point_cloud("/measure/ends", ends, COLOR, point_size=self._dot(), point_shape="circle")
        if len(ends) < 2:
            return [dots]
        return [dots, scene.add_line_segments("/measure/line", ends[None], COLOR, **screen)]

    def _dot(self) -> float:
        """Size of a marked point: a hundredth of the extent of the splats."""
        gaussians = self._splats()
        return 0.01 * float(gaussians.means.std(dim=0).norm()) if gaussians is not None and len(gaussians) > 1 else 0.01

    def _length(self) -> float:
        """Scene units; 0 before there are two points."""
        return float((self._points[1] - self._points[0]).norm()) if len(self._points) == 2 else 0.0

    def _text(self) -> str:
        length = self._length()
        scale = self._known_meters() / length if length and self._known_meters() else self.units.meters_per_unit
        if not length:
            return ""
        return f"{length:.4g} units" + ("" if scale is None else f", {scale * length:.4g} m")

    def _known_meters(self) -> float:
        """The length that the visitor typed; 0 for none."""
        try:
            return meters(self._known.value) if self._known.value else 0.0
        except UsageError:
            return 0.0

    def _line(self) -> str:
        """The command that gives the run its scale."""
        if not self._length():
            return ""
        start, end = (",".join(f"{x:.6g}" for x in point.tolist()) for point in self._points)
        known = self._known.value.replace(" ", "") if self._known_meters() else EXAMPLE
        return f"gsopt measure RUN --from={start} --to={end} --unit-length {known}"
