"""From scenes to a prior that guides a run: what its folder is, what is refused, and that training resumes exactly."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gsopt.cli import main
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import InitConfig
from gsopt.errors import InputError, UsageError
from gsopt.farm.local import LocalFarm
from gsopt.finetune import evaluation, reconstruction_pairs, run, serve_pairs
from gsopt.finetune.batches import draw_batch
from gsopt.finetune.pair_cache import collect_pairs
from gsopt.finetune.reconstruction_pairs import Pairs, make_pairs, render_pairs, whole_scene
from gsopt.finetune.scenes import TrainingScenes
from gsopt.finetune.trainer import STATE, PriorTrainer, loss
from gsopt.finetune.training_config import PriorTrainingConfig
from gsopt.init import first_gaussians
from gsopt.raster.api import make_backend
from gsopt.sds.load_prior import open_prior
from gsopt.sds.priors.protocol import Condition
from gsopt.sds.priors.view_conditioned import INPUT_CHANNELS, ViewPrior, make_unet, predict

pytest.importorskip("diffusers")
from in_process_farm import InProcess
from tiny_scenes import write_dataset

SIZE = 64


@pytest.fixture(scope="module", autouse=True)
def short_fits() -> Iterator[None]:
    """Fits of a handful of steps, few renders to measure on: how much is learned is not what is tested."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruction_pairs, "STEP_COUNTS", (12,))
        patch.setattr(evaluation, "MAX_RENDERS", 2)
        patch.setattr(run, "open_farm", lambda name, cpus: InProcess(serve_pairs.handle))
        yield


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes")
    for name in ("one", "two", "three"):
        write_dataset(root / name, train=6, test=2)
    return root


@pytest.fixture(scope="module")
def pairs(scenes: Path) -> Pairs:
    return make_pairs(scenes / "one", SIZE, 0, 0, make_backend("cpu", 1))


def test_a_worker_of_a_farm_makes_the_same_pairs(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes of their own, beside the same reconstructions in this one: the same bytes, and no partial folder."""
    monkeypatch.setattr(reconstruction_pairs, "STEP_COUNTS", (600, 1000, 1600))  # a worker's, which no fixture reaches
    out = [tmp_path / name / "pairs" for name in ("here", "there")]
    for folder, farm in zip(out, (InProcess(serve_pairs.handle), LocalFarm(2)), strict=True):
        collect_pairs([scenes / "one"], 1, 32, 5, folder, farm, print)
    here, there = (sorted(path.relative_to(folder) for path in folder.rglob("*")) for folder in out)
    assert here == there
    (name,) = (path for path in here if path.suffix)
    assert (out[0] / name).read_bytes() == (out[1] / name).read_bytes()


@pytest.fixture(scope="module")
def prior(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    out = tmp_path_factory.mktemp("priors") / "mine"
    assert main([*command(scenes, out)]) == 0
    yield out
    shutil.rmtree(out)  # 200 MB: the optimizer's state of every weight


def command(scenes: Path, out: Path, *more: str) -> list[str]:
    flags = ["--val", "three", "--fits", "1", "--size", str(SIZE), "--steps", "2", "--batch", "2", "--threads", "1"]
    return ["finetune", str(scenes), "-o", str(out), *flags, *more]


def test_an_untrained_network_gives_the_render_back() -> None:
    planes = torch.rand(2, INPUT_CHANNELS - 3, SIZE, SIZE) * 2 - 1
    x0 = predict(make_unet(0), torch.randn(2, 3, SIZE, SIZE), torch.tensor([3, 700]), planes)
    assert torch.equal(x0, planes[:, :3])


def test_pairs_are_made_of_views_that_were_held_out(pairs: Pairs) -> None:
    """The input view is met well after a fit, the same bits come again, and every byte is within its alpha."""
    assert pairs.truth.shape[1:] == (4, SIZE, SIZE)
    assert bool((pairs.truth[:, :3] <= pairs.truth[:, 3:] + 1).all())
    assert int(pairs.warped[:, :, 4].max()) > 100
    assert int(pairs.uncertainty.max()) > 0


def test_a_scene_has_about_the_size_asked_for_however_large_its_photos_are(
    scenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """24 px."""
    monkeypatch.setattr("gsopt.data.scene.LONGEST_SIDE", 8)
    camera = whole_scene(scenes / "one", 12).train[0].camera
    assert (camera.width, camera.height) == (12, 12)


def test_mirror_images_count_as_input_views(scenes: Path) -> None:
    """As in a run: what they show is less uncertain."""
    scene = whole_scene(scenes / "one", SIZE)
    few = replace(scene, train=scene.train[:2])
    gaussians, _ = first_gaussians(scene, InitConfig(count=300), 0, 0)
    backend = make_backend("cpu", 1)
    alone, with_images = (
        render_pairs(gaussians, replace(few, mirrored=images), scene.train[4:], SIZE, backend).uncertainty.float()
        for images in ((), scene.train[2:4])
    )
    assert with_images.mean() < 0.9 * alone.mean()


def test_pairs_survive_their_file(pairs: Pairs, tmp_path: Path) -> None:
    pairs.save(tmp_path / "p.safetensors")
    for a, b in zip(vars(pairs).values(), vars(Pairs.load(tmp_path / "p.safetensors")).values(), strict=True):
        assert torch.equal(a, b)
    (tmp_path / "p.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{broken}")
    with pytest.raises(InputError, match=r"p\.safetensors"):
        Pairs.load(tmp_path / "p.safetensors")


def test_training_learns_and_resumes_to_the_bit(pairs: Pairs, tmp_path: Path) -> None:
    config = PriorTrainingConfig(steps=8, batch=2, lr=2e-3)
    whole = PriorTrainer(make_unet(0), config)
    losses = [whole.advance(pairs) for _ in range(8)]
    first = PriorTrainer(make_unet(0), config)
    for _ in range(5):
        first.advance(pairs)
    first.save(tmp_path / STATE)
    second = PriorTrainer(make_unet(1), config)
    second.restore(tmp_path / STATE)
    assert [second.advance(pairs) for _ in range(3)] == losses[5:]
    for name, value in whole.average.items():
        assert torch.equal(value, second.average[name])
    with pytest.raises(InputError, match="Cannot continue"):
        PriorTrainer(make_unet(0), PriorTrainingConfig(steps=13, batch=2)).restore(tmp_path / STATE)


def test_training_lowers_the_loss(pairs: Pairs) -> None:
    """The loss of a fixed example, before and after twenty steps on its pairs: renders half as bright."""
    pairs = replace(pairs, render=torch.cat([pairs.truth[:, :3] // 2, pairs.truth[:, 3:]], 1))
    trainer = PriorTrainer(make_unet(0), PriorTrainingConfig(steps=20, batch=3, lr=1e-3))
    example = draw_batch(pairs, 4, trainer.noise, torch.Generator().manual_seed(0))
    before = float(loss(trainer.unet, example).detach())
    for _ in range(20):
        trainer.advance(pairs)
    assert float(loss(trainer.unet, example).detach()) < 0.8 * before


def test_the_folder_is_a_prior(prior: Path) -> None:
    """diffusers reads its network, gsopt opens it by its path, and its card names the scenes and what was measured."""
    import diffusers

    stock = diffusers.UNet2DConditionModel.from_pretrained(prior / "unet")
    assert stock.config.out_channels == 48
    opened = open_prior(str(prior), GuidanceConfig())
    assert isinstance(opened, ViewPrior)
    assert opened.size == SIZE
    x0 = opened.denoise(torch.zeros(1, 3, SIZE, SIZE), torch.tensor([300]), [Condition()])
    assert x0.shape == (1, 3, SIZE, SIZE)
    card = (prior / "README.md").read_text()
    assert "| one |" in card
    assert "| two |" in card
    assert "| three |" not in card
    assert set(json.loads((prior / "gsopt_prior.json").read_text())["measured"]["repair"]) >= {"300", "500"}


def test_a_prior_of_ones_own_guides_a_run(prior: Path, scenes: Path, tmp_path: Path) -> None:
    flags = ["--iterations", "20", "--prior", str(prior), "--guidance.guard-views", "0", "--guidance.every", "2"]
    flags += ["--guidance.min-uncertainty", "0", "--init-count", "60", "--backend", "cpu", "--threads", "1"]
    assert main(["train", str(scenes / "three"), "-m", str(tmp_path / "run"), *flags]) == 0
    summary = json.loads((tmp_path / "run" / "guidance" / "summary.json").read_text())
    assert summary["guided"] > 3
    assert summary["failed"] == 0


def test_the_same_command_goes_on_and_another_is_refused(prior: Path, scenes: Path) -> None:
    before = (prior / "README.md").read_bytes()
    assert main(command(scenes, prior)) == 0
    assert (prior / "README.md").read_bytes() == before
    assert main(command(scenes, prior, "--lr", "1e-3")) == 3
    assert (prior / "README.md").read_bytes() == before


@pytest.mark.parametrize("size", [100, 66, 32])
def test_a_size_that_no_prior_can_have_is_refused_before_any_work(size: int) -> None:
    with pytest.raises(UsageError, match=r"`--size`"):
        TrainingScenes((Path("a"),), (), size=size)


def test_a_scene_of_one_view_is_named(tmp_path: Path) -> None:
    scene = write_dataset(tmp_path / "one", train=1, test=1)
    (scene / "transforms_test.json").unlink()
    with pytest.raises(InputError, match="one view"):
        whole_scene(scene, SIZE)


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("not json", "gsopt_prior.json"),
        ('{"size": 100}', "size 100"),
        ('{"size": "64"}', "size '64'"),
        ("[]", "gsopt_prior.json"),
    ],
)
def test_a_broken_card_is_named(broken: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "gsopt_prior.json").write_text(broken)
    with pytest.raises(InputError, match=said):
        open_prior(str(tmp_path), GuidanceConfig())


def test_missing_weights_are_named(tmp_path: Path) -> None:
    (tmp_path / "gsopt_prior.json").write_text('{"size": 64}')
    with pytest.raises(InputError, match="unet"):
        _ = open_prior(str(tmp_path), GuidanceConfig()).unet  # type: ignore[attr-defined]


def test_data_without_scenes_and_unknown_val_names_are_refused(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["finetune", str(tmp_path / "empty"), "-o", str(tmp_path / "out")]) == 3
    assert main([*command(scenes, tmp_path / "out")[:4], "--val", "four"]) == 2
    assert not (tmp_path / "out").exists()
