"""Coverage by the inputs, candidate cameras of guidance, and the words for their sides."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_scenes import cloud

from gsopt.config.guidance import GuidanceConfig
from gsopt.data.background import Background
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras, intrinsics, look_at
from gsopt.raster.api import make_backend
from gsopt.sds import coverage
from gsopt.sds.candidate_views import AZIMUTHS, HIGHEST, LOWEST, draw_candidate, guidance_cameras, nearest, square
from gsopt.sds.guidance_plan import GuidancePlan
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import References

BACKEND = make_backend("cpu", 1)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def camera(azimuth: float, elevation: float = 0.0, distance: float = 4.0, width: int = 64, height: int = 64) -> Cameras:
    a, e = math.radians(azimuth), math.radians(elevation)
    eye = distance * torch.tensor([[math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]]).double()
    viewmat = look_at(eye, torch.zeros(3, dtype=torch.float64), UP)
    return Cameras(viewmat.float(), intrinsics(0.8, width, height)[None].float(), width, height)


def wall(x: float, *, scale: float = 0.1, thin: float = 0.01) -> Gaussians:
    """An opaque sheet of discs facing +x at this x, 1.6 units wide."""
    line = torch.linspace(-0.8, 0.8, 17)
    y, z = torch.meshgrid(line, line, indexing="ij")
    n = y.numel()
    return Gaussians(
        means=torch.stack([torch.full((n,), x), y.flatten(), z.flatten()], dim=1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.tensor([[thin, scale, scale]]).log().repeat(n, 1),
        logit_opacities=torch.full((n,), 4.0),
        sh0=torch.zeros(n, 1, 3),
        shN=torch.zeros(n, 0, 3),
    )


TWO_WALLS = wall(0.5).append(wall(-0.5))
FRONT, BACK = slice(0, 289), slice(289, 578)


def test_what_an_input_sees_is_covered_and_what_lies_behind_is_not() -> None:
    covered = coverage.coverage(TWO_WALLS, [camera(0)], BACKEND)
    assert float(covered[FRONT].min()) > 0.9
    inner = TWO_WALLS.means[BACK, 1:].abs().amax(1) < 0.7  # the rim may peep past the front wall
    assert float(covered[BACK][inner].max()) == 0.0


@pytest.mark.parametrize(("logit", "covered"), [(-3.6, 1.0), (0.0, 0.0)], ids=["haze", "wall"])
def test_what_lies_behind_haze_is_covered(logit: float, covered: float) -> None:
    """An alpha below 0.5 hides nothing, wherever its depth is."""
    front, back = wall(0.5), wall(-0.5)
    front = replace(front, logit_opacities=torch.full_like(front.logit_opacities, logit))
    back = replace(back, logit_opacities=torch.full_like(back.logit_opacities, -6.0))
    alpha = BACKEND.forward(front.append(back), camera(0), coverage.PLAIN).alphas[24:40, 24:40]
    assert bool((alpha < coverage.SOLID).all() if covered else (alpha > coverage.SOLID).all())
    inner = back.means[:, 1:].abs().amax(1) < 0.5
    seen = coverage.coverage(front.append(back), [camera(0)], BACKEND)[BACK][inner]
    assert seen.tolist() == pytest.approx([covered] * int(inner.sum()), abs=0.05)


def test_a_large_disc_a_little_behind_the_surface_is_seen_and_a_small_one_is_not() -> None:
    """A center may lie behind the depth map by two of its largest standard deviations."""
    for scale, covered in ((0.3, 1.0), (0.05, 0.0)):
        disc = wall(0.1, scale=scale)
        middle = disc.means[:, 1:].abs().amax(1) < 1e-3
        disc = replace(disc, **{name: tensor[middle] for name, tensor in disc.items()})
        seen = coverage.coverage(wall(0.5).append(disc), [camera(0)], BACKEND)[-1]
        assert float(seen) == covered


@pytest.mark.parametrize("shape", [(5, 9), (9, 5), (1, 3)])
def test_the_surface_of_its_own_pixel_hides_a_ball(shape: tuple[int, int]) -> None:
    """At every pixel, those of the border too: depths that differ wildly from pixel to pixel."""
    height, width = shape
    surface = 1 + 9 * torch.rand(height, width, generator=torch.Generator().manual_seed(1))
    alphas = 0.6 + 0.4 * torch.rand(height, width, generator=torch.Generator().manual_seed(2))
    frame = SimpleNamespace(depths=surface * alphas, alphas=alphas)
    backend: Any = SimpleNamespace(forward=lambda *_, **__: frame)
    eye = camera(30.0, 10.0, width=width, height=height)
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    rays = torch.stack([columns + 0.5, rows + 0.5, torch.ones(shape)], -1).double() @ eye.Ks[0].double().inverse().T
    for share in (0.9, 1.1):
        points = (share * surface.double()[..., None] * rays).reshape(-1, 3) - eye.viewmats[0, :3, 3].double()
        means = (points @ eye.viewmats[0, :3, :3].double()).float()
        balls = replace(cloud(len(means), 0), means=means, log_scales=torch.full((len(means), 3), -9.0))
        assert coverage.seen(balls, eye, backend).tolist() == pytest.approx([float(share < 1)] * len(means), abs=1e-4)


@pytest.mark.parametrize(
    ("size", "small"), [((512, 256), (128, 64)), ((256, 512), (64, 128)), ((100, 60), (100, 60)), ((4000, 2), (128, 1))]
)
def test_the_longer_side_of_a_depth_map_is_bounded(size: tuple[int, int], small: tuple[int, int]) -> None:
    found = coverage._small(camera(0.0, width=size[0], height=size[1]))
    assert (found.width, found.height) == small


def test_every_view_that_sees_it_adds_up_and_uncertainty_falls() -> None:
    inputs = [camera(azimuth) for azimuth in (0, 10, -10, 20)]
    means = []
    for count in range(5):
        covered = coverage.coverage(TWO_WALLS, inputs[:count], BACKEND)
        means.append(float(coverage.uncertainty(covered)[FRONT].mean()))
    assert means[0] == 1.0
    assert all(later < 0.45 * before for before, later in itertools.pairwise(means))


def test_a_disc_seen_edge_on_does_not_count_and_a_ball_does_from_everywhere() -> None:
    eye = torch.tensor([0.5, 4.0, 0.0])
    assert float(coverage.facing(wall(0.5), eye).max()) < 0.11
    assert float(coverage.facing(wall(0.5), torch.tensor([4.0, 0.0, 0.0])).min()) > 0.9
    ball = wall(0.5, scale=0.1, thin=0.1)
    assert coverage.facing(ball, eye).tolist() == [1.0] * len(ball)


@pytest.mark.parametrize("eye", [(4.0, 0.0, 0.0), (0.5, 4.0, 0.0), (0.5, 0.0, -4.0), (3.0, 2.0, 1.0)])
def test_a_needle_counts_from_everywhere(eye: tuple[float, float, float]) -> None:
    """It has no face: only a shape that is thin along one axis alone is turned away."""
    needle = wall(0.5, scale=0.01, thin=1.0)
    assert coverage.facing(needle, torch.tensor(eye)).tolist() == pytest.approx([1.0] * len(needle))


def test_the_map_is_bright_from_behind_and_dark_from_the_input() -> None:
    u = coverage.uncertainty(coverage.coverage(TWO_WALLS, [camera(0), camera(8)], BACKEND))
    seen, unseen = (coverage.uncertainty_map(TWO_WALLS, u, camera(a), BACKEND) for a in (4, 180))
    middle = slice(28, 36)
    assert float(seen[middle, middle].mean()) < 0.2
    assert float(unseen[middle, middle].mean()) > 0.9
    assert float(unseen[0].max()) == 0.0  # nothing there, nothing to guide
    means = coverage.mean_uncertainty(TWO_WALLS, u, Cameras.cat([camera(4), camera(180), camera(90)]), BACKEND)
    assert float(means[0]) < float(means[2]) < float(means[1])


def test_an_empty_view_is_not_uncertain() -> None:
    away = replace(camera(0), viewmats=look_at(torch.tensor([[9.0, 0, 0]]), torch.tensor([20.0, 0, 0]), UP.float()))
    assert coverage.mean_uncertainty(TWO_WALLS, torch.ones(578), away, BACKEND).tolist() == [0.0]


def test_coverage_does_not_depend_on_the_world_frame() -> None:
    """Rotating and shifting Gaussians and cameras together changes nothing."""
    from gsopt.geometry.quats import multiply

    half = math.sqrt(0.5)
    turn = torch.tensor([half, 0.0, 0.0, half])  # 90 degrees about z
    R, t = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), torch.tensor([1.0, 2.0, 3.0])
    moved = replace(TWO_WALLS, means=TWO_WALLS.means @ R.T + t, quats=multiply(turn.expand(578, 4), TWO_WALLS.quats))
    original = camera(20, 10)
    viewmat = original.viewmats.clone()
    viewmat[0, :3, :3] = viewmat[0, :3, :3] @ R.T
    viewmat[0, :3, 3] -= viewmat[0, :3, :3] @ t
    a = coverage.coverage(TWO_WALLS, [original], BACKEND)
    b = coverage.coverage(moved, [replace(original, viewmats=viewmat)], BACKEND)
    torch.testing.assert_close(a, b, rtol=0, atol=1e-3)


def test_no_more_views_are_looked_through_than_matter() -> None:
    many = [camera(3.6 * i) for i in range(100)]
    assert len(coverage.spread(many)) == coverage.MAX_VIEWS
    assert coverage.spread(many[:5]) == many[:5]


@pytest.mark.parametrize("cosine", [0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 1.0])
@pytest.mark.parametrize(("middle", "longest"), [(0.1, 0.1), (0.02, 0.1)])
def test_a_flat_shape_fades_from_half_face_on_to_a_tenth(cosine: float, middle: float, longest: float) -> None:
    """Hermite's step between |cos| 0.1 and 0.5; only as much as the shape is flat: 1 - shortest / middle."""
    disc = replace(wall(0.0), log_scales=torch.tensor([[0.01, middle, longest]]).log().repeat(289, 1))
    disc = replace(disc, means=torch.zeros(289, 3))
    for sign in (1, -1):
        eye = 3 * torch.tensor([sign * cosine, math.sqrt(1 - cosine**2), 0.0])
        x = min(1.0, max(0.0, (cosine - 0.1) / 0.4))
        expected = 1 - (1 - 0.01 / middle) * (1 - (3 * x**2 - 2 * x**3))
        assert coverage.facing(disc, eye)[0].item() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("behind", "covered"), [(0.99, 1.0), (1.01, 0.0)])
def test_a_center_may_lie_two_deviations_and_a_fiftieth_of_the_depth_behind_the_surface(
    behind: float, covered: float
) -> None:
    frame = SimpleNamespace(depths=torch.full((8, 8), 5.0), alphas=torch.ones(8, 8))
    backend: Any = SimpleNamespace(forward=lambda *_, **__: frame)
    eye = Cameras(torch.eye(4)[None], intrinsics(0.8, 8, 8)[None].float(), 8, 8)
    depth = 5.0 + behind * (2 * 0.2 + 0.02 * 5.0)
    ball = replace(cloud(1, 0), means=torch.tensor([[0.0, 0.0, depth]]), log_scales=torch.full((1, 3), math.log(0.2)))
    assert coverage.seen(ball, eye, backend).tolist() == pytest.approx([covered])


def test_32_views_are_looked_through_and_their_order_stays() -> None:
    many = [camera(3.6 * i) for i in range(33)]
    found = coverage.spread(many)
    assert len(found) == 32
    assert coverage.spread(many[:32]) == many[:32]
    rows = [next(row for row, one in enumerate(many) if one is view) for view in found]
    assert rows == sorted(set(rows))


@pytest.mark.parametrize(("alpha", "covered"), [(0.5, 1.0), (0.51, 0.0)])
def test_a_pixel_hides_what_is_behind_it_above_half_opacity(alpha: float, covered: float) -> None:
    frame = SimpleNamespace(depths=torch.full((8, 8), alpha), alphas=torch.full((8, 8), alpha))
    backend: Any = SimpleNamespace(forward=lambda *_, **__: frame)
    eye = Cameras(torch.eye(4)[None], intrinsics(0.8, 8, 8)[None].float(), 8, 8)
    ball = replace(cloud(1, 0), means=torch.tensor([[0.0, 0.0, 9.0]]), log_scales=torch.full((1, 3), -5.0))
    assert coverage.seen(ball, eye, backend).tolist() == pytest.approx([covered])


INPUTS = [camera(0, 20), camera(40, 20), camera(80, 20), camera(-40, 20)]


def test_candidates_stand_around_the_subject_and_look_at_it() -> None:
    cameras = guidance_cameras(INPUTS, 2.0, 32, INPUTS[0])
    assert len(cameras.candidates) == 3 * AZIMUTHS
    assert (cameras.candidates.width, cameras.candidates.height) == (32, 32)
    torch.testing.assert_close(cameras.candidates.centers.norm(dim=1), torch.full((36,), 4.0), rtol=0, atol=1e-2)
    towards = torch.nn.functional.normalize(-cameras.candidates.centers, dim=1)
    assert float((towards * cameras.candidates.forwards).sum(1).min()) > 0.999
    elevations = torch.asin(cameras.candidates.centers[:, 2] / 4)
    assert float(elevations.min()) >= LOWEST - 1e-3
    assert float(elevations.max()) <= HIGHEST + 1e-3


def test_a_wide_image_gives_the_field_of_view_of_its_middle_square() -> None:
    wide = camera(0, 20, width=96, height=64)
    cameras = guidance_cameras([wide, camera(40, 20, width=96, height=64)], 2.0, 32, wide)
    assert float(cameras.K[0, 0]) == pytest.approx(float(wide.Ks[0, 1, 1]) / 2)
    cut = square(wide, 32)
    assert (cut.width, cut.height) == (32, 32)
    assert cut.Ks[0, :2, 2].tolist() == [16.0, 16.0]


def test_cameras_that_look_at_no_common_subject_are_interpolated() -> None:
    eyes = torch.tensor([[x, 0.0, 0.0] for x in (0.0, 1.0, 2.0)])
    outward = torch.tensor([[-1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    viewmats = torch.cat([look_at(eyes[i : i + 1], eyes[i] + outward[i], UP.float()) for i in range(3)])
    inputs = [Cameras(viewmats[i : i + 1], intrinsics(0.8, 64, 64)[None].float(), 64, 64) for i in range(3)]
    cameras = guidance_cameras(inputs, 1.0, 32, inputs[0])
    assert cameras.angles is None
    assert len(cameras.candidates) == 24
    assert float(cameras.candidates.centers[:, 0].min()) >= -1e-4
    assert float(cameras.candidates.centers[:, 0].max()) <= 2 + 1e-4
    assert torch.equal(cameras.camera(3, generator(0, 0, 0, "jitter")).viewmats, cameras.candidates[3].viewmats)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "side"),
    [
        (30, 10, "front"),
        (74, 10, "front"),
        (-14, 10, "front"),
        (90, 10, "side"),
        (-60, 0, "side"),
        (200, 0, "back"),
        (30, 70, "top"),
    ],
)
def test_a_side_is_told_from_the_front_camera(azimuth: float, elevation: float, side: str) -> None:
    cameras = guidance_cameras(INPUTS, 2.0, 32, camera(30, 20))
    assert cameras.side(camera(azimuth, elevation), front_known=True) == side
    assert cameras.side(camera(azimuth, elevation), front_known=False) == ("top" if side == "top" else "")


def test_a_drawn_candidate_is_moved_a_little_and_the_same_way_again() -> None:
    cameras = guidance_cameras(INPUTS, 2.0, 32, INPUTS[0])
    one, again, other = (cameras.camera(5, generator(0, step, 5, "jitter")) for step in (1, 1, 2))
    assert torch.equal(one.viewmats, again.viewmats)
    assert not torch.equal(one.viewmats, other.viewmats)
    angle = torch.acos((one.forwards[0] @ cameras.candidates.forwards[5]).clamp(-1, 1))
    assert 0 < float(angle) < math.radians(17)


def test_candidates_are_drawn_in_proportion_to_their_uncertainty() -> None:
    mean_u = torch.tensor([0.6, 0.2, 0.04, 0.0])
    drawn = Counter(draw_candidate(mean_u, 0.05, generator(0, i, 0, "camera")) for i in range(2000))
    assert set(drawn) == {0, 1}
    assert drawn[0] / 2000 == pytest.approx(0.75, abs=0.04)


def test_nothing_is_drawn_where_the_inputs_decide() -> None:
    assert draw_candidate(torch.tensor([0.04, 0.0]), 0.05, generator(0, 0, 0, "camera")) is None
    assert draw_candidate(torch.zeros(3), 0.0, generator(0, 0, 0, "camera")) is None


def test_the_nearest_references_come_first() -> None:
    cameras = Cameras.cat([square(camera(a), 8) for a in (0, 90, 180, 45)])
    images = torch.arange(4.0)[:, None, None, None].expand(4, 3, 8, 8)
    references = References(images, torch.ones(4, 1, 8, 8), cameras)
    found = nearest(references, camera(60), 2)
    assert found is not None
    assert found.images[:, 0, 0, 0].tolist() == [3.0, 1.0]
    torch.testing.assert_close(found.cameras.viewmats[1], cameras.viewmats[1])
    assert nearest(references, camera(60), 0) is None
    everything = nearest(references, camera(60), 9)
    assert everything is not None
    assert len(everything.images) == 4


CONFIG = GuidanceConfig(start=0.25, stop=0.75, every=10, t_max=0.7, t_max_end=0.25)


def resolved(config: GuidanceConfig, iterations: int = 400) -> GuidancePlan:
    return GuidancePlan.of(config, iterations, 0, Background(), view_conditioned=False)


def test_guided_steps_lie_after_the_warm_up_and_every_kth() -> None:
    guided = [step for step in range(1, 401) if resolved(CONFIG).is_guided(step)]
    assert guided == list(range(100, 301, 10))
    assert resolved(CONFIG).guided_steps == len(guided)


@pytest.mark.parametrize(
    ("start", "stop", "iterations", "first", "last"),
    [(0.25, 0.75, 10, 3, 7), (0.1, 0.5, 25, 3, 12), (0.5, 1.0, 7, 4, 7), (0.5, 0.5, 8, 4, 4), (0.0, 0.3, 10, 1, 3)],
)
def test_guidance_keeps_within_its_shares_of_the_run(
    start: float, stop: float, iterations: int, first: int, last: int
) -> None:
    """From the first step that is not before start * iterations to the last that is not after stop * iterations."""
    plan = resolved(replace(CONFIG, start=start, stop=stop, every=1), iterations)
    assert [step for step in range(iterations + 2) if plan.is_guided(step)] == list(range(first, last + 1))


@pytest.mark.parametrize("iterations", [1, 2, 3, 17, 400])
@pytest.mark.parametrize(
    "config", [CONFIG, replace(CONFIG, start=0.0, stop=1.0, every=1), replace(CONFIG, start=1.0, stop=1.0)]
)
def test_the_number_of_guided_steps_is_what_the_schedule_counts(config: GuidanceConfig, iterations: int) -> None:
    plan = resolved(config, iterations)
    assert plan.guided_steps == sum(plan.is_guided(step) for step in range(1, iterations + 1))


@pytest.mark.parametrize("anneal", ["sqrt", "linear"])
def test_the_most_noise_falls_from_first_to_last(anneal) -> None:
    plan = resolved(replace(CONFIG, anneal=anneal))
    most = [plan.noise_range(step)[1] for step in range(100, 301, 10)]
    assert (most[0], most[-1]) == (pytest.approx(0.7), pytest.approx(0.25))
    assert all(later < before for before, later in itertools.pairwise(most))
    assert {plan.noise_range(step)[0] for step in (100, 300)} == {0.02}
    early, even = (resolved(replace(CONFIG, anneal=kind)).noise_range(200) for kind in ("sqrt", "linear"))
    assert early < even
