"""Training batches of a prior: laws that every batch keeps, whatever was cut, turned, recolored and left out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from in_process_farm import InProcess

from gsopt.errors import InputError
from gsopt.finetune import pair_cache, serve_pairs
from gsopt.finetune.batches import REPAIR_SHARE, TRAINING_SIDE, TYPICAL_ERROR, Batch, draw_batch, on_background
from gsopt.finetune.reconstruction_pairs import Pairs
from gsopt.sds.priors.view_conditioned import INPUT_CHANNELS, MAX_REFERENCES, cosine_schedule

NOISE = cosine_schedule()


def random_bytes(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def perfect_pairs(count: int = 3, size: int = 80) -> Pairs:
    """Renders that equal the truth, and references that do."""
    truth = random_bytes(count, 4, size, size)
    truth[:, :3] = torch.minimum(truth[:, :3], truth[:, 3:])  # premultiplied
    full = torch.full((count, MAX_REFERENCES, 1, size, size), 255, dtype=torch.uint8)
    warped = torch.cat([truth[:, None].expand(-1, MAX_REFERENCES, -1, -1, -1), full], 2)
    return Pairs(truth, truth.clone(), random_bytes(count, size, size, seed=1), warped)


def tensors(batch: Batch) -> list[torch.Tensor]:
    return [*(value for name, value in vars(batch).items() if name != "said"), *vars(batch.said).values()]


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_cuts_turns_and_colors_are_the_same_in_all_images_of_a_row() -> None:
    """Render and references equal to the truth stay equal after every augmentation."""
    for seed in range(4):
        batch = draw_batch(perfect_pairs(), 16, NOISE, generator(seed))
        assert (
            batch.planes.shape == (16, INPUT_CHANNELS, TRAINING_SIDE, TRAINING_SIDE)
            or batch.planes.shape[1] == INPUT_CHANNELS - 3
        )
        known = batch.planes[:, 3].flatten(1).any(1)
        assert int(known.sum()) > 10
        torch.testing.assert_close(batch.planes[known, :3], batch.x0[known])
        for k in range(MAX_REFERENCES):
            colors, confidence = batch.planes[:, 5 + 4 * k : 8 + 4 * k], batch.planes[:, 8 + 4 * k]
            there = confidence.flatten(1).any(1)
            assert 4 < int(there.sum()) <= 16
            torch.testing.assert_close(colors[there], batch.x0[there])


def test_repair_lessons_never_see_the_truth() -> None:
    """A white truth and a black render: what is left of x_t without its noise is one of the two, in the stated mix."""
    pairs = perfect_pairs()
    pairs.truth.fill_(255)
    pairs.render.zero_()
    pairs.render[:, 3] = 255
    seen = 0
    for seed in range(8):
        batch = draw_batch(pairs, 32, NOISE, generator(seed))
        signal = NOISE.signal(batch.t, batch.x_t)
        mean = (batch.x_t.mean((1, 2, 3)) / signal.sqrt().flatten())[signal.flatten() > 0.2]
        truth = batch.x0.mean((1, 2, 3))[signal.flatten() > 0.2]
        repair = mean < -0.9
        assert bool((repair | ((mean - truth).abs() < 0.1)).all())
        seen += int(repair.sum())
    assert 0.6 < seen / (8 * 32 * REPAIR_SHARE) < 1.3


def test_lessons_count_by_the_share_of_the_error_that_is_taken_away() -> None:
    """Half the error counts as much where the render is bad as where it is good, and next to nothing where there is
    none."""
    pairs = perfect_pairs()
    pairs.truth[:, 3] = 255
    pairs.render[:, 3] = 255
    shares = []
    for wrong in (0, 40, 120):
        pairs.truth[:, :3].fill_(200)
        pairs.render[:, :3].fill_(200 - wrong)
        batch = draw_batch(pairs, 32, NOISE, generator(0))
        known = batch.planes[:, 3].flatten(1).any(1)
        error = (batch.planes[:, :3] - batch.x0).square().mean((1, 2, 3))
        shares.append(float((batch.weight * error)[known].mean()))
    assert shares[0] == 0
    assert shares[2] == pytest.approx(TYPICAL_ERROR, rel=0.05)
    assert shares[1] == pytest.approx(shares[2], rel=0.2)


def test_backgrounds_are_the_same_in_all_images_of_a_row() -> None:
    pairs = perfect_pairs()
    background = torch.rand(3, 3, generator=generator(0))
    images = on_background(pairs, background)
    torch.testing.assert_close(images.truth, images.render[:, :3])
    torch.testing.assert_close(images.truth, images.warped[:, 1, :3])
    hole = pairs.truth[:, 3] == 0
    assert bool(hole.any())
    torch.testing.assert_close(images.truth.permute(0, 2, 3, 1)[hole], background[hole.nonzero()[:, 0]])


def test_the_same_generator_draws_the_same_batch() -> None:
    first, second = (draw_batch(perfect_pairs(), 4, NOISE, generator(3)) for _ in range(2))
    for a, b in zip(tensors(first), tensors(second), strict=True):
        assert torch.equal(a, b)


def test_pairs_serve_again_only_for_the_same_scene_size_and_seed(tmp_path: Path) -> None:
    made: list[tuple[str, int, int]] = []

    def handle(request: Mapping[str, Any]) -> int:
        made.append((request["scene"], request["size"], request["seed"]))
        Path(request["out"]).mkdir()
        perfect_pairs(1).save(Path(request["out"]) / serve_pairs.PAIRS)
        return 1

    calls = [("a", 80, 0), ("a", 80, 0), ("a", 64, 0), ("a", 80, 1), ("b", 80, 0)]
    for root, size, seed in calls:
        scene = tmp_path / root / "cup"
        pair_cache.collect_pairs([scene], 1, size, seed, tmp_path / "pairs", InProcess(handle), print)
    assert made == [(str(tmp_path / root / "cup"), size, seed) for root, size, seed in calls[1:]]


def test_what_cannot_be_reconstructed_is_named_and_left_out(tmp_path: Path) -> None:
    """The others keep their pairs, each with its scene; nothing at all is an error."""

    def handle(request: Mapping[str, Any]) -> int:
        count = {"cup": 2, "jar": 0, "pot": 3}[Path(request["scene"]).name]
        if not count or request["index"] > 1:
            raise InputError("It has one view.")
        Path(request["out"]).mkdir()
        perfect_pairs(count).save(Path(request["out"]) / serve_pairs.PAIRS)
        return count

    scenes, lines = [tmp_path / name for name in ("jar", "cup", "pot")], list[str]()
    cache = pair_cache.collect_pairs(scenes, 3, 80, 0, tmp_path / "pairs", InProcess(handle), lines.append)
    assert cache.scenes == tuple(scenes[1:])
    assert cache.scene.tolist() == [0] * 4 + [1] * 6
    assert len(cache.pairs) == 10
    assert sum("is left out: It has one view." in line for line in lines) == 5
    with pytest.raises(InputError, match="None of the 1 scenes"):
        pair_cache.collect_pairs(scenes[:1], 3, 80, 0, tmp_path / "pairs", InProcess(handle), lines.append)
