"""The view-conditioned prior against its formulas: what its network is shown, what it answers, and how noise rises."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.sds.priors import view_conditioned as prior
from gsopt.sds.priors.protocol import Condition, References
from gsopt.sds.priors.view_conditioned import MAX_REFERENCES, TextTokens, condition_planes, cosine_schedule, predict


def test_the_answer_is_the_render_and_what_the_network_adds_patch_by_patch() -> None:
    """A network that gives the first three planes of each place of a patch gives twice the render back."""
    random = torch.Generator().manual_seed(0)
    x_t, planes = torch.randn(2, 3, 8, 8, generator=random), torch.randn(2, 17, 8, 8, generator=random)
    asked: list[Any] = []

    def network(stacked: torch.Tensor, t: Any, *, encoder_hidden_states: Any, encoder_attention_mask: Any) -> Any:
        asked.append((stacked.shape, encoder_hidden_states.shape, encoder_attention_mask))
        back = torch.nn.functional.pixel_shuffle(stacked, 4)
        return SimpleNamespace(sample=torch.nn.functional.pixel_unshuffle(back[:, 3:6] + 10 * back[:, :3], 4))

    found = predict(network, x_t, torch.tensor([1, 2]), planes)
    torch.testing.assert_close(found, 2 * planes[:, :3] + 10 * x_t)
    padded = TextTokens(torch.zeros(2, 3, 192), torch.tensor([[True] * 3, [True, False, False]]))
    predict(network, x_t, torch.tensor([1, 2]), planes, padded)
    assert asked[0] == ((2, 20 * 16, 2, 2), (2, 1, 192), None)
    assert asked[1][2] is padded.mask


@pytest.mark.parametrize("count", [1, 3, 5])
def test_up_to_three_references_are_warped_into_the_camera(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def warped(camera: Any, depth: Any, alphas: Any, images: Any, *others: Any) -> torch.Tensor:
        asked.append(len(images))
        assert (camera, depth) == ("camera", "depth")
        assert float(alphas.mean()) == 0.5
        return torch.full((len(images), 4, 8, 8), 0.75)

    monkeypatch.setattr(prior, "warp", warped)
    render = torch.full((4, 8, 8), 0.25)
    render[3] = 0.5
    four = torch.zeros(count, 3, 8, 8)
    references = References(four, four[:, :1], range(count), four[:, 0])  # type: ignore[arg-type]
    planes = condition_planes(
        Condition(
            render=render, uncertainty=torch.full((8, 8), 0.1), camera="camera", depth="depth", references=references
        ),  # type: ignore[arg-type]
        8,
    )
    used = min(count, MAX_REFERENCES)
    assert asked == [used]
    assert planes[:, 0, 0].tolist() == pytest.approx(
        [-0.5] * 3 + [0.5, 0.1] + [0.375, 0.375, 0.375, 0.75] * used + [0.0] * 4 * (MAX_REFERENCES - used)
    )
    without = References(four, four[:, :1], range(count), None)  # type: ignore[arg-type]
    assert not bool(condition_planes(Condition(references=without, camera="camera"), 8)[5:].any())  # type: ignore[arg-type]


def test_the_signal_falls_by_the_cosine_of_nichol_and_dhariwal() -> None:
    schedule = cosine_schedule()
    signal = [schedule.alphas_cumprod[t - 1].item() for t in (1, 250, 500, 750, 1000)]

    def f(share: float) -> float:
        return math.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2

    expected = [max(1e-6, f(t / 1000) / f(0.0)) for t in (1, 250, 500, 750, 1000)]
    assert signal == pytest.approx(expected, rel=1e-4)
    assert len(schedule.alphas_cumprod) == 1000
