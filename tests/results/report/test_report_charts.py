"""Charts of the report: where their lines and ticks lie, and which numbers they print."""

from __future__ import annotations

import re

import pytest

from gsopt.results.report import charts


def numbers(pattern: str, svg: str) -> list[float]:
    return [float(found) for found in re.findall(pattern, svg)]


def test_a_line_goes_from_corner_to_corner_of_its_axes() -> None:
    """The axes end at round numbers; the frame is 360 x 210 with margins of 52, 14, 14 and 36."""
    svg = charts.line_chart("PSNR", [(0.0, 0.0), (50.0, 5.0), (100.0, 10.0)], unit=" dB")
    assert 'points="52.0,174.0 199.0,94.0 346.0,14.0"' in svg
    assert 'cx="346.0" cy="14.0"' in svg
    assert "<b>10 dB</b>" in svg
    assert numbers(r'class="grid" x1="52" x2="346" y1="([\d.]+)"', svg) == [174, 94, 14]
    assert re.findall(r'text-anchor="end">([^<]+)<', svg) == ["0", "5", "10", "step"]
    assert re.findall(r'text-anchor="middle">([^<]+)<', svg) == ["0", "50", "100"]
    assert numbers(r'x="([\d.]+)" y="[\d.]+" text-anchor="middle"', svg) == [52, 199, 346]


def test_a_logarithmic_axis_has_equal_ways_for_equal_factors() -> None:
    svg = charts.line_chart("Loss", [(0.0, 1.0), (1.0, 10.0), (2.0, 100.0)], log=True)
    assert 'points="52.0,174.0 199.0,94.0 346.0,14.0"' in svg


def test_the_scale_covers_ticks_beyond_the_values() -> None:
    """Values 1 to 9 have ticks 0 to 10."""
    svg = charts.line_chart("n", [(0.0, 1.0), (100.0, 9.0)])
    assert 'points="52.0,158.0 346.0,30.0"' in svg


def test_labels_stand_within_the_frame_and_outside_of_the_axes() -> None:
    svg = charts.line_chart("n", [(0.0, 0.0), (100.0, 10.0)])
    left = numbers(r'class="tick" x="([\d.]+)" y="[\d.]+" text-anchor="end">\d', svg)
    below = numbers(r'y="([\d.]+)" text-anchor="middle"', svg)
    assert all(30 < x < 52 for x in left)
    assert all(174 < y < 210 for y in below)
    assert len(left) == len(below) == 3


def test_two_points_are_a_chart_and_one_is_none() -> None:
    assert "polyline" in charts.line_chart("n", [(0.0, 1.0), (1.0, 2.0)])
    assert "polyline" not in charts.line_chart("n", [(0.0, 1.0)])
    assert "polyline" in charts.line_chart("n", [(0.0, 0.0), (1.0, 2.0), (2.0, 3.0)], log=True)
    assert "polyline" not in charts.line_chart("n", [(0.0, 0.0), (1.0, 2.0)], log=True)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 7, [0, 2, 4, 6, 8]),
        (0, 40, [0, 10, 20, 30, 40]),
        (0, 4, [0, 1, 2, 3, 4]),
        (-3, 16.5, [-5, 0, 5, 10, 15, 20]),
        (5, 5, [4.6, 4.8, 5.0, 5.2, 5.4]),
        (0, 0, [-0.05, 0, 0.05]),
        (-40, -40, [-42, -41, -40, -39, -38]),
    ],
)
def test_ticks_are_the_nearest_multiples_of_one_two_or_five(low: float, high: float, expected: list[float]) -> None:
    assert charts.ticks(low, high, 4) == expected


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (1e-6, 3, [1e-6, 2e-5, 5e-4, 1e-2, 0.2, 5]),
        (0.5, 0.5, [0.5, 1]),
        (0.02, 0.021, [0.02, 0.05]),
        (3, 300, [2, 5, 10, 20, 50, 100, 200, 500]),
        (1, 1000, [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]),
        (1, 2000, [1, 5, 20, 100, 500, 2000]),
    ],
)
def test_logarithmic_ticks_are_the_nearest_around_and_fewer_where_there_are_many(
    low: float, high: float, expected: list[float]
) -> None:
    assert charts.log_ticks(low, high) == pytest.approx(expected)


def test_many_points_become_means_of_runs_and_the_last_stays() -> None:
    points = [(float(step), float(step % 2)) for step in range(301)]
    assert charts.thinned(points[:300]) == points[:300]
    found = charts.thinned(points)
    assert found == [*((2 * pair + 0.5, 0.5) for pair in range(150)), (300.0, 0.0)]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.000123461, "0.0001235"),
        (9999, "9999"),
        (10_000, "10k"),
        (12_345, "12.35k"),
        (-25_000, "-25k"),
        (999_900, "999.9k"),
        (1_000_000, "1M"),
        (-3_210_000, "-3.21M"),
    ],
)
def test_numbers_have_four_digits_and_thousands_a_letter(value: float, text: str) -> None:
    assert charts.short(value) == text


@pytest.mark.parametrize("high", [5e-324, 1e-301, 0.0])
def test_values_that_are_all_but_equal_have_ticks(high: float) -> None:
    assert charts.ticks(0, high, 4) == [-0.05, 0, 0.05]
    assert 'points="52.0,' in charts.line_chart("PSNR", [(0.0, 0.0), (high, high)])
