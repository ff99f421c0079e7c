"""A picked point lies on the surface that the image shows, in Python as in `gsopt measure`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from finished_runs import make_run, splats
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.cli import main
from gsopt.data.scene import load_scene
from gsopt.formats.units import Units
from gsopt.gaussians import Gaussians
from gsopt.results.finished_run import open_run
from gsopt.results.measure import lifted
from gsopt.results.picking import surface_along
from gsopt.results.viewer_measure import MeasureControls

pytest.importorskip("scipy")

angles = st.floats(-1.0, 1.0)


def wall(z: float, opacity: float = 0.95) -> Gaussians:
    """Flat splats that cover the plane at a depth."""
    side = torch.linspace(-1, 1, 41)
    means = torch.cartesian_prod(side, side, torch.tensor([z]))
    count = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.tensor([[0.06, 0.06, 1e-4]]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh0=torch.zeros(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
    )


@settings(deadline=None)
@given(angles, angles, st.floats(0.1, 10.0))
def test_a_ray_meets_a_wall_where_the_planes_equation_says(x: float, y: float, stretch: float) -> None:
    """Slanted rays too: the depth is that of the plane, not of the centers of the splats."""
    ray = torch.tensor([0.2 * x, 0.2 * y, 1.0])
    point = surface_along(wall(4.0), torch.zeros(3), stretch * ray, 500.0)
    assert point is not None
    torch.testing.assert_close(point, 4 * ray, atol=0.02, rtol=0)


def test_a_veil_before_a_wall_is_looked_through() -> None:
    through = surface_along(wall(2.0, 0.05).append(wall(4.0)), torch.zeros(3), torch.tensor([0.0, 0, 1]), 500.0)
    assert through is not None
    assert float(through[2]) == pytest.approx(4, abs=0.02)
    assert surface_along(wall(4.0), torch.zeros(3), torch.tensor([0.0, 0, -1]), 500.0) is None
    assert surface_along(wall(4.0), torch.zeros(3), torch.tensor([1.0, 0, 0.1]), 500.0) is None


def test_a_pick_agrees_with_what_a_pixel_of_a_view_shows(tmp_path: Path) -> None:
    """Blobs of a deviation of 0.25: the median depth of their slabs and the peak along the ray differ by less."""
    run = open_run(make_run(tmp_path, learned=splats(60)))
    view = load_scene(run.config.data).train[0]
    K, viewmat = view.camera.Ks[0].double(), view.camera.viewmats[0].double()
    for column, row in ((20.5, 16.5), (14.5, 14.5), (24.5, 18.5)):
        ray = viewmat[:3, :3].T @ torch.linalg.solve(K, torch.tensor([column, row, 1.0], dtype=torch.float64))
        point = surface_along(run.gaussians, view.camera.centers[0], ray, float(K[0, 0]))
        assert point is not None
        torch.testing.assert_close(point, lifted(run, view, column, row), atol=0.2, rtol=0)


def alone(opacity: float, size: float, place: tuple[float, float, float]) -> Gaussians:
    """One round splat."""
    return Gaussians(
        means=torch.tensor([place]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(size)),
        logit_opacities=torch.tensor([math.log(opacity / (1 - opacity))]),
        sh0=torch.zeros(1, 1, 3),
        shN=torch.zeros(1, 0, 3),
    )


@pytest.mark.parametrize("unit", [0.05, 1.0, 30.0])
@pytest.mark.parametrize(("aside", "met"), [(1.0, True), (1.15, True), (1.2, False), (3.0, False)])
def test_a_ray_meets_a_splat_where_it_takes_half_of_the_light(aside: float, met: bool, unit: float) -> None:
    """0.99 exp(-s² / 2) is one half at s = 1.169 standard deviations; the blur of 0.3 px² is none at this focal."""
    splat = alone(0.99, 0.1 * unit, (0.1 * unit * aside, 0, 5 * unit))
    point = surface_along(splat, torch.zeros(3), torch.tensor([0.0, 0, 1]), 1e5)
    assert (point is not None) == met
    if point is not None:
        torch.testing.assert_close(point, torch.tensor([0.0, 0, 5 * unit]), atol=1e-4 * unit, rtol=0)


@pytest.mark.parametrize(("focal", "met"), [(100.0, True), (50.0, True), (200.0, False)])
def test_the_blur_of_a_pixel_widens_a_splat(focal: float, met: bool) -> None:
    """At a depth of 10 the variance of 0.3 px² is 0.3 (10 / focal)²: 0.003, 0.012 and 0.00075. The ray passes by at a
    distance of 0.06 of a splat of 0.01: half of the light goes from a variance of 0.06² / 1.366 = 0.0026 on."""
    point = surface_along(alone(0.99, 0.01, (0.06, 0, 10)), torch.zeros(3), torch.tensor([0.0, 0, 1]), focal)
    assert (point is not None) == met


def test_splats_add_up_until_half_of_the_light_is_gone() -> None:
    """Of three splats of opacity 0.3 in a row the second leaves 0.49; those behind the eye do not count."""
    row = alone(0.3, 0.2, (0, 0, 3)).append(alone(0.3, 0.2, (0, 0, 2))).append(alone(0.3, 0.2, (0, 0, 4)))
    behind = alone(0.9, 0.2, (0, 0, -0.5))
    point = surface_along(row.append(behind), torch.zeros(3), torch.tensor([0.0, 0, 1]), 1e5)
    assert point is not None
    assert float(point[2]) == pytest.approx(3, abs=1e-4)
    assert surface_along(row.select(torch.tensor([0])), torch.zeros(3), torch.tensor([0.0, 0, 1]), 1e5) is None


def test_a_splat_that_rounds_to_nothing_takes_no_light() -> None:
    """Two hundred layers of less than 1 / 255 are not drawn; of little more they leave less than half."""
    for opacity, met in ((0.9 / 255, False), (1.1 / 255, True)):
        layers = alone(opacity, 0.2, (0, 0, 3))
        for depth in torch.linspace(3, 4, 199).tolist():
            layers = layers.append(alone(opacity, 0.2, (0, 0, depth)))
        assert (surface_along(layers, torch.zeros(3), torch.tensor([0.0, 0, 1]), 1e5) is not None) == met


def test_a_splat_that_the_eye_stands_beside_is_not_before_it() -> None:
    """Its densest place on the ray lies behind the eye, though its center lies before the image plane."""
    tilted = alone(0.99, 0.2, (1.0, 0, 0.1))
    tilted = replace(tilted, log_scales=torch.tensor([[1.0, 1e-3, 0.3]]).log())
    turn = torch.tensor([[math.cos(0.4), 0, math.sin(0.4), 0]])
    assert surface_along(replace(tilted, quats=turn), torch.zeros(3), torch.tensor([0.0, 0, 1]), 1e5) is None


def clicked(controls: MeasureControls, x: float) -> None:
    camera = SimpleNamespace(image_height=400, fov=0.8)
    event = SimpleNamespace(client=SimpleNamespace(camera=camera), ray_origin=(x, 0.0, 0.0))
    event.ray_direction = (0.0, 0.0, 1.0)
    controls.click(event)


def test_two_clicks_in_the_viewer_give_a_length_and_the_command_for_it(tmp_path: Path, capsys: Any) -> None:
    texts: dict[str, Any] = {}
    server = MagicMock()
    server.gui.add_text.side_effect = lambda name, value, **_: texts.setdefault(name, MagicMock(value=value))
    controls = MeasureControls(server, lambda: wall(4.0))
    controls.units = Units(meters_per_unit=0.5)
    clicked(controls, 0.0)
    assert (texts["distance"].value, texts["scale"].value) == ("", "")
    clicked(controls, 0.5)
    assert texts["distance"].value == "0.5 units, 0.25 m"
    texts["true length"].value = "3 m"
    clicked(controls, 7.0)
    assert texts["distance"].value == "there is no surface"
    controls._show()
    assert texts["distance"].value == "0.5 units, 3 m"
    words = texts["scale"].value.split()
    assert words[:3] == ["gsopt", "measure", "RUN"]
    run = make_run(tmp_path)
    assert main(["measure", str(run), *words[3:]]) == 0
    assert "1 scene unit is 6 m" in capsys.readouterr().out
    clicked(controls, 0.2)
    assert texts["distance"].value == ""
    controls.turn(False)
    server.scene.remove_click_callback.assert_called_once_with(controls.click)
