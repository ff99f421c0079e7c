"""Turning axes around changes the frame and nothing that can be seen."""

from __future__ import annotations

import pytest
import torch
from splat_samples import make_splats, same_bits

from gsopt.formats.axes import LEFT_UP_FORWARD, RIGHT_UP_BACK, Signs, with_flipped_axes
from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.quats import rotation_matrices

FRAMES = [RIGHT_UP_BACK, LEFT_UP_FORWARD]


def covariances(splats: Gaussians) -> torch.Tensor:
    root = rotation_matrices(splats.quats.double()) * splats.scales.double()[:, None]
    return root @ root.transpose(1, 2)


@pytest.mark.parametrize("signs", FRAMES)
def test_turning_twice_changes_no_bit(signs: Signs) -> None:
    assert same_bits(with_flipped_axes(with_flipped_axes(make_splats(), signs), signs), make_splats())


@pytest.mark.parametrize("signs", FRAMES)
@pytest.mark.parametrize("degree", range(4))
def test_a_turned_splat_has_its_color_in_turned_directions(signs: Signs, degree: int) -> None:
    splats = make_splats(degree=degree)
    directions = torch.nn.functional.normalize(torch.randn(len(splats), 3, generator=torch.manual_seed(1)), dim=1)
    turned_splats, turned_directions = with_flipped_axes(splats, signs), directions * torch.tensor(signs)
    before = sh.evaluate(splats.sh0, splats.shN, directions, degree)
    after = sh.evaluate(turned_splats.sh0, turned_splats.shN, turned_directions, degree)
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)


@pytest.mark.parametrize("signs", FRAMES)
def test_covariances_turn_with_the_means(signs: Signs) -> None:
    splats = make_splats()
    S = torch.diag(torch.tensor(signs, dtype=torch.float64))
    torch.testing.assert_close(covariances(with_flipped_axes(splats, signs)), S @ covariances(splats) @ S)


@pytest.mark.parametrize("signs", FRAMES)
def test_the_frames_are_proper_rotations_of_the_ply_frame(signs: Signs) -> None:
    assert signs[0] * signs[1] * signs[2] == 1
