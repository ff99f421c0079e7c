"""Defects of a model folder: each fault is an InputError or UsageError that names the part and the remedy."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import tiny_sd21

from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import GsoptError, InputError, UsageError
from gsopt.sds.load_prior import open_prior
from gsopt.sds.priors.folder import SD21, find_folder
from gsopt.sds.select_prior import select_prior


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def edit(path: Path, **changes: object) -> None:
    import json

    tiny_sd21.write_json(path, {**json.loads(path.read_text()), **changes})


def only_pickle(part: Path) -> None:
    (part / "diffusion_pytorch_model.safetensors").rename(part / "diffusion_pytorch_model.bin")


FAULTS: list[tuple[str, Callable[[Path], object], str]] = [
    ("half a file of weights", lambda f: truncate(f / "unet" / "diffusion_pytorch_model.safetensors"), "incomplete"),
    ("no weights", lambda f: (f / "vae" / "diffusion_pytorch_model.safetensors").unlink(), "holds no weights"),
    ("no text encoder", lambda f: shutil.rmtree(f / "text_encoder"), "text_encoder"),
    ("no text encoder weights", lambda f: (f / "text_encoder" / "model.safetensors").unlink(), "text_encoder"),
    ("weights as a pickle", lambda f: only_pickle(f / "unet"), "pickle"),
    (
        "an empty file of weights",
        lambda f: (f / "vae" / "diffusion_pytorch_model.safetensors").write_bytes(b""),
        "incomplete",
    ),
    ("no U-Net", lambda f: shutil.rmtree(f / "unet"), "unet/config.json"),
    ("no VAE", lambda f: shutil.rmtree(f / "vae"), "vae"),
    ("no scheduler", lambda f: shutil.rmtree(f / "scheduler"), "scheduler_config.json"),
    ("no vocabulary", lambda f: (f / "tokenizer" / "merges.txt").unlink(), "vocabulary"),
    ("a configuration that is no JSON", lambda f: (f / "unet" / "config.json").write_text("{"), "config.json"),
    ("a configuration that is no object", lambda f: (f / "vae" / "config.json").write_text("[]"), "config.json"),
    ("another kind of U-Net", lambda f: edit(f / "unet" / "config.json", _class_name="FluxTransformer2DModel"), "Flux"),
    ("an inpainting U-Net", lambda f: edit(f / "unet" / "config.json", in_channels=9), "inpainting"),
    ("another model's text encoder", lambda f: edit(f / "text_encoder" / "config.json", hidden_size=768), "768"),
    ("unknown class embeddings", lambda f: edit(f / "unet" / "config.json", class_embed_type="timestep"), "timestep"),
    ("a shard that is missing", lambda f: sharded(f / "unet"), "00002"),
]


def sharded(part: Path) -> None:
    (part / "diffusion_pytorch_model.safetensors").rename(part / "diffusion_pytorch_model-00001-of-00002.safetensors")
    names = {
        "a": "diffusion_pytorch_model-00001-of-00002.safetensors",
        "b": "diffusion_pytorch_model-00002-of-00002.safetensors",
    }
    tiny_sd21.write_json(part / "diffusion_pytorch_model.safetensors.index.json", {"weight_map": names})


@pytest.mark.parametrize(("spoil", "named"), [fault[1:] for fault in FAULTS], ids=[fault[0] for fault in FAULTS])
def test_a_broken_folder_is_named_before_anything_is_loaded(
    sd21_copy: Path, spoil: Callable[[Path], object], named: str
) -> None:
    assert find_folder(str(sd21_copy)).path == sd21_copy
    spoil(sd21_copy)
    with pytest.raises(InputError) as caught:
        find_folder(str(sd21_copy))
    assert named in str(caught.value)
    assert str(sd21_copy) in str(caught.value)


def test_weights_that_do_not_fit_the_configuration_are_named_when_loaded(sd21_copy: Path) -> None:
    edit(sd21_copy / "unet" / "config.json", block_out_channels=[16, 64])
    prior = open_prior(str(sd21_copy), GuidanceConfig())
    with pytest.raises(InputError, match="UNet2DConditionModel"):
        prior.unet  # type: ignore[attr-defined]  # noqa: B018 - the access loads it


def test_a_tokenizer_of_another_model_is_named(sd21_copy: Path) -> None:
    edit(sd21_copy / "text_encoder" / "config.json", vocab_size=100)
    with pytest.raises(InputError, match="text_encoder"):
        open_prior(str(sd21_copy), GuidanceConfig()).encoder()


@pytest.mark.parametrize("name", ["sd21", "nobody/no-such-model"])
def test_a_hub_that_cannot_be_reached_is_an_error_with_remedies(name: str, monkeypatch, tmp_path: Path) -> None:
    hub = pytest.importorskip("huggingface_hub")

    def unreachable(repo_id: str, **options: object) -> str:
        raise OSError("no route to host")

    monkeypatch.setattr(hub, "snapshot_download", unreachable)
    with pytest.raises(InputError, match="no route to host") as caught:
        find_folder(name)
    told = str(caught.value)
    assert (SD21 if name == "sd21" else name) in told
    assert "--lambda_sds 0" in told
    assert ("withdrawn" in told) == (name == "sd21")


def test_offline_without_a_cache_fails_at_once(monkeypatch, tmp_path: Path) -> None:
    """The real client, told that there is no network."""
    constants = pytest.importorskip("huggingface_hub").constants
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(InputError, match="could not be fetched"):
        find_folder("sd21")


def test_a_model_in_the_cache_needs_no_network(sd21: Path, monkeypatch) -> None:
    hub = pytest.importorskip("huggingface_hub")

    def cached(repo_id: str, *, local_files_only: bool = False, **options: object) -> str:
        assert local_files_only, "asked the network for what is in the cache"
        return str(sd21)

    monkeypatch.setattr(hub, "snapshot_download", cached)
    assert find_folder("sd21").path == sd21


def test_half_a_cache_is_completed_from_the_network(sd21: Path, sd21_copy: Path, monkeypatch) -> None:
    hub = pytest.importorskip("huggingface_hub")
    (sd21_copy / "vae" / "diffusion_pytorch_model.safetensors").unlink()
    monkeypatch.setattr(
        hub, "snapshot_download", lambda name, **options: str(sd21_copy if options.get("local_files_only") else sd21)
    )
    assert find_folder("sd21").path == sd21


@pytest.mark.parametrize("name", ["", "./absent", "no/such/folder", "name with spaces", "../../etc", "sd 21", "a/b/c"])
def test_what_is_no_name_at_all_is_a_usage_error(name: str) -> None:
    with pytest.raises(GsoptError, match="prior"):
        find_folder(name) if name else GuidanceConfig(prior=name)


def test_the_default_is_off_and_says_how_to_ask() -> None:
    choice = select_prior(GuidanceConfig())
    assert (choice.name, choice.weight) == (None, 0.0)
    assert "nobody asked" in choice.reason
    assert "--lambda_sds 0.2" in choice.reason


def test_zero_is_off_whatever_else_was_given() -> None:
    choice = select_prior(GuidanceConfig(lambda_sds=0, prior="sd21", prompt=("a chair",)))
    assert (choice.name, choice.weight) == (None, 0.0)
    assert "lambda_sds is 0" in choice.reason


def test_a_named_prior_guides_with_the_default_weight() -> None:
    assert select_prior(GuidanceConfig(prior="sd21")).weight == 0.2
    assert select_prior(GuidanceConfig(prior="sd21", lambda_sds=0.7)).weight == 0.7


@pytest.mark.parametrize(
    "asked",
    [{"lambda_sds": 0.1}, {"prior": "embedded"}, {"prompt": ("a",)}, {"negative": ("a",)}, {"ref_image": ("a.png",)}],
)
def test_guidance_that_was_asked_for_is_never_dropped_silently(asked: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="asks for guidance"):
        select_prior(GuidanceConfig(**asked))  # type: ignore[arg-type]
