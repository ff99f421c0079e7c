"""Few photos of a whole scene, no masks: the mean of the last steps, weak gradients near a lens, the photos' mean color
behind everything, and depths on which photos agree."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from run_configs import opaque
from test_depth_loss import room_dataset
from tiny_scenes import cloud, ring, tiny_config

from gsopt.config.train import DataConfig, InitConfig, LossConfig, PoseConfig, TrainConfig
from gsopt.data.background import Background
from gsopt.data.scene import load_scene
from gsopt.errors import InputError
from gsopt.formats import load_splats
from gsopt.gaussians import Gaussians
from gsopt.init.stereo.depths import with_stereo_depths
from gsopt.raster.backend import RasterSettings
from gsopt.raster.reference import ReferenceBackend
from gsopt.results.finished_run import background_of
from gsopt.training.averaging import EVERY, RunningAverage
from gsopt.training.loop import train
from gsopt.training.plan import HAZE_SHARE, NEAR_SHARE, RunPlan, matches_photos
from gsopt.training.regularizers import weaken_near


def test_the_average_is_the_mean_of_what_it_noted_beside_each_gaussian() -> None:
    seen = [cloud(6, seed=seed).to(torch.float64) for seed in range(4)]
    average, rows = RunningAverage(first=EVERY), torch.tensor([4, 0, 2])
    assert average.of(seen[0]) is seen[0]
    average.note(EVERY, seen[0])
    average.note(EVERY + 1, seen[0])
    assert average.count == 0, "too early, and not due"
    average.note(2 * EVERY, seen[1])
    average.note(3 * EVERY, seen[2])
    average.select(rows)
    average.note(4 * EVERY, seen[3].select(rows))
    for name, values in average.of(seen[3]).items():
        each = [getattr(one, name)[rows] for one in seen[1:]]
        torch.testing.assert_close(values, torch.stack(each).mean(0))
    copy = RunningAverage(first=EVERY)
    copy.restore(average.tensors(), seen[3].select(rows))
    assert copy.tensors().keys() == average.tensors().keys()
    with pytest.raises(InputError, match=r"average\.means"):
        copy.restore(average.tensors(), seen[3])


def test_every_tenth_step_after_the_first_is_averaged() -> None:
    average, seen, counts = RunningAverage(first=20), cloud(2, seed=1), []
    for step in range(1, 61):
        before = average.count
        average.note(step, seen)
        counts += [step] if average.count > before else []
    assert counts == [30, 40, 50, 60]


def test_a_run_on_a_whole_scene_hands_on_the_mean_of_its_last_steps(dataset: Path, tmp_path: Path) -> None:
    """The last Gaussians stay in the checkpoint, to go on from; those of objects are handed on."""
    small = {"init": InitConfig(method="random", count=60), "iterations": 160}
    for name, data in (("scene", opaque(dataset)), ("object", dataset)):
        config = replace(tiny_config(dataset), data=DataConfig(path=str(data)), **small)  # type: ignore[arg-type]
        result = train(config, tmp_path / name)
        handed = load_splats(tmp_path / name / "splat.ply")
        assert len(handed) == len(result.gaussians)
        last = checkpointed(tmp_path / name)
        assert torch.equal(handed.means, last.means) == (name == "object")
        assert float((handed.means - last.means).abs().max()) < 0.05


def checkpointed(run: Path) -> Gaussians:
    from gsopt.training.checkpoint import load_newest

    checkpoint = load_newest(run / "checkpoints", print)
    assert checkpoint is not None
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    return Gaussians(**{name: checkpoint.tensors[f"gaussians.{name}"] for name in names})


def test_gradients_fall_with_the_square_of_the_distance_below_a_distance() -> None:
    backend, camera, gaussians = ReferenceBackend(), ring(5, height=1.0)[0], cloud(30, seed=3)
    away = (gaussians.means - camera.centers[0].float()).norm(dim=1)
    limit = float(away.median())
    frame = backend.forward(gaussians, camera, RasterSettings(sh_degree=1))
    plain = backend.backward(frame, torch.ones_like(frame.colors))
    frame = backend.forward(gaussians, camera, RasterSettings(sh_degree=1))
    weak = backend.backward(frame, torch.ones_like(frame.colors))
    weaken_near(weak, gaussians.means, camera, limit)
    factors = (away / limit).square().clamp(max=1)
    assert 0 < float(factors.min()) < 1
    torch.testing.assert_close(weak.means, plain.means * factors[:, None])
    torch.testing.assert_close(weak.logit_opacities, plain.logit_opacities * factors)
    assert weak.shN is not None
    assert plain.shN is not None
    torch.testing.assert_close(weak.shN, plain.shN * factors[:, None, None])


def test_only_few_photos_of_a_whole_scene_are_treated_so(dataset: Path) -> None:
    scene, config = load_scene(opaque(dataset)), TrainConfig()
    plan = RunPlan.of(config, scene)
    assert plan.opaque
    assert plan.near_distance == pytest.approx(NEAR_SHARE * 10**0.5, rel=1e-3), "the cameras stand there"
    masked = RunPlan.of(config, load_scene(dataset))
    many = RunPlan.of(TrainConfig.of(sparse={"below_views": 2}), scene)
    for other in (masked, many):
        assert (other.opaque, other.near_distance) == (False, 0.0)
    assert many.haze_distance == plan.haze_distance == pytest.approx(HAZE_SHARE * 10**0.5, rel=1e-3)
    assert masked.haze_distance == 0
    assert plan.weights.opacity < masked.weights.opacity
    outward = tuple(
        replace(
            view,
            camera=replace(view.camera, viewmats=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ view.camera.viewmats),
        )
        for view in scene.train
    )
    apart = RunPlan.of(config, replace(scene, train=outward))
    assert apart.near_distance == apart.haze_distance == 0, "no place that all look at"


def test_behind_a_scene_lies_its_mean_color_and_behind_an_object_white(dataset: Path, tmp_path: Path) -> None:
    scene = load_scene(opaque(dataset))
    pixels = torch.cat([view.pixels().flatten(0, 1) for view in scene.train]).double() / 255
    color = Background.of(DataConfig(), scene).color
    assert color == pytest.approx(pixels.mean(0).tolist(), abs=6e-4)
    assert Background.of(DataConfig(), load_scene(dataset)).color == (1.0, 1.0, 1.0)
    assert Background.of(DataConfig(background="black"), scene).color == (0.0, 0.0, 0.0)
    config = replace(tiny_config(dataset), data=DataConfig(path=str(opaque(dataset))))
    train(config, tmp_path / "run")
    assert background_of(tmp_path / "run").tolist() == pytest.approx(color)
    document = json.loads((tmp_path / "run" / "config.json").read_text())
    del document["plan"]
    (tmp_path / "run" / "config.json").write_text(json.dumps(document))
    assert background_of(tmp_path / "run").tolist() == [1, 1, 1]
    document["plan"] = {"background": {"color": [0.5, "red", 0]}}
    (tmp_path / "run" / "config.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"plan\.background"):
        background_of(tmp_path / "run")


def test_depths_on_which_photos_agree_are_those_of_the_room(tmp_path: Path) -> None:
    data = room_dataset(tmp_path / "room", inputs=4, held_out=3)
    scene = load_scene(data)
    found = with_stereo_depths(scene, 0.04, seed=0)
    exact = load_scene(DataConfig(path=str(data), depth=str(data / "depth")))
    for stereo, true in zip(found.train, exact.train, strict=True):
        assert stereo.depth is not None
        height, width = stereo.depth.shape
        truth = true.inverse_depths(height, width)
        assert truth is not None
        known = torch.isfinite(stereo.depth) & torch.isfinite(truth)
        assert float(known.float().mean()) > 0.4
        assert float((stereo.depth / truth - 1)[known].abs().median()) < 0.01
    few = with_stereo_depths(scene, 1.0, seed=0)
    assert few.train == scene.train, "less than that share agrees"
    assert few.agreed is not None, "which need not be found out again"


def test_photos_are_matched_where_nothing_else_gives_depth(dataset: Path) -> None:
    scene, config = load_scene(opaque(dataset)), TrainConfig()
    assert matches_photos(config, scene)
    assert not matches_photos(config, load_scene(dataset))
    assert not matches_photos(config, replace(scene, train=scene.train[:1]))
    assert not matches_photos(replace(config, loss=LossConfig(lambda_depth=0.0)), scene)
    assert not matches_photos(replace(config, data=DataConfig(depth="somewhere")), scene)
    assert matches_photos(replace(config, poses=PoseConfig(refine=True)), scene)
