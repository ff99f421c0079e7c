"""The prior that ships: there, small, deterministic, documented; used where it fits and nowhere else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from gsopt.config.guidance import GuidanceConfig
from gsopt.finetune.half_precision import rounded
from gsopt.sds.load_prior import open_prior
from gsopt.sds.priors.protocol import Condition
from gsopt.sds.priors.view_conditioned import ViewPrior
from gsopt.sds.select_prior import select_prior

pytest.importorskip("diffusers")
NONE = {"lambda_sds": 0.0}


def test_the_folder_is_small_and_says_what_it_is(embedded: Path) -> None:
    files = [file for file in embedded.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) < 30e6
    assert max(file.stat().st_size for file in files) < 15e6
    plan = json.loads((embedded / "finetune.json").read_text())
    card = (embedded / "README.md").read_text()
    for name in plan["train"]:
        assert f"| {name} |" in card
    assert not set(plan["train"]) & set(plan["val"])
    assert (embedded / "train.jsonl").read_text().count("\n") > 5
    measured = json.loads((embedded / "gsopt_prior.json").read_text())["measured"]
    assert max(measured["repair"].values()) > measured["render"]


def test_its_weights_have_few_bits_for_archives_to_keep(embedded: Path) -> None:
    for file in embedded.rglob("*.safetensors"):
        for name, weights in load_file(file).items():
            if weights.is_floating_point():
                assert torch.equal(weights, rounded(weights)), name


def test_nothing_it_learned_from_is_a_test_object(shared_data: Path, embedded: Path) -> None:
    splits = json.loads((shared_data / "splits.json").read_text())
    plan = json.loads((embedded / "finetune.json").read_text())
    kept_apart = {name.removeprefix("sh3d/") for part in ("test", "val", "other") for name in splits[part]}
    assert not set(plan["train"]) & kept_apart


@pytest.mark.usefixtures("embedded")
def test_it_answers_the_same_bits_each_time() -> None:
    first, second = (open_prior("embedded", GuidanceConfig()) for _ in range(2))
    assert isinstance(first, ViewPrior)
    x_t = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    render = torch.rand(4, 64, 64, generator=torch.Generator().manual_seed(1))
    a, b = (p.denoise(x_t, torch.tensor([200]), [Condition(render=render)]) for p in (first, second))
    assert torch.equal(a, b)
    assert not torch.equal(a[0], 2 * render[:3] - 1)


@pytest.mark.usefixtures("embedded")
@pytest.mark.parametrize(
    "asked",
    [
        {"lambda_sds": 0.2},
        {"prior": "embedded"},
        {"prompt": ("a chair",)},
        {"negative": ("a table",)},
        {"prompts": "prompts.json"},
        {"ref_image": ("chair.png",)},
    ],
)
def test_it_guides_where_somebody_asks_and_nowhere_else(asked: dict[str, Any]) -> None:
    choice = select_prior(GuidanceConfig(**asked))
    assert (choice.name, choice.weight) == ("embedded", 0.2)
    assert "as asked for with --" in choice.reason
    for silent in (GuidanceConfig(), GuidanceConfig(policy="recon", device="cpu"), GuidanceConfig(**asked | NONE)):
        assert select_prior(silent).name is None
        assert select_prior(silent).weight == 0
