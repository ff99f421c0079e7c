"""Evaluation: the same splats are perfect, other splats are not, and nothing is called held-out that was not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from finished_runs import WHITE, make_run, splats
from PIL import Image

from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.metrics import PSNR_CAP, VGG_VARIABLE
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.results import evaluation
from gsopt.results.evaluation import evaluate, evaluate_views
from gsopt.results.finished_run import truth


@pytest.fixture(scope="module")
def perfect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("perfect"))


@pytest.fixture(scope="module")
def imperfect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("imperfect"), learned=splats(seed=1))


def test_the_splats_that_made_the_truth_are_perfect(perfect: Path) -> None:
    metrics = evaluate(perfect, vgg=False)
    assert metrics["mean"] == {"psnr": PSNR_CAP, "ssim": 1.0, "lpips_alex": 0.0, "lpips_vgg": None}
    assert [row["name"] for row in metrics["per_view"]] == ["test/r_0.png", "test/r_1.png"]
    assert metrics["reason"] is None
    assert metrics["train"] is None


def test_the_means_are_the_means_of_the_views(imperfect: Path) -> None:
    metrics = evaluate(imperfect, vgg=False)
    for key in ("psnr", "ssim", "lpips_alex"):
        values = [row[key] for row in metrics["per_view"]]
        assert metrics["mean"][key] == pytest.approx(np.mean(values), abs=1e-6)
        assert len(set(values)) == 2
    assert metrics["mean"]["psnr"] < 40


def test_figures_belong_to_the_pictures_that_were_saved(imperfect: Path) -> None:
    """PSNR of the PNG files equals the reported value."""
    metrics = evaluate(imperfect, vgg=False)
    row = metrics["per_view"][0]
    picture, target = (
        np.asarray(Image.open(path).convert("RGB"), dtype=np.float64) / 255
        for path in (imperfect / row["render"], imperfect.parent / "data" / row["name"])
    )
    assert row["psnr"] == pytest.approx(-10 * np.log10(np.mean((picture - target) ** 2)), abs=1e-5)


def test_metrics_json_keeps_what_others_wrote_and_is_strict_json(perfect: Path) -> None:
    (perfect / "metrics.json").write_text(json.dumps({"train_seconds": 12.5, "peak_memory_mb": 99, "mean": "old"}))
    evaluate(perfect, vgg=False)
    document = json.loads((perfect / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert (document["train_seconds"], document["peak_memory_mb"]) == (12.5, 99)
    assert document["mean"]["ssim"] == 1.0
    assert document["n_gaussians"] == 12
    assert document["config"]["iterations"] == 100
    assert "[-1,1]" in document["protocol"]
    assert "held out 2" in document["protocol"]


def test_a_broken_metrics_file_is_not_replaced(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=1, test=1)
    (run / "metrics.json").write_text("{")
    with pytest.raises(InputError, match="Move it away"):
        evaluate(run, vgg=False)
    assert (run / "metrics.json").read_text() == "{"
    assert not (run / "renders").exists()


def test_without_held_out_views_nothing_is_called_held_out(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=3, test=0)
    metrics = evaluate(run, vgg=False)
    assert metrics["mean"] is None
    assert metrics["per_view"] == []
    assert "not reported as held-out" in metrics["reason"]
    assert len(metrics["train"]["per_view"]) == 3
    assert (run / metrics["train"]["per_view"][0]["render"]).is_file()


def test_a_run_that_has_not_finished_or_is_none_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        evaluate(tmp_path / "absent")
    run = make_run(tmp_path, train=1, test=1)
    (run / "splat.ply").unlink()
    with pytest.raises(InputError, match="not finished"):
        evaluate(run)


def test_vgg_without_weights_is_null_and_says_how_to_get_them(perfect: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VGG_VARIABLE, raising=False)
    monkeypatch.setattr(evaluation, "find_vgg_weights", lambda: None)
    metrics = evaluate(perfect)
    assert metrics["mean"]["lpips_vgg"] is None
    assert VGG_VARIABLE in metrics["notes"][0]


def test_images_too_small_for_a_network_have_no_such_figure(perfect: Path) -> None:
    scene = load_scene(str(perfect.parent / "data"))
    small = [type(view)(view.name, view.camera.resized(20, 16), _Halved(view.store), view.index) for view in scene.test]
    result = evaluate_views(splats(), small, ReferenceBackend(), RasterSettings(sh_degree=0), WHITE, None, vgg=False)
    assert result["mean"]["lpips_alex"] is None
    assert 0 < result["mean"]["psnr"] < PSNR_CAP
    assert "render" not in result["per_view"][0]


class _Halved:
    """A store whose images have half the size."""

    def __init__(self, store) -> None:
        self._store = store

    def get(self, index: int) -> torch.Tensor:
        return self._store.get(index)[::2, ::2]


def test_transparent_truth_is_put_on_the_background() -> None:
    pixels = torch.tensor([[[200, 100, 0, 255], [200, 100, 0, 0], [200, 100, 0, 51]]], dtype=torch.uint8)

    class Fake:
        def pixels(self) -> torch.Tensor:
            return pixels

    on_black = truth(Fake(), torch.zeros(3))  # type: ignore[arg-type]
    on_white = truth(Fake(), torch.ones(3))  # type: ignore[arg-type]
    assert on_black.tolist() == [[[200, 100, 0], [0, 0, 0], [40, 20, 0]]]
    assert on_white.tolist() == [[[200, 100, 0], [255, 255, 255], [244, 224, 204]]]


def test_no_views_have_no_mean() -> None:
    result = evaluate_views(splats(), [], ReferenceBackend(), RasterSettings(sh_degree=0), WHITE, None, vgg=False)
    assert result == {"mean": None, "per_view": []}
