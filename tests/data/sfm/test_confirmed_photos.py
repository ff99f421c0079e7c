"""A photo is placed where a third photo, or a triangle of photos, confirms the points that hold it."""

from __future__ import annotations

import pytest
from test_mapping_rules import Reconstruction, shared

from gsopt.data.sfm.few_photos import keep_confirmed, sides_of_triangles


@pytest.mark.parametrize(("count", "kept"), [(50, {1, 2, 3, 4}), (49, {1, 2, 3})])
def test_a_photo_is_confirmed_by_fifty_points_of_three_photos(count: int, kept: set[int]) -> None:
    model = Reconstruction([1, 2, 3, 4], [*shared(60, 1, 2, 3), *shared(count, 2, 3, 4)])
    keep_confirmed(model)
    assert model.photos == kept


@pytest.mark.parametrize(("count", "kept"), [(30, {1, 2, 3}), (29, set())])
def test_three_photos_confirm_each_other_pair_by_pair(count: int, kept: set[int]) -> None:
    """No point is seen three times. Photo 4 makes no triangle: along its baseline it could stand anywhere."""
    pairs = [*shared(60, 1, 2), *shared(60, 2, 3), *shared(count, 1, 3), *shared(999, 3, 4)]
    model = Reconstruction([1, 2, 3, 4], pairs)
    keep_confirmed(model)
    assert model.photos == kept


def test_sides_of_triangles_are_pairs_with_a_third_photo_in_common() -> None:
    triangle = {(1, 2), (2, 3), (1, 3)}
    assert sides_of_triangles(triangle) == triangle
    assert sides_of_triangles({*triangle, (3, 4), (4, 5)}) == triangle
    assert sides_of_triangles({(1, 2), (2, 3), (3, 4), (1, 4)}) == set()


def test_photos_go_one_by_one_the_weakest_first() -> None:
    """Without photo 4 nothing is left that three photos see."""
    model = Reconstruction([1, 2, 3, 4], [*shared(30, 1, 2, 4), *shared(29, 2, 3, 4)])
    keep_confirmed(model)
    assert model.photos == set()
    keep_confirmed(model)
