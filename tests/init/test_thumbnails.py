"""Small copies of views: their size, their colors, and what their borders say."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from gsopt.data.scene import View
from gsopt.geometry.cameras import Cameras
from gsopt.init.thumbnails import Thumbnail, colors_from_sums, mean_colors, small_photos


@dataclass(frozen=True)
class Drawn:
    """A store of one image."""

    image: Tensor

    def get(self, index: int) -> Tensor:
        return self.image


def camera(width: int, height: int, x: float = 0.0) -> Cameras:
    """At (x, 0, 0), looking along z, with a focal length of 100 px."""
    K = torch.tensor([[[100.0, 0, width / 2], [0, 100, height / 2], [0, 0, 1]]])
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Cameras(viewmat[None], K, width, height)


def view(image: Tensor, x: float = 0.0) -> View:
    return View("a", camera(image.shape[1], image.shape[0], x), Drawn(image), 0)


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [(512, 300, (512, 300)), (1024, 512, (512, 256)), (256, 1024, (128, 512)), (40, 30, (40, 30))],
)
def test_the_longer_side_of_a_copy_is_at_most_512_px(width: int, height: int, expected: tuple[int, int]) -> None:
    (photo,) = small_photos([view(torch.full((height, width, 3), 90, dtype=torch.uint8))], 1)
    assert (photo.camera.width, photo.camera.height) == expected
    assert photo.planes.shape == (4, expected[1], expected[0])
    assert float(photo.camera.Ks[0, 0, 0]) == pytest.approx(100 * expected[0] / width)


def test_a_copy_without_alpha_is_opaque_and_one_with_alpha_is_premultiplied() -> None:
    opaque = torch.tensor([[[10, 20, 30], [40, 50, 60]]], dtype=torch.uint8)
    (photo,) = small_photos([view(opaque)], 1)
    assert photo.planes.tolist() == [[[10, 40]], [[20, 50]], [[30, 60]], [[255, 255]]]
    masked = torch.tensor([[[10, 20, 30, 0], [200, 100, 50, 51]]], dtype=torch.uint8)
    (photo,) = small_photos([view(masked)], 1)
    assert photo.planes.tolist() == [[[0, 40]], [[0, 20]], [[0, 10]], [[0, 51]]]
    assert photo.alpha().tolist() == [[[0, pytest.approx(0.2)]]]


def test_of_many_views_the_farthest_apart_are_taken_in_their_order() -> None:
    image = torch.zeros(4, 4, 3, dtype=torch.uint8)
    views = [view(image, x) for x in (5.0, 5.1, 0.0, 0.1, 10.0)]
    places = [float(photo.camera.centers[0, 0]) for photo in small_photos(views, 3)]
    assert len(places) == 3
    assert places == [place for place in (5.0, 5.1, 0.0, 0.1, 10.0) if any(abs(place - p) < 1e-5 for p in places)]
    assert max(places) == pytest.approx(10)
    assert min(places) < 0.2
    assert len(small_photos(views, 5)) == 5


@pytest.mark.parametrize(("row", "column"), [(0, 2), (3, 2), (2, 0), (2, 4)])
def test_a_silhouette_at_any_border_does_not_show_all(row: int, column: int) -> None:
    planes = torch.zeros(4, 4, 5, dtype=torch.uint8)
    photo = Thumbnail(camera(5, 4), planes)
    assert not photo.shows_all(), "there is no silhouette"
    planes[3, 1:3, 1:4] = 128
    assert photo.shows_all()
    planes[3, row, column] = 127
    assert photo.shows_all()
    planes[3, row, column] = 128
    assert not photo.shows_all()


def test_a_color_is_its_sum_over_its_alpha_and_gray_without() -> None:
    total = torch.tensor([[0.2, 0.1, 0.4, 0.5], [0.5, 0.25, 1.0, 2.5], [0, 0, 0, 0], [0.3, 0.3, 0.3, 1e-7]])
    found = colors_from_sums(total.T)
    expected = torch.tensor([[0.4, 0.2, 0.8], [0.2, 0.1, 0.4], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    torch.testing.assert_close(found, expected)


def test_a_mean_color_counts_photos_by_alpha_and_only_those_that_show_the_point() -> None:
    red = torch.zeros(4, 10, 10, dtype=torch.uint8)
    red[0], red[3] = 255, 255
    blue = torch.zeros(4, 10, 10, dtype=torch.uint8)
    blue[2], blue[3] = 51, 51
    photos = [Thumbnail(camera(10, 10), red), Thumbnail(camera(10, 10), blue), Thumbnail(camera(10, 10, 50.0), blue)]
    points = torch.tensor([[0.0, 0, 10], [50.0, 0, 10], [0, 0, -10], [20, 0, 10]])
    expected = torch.tensor([[1 / 1.2, 0, 0.2 / 1.2], [0, 0, 1], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]])
    torch.testing.assert_close(mean_colors(photos, points), expected, atol=1e-5, rtol=0)
