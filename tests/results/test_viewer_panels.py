"""The panels of the web viewer: lengths between clicked points, and held-out views."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from test_viewer import gaussians

from gsopt.gaussians import Gaussians
from gsopt.results import viewer_controls, viewer_measure
from gsopt.results.viewer_measure import MeasureControls


class Panel:
    """A fake of viser's panel that keeps what is shown, by name."""

    def __init__(self) -> None:
        self.texts: dict[str, Any] = {}
        self.server = MagicMock()
        self.server.gui.add_text.side_effect = lambda name, value, **_: self.texts.setdefault(
            name, MagicMock(value=value)
        )


def click(controls: MeasureControls, fov: float = 0.8, height: int = 400) -> None:
    camera = SimpleNamespace(image_height=height, fov=fov)
    ray = {"ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0)}
    controls.click(SimpleNamespace(client=SimpleNamespace(camera=camera), **ray))


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> tuple[Panel, MeasureControls, list[float]]:
    """Controls whose k-th click meets the point (k, 0, 0), and the focal lengths of the clicks."""
    panel, focals = Panel(), list[float]()

    def surface(splats: Gaussians, eye: torch.Tensor, ray: torch.Tensor, focal: float) -> torch.Tensor:
        focals.append(focal)
        return torch.tensor([float(len(focals)), 0, 0])

    monkeypatch.setattr(viewer_measure, "surface_along", surface)
    return panel, MeasureControls(panel.server, lambda: gaussians(50)), focals


def test_picked_points_are_dots_joined_by_a_line_and_vanish_with_the_next(
    measured: tuple[Panel, MeasureControls, list[float]],
) -> None:
    panel, controls, _ = measured
    scene = panel.server.scene
    click(controls)
    assert scene.add_point_cloud.call_args.args[1].tolist() == [[1, 0, 0]]
    assert not scene.add_line_segments.called
    click(controls)
    assert scene.add_point_cloud.call_args.args[1].tolist() == [[1, 0, 0], [2, 0, 0]]
    assert scene.add_line_segments.call_args.args[1].tolist() == [[[1, 0, 0], [2, 0, 0]]]
    assert scene.add_point_cloud.return_value.remove.call_count == 1
    click(controls)
    assert scene.add_point_cloud.call_args.args[1].tolist() == [[3, 0, 0]]
    assert scene.add_line_segments.call_count == 1
    assert scene.add_line_segments.return_value.remove.call_count == 1
    controls.turn(True)
    assert scene.add_point_cloud.return_value.remove.call_count == 3
    assert scene.add_point_cloud.call_count == 3
    scene.on_click.return_value.assert_called_once_with(controls.click)


def test_a_dot_is_a_hundredth_of_the_extent_of_the_splats(
    measured: tuple[Panel, MeasureControls, list[float]],
) -> None:
    panel, controls, _ = measured
    click(controls)
    size = panel.server.scene.add_point_cloud.call_args.kwargs["point_size"]
    assert size == pytest.approx(0.01 * float(gaussians(50).means.std(dim=0).norm()))
    for few in (None, gaussians(1), gaussians(0)):
        assert MeasureControls(panel.server, lambda few=few: few)._dot() == 0.01  # type: ignore[misc]
    pair = gaussians(2)
    both = MeasureControls(panel.server, lambda: pair)._dot()
    assert both == pytest.approx(0.01 * float((pair.means[0] - pair.means[1]).norm()) / math.sqrt(2))


def test_a_click_looks_along_the_visitors_own_lens(measured: tuple[Panel, MeasureControls, list[float]]) -> None:
    _, controls, focals = measured
    click(controls, math.pi / 2, 400)
    click(controls, 2 * math.atan(0.5), 300)
    assert focals == pytest.approx([200, 300])


def test_a_click_before_the_first_splats_shows_nothing() -> None:
    panel = Panel()
    click(MeasureControls(panel.server, lambda: None))
    assert panel.texts["distance"].value == ""
    assert not panel.server.scene.add_point_cloud.called


def test_a_length_is_told_in_meters_only_where_one_is_known(
    measured: tuple[Panel, MeasureControls, list[float]],
) -> None:
    panel, controls, _ = measured
    click(controls)
    panel.texts["true length"].value = "2m"
    controls._show()
    assert (panel.texts["distance"].value, panel.texts["scale"].value) == ("", "")
    panel.texts["true length"].value = ""
    click(controls)
    assert panel.texts["distance"].value == "1 units"
    assert panel.texts["scale"].value.endswith("--from=1,0,0 --to=2,0,0 --unit-length 0.25m")
    panel.texts["true length"].value = "much"
    controls._show()
    assert panel.texts["distance"].value == "1 units"
    assert panel.texts["scale"].value.endswith("--unit-length 0.25m")


def held_out(count: int, monkeypatch: pytest.MonkeyPatch) -> tuple[viewer_controls.HeldOutViews, MagicMock]:
    server, views = MagicMock(), tuple(SimpleNamespace(number=i) for i in range(count))
    monkeypatch.setattr(viewer_controls, "backend_of", lambda config: None)
    panel: Any = viewer_controls.held_out_views(server, views, SimpleNamespace(), Path("run"))  # type: ignore[arg-type]
    monkeypatch.setattr(panel, "panes", lambda splats: panel._views[panel._number].number)
    return panel, server


@pytest.mark.parametrize(("count", "most"), [(1, 2), (2, 2), (5, 5)])
def test_the_slider_chooses_among_the_held_out_views(monkeypatch: pytest.MonkeyPatch, count: int, most: int) -> None:
    """A slider needs two places; with one view both show it."""
    panel, server = held_out(count, monkeypatch)
    slider, image = server.gui.add_slider, server.gui.add_image.return_value
    assert slider.call_args.kwargs == {"min": 1, "max": most, "step": 1, "initial_value": 1}
    image.image = "empty"
    chosen: Callable[[object], None] = slider.return_value.on_update.call_args.args[0]
    slider.return_value.value = 1
    chosen(None)
    assert image.image == "empty"
    panel.update(gaussians())
    assert image.image == 0
    for number in range(1, most + 1):
        slider.return_value.value = number
        chosen(None)
        assert image.image == min(number, count) - 1
