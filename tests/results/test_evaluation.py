"""Evaluation: the same splats are perfect, other splats are not, and nothing is called held-out that was not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from finished_runs import WHITE, make_run, splats
from PIL import Image

from gsopt import metrics as metrics_module
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.metrics import PSNR_CAP, VGG_VARIABLE, Lpips, ssim
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.results import evaluation
from gsopt.results.evaluation import evaluate, evaluate_views
from gsopt.results.finished_run import open_run, truth


@pytest.fixture(scope="module")
def perfect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("perfect"))


@pytest.fixture(scope="module")
def imperfect(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("imperfect"), learned=splats(seed=1))


def test_the_splats_that_made_the_truth_are_perfect(perfect: Path) -> None:
    metrics = evaluate(perfect)
    assert metrics["mean"] == {"psnr": PSNR_CAP, "ssim": 1.0, "lpips_alex": 0.0, "cc_psnr": PSNR_CAP}
    assert [row["name"] for row in metrics["per_view"]] == ["test/r_0.png", "test/r_1.png"]
    assert metrics["reason"] is None
    assert metrics["train"] is None


def test_the_means_are_the_means_of_the_views(imperfect: Path) -> None:
    metrics = evaluate(imperfect)
    for key in ("psnr", "ssim", "lpips_alex"):
        values = [row[key] for row in metrics["per_view"]]
        assert metrics["mean"][key] == pytest.approx(np.mean(values), abs=1e-6)
        assert len(set(values)) == 2
    assert metrics["mean"]["psnr"] < 40


def test_figures_belong_to_the_pictures_that_were_saved(imperfect: Path) -> None:
    """PSNR of the PNG files equals the reported value."""
    metrics = evaluate(imperfect)
    row = metrics["per_view"][0]
    picture, target = (
        np.asarray(Image.open(path).convert("RGB"), dtype=np.float64) / 255
        for path in (imperfect / row["render"], imperfect.parent / "data" / row["name"])
    )
    assert row["psnr"] == pytest.approx(-10 * np.log10(np.mean((picture - target) ** 2)), abs=1e-5)


def test_metrics_json_keeps_what_others_wrote_and_is_strict_json(perfect: Path) -> None:
    (perfect / "metrics.json").write_text(json.dumps({"train_seconds": 12.5, "peak_memory_mb": 99, "mean": "old"}))
    evaluate(perfect)
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
        evaluate(run)
    assert (run / "metrics.json").read_text() == "{"
    assert not (run / "renders").exists()


def test_without_held_out_views_nothing_is_called_held_out(tmp_path: Path) -> None:
    run = make_run(tmp_path, train=3, test=0)
    metrics = evaluate(run)
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


def test_vgg_without_weights_says_how_to_get_them_and_nobody_asks_for_it_unasked(
    perfect: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_module, "find_vgg_weights", lambda: None)
    with pytest.raises(InputError, match=VGG_VARIABLE):
        evaluate(perfect, vgg=True)
    assert "lpips_vgg" not in evaluate(perfect)["mean"]


def test_figures_do_not_depend_on_threads_and_are_those_of_the_metrics(imperfect: Path) -> None:
    """Views are compared side by side, each by one thread; SSIM comes from the backend's kernel."""
    run = open_run(imperfect)
    views = load_scene(run.config.data).test * 3
    drawing = run.gaussians, views, run.backend, run.settings, run.background, None
    seen: list[tuple[int, int]] = []
    rows = evaluate_views(*drawing, threads=3, on_view=lambda done, total: seen.append((done, total)))["per_view"]
    assert rows == evaluate_views(*drawing, threads=1)["per_view"]
    assert seen == [(done, 6) for done in range(1, 7)]
    for row, view in zip(rows, views, strict=True):
        render, target = (image[None] / 255 for image in (run.draw(view.camera), truth(view, run.background)))
        assert row["ssim"] == pytest.approx(ssim(render, target).item(), abs=2e-6)
        assert row["lpips_alex"] == pytest.approx(Lpips("alex")(render, target).item(), abs=2e-6)


def test_images_too_small_for_a_network_have_no_such_figure(perfect: Path) -> None:
    scene = load_scene(str(perfect.parent / "data"))
    small = [type(view)(view.name, view.camera.resized(20, 16), _Halved(view.store), view.index) for view in scene.test]
    result = evaluate_views(splats(), small, ReferenceBackend(), RasterSettings(sh_degree=0), WHITE, None)
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
    result = evaluate_views(splats(), [], ReferenceBackend(), RasterSettings(sh_degree=0), WHITE, None)
    assert result == {"mean": None, "per_view": []}


def test_input_views_are_evaluated_at_their_refined_poses(tmp_path: Path) -> None:
    """Poses as they were keep the splats perfect; a pose that the run moved draws another image."""
    run = make_run(tmp_path, train=2, test=0)
    scene = load_scene(str(tmp_path / "data"))
    poses = []
    for view in scene.train:
        pose = view.camera.viewmats[0].double()
        pose[:3, 3] -= pose[:3, :3] @ torch.tensor(scene.origin, dtype=torch.float64)
        poses.append({"name": view.name, "cam_from_world": pose.tolist()})
    (run / "poses.json").write_text(json.dumps({"views": poses}))
    assert evaluate(run)["train"]["mean"]["psnr"] == PSNR_CAP
    poses[1]["cam_from_world"][0][3] += 0.2
    (run / "poses.json").write_text(json.dumps({"views": poses}))
    first, second = evaluate(run)["train"]["per_view"]
    assert first["psnr"] == PSNR_CAP
    assert second["psnr"] < 40


def test_some_of_many_input_views_are_evaluated_evenly_spread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "MAX_TRAIN_VIEWS", 3)
    run = make_run(tmp_path, train=7, test=0)
    names = [view.name for view in load_scene(str(tmp_path / "data")).train]
    evaluated = [row["name"] for row in evaluate(run)["train"]["per_view"]]
    assert evaluated == [names[0], names[2], names[4]]


def test_a_metric_that_some_views_lack_has_no_mean(perfect: Path) -> None:
    whole, other = load_scene(str(perfect.parent / "data")).test
    small = type(other)(other.name, other.camera.resized(20, 16), _Halved(other.store), other.index)
    views, backend = [whole, small], ReferenceBackend()
    result = evaluate_views(splats(), views, backend, RasterSettings(sh_degree=0), WHITE, None)
    assert [row["lpips_alex"] is None for row in result["per_view"]] == [False, True]
    assert result["mean"]["lpips_alex"] is None
    assert result["mean"]["psnr"] == pytest.approx(np.mean([row["psnr"] for row in result["per_view"]]), abs=1e-5)


@pytest.mark.parametrize("name", ["renders", "renders/test"])
def test_renders_do_not_leave_a_foreign_run_through_a_link(tmp_path: Path, name: str) -> None:
    run = make_run(tmp_path, train=1, test=1)
    (tmp_path / "elsewhere").mkdir()
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="symbolic link"):
        evaluate(run)
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.parametrize(("name", "key"), [("metrics.json", "extra"), ("config.json", "versions")])
def test_fields_that_cannot_be_kept_are_an_input_error_before_the_work(tmp_path: Path, name: str, key: str) -> None:
    """NaN, and lists nested as deep as can just be read."""
    run = make_run(tmp_path, train=1, test=1)
    document = json.loads((run / name).read_text()) if name == "config.json" else {}
    (tmp_path / "data").rename(tmp_path / "gone")  # what can be kept ends here, before the work
    errors = []
    for value in ("NaN", *("[" * depth + "]" * depth for depth in range(900, 1000, 10))):
        (run / name).write_text(json.dumps({**document, key: "HERE"}).replace('"HERE"', value))
        with pytest.raises(InputError) as error:
            evaluate(run)
        errors.append(str(error.value))
    assert "strict JSON" in errors[0]


class OneImage:
    """A store of one image."""

    def __init__(self, pixels: torch.Tensor) -> None:
        self.pixels = pixels

    def get(self, index: int) -> torch.Tensor:
        return self.pixels


@pytest.mark.parametrize(("alpha", "expected"), [(None, "absent"), (0, None), (255, PSNR_CAP)])
def test_the_object_is_measured_where_a_view_has_alpha(
    perfect: Path, alpha: int | None, expected: float | str | None
) -> None:
    """Nothing is claimed about an object that no mask shows."""
    run = open_run(perfect)
    view = load_scene(run.config.data).test[0]
    pixels = view.pixels()[..., :3]
    if alpha is not None:
        pixels = torch.cat([pixels, torch.full_like(pixels[..., :1], alpha)], dim=2)
    masked = replace(view, store=OneImage(pixels), index=0)
    drawn = evaluate_views(run.gaussians, [masked], run.backend, run.settings, run.background, None)
    assert drawn["per_view"][0].get("psnr_object", "absent") == expected
    assert drawn["mean"].get("psnr_object", "absent") == expected
    assert ("cc_psnr_object" in drawn["mean"]) == (alpha is not None)
