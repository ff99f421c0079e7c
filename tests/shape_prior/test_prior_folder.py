"""Folders of shape priors: what is written is read again, and nothing else is."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_prior import WORDS, untrained, write_prior

from gsopt.errors import InputError
from gsopt.shape_prior import folder as folders
from gsopt.shape_prior.folder import CARD_FILE, read_prior

WEIGHTS = "weights_00.safetensors"


def changed(key: str, value: object) -> Callable[[Path], object]:
    def act(folder: Path) -> object:
        document = json.loads((folder / CARD_FILE).read_text())
        return (folder / CARD_FILE).write_text(json.dumps({**document, key: value}))

    return act


def with_weights(act: Callable[[dict[str, torch.Tensor]], object]) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        tensors = load_file(folder / WEIGHTS)
        act(tensors)
        save_file(tensors, folder / WEIGHTS)

    return change


def spoiled(tensors: dict[str, torch.Tensor]) -> None:
    tensors["level.0.weight"][0, 0] = float("nan")


def network(**sizes: object) -> Callable[[Path], object]:
    return changed("network", {"side": 32, "widths": [8, 16], "blocks": 1, **sizes})


HOSTILE: dict[str, Callable[[Path], object]] = {
    "no card": lambda folder: (folder / CARD_FILE).unlink(),
    "half a card": lambda folder: (folder / CARD_FILE).write_text("{"),
    "nested card": lambda folder: (folder / CARD_FILE).write_text("[" * 100_000),
    "another format": changed("format", "gsopt-shape-prior-9"),
    "no network": changed("network", 3),
    "an endless network": network(widths=[8] * 10_000),
    "a vast network": network(widths=[1024] * 5, side=128, blocks=6),
    "widths of text": network(widths=["8", "16"]),
    "a side that is none": network(side=33),
    "true for a number": network(blocks=True),
    "words that are none": changed("vocabulary", [1, 2]),
    "a word of a million letters": changed("vocabulary", ["x" * 1_000_000]),
    "a vast image": changed("image_side", 1 << 30),
    "another size": network(widths=[16, 16]),
    "other words": changed("vocabulary", [*WORDS, "more"]),
    "no weights": lambda folder: (folder / WEIGHTS).unlink(),
    "a pickle": lambda folder: (folder / WEIGHTS).write_bytes(b"\x80\x04cos\nsystem\n(S'touch owned'\ntR."),
    "half the weights": lambda folder: (folder / WEIGHTS).write_bytes((folder / WEIGHTS).read_bytes()[:2000]),
    "a tensor less": with_weights(lambda tensors: tensors.pop("level.0.weight")),
    "a tensor more": with_weights(lambda tensors: tensors.update({"more": torch.zeros(1)})),
    "a weight that is no number": with_weights(spoiled),
    "another type": with_weights(lambda tensors: tensors.update({"level.0.weight": tensors["level.0.weight"].int()})),
}


def test_weights_and_words_return_in_half_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prior = untrained(4)
    whole = read_prior(write_prior(tmp_path / "one", prior))
    assert (whole.config, whole.vocabulary, whole.image_side) == (prior.config, WORDS, prior.image_side)
    for name, value in prior.network.state_dict().items():
        assert torch.equal(whole.network.state_dict()[name], value.half().float())
    monkeypatch.setattr(folders, "MAX_SHARD_BYTES", 5000)
    parts = read_prior(write_prior(tmp_path / "parts", prior))
    assert len(list((tmp_path / "parts").glob("weights_*"))) > 3
    assert parts.digest == whole.digest != read_prior(write_prior(tmp_path / "other", untrained(5))).digest


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_folder_is_one_line_and_nothing_else(case: str, tmp_path: Path) -> None:
    folder = write_prior(tmp_path / "prior")
    HOSTILE[case](folder)
    with pytest.raises(InputError) as caught:
        read_prior(folder)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700
    assert "gsopt finetune --shape" in str(caught.value)
    assert not Path("owned").exists()


def test_a_missing_folder_says_that_none_ships(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="ships none"):
        read_prior(tmp_path / "absent")
