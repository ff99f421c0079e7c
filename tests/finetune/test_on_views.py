"""Stable Diffusion learns images: what it is asked, that it learns, resumes, and what its folder is to others."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

pytest.importorskip("diffusers")
pytest.importorskip("peft")
import tiny_sd21
from tiny_scenes import write_dataset

from gsopt.cli import main
from gsopt.config.guidance import GuidanceConfig
from gsopt.finetune.on_views import run as stage
from gsopt.finetune.on_views import sample_sheet
from gsopt.finetune.on_views import trainer as training_module
from gsopt.finetune.on_views.batches import TrainingExample, TrainingExamples, make_examples
from gsopt.finetune.on_views.images import ViewSelection, find_images
from gsopt.finetune.on_views.trainer import STATE, ImageTrainer, loss
from gsopt.finetune.on_views.training_config import ImagePreparation, ImageTrainingConfig
from gsopt.sds.load_prior import open_prior
from gsopt.sds.noise import Prediction
from gsopt.sds.priors.folder import find_folder
from gsopt.sds.priors.protocol import Condition
from gsopt.sds.priors.stable_diffusion import DiffusersPrior

STEPS = 6


@pytest.fixture(scope="module", autouse=True)
def small_sheets() -> None:
    """Their content is not tested."""
    sample_sheet.STEPS, sample_sheet.SHOWN_IMAGES = 2, 1


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_sd21.build(tmp_path_factory.mktemp("models") / "sd")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("scenes") / "red-chair", train=3, test=1)


@pytest.fixture(scope="module")
def examples(base: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainingExamples:
    images = find_images([scene], ViewSelection(), "a red chair", lambda line: None)
    preparation = ImagePreparation(flip=True, variants=2)
    return make_examples(opened(base), images, preparation, 0, tmp_path_factory.mktemp("lessons"), lambda line: None)


@pytest.fixture(scope="module")
def learned(base: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished training."""
    out = tmp_path_factory.mktemp("priors") / "mine"
    assert main(command(scene, out, base)) == 0
    return out


def command(scene: Path, out: Path, base: Path | str, *more: str) -> list[str]:
    flags = ["--on-views", "--base", str(base), "--steps", str(STEPS), "--batch", "2", "--rank", "2", "--lr", "1e-2"]
    flags += ["--save-every", "2", "--sheet-every", "3", "--flip", "--variants", "2", "--prompt", "a red chair"]
    return ["finetune", str(scene), "-o", str(out), *flags, "--threads", "1", *more]


def opened(folder: Path) -> DiffusersPrior:
    prior = open_prior(str(folder), GuidanceConfig())
    assert isinstance(prior, DiffusersPrior)
    return prior


def x0(prior: DiffusersPrior) -> torch.Tensor:
    """An answer that shows every weight."""
    random = torch.Generator().manual_seed(0)
    tokens = torch.randn(77, tiny_sd21.WIDTH, generator=random)
    return prior.denoise(torch.randn(1, 4, 8, 8, generator=random), torch.tensor([600]), [Condition(tokens=tokens)])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_the_network_is_asked_for_what_it_predicts(base: Path, kind: Prediction) -> None:
    """Closed form: x_t, and the squared distance to eps, to sqrt(a) eps - sqrt(1-a) z, to z."""
    prior = opened(base)
    prior.prediction = kind
    random = torch.Generator().manual_seed(1)
    z, eps, answer = (torch.randn(1, 4, 8, 8, generator=random) for _ in range(3))
    seen = []

    def unet(x_t, t, encoder_hidden_states):
        seen.append((x_t, t, encoder_hidden_states))
        return type("Output", (), {"sample": answer})()

    prior.__dict__["unet"] = unet
    tokens = torch.randn(1, 77, tiny_sd21.WIDTH, generator=random)
    found = loss(prior, TrainingExample(z, eps, torch.tensor([700]), tokens))
    a = float(prior.schedule.alphas_cumprod[700])
    target = {"epsilon": eps, "v_prediction": a**0.5 * eps - (1 - a) ** 0.5 * z, "sample": z}[kind]
    assert float(found) == pytest.approx(float(((answer - target) ** 2).mean()), rel=1e-5)
    torch.testing.assert_close(seen[0][0], a**0.5 * z + (1 - a) ** 0.5 * eps)
    assert seen[0][1].tolist() == [700]
    assert torch.equal(seen[0][2], tokens)


def test_lessons_are_spread_over_pictures_noise_and_words(examples: TrainingExamples) -> None:
    drawn = [examples.draw(0, step, 0, 1000) for step in range(400)]
    times = torch.cat([example.t for example in drawn]).float()
    assert examples.latents.shape == (3, 2, 4, 8, 8)
    assert abs(float(times.mean()) - 500) < 60
    assert (float(times.min()), float(times.max())) < (30, 1000)
    assert examples.tokens is not None
    wordless = sum(torch.equal(example.tokens[0], examples.tokens[0]) for example in drawn)
    assert 20 < wordless < 65  # one in ten
    different = {example.z.numpy().tobytes() for example in drawn}
    assert len(different) == 6
    again = examples.draw(0, 7, 0, 1000)
    assert torch.equal(again.eps, drawn[7].eps)
    assert not torch.equal(again.eps, examples.draw(0, 7, 1, 1000).eps)
    assert not torch.equal(again.eps, examples.draw(1, 7, 0, 1000).eps)


def test_latents_are_those_of_the_prior(base: Path, scene: Path, examples: TrainingExamples) -> None:
    """Scaled, of the image on white."""
    from gsopt.data.scene import load_scene
    from gsopt.sds.candidate_views import square_views

    prior = opened(base)
    images = square_views(load_scene(scene).train, prior.size, torch.ones(3)).images
    with torch.no_grad():
        z = prior.encode(images[:1])
    torch.testing.assert_close(examples.latents[0, :1], z, rtol=0, atol=2e-3)


@pytest.mark.parametrize("full", [False, True], ids=["lora", "full"])
def test_training_learns_only_what_it_should(base: Path, examples: TrainingExamples, full: bool) -> None:
    """The exam's loss falls; with LoRA every weight of the base stays as it was."""
    trainer = ImageTrainer(
        opened(base), examples, ImageTrainingConfig(steps=25, batch=1, lr=2e-3 if full else 2e-2, full=full)
    )
    before = trainer.evaluate()
    own = {n: p.detach().clone() for n, p in trainer.unet.named_parameters() if n not in trainer.trained}
    for _ in range(25):
        trainer.advance()
    assert trainer.evaluate() < 0.9 * before
    assert bool(own) != full
    assert all(torch.equal(own[n], p) for n, p in trainer.unet.named_parameters() if n in own)
    if not full:
        assert all(".lora_" in name and value.dtype == torch.float32 for name, value in trainer.trained.items())


def test_large_models_recompute_their_blocks_to_the_same_change(
    base: Path, examples: TrainingExamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, found = ImageTrainingConfig(steps=2, batch=1, rank=2, lr=1e-2), []
    for bytes_from in (1 << 30, 0):
        monkeypatch.setattr(training_module, "LARGE_UNET_BYTES", bytes_from)
        trainer = ImageTrainer(opened(base), examples, config)
        assert trainer.unet.is_gradient_checkpointing == (bytes_from == 0)
        trainer.advance()
        found.append(trainer.trained)
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(*(f.values() for f in found), strict=True))


def test_half_precision_is_for_what_is_frozen_only(base: Path, examples: TrainingExamples) -> None:
    config = ImageTrainingConfig(steps=2, batch=1, rank=2, dtype="bfloat16")
    trainer = ImageTrainer(stage.open_base(find_folder(str(base)), config, ImagePreparation()), examples, config)
    assert {value.dtype for value in trainer.trained.values()} == {torch.float32}
    assert {p.dtype for p in trainer.unet.parameters() if not p.requires_grad} == {torch.bfloat16}
    before = {name: value.detach().clone() for name, value in trainer.trained.items()}
    trainer.advance()
    assert any(not torch.equal(value, before[name]) for name, value in trainer.trained.items())


@pytest.mark.parametrize("full", [False, True], ids=["lora", "full"])
def test_a_resumed_training_has_the_same_bits(
    base: Path, examples: TrainingExamples, full: bool, tmp_path: Path
) -> None:
    config = ImageTrainingConfig(steps=6, batch=2, lr=1e-2, rank=2, full=full)
    whole, first, second = (ImageTrainer(opened(base), examples, config) for _ in range(3))
    losses = [whole.advance() for _ in range(6)]
    for _ in range(4):
        first.advance()
    first.save(tmp_path / STATE)
    second.restore(tmp_path / STATE)
    assert [second.advance() for _ in range(2)] == losses[4:]
    assert all(torch.equal(value, second.trained[name]) for name, value in whole.trained.items())


def test_a_killed_command_goes_on_to_the_same_files(
    base: Path, scene: Path, learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = stage.Log.__call__

    def killed(self, step, found):
        if step == 5:
            raise KeyboardInterrupt
        inner(self, step, found)

    out = tmp_path / "mine"
    with monkeypatch.context() as patch:
        patch.setattr(stage.Log, "__call__", killed)
        assert main(command(scene, out, base)) == 130
    assert (out / STATE).exists()
    assert main(["train", str(scene), "--prior", str(out), "-m", str(tmp_path / "run")]) == 3  # half a model is none
    assert main(command(scene, out, base)) == 0
    theirs, ours = contents(learned), contents(out)
    for name in ("lora/adapter_model.safetensors", "pytorch_lora_weights.safetensors", "samples/step_000006.png"):
        assert ours[name] == theirs[name]
    assert json.loads(ours["finetune.json"])["measured"] == json.loads(theirs["finetune.json"])["measured"]


def test_the_folder_is_whole_small_and_outlives_its_base(base: Path, scene: Path, tmp_path: Path) -> None:
    """Links to the base's files, which are as they were; the folder works when the base is gone."""
    own = Path(shutil.copytree(base, tmp_path / "base"))
    before, out = contents(own), tmp_path / "mine"
    assert main(command(scene, out, own, "--steps", "1", "--sheet-every", "0")) == 0
    assert contents(own) == before
    weights = "unet/diffusion_pytorch_model.safetensors"
    assert (out / weights).samefile(own / weights)
    assert not (out / "samples").exists()
    assert not list(out.rglob("*.tmp"))
    assert {"README.md", "finetune.json", "train.jsonl"} < set(contents(out))
    assert not (set(contents(out)) & {STATE, "latents.safetensors"})
    shutil.rmtree(own)
    assert torch.isfinite(x0(opened(out))).all()


def test_links_become_copies_where_there_are_none(
    base: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args, **kwargs):
        raise OSError("another file system")

    monkeypatch.setattr("os.link", refuse)
    assert main(command(scene, tmp_path / "mine", base, "--steps", "0", "--sheet-every", "0")) == 0
    theirs = contents(tmp_path / "mine")
    assert all(theirs[name] == data for name, data in contents(base).items())


@pytest.mark.parametrize("full", [(), ("--full",)], ids=["lora", "full"])
def test_no_step_is_the_base_itself(base: Path, scene: Path, full: tuple[str, ...], tmp_path: Path) -> None:
    assert main(command(scene, tmp_path / "mine", base, "--steps", "0", "--sheet-every", "0", *full)) == 0
    assert torch.equal(x0(opened(tmp_path / "mine")), x0(opened(base)))
    assert (tmp_path / "mine" / "lora").exists() != bool(full)


def test_the_whole_unet_is_kept_in_its_bases_number_format(base: Path, scene: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    own = Path(shutil.copytree(base, tmp_path / "base"))
    file = own / "unet" / "diffusion_pytorch_model.safetensors"
    save_file({k: v.half() for k, v in load_file(file).items()}, file, metadata={"format": "pt"})
    out = tmp_path / "mine"
    assert main(command(scene, out, own, "--full", "--steps", "1", "--sheet-every", "0")) == 0
    kept = load_file(out / "unet" / "diffusion_pytorch_model.safetensors")
    assert {value.dtype for value in kept.values()} == {torch.float16}
    assert not torch.equal(x0(opened(out)), x0(opened(own)))


def test_other_tools_read_the_same_change(base: Path, learned: Path) -> None:
    """gsopt puts it into the weights; peft and diffusers run it beside them."""
    from diffusers import StableDiffusionPipeline, UNet2DConditionModel
    from peft import PeftModel

    ours = x0(opened(learned))
    by_peft, by_diffusers = opened(base), opened(base)
    wrapped = PeftModel.from_pretrained(UNet2DConditionModel.from_pretrained(base / "unet"), learned / "lora")
    by_peft.__dict__["unet"] = wrapped.eval()
    pipeline = StableDiffusionPipeline.from_pretrained(learned, feature_extractor=None)
    pipeline.load_lora_weights(learned)
    by_diffusers.__dict__["unet"] = pipeline.unet.eval()
    torch.testing.assert_close(x0(by_peft), ours, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(x0(by_diffusers), ours, rtol=1e-4, atol=1e-4)
    assert float((x0(opened(base)) - ours).abs().max()) > 1e-2


def test_the_folder_guides_a_run(learned: Path, scene: Path, tmp_path: Path) -> None:
    flags = ["--iterations", "12", "--prior", str(learned), "--prompt", "a red chair", "--guidance.guard-views", "0"]
    flags += ["--guidance.min-uncertainty", "0", "--guidance.every", "3", "--init", "random", "--init-count", "60"]
    assert main(["train", str(scene), "-m", str(tmp_path / "run"), *flags, "--backend", "cpu", "--threads", "1"]) == 0
    summary = json.loads((tmp_path / "run" / "guidance" / "summary.json").read_text())
    assert summary["guided"] >= 3
    assert summary["failed"] == 0
    assert "with LoRA" in summary["model"]


def test_what_the_user_sees(learned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    card = (learned / "README.md").read_text()
    assert "a red chair" in card
    assert "red-chair/train/r_0.png" in card
    assert "before" in card
    log = [json.loads(line) for line in (learned / "train.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == STEPS
    assert {p.name for p in (learned / "samples").iterdir()} == {f"step_00000{n}.png" for n in (0, 3, 6)}
    assert find_folder(str(learned)).adapter is not None


@pytest.mark.parametrize("flag", ["--on-views", "--on_views"])
def test_the_flag_may_be_spelled_as_any_other(flag: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["finetune", flag, "--help"]) == 0
    assert "LoRA" in capsys.readouterr().out


def test_a_finished_training_is_left_alone(base: Path, scene: Path, learned: Path) -> None:
    before = contents(learned)
    assert main(command(scene, learned, base)) == 0
    assert main(command(scene, learned, base, "--seed", "1")) == 3
    assert contents(learned) == before
