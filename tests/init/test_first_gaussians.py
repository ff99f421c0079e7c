"""The choice of the method for the first Gaussians, and their properties."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from shapes import ellipsoid_scene, spread_cameras

from gsopt.config.train import DataConfig, InitConfig
from gsopt.data.scene import Points, Scene, load_scene
from gsopt.errors import UsageError
from gsopt.geometry.cameras import Cameras, look_at
from gsopt.geometry.focus import Focus, find_focus
from gsopt.geometry.projection import project, sees
from gsopt.geometry.sh import rgb_from_sh0
from gsopt.init import first_gaussians
from gsopt.init.frustum import BACKGROUND_FAR, random_points
from gsopt.init.neighbors import mean_neighbor_distance

pytestmark = pytest.mark.usefixtures("coarse_hull")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    root = ellipsoid_scene(tmp_path_factory.mktemp("scene"), spread_cameras(8), (0.0, 0.0, 0.0), (0.8, 0.6, 0.5))
    return load_scene(root)


def with_points(scene: Scene, count: int) -> Scene:
    generator = torch.Generator().manual_seed(0)
    xyz = torch.randn(count, 3, generator=generator)
    rgb = torch.randint(0, 256, (count, 3), generator=generator, dtype=torch.uint8)
    return dataclasses.replace(scene, points=Points(xyz, rgb))


def test_auto_prefers_points_then_the_hull_then_random(scene: Scene) -> None:
    config = InitConfig(count=200)
    without_alpha = dataclasses.replace(scene, has_alpha=False, train=scene.train[:1])  # one photo: no stereo
    for given, word in (
        (with_points(scene, 100), "points that came with the scene"),
        (with_points(scene, 99), "visual hull"),
        (scene, "visual hull"),
        (without_alpha, "random"),
        (with_points(without_alpha, 99), "random"),
    ):
        gaussians, said = first_gaussians(given, config, 2, 0)
        assert word in said
        assert "\n" not in said
        assert gaussians.validate().sh_degree == 2


def test_few_photos_that_agree_come_before_few_points(scene: Scene) -> None:
    """A thousand sparse points lost 2.9 dB to stereo on a real capture; as many points as wanted do not."""
    opaque = dataclasses.replace(scene, has_alpha=False)
    for known, word in ((100, "by stereo"), (199, "by stereo"), (200, "points that came with the scene")):
        _, said = first_gaussians(with_points(opaque, known), InitConfig(count=200), 2, 0)
        assert word in said


@pytest.mark.parametrize("method", ["points", "hull", "random"])
def test_what_every_method_gives(scene: Scene, method: str) -> None:
    given = with_points(scene, 150)
    gaussians, said = first_gaussians(given, InitConfig(method=method, count=300), 3, 0)  # type: ignore[arg-type]
    assert len(gaussians) == (150 if method == "points" else 300)
    assert said
    assert gaussians.shN.shape == (len(gaussians), 15, 3)
    assert not bool(gaussians.shN.any())
    assert torch.allclose(gaussians.opacities, torch.tensor(0.1))
    assert torch.equal(gaussians.quats, torch.tensor([[1.0, 0, 0, 0]]).expand(len(gaussians), 4))
    distance = mean_neighbor_distance(gaussians.means)
    assert torch.allclose(gaussians.scales, distance[:, None].expand(-1, 3), rtol=1e-5)
    colors = rgb_from_sh0(gaussians.sh0)
    assert float(colors.min()) > -1e-6
    assert float(colors.max()) < 1 + 1e-6
    for _, tensor in gaussians.items():
        assert tensor.dtype == torch.float32
        assert not tensor.requires_grad


def test_points_keep_their_places_and_colors(scene: Scene) -> None:
    given = with_points(scene, 120)
    gaussians, _ = first_gaussians(given, InitConfig(), 0, 0)
    assert given.points is not None
    assert torch.equal(gaussians.means, given.points.xyz)
    assert torch.equal((rgb_from_sh0(gaussians.sh0[:, 0]) * 255).round().to(torch.uint8), given.points.rgb)


@pytest.mark.parametrize("method", ["hull", "random"])
def test_the_seed_decides_and_nothing_else(scene: Scene, method: str) -> None:
    config = InitConfig(method=method, count=100)  # type: ignore[arg-type]
    first, again, other = (first_gaussians(scene, config, 1, seed)[0] for seed in (5, 5, 6))
    for (name, a), (_, b) in zip(first.items(), again.items(), strict=True):
        assert torch.equal(a, b), name
    assert not torch.equal(first.means, other.means)


@pytest.mark.parametrize(("method", "message"), [("points", "needs a scene with points"), ("hull", "needs alpha")])
def test_a_method_the_scene_cannot_serve_is_refused(scene: Scene, method: str, message: str) -> None:
    bare = dataclasses.replace(scene, has_alpha=False)
    with pytest.raises(UsageError, match=message):
        first_gaussians(bare, InitConfig(method=method), 0, 0)  # type: ignore[arg-type]


def test_random_points_are_seen_by_at_least_half_of_the_cameras_and_fill_the_view(scene: Scene) -> None:
    cameras = [view.camera for view in scene.train]
    focus = find_focus(cameras, scene.extent)
    assert focus.converging
    points = random_points(cameras, focus, 500, False, torch.Generator().manual_seed(0))
    seen = torch.stack([sees(camera, points) for camera in cameras]).sum(0)
    assert int(seen.min()) * 2 >= len(cameras)
    # What half of the cameras see of a ball around the origin is not a corner of it.
    assert float(points.mean(0).norm()) < 0.2
    assert float(points.norm(dim=1).quantile(0.9)) > 1


def cameras_at(eyes: torch.Tensor, targets: torch.Tensor) -> list[Cameras]:
    up = torch.tensor([0.0, 0, 1])
    viewmats = torch.cat([look_at(e[None], t, up) for e, t in zip(eyes, targets, strict=True)])
    model = spread_cameras(1).to(torch.float32)
    return [dataclasses.replace(model, viewmats=viewmats[i : i + 1]) for i in range(len(eyes))]


def test_no_random_point_is_drawn_where_fewer_than_half_of_the_cameras_look() -> None:
    """Half of these cameras look above the middle, half below: a third of the ball that they frame is not common."""
    angles = torch.arange(8) * (torch.pi / 4)
    eyes = 3 * torch.stack([angles.cos(), angles.sin(), torch.full((8,), 0.2)], dim=1)
    cameras = cameras_at(eyes, torch.tensor([[0.0, 0, 1.3], [0, 0, -1.3]]).repeat(4, 1))
    focus = find_focus(cameras, 1.0)
    assert focus.converging

    def seen(points: torch.Tensor) -> torch.Tensor:
        return torch.stack([sees(camera, points) for camera in cameras]).sum(0)

    cube = focus.radius * (2 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(1)) - 1)
    ball = cube[cube.norm(dim=1) < focus.radius]
    assert float((2 * seen(focus.point + ball) < 8).double().mean()) > 0.2
    points = random_points(cameras, focus, 500, False, torch.Generator().manual_seed(0))
    assert 2 * int(seen(points).min()) >= 8


def test_points_along_pixels_lie_at_uniform_inverse_depths() -> None:
    """From a fifth of the distance to the focus on to BACKGROUND_FAR of them, where the axes do not meet."""
    camera = cameras_at(torch.tensor([[3.0, 0, 0]]), torch.zeros(1, 3))[0]
    focus = Focus(torch.zeros(3), 3.0, 1.0, converging=False)
    _, _, depths = project(camera, random_points([camera], focus, 4000, False, torch.Generator().manual_seed(0)))
    near, far = 1 / (0.2 * 3), 1 / (BACKGROUND_FAR * 3)
    share = (1 / depths - far) / (near - far)
    assert -1e-4 < float(share.min()) < 0.01
    assert 0.99 < float(share.max()) < 1 + 1e-4
    torch.testing.assert_close(share.sort().values, torch.linspace(0, 1, 4000), rtol=0, atol=0.04)


EYES = torch.tensor([[3.0, 0, 0], [0, 3.0, 0.1], [-3.0, 0.1, 0], [0.1, -3.0, 0]])
ARRANGEMENTS = {
    "two that face each other": cameras_at(EYES[[0, 2]], torch.zeros(2, 3)),
    "outward": cameras_at(EYES, 2 * EYES),
    "parallel": cameras_at(EYES * 0.1, EYES * 0.1 + torch.tensor([9.0, 0, 0])),
    "one": cameras_at(EYES[:1], torch.zeros(1, 3)),
    "one that looks past the origin": cameras_at(EYES[:1], torch.tensor([[3.0, 5, 5]])),
    "all in one place": cameras_at(EYES[[0, 0, 0]], torch.tensor([[0.0, 0, 0], [0, 5, 0], [9, 9, 9]])),
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_every_arrangement_gets_finite_points_before_some_camera(name: str) -> None:
    cameras = ARRANGEMENTS[name]
    focus = find_focus(cameras, 1.0)
    points = random_points(cameras, focus, 200, True, torch.Generator().manual_seed(0))
    assert points.shape == (200, 3)
    assert bool(points.isfinite().all())
    seen = torch.stack([sees(camera, points) for camera in cameras]).any(0)
    assert float(seen.double().mean()) > 0.95


def test_real_lego_from_eight_views(shared_data: Path) -> None:
    scene = load_scene(DataConfig(path=str(shared_data / "views" / "nerf_synthetic_lego_400"), views=8))
    gaussians, said = first_gaussians(scene, InitConfig(count=3000), 0, 0)
    assert "visual hull of 8 silhouettes" in said
    assert len(gaussians.validate()) == 3000
    # Yellow bricks dominate: red and green above blue.
    red, green, blue = rgb_from_sh0(gaussians.sh0[:, 0]).mean(0).tolist()
    assert min(red, green) > blue + 0.1


def test_real_fox_without_points_or_alpha(shared_data: Path) -> None:
    scene = load_scene(DataConfig(path=str(shared_data / "views" / "fox"), views=6, downscale=4))
    gaussians, said = first_gaussians(scene, InitConfig(count=300), 1, 0)
    assert "stereo" in said
    gaussians.validate()
