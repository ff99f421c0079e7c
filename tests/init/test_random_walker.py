"""The random walker: its system against a dense solver, and its behavior at edges."""

from __future__ import annotations

import torch
from torch import Tensor

from gsopt.init.random_walker import LEAST_WEIGHT, TRUST, walked


def dense(colors: Tensor, likely: Tensor) -> Tensor:
    """The same minimum, by a matrix of all pairs of neighbors."""
    height, width = likely.shape
    numbers = torch.arange(height * width).view(height, width)
    pairs = torch.cat(
        [
            torch.stack([numbers[:, :-1].flatten(), numbers[:, 1:].flatten()], 1),
            torch.stack([numbers[:-1].flatten(), numbers[1:].flatten()], 1),
        ]
    )
    flat = colors.double().flatten(1).T
    squares = (flat[pairs[:, 0]] - flat[pairs[:, 1]]).square().sum(1)
    weights = (-squares / (2 * squares.mean())).exp() + LEAST_WEIGHT
    matrix = TRUST * torch.eye(height * width, dtype=torch.float64)
    for (a, b), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
        matrix[a, a] += weight
        matrix[b, b] += weight
        matrix[a, b] -= weight
        matrix[b, a] -= weight
    return torch.linalg.solve(matrix, TRUST * likely.double().flatten()).view(height, width)


def test_it_solves_its_system() -> None:
    generator = torch.Generator().manual_seed(3)
    colors = torch.randint(0, 256, (3, 9, 13), generator=generator, dtype=torch.uint8)
    likely = torch.rand(9, 13, generator=generator)
    torch.testing.assert_close(walked(colors, likely).double(), dense(colors, likely), rtol=0, atol=1e-4)


def test_of_one_likelihood_nothing_changes() -> None:
    colors = torch.randint(0, 256, (3, 8, 8), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    torch.testing.assert_close(walked(colors, torch.full((8, 8), 0.7)), torch.full((8, 8), 0.7))


def test_a_photo_of_one_color_has_no_edges() -> None:
    likely = torch.rand(12, 12, generator=torch.Generator().manual_seed(2))
    assert float(walked(torch.full((3, 12, 12), 90, dtype=torch.uint8), likely).std()) < 0.2 * float(likely.std())


def test_a_spot_in_foreign_colors_goes_with_its_surroundings_up_to_the_edge() -> None:
    """Half the photo is the object; a spot within it looks like the background to the histogram, not to the eye."""
    colors = torch.full((3, 40, 40), 40, dtype=torch.uint8)
    colors[:, :, 20:] = 200
    likely = torch.zeros(40, 40)
    likely[:, 20:] = 1
    likely[18:22, 28:32] = 0
    found = walked(colors, likely)
    assert float(found[:, 20:].min()) > 0.5
    assert float(found[:, :20].max()) < 0.1
