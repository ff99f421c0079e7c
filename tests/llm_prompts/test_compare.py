"""`gsopt prompts compare`: the same scene, the same steps, only the words differ; one page shows them side by side."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from analytic_priors import PixelPrior, gaussian_posterior
from tiny_scenes import write_dataset

from gsopt import cli
from gsopt.sds import load_prior
from gsopt.sds.prompts import Prompt, PromptSet, ReferenceImage, write_prompts, write_set


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("scene") / "cloud", train=4)


def compare(dataset: Path, folder: Path, prior: str, *files: Path) -> int:
    few = ["--steps", "6", "--leave-out", "1", "--threads", "1", "-o", str(folder / "page.html")]
    return cli.main(["prompts", "compare", str(dataset), *map(str, files), "--prior", prior, *few])


def test_sets_are_judged_on_the_same_views_and_shown_side_by_side(dataset: Path, sd21: Path, tmp_path: Path) -> None:
    one, two = tmp_path / "chair.json", tmp_path / "evil.json"
    write_prompts(one, [Prompt("a red chair")])
    write_set(two, PromptSet((Prompt("<b>blue</b> & chair", source="llm:m"),), images=(ReferenceImage("a.png"),)))
    assert compare(dataset, tmp_path, str(sd21), one, two, one) == 0
    figures = json.loads((tmp_path / "page.json").read_text())
    names = [arm["name"] for arm in figures["arms"]]
    assert names[:2] == ["no guidance", "no prompts"]
    assert len(figures["views"]) == 1
    scores = {name: arm["psnr"] for name, arm in zip(names, figures["arms"], strict=True)}
    assert figures["arms"][2]["psnr"] == figures["arms"][4]["psnr"]  # the same file twice: the same bits
    assert scores["no guidance"] != scores["no prompts"] != scores["evil"] != figures["arms"][2]["psnr"]
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<b>blue" not in page
    assert "&lt;b&gt;blue&lt;/b&gt; &amp; chair" in page
    assert page.count("data:image/webp") == 1 + 5
    assert "llm:m, all, positive" in page


def test_a_prior_that_takes_no_words_is_said_to_make_no_difference(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    toy = PixelPrior(gaussian_posterior(0.2, 0.5), size=16)
    monkeypatch.setattr(load_prior, "open_prior", lambda name, config: toy)
    write_prompts(tmp_path / "p.json", [Prompt("a chair")])
    assert compare(dataset, tmp_path, "toy/prior", tmp_path / "p.json") == 2
    assert "takes no words" in capsys.readouterr().err


def test_a_view_left_out_is_not_learned_from(dataset: Path) -> None:
    from gsopt.config.train import DataConfig
    from gsopt.data.scene import load_scene
    from gsopt.training.guided.guard import spread_views, without

    scene = load_scene(DataConfig(path=str(dataset)))
    chosen = spread_views(scene, 3)
    assert len(set(chosen)) == 3
    for index in chosen:
        left = without(scene, index)
        assert left.view.name == scene.train[index].name
        assert left.view.name not in [view.name for view in left.scene.train]
        assert len(left.scene.train) == len(scene.train) - 1
        centers = torch.cat([view.camera.centers for view in left.scene.train])
        assert not (centers == left.view.camera.centers).all(1).any()


@pytest.mark.parametrize("more", [[], ["--lambda-sds", "0"], ["--steps", "1"], ["--leave-out", "-1"]])
def test_wrong_flags_end_before_any_work(dataset: Path, tmp_path: Path, capsys, more: list[str]) -> None:
    file = tmp_path / "p.json"
    if more:
        write_prompts(file, [Prompt("a chair")])
    output = str(tmp_path / "page.html")
    assert cli.main(["prompts", "compare", str(dataset), str(file), "--prior", "x", "-o", output, *more]) in (2, 3)
    assert not (tmp_path / "page.html").exists()
    assert "Traceback" not in capsys.readouterr().err
