"""Which symmetries are believed, with stand-ins for the search: their order, their limits and the number of photos."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_symmetry_limits import blocks, photo

from gsopt.symmetry import find, upright
from gsopt.symmetry.axis import Axis
from gsopt.symmetry.mirror import Mirror
from gsopt.symmetry.search import Ball
from gsopt.symmetry.symmetry import Symmetry

UP = torch.tensor([0.0, 0.0, 1.0])
FOCUS: Any = SimpleNamespace(point=torch.tensor([0.5, 0.0, 0.0]), radius=2.0)


def believed(photos: int, misses: dict[int, float], monkeypatch: pytest.MonkeyPatch, edges: bool = True) -> Any:
    """What is believed where an axis of so many turns misses by shares of silhouettes of 50 px on average."""
    log = SimpleNamespace(tried=[], mirrors=[])
    radii = iter([40.0, 60.0, 50.0])

    def refined(axis: Axis, silhouettes: Any, ball: Ball, most: float) -> tuple[Axis, float]:
        assert (ball.radius, ball.center.tolist()) == (2.0, [0.5, 0, 0])
        assert axis.point.tolist() == [7, 7, 7]
        log.tried.append((axis.turns, round(most, 6)))
        return axis, 50 * misses[axis.turns]

    def level(photos: Any, silhouettes: Any, ball: Any, grid: Any, up: Any, pixels: float, turns: int) -> list[str]:
        log.mirrors.append((pixels, turns))
        return ["mirror"]

    monkeypatch.setattr(upright, "Silhouettes", lambda *_: SimpleNamespace(outline_something=edges))
    monkeypatch.setattr(upright, "world_up", lambda viewmats: UP)
    monkeypatch.setattr(upright, "_silhouette_radius", lambda photo: next(radii))
    monkeypatch.setattr(upright, "middle_axis", lambda photos, up, point: torch.full((3,), 7.0))
    monkeypatch.setattr(upright, "refined", refined)
    monkeypatch.setattr(upright, "_level_mirrors", level)
    monkeypatch.setattr(upright, "_symmetry", lambda axis, misses, *_: (axis.turns, round(misses, 6)))
    log.found = upright.upright_symmetries([photo(0)] * photos, FOCUS, blocks())
    return log


def test_as_good_as_round_is_tried_first_then_a_hexagon_then_a_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """An axis may miss by four thousandths of the mean radius of the silhouettes; the first that does is it."""
    log = believed(2, {8: 0.0041, 6: 0.004, 4: 0.001}, monkeypatch)
    assert log.tried == [(8, 0.2), (6, 0.2)]
    assert log.found == [(6, 0.004)]
    assert believed(3, {8: 0.003, 6: 0.0, 4: 0.0}, monkeypatch).found == [(8, 0.003)]
    assert [turns for turns, _ in believed(3, {8: 1, 6: 1, 4: 0.001}, monkeypatch).tried] == [8, 6, 4]


@pytest.mark.parametrize(
    ("photos", "turns", "found", "mirrors"),
    [
        (1, None, [], []),
        (2, None, ["mirror"], [(50.0, 2)]),
        (3, None, ["mirror"], [(50.0, 2)]),
        (2, 6, [(6, 0.001)], []),
        (3, 6, [(6, 0.001), "mirror"], [(50.0, 6)]),
        (3, 4, [(4, 0.001), "mirror"], [(50.0, 4)]),
        (3, 8, [(8, 0.001)], []),
    ],
)
def test_mirrors_are_sought_without_an_axis_or_beside_one_that_three_photos_show(
    photos: int, turns: int | None, found: list[Any], mirrors: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = believed(photos, {n: 0.001 if n == turns else 1.0 for n in (8, 6, 4)}, monkeypatch)
    assert log.found == found
    assert [(round(pixels), n) for pixels, n in log.mirrors] == (
        [(40 if photos == 1 else 50, mirrors[0][1])] if mirrors else []
    )


def test_photos_without_an_outline_prove_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    log = believed(3, {8: 0.0, 6: 0.0, 4: 0.0}, monkeypatch, edges=False)
    assert (log.found, log.tried, log.mirrors) == ([], [], [])


def at(degrees: float, length: float = 1.0) -> Mirror:
    a = math.radians(degrees)
    return Mirror(length * torch.tensor([math.cos(a), math.sin(a), 0.0]), 0.0)


def test_mirrors_that_fit_the_best_are_kept_in_the_order_of_their_misses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a square: at 45 and 90 degrees to the best, not at 30; sixty directions, five degrees apart, are tried."""
    misses = {0: 1e-4, 90: 2e-4, 30: 3e-4, 45: 4e-4}
    asked: list[Any] = []

    def candidates(grid: Any, photos: Any, ball: Any, normals: Any, apart: float) -> list[Mirror]:
        asked.append((len(normals), apart))
        return [at(degrees) for degrees in (45, 30, 0, 90)]

    def degrees_of(mirror: Mirror) -> int:
        return round(math.degrees(math.atan2(float(mirror.normal[1]), float(mirror.normal[0]))))

    monkeypatch.setattr(upright, "candidates", candidates)
    monkeypatch.setattr(upright, "refined", lambda mirror, *_: (mirror, 50 * misses[degrees_of(mirror)]))
    monkeypatch.setattr(upright, "_symmetry", lambda element, missed, *_: Symmetry(element, missed, 1.0))
    nothing: Any = None
    found = upright._level_mirrors([], nothing, Ball(torch.zeros(3), 1.0), blocks(), UP, 50.0, 4)
    assert [degrees_of(one.element) for one in found] == [0, 90, 45]  # type: ignore[arg-type]
    assert asked == [(60, 5.0)]


@pytest.mark.parametrize(("degrees", "turns"), [(0.0, 2), (90.0, 2), (45.0, 4)])
def test_normals_that_rounding_made_too_long_are_compared_all_the_same(degrees: float, turns: int) -> None:
    """The cosine of two equal ones is more than 1 then."""
    assert upright._fits(at(0, 1 + 1e-6), at(degrees, 1 + 1e-6), turns) == (degrees > 0)


def scene(views: int, alpha: bool = True) -> Any:
    return SimpleNamespace(train=[None] * views, has_alpha=alpha, extent=3.0)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Seams of the search among many photos, and what was asked of them."""
    log = SimpleNamespace(asked=[], misses={}, normals=[], most=[], empty=False, edges=True)
    ball = Ball(torch.zeros(3), 2.0)

    def small(views: list[Any], most: int) -> list[Any]:
        log.asked.append(("photos", most))
        return [photo(30 * i) for i in range(min(len(views), most))]

    def candidates(grid: Any, photos: Any, ball: Ball, normals: Any, apart: float) -> list[Mirror]:
        log.asked.append(("candidates", len(normals), apart))
        return [at(degrees) for degrees in log.normals]

    def refined(mirror: Mirror, silhouettes: Any, ball: Ball, most: float) -> tuple[Mirror, float]:
        log.most.append(most)
        return mirror, log.misses.get(round(math.degrees(math.acos(float(mirror.normal[0])))), 1.0) * most

    monkeypatch.setattr(find, "small_photos", small)
    monkeypatch.setattr(find, "carve", lambda photos, focus: None if log.empty else blocks())
    monkeypatch.setattr(find, "bounding_ball", lambda grid: ball)
    monkeypatch.setattr(find, "Silhouettes", lambda *_: SimpleNamespace(outline_something=log.edges))
    monkeypatch.setattr(find, "candidates", candidates)
    monkeypatch.setattr(find, "refined", refined)
    monkeypatch.setattr(find, "symmetric_part", lambda grid, photos, mirror: "part")
    monkeypatch.setattr(find, "disagreement", lambda shape, photos, mirror, radius: radius / 10)
    monkeypatch.setattr(find, "upright_symmetries", lambda *_: ["upright"])
    return log


def test_a_mirror_may_miss_by_less_the_more_photos_there_are(searched: Any) -> None:
    """By 0.014 of the ball's radius in the photos, over their number."""
    searched.normals, searched.misses = [0, 40, 80], {0: 1.0, 40: 1.001, 80: 0.5}
    for views in (4, 12):
        searched.most.clear()
        found = find.find_symmetries(scene(views))
        photos = [photo(30 * i) for i in range(min(views, 8))]
        pixels = sum(find._projected_radius(one, Ball(torch.zeros(3), 2.0)) for one in photos) / len(photos)
        assert searched.most == pytest.approx([0.014 / views * pixels] * 3)
        assert [one.misses for one in found] == pytest.approx([0.014 / views, 0.007 / views])
        assert [one.disagreement for one in found] == [0.2, 0.2]
    assert searched.asked[:2] == [("photos", 8), ("candidates", 400, 20.0)]


def test_mirrors_within_ten_degrees_are_one(searched: Any) -> None:
    searched.normals = [0, 9.5, 10.5, 20]
    searched.misses = dict.fromkeys(map(round, searched.normals), 0.5)
    found = [round(math.degrees(math.acos(float(one.element.normal[0])))) for one in find.find_symmetries(scene(5))]  # type: ignore[union-attr]
    assert found == [0, 10]


def test_one_to_three_photos_are_judged_upright_and_what_outlines_nothing_not_at_all(searched: Any) -> None:
    searched.normals, searched.misses = [0], {0: 0.5}
    assert find.find_symmetries(scene(3)) == ["upright"]
    (found,) = find.find_symmetries(scene(4))
    assert isinstance(found, Symmetry)
    assert find.find_symmetries(scene(4, alpha=False)) == []
    searched.edges = False
    assert find.find_symmetries(scene(4)) == []
    searched.empty = True
    assert find.find_symmetries(scene(3)) == []


def test_the_radius_of_a_ball_in_a_photo_goes_by_its_own_distance() -> None:
    """A camera within its center sees it as large as numbers go."""
    shown = photo(0)
    eye, focal = shown.camera.centers[0], float(shown.camera.Ks[0, 0, 0])
    ball = Ball(eye + torch.tensor([3.0, 0.0, 4.0]), 0.5)
    assert find._projected_radius(shown, ball) == pytest.approx(0.5 * focal / 5, rel=1e-5)
    assert find._projected_radius(shown, Ball(eye, 0.5)) == pytest.approx(0.5 * focal / 1e-6, rel=1e-5)
