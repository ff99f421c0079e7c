"""Stable Diffusion 1 and 2 behind the `Prior` interface: any diffusers folder with a U-Net, a VAE and a CLIP.

The networks are loaded on first use, after the text encoder is released. No gradient passes through the U-Net; the
VAE's encoder recomputes its blocks in the backward pass (Chen et al. 2016), so that memory holds one block's
activations.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
import torch.utils.checkpoint
from jaxtyping import Float, Int
from torch import Tensor

from gsopt._optional import require
from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError, UsageError
from gsopt.sds.noise import PREDICTIONS, Latents, NoiseSchedule, Prediction, x0_from
from gsopt.sds.priors import clip, lora
from gsopt.sds.priors.folder import DiffusersFolder, check_weights
from gsopt.sds.priors.protocol import Condition, Encoder, Images

LARGE_UNET_BYTES = 1 << 30
"""Size of U-Net weights on disk, bytes, from which on a CPU computes in bfloat16."""


RESIDUAL_BLOCK = "ResnetBlock2D"
"""Type of the blocks that hold nearly all memory of an autoencoder's encoder."""


class DiffusersPrior:
    """See `gsopt.sds.priors.protocol.Prior`."""

    x0_limit: float | None = None
    aligned = False

    def __init__(self, folder: DiffusersFolder, config: GuidanceConfig) -> None:
        self.folder = folder
        self.device = choose_device(config.device)
        self.dtype = choose_dtype(config.dtype, self.device, folder.unet_bytes)
        self.prediction, self.schedule = read_schedule(folder)
        learned = " with LoRA" if folder.adapter else ""
        self.name = f"{folder.name}{learned} ({self.prediction}, {str(self.dtype)[6:]} on {self.device})"
        self.size = config.size or _side(folder)
        self.class_embedding_width = _class_width(folder)
        self._tiny_vae, self._clip = config.tiny_vae, config.clip
        self._downscale = 2 ** (len(folder.vae.get("block_out_channels", [0] * 4)) - 1)
        if self.size % self._downscale:
            raise UsageError(
                f"`--guidance.size` must be a multiple of {self._downscale} for {folder.name}, got {self.size}. "
                f"Try {max(1, self.size // self._downscale) * self._downscale}."
            )

    @cached_property
    def unet(self) -> Any:
        """The denoiser, frozen, with its LoRA merged."""
        diffusers = require("diffusers", "sds", "Guidance by Stable Diffusion")
        unet = _loaded(diffusers.UNet2DConditionModel, self.folder.path / "unet", self.dtype)
        if self.folder.adapter is not None:
            lora.merge(unet, self.folder.adapter)
        return self._placed(unet)

    @cached_property
    def vae(self) -> Any:
        """The autoencoder, frozen; its encoder recomputes its blocks in the backward pass."""
        diffusers = require("diffusers", "sds", "Guidance by Stable Diffusion")
        tiny = self._tiny_vae or self.folder.vae["_class_name"] == "AutoencoderTiny"
        path = find_part(self._tiny_vae) if self._tiny_vae else self.folder.path / "vae"
        vae = _loaded(diffusers.AutoencoderTiny if tiny else diffusers.AutoencoderKL, path, self.dtype)
        if vae.config.latent_channels != self.folder.unet["in_channels"]:
            raise InputError(
                f"The autoencoder {path} makes {vae.config.latent_channels} channels, the U-Net takes "
                f"{self.folder.unet['in_channels']}. Give one that was made for this model."
            )
        if not tiny:
            recompute(vae)
        return self._placed(vae)

    def encode(self, images: Images) -> Latents:
        """Returns the mean of the VAE's distribution: sampling it would only add variance."""
        encoded = self.vae.encode((2 * images - 1).to(self.device, self.dtype))
        latents = encoded.latents if hasattr(encoded, "latents") else encoded.latent_dist.mean
        shift = getattr(self.vae.config, "shift_factor", None) or 0.0
        return (latents.float() - shift) * self.vae.config.scaling_factor

    @torch.no_grad()
    def decode(self, x0: Latents) -> Images:
        """Decodes with the VAE; the result is clamped and on the CPU."""
        shift = getattr(self.vae.config, "shift_factor", None) or 0.0
        latents = x0.to(self.device) / self.vae.config.scaling_factor + shift
        return (self.vae.decode(latents.to(self.dtype)).sample.float().cpu() / 2 + 0.5).clamp(0, 1)

    @torch.no_grad()
    def denoise(self, x_t: Latents, t: Int[Tensor, "B"], conditions: Sequence[Condition]) -> Latents:
        """Calls the U-Net once and converts its prediction to x0."""
        tokens, mask = padded_tokens([condition.tokens for condition in conditions])
        output = self.unet(
            x_t.to(self.device, self.dtype),
            t.to(self.device),
            encoder_hidden_states=None if tokens is None else tokens.to(self.device, self.dtype),
            encoder_attention_mask=None if mask is None else mask.to(self.device),
            class_labels=self._class_labels(conditions),
        ).sample
        return x0_from(output.to(x_t), x_t, self.schedule.signal(t, x_t), self.prediction)

    def encoder(self) -> Encoder | None:
        """Loads the folder's text encoder and its image encoder, if any; --guidance.clip adds a whole CLIP."""
        if not self.folder.takes_text:
            return None
        path, dtype = self.folder.path, torch.float32
        text = clip.load_text_tower(path / "tokenizer", path / "text_encoder", dtype)
        own = path / "image_encoder"
        image = clip.load_image_tower(own, path / "feature_extractor", dtype) if own.is_dir() else None
        joint = clip.load_joint_clip(find_part(self._clip), dtype) if self._clip else None
        return clip.ClipEncoder(self.folder.name, text, image, joint)

    def _class_labels(self, conditions: Sequence[Condition]) -> Float[Tensor, "B 2E"] | None:
        """unCLIP's image embedding with the embedding of noise level 0 (cos 0, sin 0); zeros for what has none."""
        width = self.class_embedding_width
        if width is None:
            return None
        level = torch.cat([torch.ones(width // 2), torch.zeros(width - width // 2)])
        rows = [
            torch.zeros(2 * width) if c.class_embedding is None else torch.cat([c.class_embedding.cpu(), level])
            for c in conditions
        ]
        return torch.stack(rows).to(self.device, self.dtype)

    def _placed(self, network: Any) -> Any:
        return network.to(self.device).eval().requires_grad_(False)


def recompute(vae: Any) -> None:
    """Let an autoencoder's encoder recompute every residual block in the backward pass instead of keeping what it made.

    At 512 px and 16 bits this leaves 0.6 GB of 1.7 GB; diffusers' own switch, which takes whole levels, 1.0 GB. There
    is no chance in the blocks, so no state of a random generator is kept.
    """
    again = partial(torch.utils.checkpoint.checkpoint, use_reentrant=False, preserve_rng_state=False)
    for block in vae.encoder.modules():
        if type(block).__name__ == RESIDUAL_BLOCK:
            block.forward = partial(again, block.forward)


def padded_tokens(
    rows: Sequence[Float[Tensor, "L D"] | None],
) -> tuple[Float[Tensor, "B L D"] | None, Float[Tensor, "B L"] | None]:
    """Returns rows of tokens as one batch, with a mask (1 = token) if their lengths differ.

    Only the positive half has image tokens; the padding of the shorter negative half must not be attended to.
    """
    given = [row for row in rows if row is not None]
    if len(given) != len(rows):
        return None, None
    longest = max(len(row) for row in given)
    mask = torch.stack([torch.arange(longest) < len(row) for row in given]).float()
    batch = torch.stack([torch.nn.functional.pad(row, (0, 0, 0, longest - len(row))) for row in given])
    return batch, None if bool(mask.all()) else mask


def read_schedule(folder: DiffusersFolder) -> tuple[Prediction, NoiseSchedule]:
    """Reads the prediction type and the noise schedule from scheduler_config.json."""
    prediction = folder.scheduler.get("prediction_type", "epsilon")
    if prediction not in PREDICTIONS:
        raise InputError(
            f"The model {folder.path} predicts {prediction!r}; known are {', '.join(PREDICTIONS)}. Give another model."
        )
    diffusers = require("diffusers", "sds", "Guidance by Stable Diffusion")
    try:
        alphas = diffusers.DDIMScheduler.from_config(folder.scheduler).alphas_cumprod
    except (ValueError, TypeError, KeyError, NotImplementedError) as error:
        raise InputError(f"{folder.path / 'scheduler'} cannot be used: {error}. Fetch the model again.") from error
    return prediction, NoiseSchedule.of(alphas)


def choose_device(name: str) -> torch.device:
    """Returns the device; `auto` prefers a GPU. Raises UsageError for a missing GPU."""
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise UsageError("`--guidance.device` is cuda, but torch finds no GPU. Use cpu, or install torch for CUDA.")
    return torch.device("cuda" if name == "cuda" or (name == "auto" and available) else "cpu")


def choose_dtype(name: str, device: torch.device, unet_bytes: int) -> torch.dtype:
    """Returns the dtype. `auto`: float16 on a GPU; on a CPU bfloat16 for large models if torch has fast kernels for it,
    else float32."""
    if device.type == "cpu" and name == "float16":
        raise UsageError(
            "`--guidance.dtype` float16 does not work on a CPU. Use bfloat16 (the same memory), float32 or auto: the "
            "weights are converted when they are loaded."
        )
    if name != "auto":
        return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[name]
    if device.type != "cpu":
        return torch.float16
    return torch.bfloat16 if unet_bytes >= LARGE_UNET_BYTES and has_bfloat16() else torch.float32


def has_bfloat16() -> bool:
    """True if this CPU computes in bfloat16 fast enough. Without AVX-512 a convolution of SD 2.1 takes a hundred times
    as long as in float32 (measured on AVX2)."""
    return torch.backends.cpu.get_cpu_capability() == "AVX512"


def find_part(name: str) -> Path:
    """Finds a folder with one model (a tiny autoencoder, a CLIP), local or from the hub."""
    path = Path(name).expanduser()
    if not path.is_dir():
        hub = require("huggingface_hub", "sds", "Fetching a model from the hub")
        try:
            path = Path(hub.snapshot_download(name, allow_patterns=["*.json", "*.txt", "*.safetensors"]))
        except Exception as error:  # whatever its HTTP library raises
            raise InputError(
                f"The model {name} is no folder and could not be fetched ({type(error).__name__}). "
                "Give a folder that was downloaded before."
            ) from error
    check_weights(path)
    return path


def _side(folder: DiffusersFolder) -> int:
    """Returns the side of the model's training images, px."""
    sample = folder.unet.get("sample_size") or 64
    sample = max(sample) if isinstance(sample, list) else sample
    return int(sample) * 2 ** (len(folder.vae.get("block_out_channels", [0] * 4)) - 1)


def _class_width(folder: DiffusersFolder) -> int | None:
    if folder.unet.get("class_embed_type") is None:
        return None
    return int(folder.unet.get("projection_class_embeddings_input_dim") or 2048) // 2


def _loaded(kind: Any, path: Path, dtype: torch.dtype) -> Any:
    try:
        return kind.from_pretrained(str(path), torch_dtype=dtype, use_safetensors=True, local_files_only=True)
    except Exception as error:  # diffusers raises whatever its parsers raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"Cannot load {kind.__name__} from {path}: {reason:.200}. Fetch the model again.") from error
