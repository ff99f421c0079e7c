"""Values of an image at points of the scene, against projection and bilinear interpolation one after the other."""

from __future__ import annotations

import math

import pytest
import torch

from gsopt.data.lookup import Picture, lowest
from gsopt.data.resample import sample
from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.projection import inside, project
from gsopt.raster import _cpu  # type: ignore[attr-defined]
from gsopt.raster.cpu_backend import workspace
from gsopt.raster.threads import one_torch_thread, preparing_threads

WIDTH, HEIGHT = 40, 30
K = torch.tensor([[[50.0, 0, 19], [0, 45, 16], [0, 0, 1]]])
CAMERA = Cameras(look_at(torch.tensor([[3.0, -2, 1]]), torch.zeros(3), torch.tensor([0.0, 0, 1])), K, WIDTH, HEIGHT)
AHEAD = Cameras(torch.eye(4)[None], K, WIDTH, HEIGHT)


def values(
    camera: Cameras,
    image: torch.Tensor,
    points: torch.Tensor,
    *,
    unseen: float,
    beside: float | None = None,
    radius: float = 0.0,
) -> torch.Tensor:
    """The values of one picture."""
    return lowest([Picture(camera, image, unseen)], points, beside=beside, radius=radius)[0]


def random_points(count: int) -> torch.Tensor:
    """Half of them lie near the origin, where the camera looks, and some behind the camera."""
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(count))
    return torch.cat([points[::2] * 0.5, points[1::2] * 4])


def test_any_number_of_threads_gives_the_same_bits() -> None:
    """The points are more than one thread takes at once, and the last of them stands alone."""
    image = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    points = random_points(2 * 2048 + 1)
    expected = lowest([Picture(CAMERA, image, unseen=-3.0)], points, beside=0.5, radius=0.1)
    with one_torch_thread(3):
        found = lowest([Picture(CAMERA, image, unseen=-3.0)], points, beside=0.5, radius=0.1)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_the_threads_that_prepare_a_scene_are_those_of_the_run_around() -> None:
    assert preparing_threads() == 1
    with one_torch_thread(3):
        assert preparing_threads() == 3
        with one_torch_thread():
            assert preparing_threads() == 1
        assert preparing_threads() == 3
    assert preparing_threads() == 1


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
@pytest.mark.parametrize("count", [1, 7, 8, 500])
@pytest.mark.parametrize("finer", [1, 2])
def test_a_value_is_that_between_the_pixels_of_the_projection(
    isa: str, count: int, finer: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSOPT_ISA", isa)
    image = torch.rand(1, finer * HEIGHT, finer * WIDTH, generator=torch.Generator().manual_seed(0))
    points = random_points(count)
    column, row, depth = project(CAMERA, points)
    expected = sample(image, finer * column, finer * row)[0]
    found = values(CAMERA, image[0], points, unseen=-3.0)
    torch.testing.assert_close(found, torch.where(depth > 0, expected, -3.0), atol=2e-4, rtol=0)
    within = values(CAMERA, image[0], points, beside=-3.0, unseen=-3.0)
    torch.testing.assert_close(within, torch.where(inside(CAMERA, column, row, depth), found, -3.0), atol=0, rtol=0)


def test_what_lies_beside_or_behind_the_camera_is_near_a_ball_that_holds_or_passes_it() -> None:
    behind = torch.tensor([[0.0, 0, -3], [900, 0, 0.9], [900, 0, 1.1]])
    found = values(AHEAD, torch.ones(HEIGHT, WIDTH), behind, beside=3.0, radius=1.0, unseen=0.0)
    assert found.tolist() == [3.0, 3.0, 0.0]


def test_points_of_any_shape_have_values_of_that_shape() -> None:
    points = random_points(60)
    found = values(CAMERA, torch.rand(HEIGHT, WIDTH), points.view(3, 4, 5, 3), unseen=0.0)
    assert found.shape == (3, 4, 5)
    assert values(CAMERA, torch.rand(HEIGHT, WIDTH), points[:0], unseen=0.0).shape == (0,)


def test_a_camera_sees_a_ball_that_reaches_into_its_image() -> None:
    """A radius of one at a depth of eleven, whose near side is ten away, reaches five pixels beyond each border."""

    def place(column: float, row: float) -> list[float]:
        return [11 * (column - 19) / 50, 11 * (row - 16) / 45, 11.0]

    image = torch.full((HEIGHT, WIDTH), 2.0)
    seen = [place(-4.9, 9), place(44.9, 9), place(9, -4.9), place(9, 34.9)]
    beyond = [place(-5.1, 9), place(45.1, 9), place(9, -5.1), place(9, 35.1)]
    found = values(AHEAD, image, torch.tensor(seen + beyond), beside=3.0, radius=1.0, unseen=0.0)
    assert found.tolist() == [3.0] * len(seen) + [0.0] * len(beyond)
    assert values(AHEAD, image, torch.tensor(seen), beside=3.0, unseen=0.0).tolist() == [0.0] * len(seen)
    assert values(AHEAD, image, torch.tensor(seen), unseen=0.0).tolist() == [2.0] * len(seen)


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_points_that_are_nowhere_are_not_seen(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSOPT_ISA", isa)
    points = torch.tensor([[math.nan, 0, 1], [0, math.nan, 1], [0, 0, math.nan], [0, 0, 0], [0, 0, -1]])
    assert values(AHEAD, torch.ones(HEIGHT, WIDTH), points, unseen=-1.0).tolist() == [-1] * 5
    far = torch.tensor([[1e38, 0, 1e-6], [-1e38, 1e38, 1e-6], [math.inf, 0, 1]])
    assert values(AHEAD, torch.ones(HEIGHT, WIDTH), far, beside=3.0, unseen=-1.0).tolist() == [-1] * 3


def test_an_image_of_one_pixel_is_that_everywhere() -> None:
    assert set(values(CAMERA, torch.full((1, 1), 0.5), random_points(50), unseen=0.5).tolist()) == {0.5}


@pytest.mark.parametrize("isa", _cpu.instruction_sets())
def test_the_lowest_value_of_several_pictures_counts(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """How many pictures show a point is known of those that were looked at: one is enough where it has a low value."""
    monkeypatch.setenv("GSOPT_ISA", isa)
    pictures = [
        Picture(camera, torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(row)), -row)
        for row, camera in enumerate((CAMERA, AHEAD, CAMERA))
    ]
    points = random_points(301)
    each = torch.stack([values(one.camera, one.image, points, unseen=one.unseen) for one in pictures])
    sees = torch.stack([inside(one.camera, *project(one.camera, points)) for one in pictures])
    found, shown = lowest(pictures, points)
    assert torch.equal(found, each.amin(0))
    assert torch.equal(shown, sees.sum(0).int())
    early, few = lowest(pictures, points, enough=0.3)
    assert torch.equal(early > 0.3, found > 0.3)
    assert torch.equal(early[found > 0.3], found[found > 0.3])
    assert torch.equal(few[found > 0.3], shown[found > 0.3])
    assert bool((few <= shown).all())
    low = lowest(pictures, points[:1].expand(8, 3), enough=float("inf"))[0]
    assert low.tolist() == each[0, :1].tolist() * 8, "the first picture has a value low enough"


def test_kernels_refuse_what_does_not_fit_together() -> None:
    found, shown, points = torch.empty(3), torch.empty(3, dtype=torch.int32), torch.zeros(3, 3)
    parts = Picture(AHEAD, torch.ones(2, 2), 0.0).parts
    with pytest.raises(ValueError, match="points: wrong number"):
        _cpu.lookup(workspace(1), points[:2], [parts], None, 0.0, 0.0, found, shown)
    with pytest.raises(ValueError, match="shown: wrong number"):
        _cpu.lookup(workspace(1), points, [parts], None, 0.0, 0.0, found, shown[:2])
    with pytest.raises(ValueError, match="no picture"):
        _cpu.lookup(workspace(1), points, [], None, 0.0, 0.0, found, shown)
    with pytest.raises(ValueError, match="an empty image"):
        _cpu.lookup(workspace(1), points, [(*parts[:3], torch.ones(0, 2), 0.0)], None, 0.0, 0.0, found, shown)
    cells, lost = torch.ones(2, 2, 2, dtype=torch.uint8), torch.empty(1)
    plane, offset = torch.tensor([[1.0, 0, 0]]), torch.zeros(1)
    for rows, pixel in (([3], [0]), ([-1], [0]), ([0], [5]), ([0], [-1])):
        photo = (torch.tensor(rows, dtype=torch.int32), torch.tensor(pixel, dtype=torch.int32), 5)
        with pytest.raises(ValueError, match="what is not there"):
            _cpu.mirror(workspace(1), points, plane, offset, cells, [photo], lost)
