"""The controls of the web viewer: progress and stop of a run, held-out views beside their truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsopt.config.train import TrainConfig
from gsopt.data.scene import View
from gsopt.errors import GsoptError
from gsopt.events import write_atomic
from gsopt.gaussians import Gaussians
from gsopt.raster.backend import RasterSettings
from gsopt.results.finished_run import backend_of, background_of, draw, truth, with_longest_side
from gsopt.results.report.embedded_images import error_map
from gsopt.results.video import as_image

PANE = 240
"""Longer side of one image of a held-out view, px."""


class RunControls:
    """A bar that shows how far a run is, and a button that asks it to stop; both vanish when it is over."""

    def __init__(self, server: Any, run: Path) -> None:
        self._bar = server.gui.add_progress_bar(0.0, visible=False)
        self._button = server.gui.add_button("stop the run", visible=False)
        self._button.on_click(lambda _: ask_to_stop(run))

    def show(self, share: float | None) -> None:
        """Shows the share of the run that is done, or nothing when it is over (None)."""
        self._bar.visible = self._button.visible = share is not None
        if share is not None:
            self._bar.value = 100 * share


def ask_to_stop(run: Path) -> None:
    """The run finishes its step, saves and exits (docs/protocol.md)."""
    write_atomic(run / "stop", b"")  # a link in its place is replaced, not followed


class HeldOutViews:
    """Truth, render and error of one held-out view, chosen by a slider."""

    def __init__(self, server: Any, views: tuple[View, ...], config: TrainConfig, run: Path) -> None:
        self._views, self._config, self._run = views, config, run
        self._number = 0
        self._gaussians: Gaussians | None = None
        self._backend = backend_of(config)
        with server.gui.add_folder("held-out views: truth, render, error"):
            slider = server.gui.add_slider("view", min=1, max=max(2, len(views)), step=1, initial_value=1)
            self._image = server.gui.add_image(np.zeros((2, 6, 3), np.uint8))
        slider.on_update(lambda _: self._choose(int(slider.value)))

    def _choose(self, number: int) -> None:
        self._number = min(number, len(self._views)) - 1
        self._show()

    def update(self, gaussians: Gaussians) -> None:
        """Draws the chosen view with new splats."""
        self._gaussians = gaussians
        self._show()

    def _show(self) -> None:
        if self._gaussians is not None:
            self._image.image = self.panes(self._gaussians)

    def panes(self, gaussians: Gaussians) -> np.ndarray:
        """[H, 3 W, 3] truth, render and error of the chosen view."""
        view, background = self._views[self._number], background_of(self._run)
        settings = RasterSettings(sh_degree=gaussians.sh_degree, antialiased=self._config.antialiased)
        camera = with_longest_side(view.camera, PANE)
        render = as_image(draw(gaussians, camera, self._backend, settings, background))
        target = as_image(truth(view, background)).resize(render.size, Image.Resampling.LANCZOS)
        return np.concatenate([np.asarray(image) for image in (target, render, error_map(render, target))], axis=1)


def held_out_views(server: Any, views: tuple[View, ...], config: TrainConfig, run: Path) -> HeldOutViews | None:
    """The panel of held-out views, or None where there are none or nothing can draw them."""
    try:
        return HeldOutViews(server, views, config, run) if views else None
    except GsoptError:
        return None
