"""The prior that ships: there, small, deterministic, documented; used where it fits and nowhere else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.sds.load_prior import open_prior
from gsopt.sds.priors.protocol import Condition
from gsopt.sds.priors.view_conditioned import ViewPrior
from gsopt.sds.select_prior import PriorSelection, restrict_to_scene, select_prior

pytest.importorskip("diffusers")
DEFAULT = PriorSelection("embedded", 0.2, "the embedded prior (default)")


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


def test_nothing_it_learned_from_is_a_test_object(shared_data: Path, embedded: Path) -> None:
    splits = json.loads((shared_data / "splits.json").read_text())
    plan = json.loads((embedded / "finetune.json").read_text())
    kept_apart = {name.removeprefix("sh3d/") for part in ("test", "val", "other") for name in splits[part]}
    assert not set(plan["train"]) & kept_apart


@pytest.mark.usefixtures("embedded")
def test_it_is_the_default_and_answers_the_same_bits_each_time() -> None:
    assert select_prior(GuidanceConfig()) == DEFAULT
    first, second = (open_prior("embedded", GuidanceConfig()) for _ in range(2))
    assert isinstance(first, ViewPrior)
    x_t = torch.randn(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    render = torch.rand(4, 64, 64, generator=torch.Generator().manual_seed(1))
    a, b = (p.denoise(x_t, torch.tensor([200]), [Condition(render=render)]) for p in (first, second))
    assert torch.equal(a, b)
    assert not torch.equal(a[0], 2 * render[:3] - 1)


@pytest.mark.parametrize(
    ("views", "has_alpha", "said", "guided"),
    [
        (4, True, {}, True),
        (5, True, {}, True),
        (6, True, {}, False),
        (6, True, {"prompt": ("a chair",)}, True),
        (4, False, {}, False),
        (40, False, {"lambda_sds": 0.2}, True),
    ],
)
def test_it_guides_few_views_of_cut_out_objects_or_where_it_was_asked_for(views, has_alpha, said, guided) -> None:
    found = restrict_to_scene(DEFAULT, GuidanceConfig(**said), views, has_alpha)
    assert (found.prior == "embedded") == guided
    assert guided or found.weight == 0
    other = PriorSelection("sd21", 0.2, "as asked for with --prior")
    assert restrict_to_scene(other, GuidanceConfig(prior="sd21"), views, has_alpha) == other
