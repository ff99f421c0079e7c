"""Random points before the cameras: how they are spread, and how the method for the first Gaussians is chosen."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from shapes import spread_cameras

from gsopt.config.train import InitConfig
from gsopt.data.scene import Points
from gsopt.errors import UsageError
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.geometry.focus import Focus
from gsopt.geometry.projection import inside, project
from gsopt.init import frustum
from gsopt.init.frustum import CLEAR_OF_CAMERAS, background_points, random_points

first = importlib.import_module("gsopt.init.first_gaussians")  # the package has its function under this name
WIDTH, HEIGHT = 40, 20


def camera(eye: tuple[float, float, float], target: tuple[float, float, float] = (0.0, 0, 0)) -> Cameras:
    """A camera whose principal point lies off the middle of a wide image."""
    viewmat = look_at(torch.tensor([eye]), torch.tensor(target), torch.tensor([0.0, 0, 1]))
    K = intrinsics(0.9, WIDTH, HEIGHT).float()
    K[0, 2], K[1, 2], K[1, 1] = 13.0, 14.0, 1.5 * K[0, 0]
    return Cameras(viewmat, K[None], WIDTH, HEIGHT)


def drawn(cameras: list[Cameras], focus: Focus, count: int, background: bool = False) -> torch.Tensor:
    return random_points(cameras, focus, count, background, torch.Generator().manual_seed(0))


def is_even(values: torch.Tensor, tolerance: float = 0.04) -> bool:
    """Are the values spread evenly over 0 to 1?"""
    expected = torch.linspace(0, 1, len(values))
    return float((values.double().sort().values - expected).abs().max()) < tolerance


SEEN = Focus(torch.tensor([0.2, -0.1, 0.05]), 4.0, 0.3, converging=True)
"""A ball that every camera of a sphere sees as a whole."""


def test_points_fill_the_ball_that_the_cameras_frame_evenly() -> None:
    around = spread_cameras(6)
    points = drawn([around[i].to(torch.float32) for i in range(6)], SEEN, 3000)
    offset = (points - SEEN.point) / SEEN.radius
    assert is_even(offset.norm(dim=1) ** 3)
    assert is_even((offset[:, 2] / offset.norm(dim=1) + 1) / 2)
    assert is_even(torch.atan2(offset[:, 1], offset[:, 0]) / (2 * math.pi) + 0.5)


@pytest.mark.parametrize(("background", "behind"), [(False, 0), (True, 300)])
def test_three_tenths_of_the_points_lie_behind_the_focus_where_there_is_a_background(
    background: bool, behind: int
) -> None:
    """From the distance of the focus to eight times that, evenly in inverse depth."""
    around = [spread_cameras(2)[i].to(torch.float32) for i in range(2)]
    points = drawn(around, SEEN, 1000, background)
    in_ball = (points - SEEN.point).norm(dim=1) <= SEEN.radius * (1 + 1e-5)
    assert int(in_ball.sum()) == 1000 - behind
    assert bool(in_ball[: 1000 - behind].all())
    if behind:
        far = points[~in_ball]
        depths = torch.stack([project(one, far)[2] for one in around]).amax(0)
        assert float(depths.min()) >= 4.0 * (1 - 1e-4)
        assert float(depths.max()) <= 32.0 * (1 + 1e-4)
        assert is_even((1 / depths - 1 / 32) / (1 / 4 - 1 / 32), 0.1)


def test_points_along_pixels_are_spread_evenly_over_the_images_of_all_cameras() -> None:
    """Two cameras back to back, so that each sees its own points alone."""
    cameras = [camera((3.0, 0, 0), (9.0, 1, 2)), camera((-3.0, 0, 0), (-9.0, 1, 2))]
    points = drawn(cameras, Focus(torch.zeros(3), 2.0, 1.0, converging=False), 4000)
    shares = []
    for one in cameras:
        column, row, depth = project(one, points)
        seen = inside(one, column, row, depth)
        shares.append(float(seen.double().mean()))
        assert is_even(column[seen] / one.width)
        assert is_even(row[seen] / one.height)
    assert shares == pytest.approx([0.5, 0.5], abs=0.03)
    assert sum(shares) == pytest.approx(1.0, abs=0.01)


def test_half_of_the_cameras_are_enough() -> None:
    """One camera sees the ball's upper part, another looks away: what either sees, half of them see."""
    above, away = camera((3.0, 0, 0), (0.0, 0, 0.5)), camera((-3.0, 0, 0), (-9.0, 0, 0))
    focus = Focus(torch.zeros(3), 3.0, 1.0, converging=True)
    points = drawn([above, away], focus, 300)
    column, row, depth = project(above, points)
    assert bool(inside(above, column, row, depth).all())
    assert bool((points.norm(dim=1) <= 1 + 1e-5).all())


def test_a_ball_that_nobody_sees_is_filled_all_the_same() -> None:
    focus = Focus(torch.tensor([0.0, 0, 50]), 3.0, 2.0, converging=True)
    points = drawn([camera((3.0, 0, 0)), camera((-3.0, 0, 0))], focus, 200)
    assert points.shape == (200, 3)
    assert float((points - focus.point).norm(dim=1).max()) <= 2 * (1 + 1e-5)
    assert is_even(((points - focus.point).norm(dim=1) / 2) ** 3, 0.15)


def test_the_background_begins_behind_the_thing_and_leaves_the_way_around_it_free() -> None:
    """Cameras all around look at the origin: what lies between two of them would hang before their neighbors."""
    angles = torch.arange(8) * math.pi / 4
    ring = [camera((3 * math.cos(angle), 3 * math.sin(angle), 0.0)) for angle in angles.tolist()]
    focus = Focus(torch.zeros(3), 3.0, 1.0, converging=True)
    points = background_points(ring, focus, 500, torch.Generator().manual_seed(0))
    assert points.shape == (500, 3)
    away = torch.cdist(points, torch.cat([each.centers for each in ring]))
    assert float(away.min()) >= CLEAR_OF_CAMERAS * 3
    depths = torch.stack([project(each, points)[2] for each in ring])
    assert bool((depths.amax(0) >= 3 * (1 - 1e-5)).all())
    assert bool((points.norm(dim=1) > 4).any())
    again = background_points(ring, focus, 500, torch.Generator().manual_seed(0))
    assert torch.equal(points, again)


def test_a_background_without_a_place_clear_of_cameras_is_drawn_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frustum, "CLEAR_OF_CAMERAS", 100.0)
    focus = Focus(torch.zeros(3), 3.0, 1.0, converging=True)
    points = background_points([camera((3.0, 0, 0))], focus, 50, torch.Generator().manual_seed(0))
    assert points.shape == (50, 3)
    assert float(points[:, 0].max()) <= 1e-5


def scene(views: int, alpha: bool, points: int = 0) -> Any:
    around = spread_cameras(views)
    train = tuple(SimpleNamespace(camera=around[i].to(torch.float32)) for i in range(views))
    known = Points(torch.rand(points, 3), torch.zeros(points, 3, dtype=torch.uint8)) if points else None
    return SimpleNamespace(train=train, has_alpha=alpha, points=known, extent=2.0)


@pytest.mark.parametrize(
    ("views", "alpha", "known", "methods"),
    [
        (16, False, 0, ["stereo"]),
        (17, False, 0, ["stereo"]),
        (16, True, 0, ["hull", "stereo"]),
        (17, True, 0, ["hull", "stereo"]),
        (16, False, 100, ["stereo", "points"]),
        (16, False, 499, ["stereo", "points"]),
        (16, False, 500, ["points"]),
        (17, False, 99, ["stereo"]),
        (17, False, 100, ["points"]),
        (16, True, 100, ["points", "hull", "stereo"]),
    ],
)
def test_methods_are_tried_in_the_order_of_what_the_scene_tells(
    views: int, alpha: bool, known: int, methods: list[str]
) -> None:
    found = first._suited_methods(scene(views, alpha), known, InitConfig(count=500))
    assert found == methods


@pytest.mark.parametrize("method", ["points", "hull", "stereo", "random"])
def test_an_asked_method_is_the_only_one(method: Any) -> None:
    expected = [] if method == "random" else [method]
    assert first._suited_methods(scene(20, False), 0, InitConfig(method=method)) == expected


@pytest.mark.parametrize(("share", "taken"), [(0.04, True), (0.039, False)])
def test_stereo_is_believed_where_photos_agree_on_enough_pixels(
    monkeypatch: pytest.MonkeyPatch, share: float, taken: bool
) -> None:
    """Points in the background stand beside what agrees; below that nothing is taken."""
    stereo = pytest.importorskip("gsopt.init.stereo.points")
    found = SimpleNamespace(xyz=torch.rand(30, 3) + 50, rgb=torch.ones(30, 3), photos=4, share=share)
    monkeypatch.setattr(stereo, "stereo_points", lambda *_: found)
    monkeypatch.setattr(first, "mean_colors", lambda photos, xyz: torch.zeros(len(xyz), 3))
    monkeypatch.setattr(first, "small_photos", lambda views, most: [])
    start = first._from_stereo(scene(4, False), 70, 1, torch.Generator().manual_seed(0))
    assert (start is not None) == taken
    if start is not None:
        gaussians, said = start
        assert len(gaussians) == 100
        assert torch.equal(gaussians.means[:30], found.xyz)
        assert said == "30 points by stereo (4 photos agree on 4% of their pixels) and 70 in the background"


def test_random_points_of_a_masked_thing_are_gray_and_stay_near_it() -> None:
    xyz, rgb = first._random_points(scene(6, True), 400, torch.Generator().manual_seed(0))
    assert bool((rgb == 0.5).all())
    assert float(xyz.norm(dim=1).max()) < 2.5


def test_random_points_of_a_whole_scene_have_its_colors_and_lie_behind_it_too(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(first, "small_photos", lambda views, most: asked.append(most))
    monkeypatch.setattr(first, "mean_colors", lambda photos, xyz: xyz)
    xyz, rgb = first._random_points(scene(6, False), 400, torch.Generator().manual_seed(0))
    assert torch.equal(xyz, rgb)
    assert float(xyz.norm(dim=1).max()) > 2.5
    assert asked == [first._MAX_COLOR_PHOTOS]


@pytest.mark.parametrize(("degree", "fine"), [(-1, False), (0, True), (3, True), (4, False)])
def test_a_run_starts_from_gaussians_of_bands_that_exist(degree: int, fine: bool) -> None:
    config = replace(InitConfig(), method="points", count=1)
    given = scene(20, False, 3)
    if fine:
        gaussians, said = first.first_gaussians(given, config, degree, 0)
        assert (len(gaussians), gaussians.sh_degree) == (3, degree)
        assert said == "3 points that came with the scene, as asked"
    else:
        with pytest.raises(UsageError, match="sh_degree"):
            first.first_gaussians(given, config, degree, 0)


def test_no_points_and_no_silhouettes_are_no_start() -> None:
    empty = scene(20, False)
    empty.points = Points(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    assert first._from_points(empty, 5, 0, torch.Generator()) is None
    assert first._from_hull(scene(20, False), 5, 0, torch.Generator()) is None
