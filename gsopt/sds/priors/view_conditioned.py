"""The view-conditioned prior: a small U-Net that improves a render, given the input views.

    (1)  x0_hat = r + f(x_t, t, r, alpha, u, w_1, c_1, ..., w_K, c_K)

r is the current render, u its uncertainty (`coverage`), w_k the input views warped into the camera by the render's
depth with confidence c_k (`warp`): all aligned, pixel by pixel. f predicts the error of the render; an untrained
network changes nothing. If the folder holds a CLIP, f attends to text and image tokens as well. It works on pixels in
[-1, 1], cut into PATCH_SIDE x PATCH_SIDE tiles for speed (Li & He 2025: x0 is the prediction that patches of pixels
need), on sides that are multiples of `side_multiple()`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError
from torch import Tensor

from gsopt._optional import require
from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError, UsageError
from gsopt.sds.noise import Latents, NoiseSchedule
from gsopt.sds.priors.clip import ClipEncoder, load_joint_clip
from gsopt.sds.priors.protocol import Condition, Encoder, Images
from gsopt.sds.priors.stable_diffusion import find_part
from gsopt.sds.warp import warp

PATCH_SIDE = 4
MAX_REFERENCES = 3
"""Number of references warped into the camera, the nearest ones."""
INPUT_CHANNELS = 3 + 4 + 1 + 4 * MAX_REFERENCES
"""Channels of x_t, the render with alpha, its uncertainty, and the references with their confidence."""
UNET_WIDTHS = (96, 128, 192)
TOKEN_WIDTH = 192
CLIP_FOLDER = "clip"
"""Subfolder of the CLIP whose tokens the network takes; a prior without it takes no text."""
NOISE_STEPS = 1000
CARD_FILE = "gsopt_prior.json"
"""File that marks a folder as this kind of prior."""


@dataclass(frozen=True)
class PriorCard:
    """Contents of `gsopt_prior.json`."""

    size: int
    """Side of the renders it was trained for, px."""


@dataclass(frozen=True)
class TextTokens:
    """Tokens for cross-attention, row by row."""

    tokens: Float[Tensor, "B L D"]
    mask: Bool[Tensor, "B L"]
    """True for tokens, False for padding."""

    @staticmethod
    def empty(count: int) -> TextTokens:
        """Returns one zero token per row, which adds nothing."""
        return TextTokens(torch.zeros(count, 1, TOKEN_WIDTH), torch.ones(count, 1, dtype=torch.bool))

    @staticmethod
    def from_conditions(conditions: Sequence[Condition]) -> TextTokens:
        """Returns the padded tokens of these conditions."""
        rows = [torch.zeros(1, TOKEN_WIDTH) if c.tokens is None else c.tokens for c in conditions]
        mask = [torch.ones(len(row), dtype=torch.bool) for row in rows]
        pad = torch.nn.utils.rnn.pad_sequence
        return TextTokens(pad(rows, batch_first=True), pad(mask, batch_first=True))


class ViewPrior:
    """See `gsopt.sds.priors.protocol.Prior`."""

    x0_limit: float | None = 1.0
    class_embedding_width: int | None = None
    aligned = True

    def __init__(self, folder: Path, config: GuidanceConfig) -> None:
        card = read_card(folder)
        self.folder = folder
        self.name = f"{folder.name} (view-conditioned, {card.size} px)"
        self.size = config.size or card.size
        if self.size % side_multiple():
            raise UsageError(
                f"`--guidance.size` must be a multiple of {side_multiple()} for this prior, got {self.size}. "
                f"Try {max(1, self.size // side_multiple()) * side_multiple()}."
            )
        self.schedule = cosine_schedule()
        self._clip = config.clip

    @cached_property
    def unet(self) -> Any:
        """The network, frozen."""
        diffusers = require("diffusers", "sds", "Guidance by a diffusion prior")
        diffusers.utils.logging.disable_progress_bar()
        try:
            unet = diffusers.UNet2DConditionModel.from_pretrained(
                self.folder / "unet", torch_dtype=torch.float32, use_safetensors=True, local_files_only=True
            )
        except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
            raise InputError(
                f"Cannot load the prior in {self.folder} ({error}). Restore its unet/ folder or name another --prior."
            ) from error
        if unet.config.in_channels != INPUT_CHANNELS * PATCH_SIDE**2 or unet.config.out_channels != 3 * PATCH_SIDE**2:
            raise InputError(
                f"The prior in {self.folder} takes {unet.config.in_channels} channels instead of "
                f"{INPUT_CHANNELS * PATCH_SIDE**2}: another version of gsopt made "
                "it. Train it anew with `gsopt finetune`."
            )
        return unet.eval().requires_grad_(False)

    def encode(self, images: Images) -> Latents:
        """Maps pixels to [-1, 1]."""
        return 2 * images - 1

    @torch.no_grad()
    def decode(self, x0: Latents) -> Images:
        return (x0 / 2 + 0.5).clamp(0, 1)

    @torch.no_grad()
    def denoise(self, x_t: Latents, t: Int[Tensor, "B"], conditions: Sequence[Condition]) -> Latents:
        """Equation (1)."""
        planes = torch.stack([condition_planes(condition, x_t.shape[-1]) for condition in conditions])
        return predict(self.unet, x_t, t, planes, TextTokens.from_conditions(conditions))

    def encoder(self) -> Encoder | None:
        """Returns `None` for a network without text. A CLIP trained on a few hundred captions does not measure
        alignment; the one that --guidance.clip names does."""
        folder = self.folder / CLIP_FOLDER
        if not folder.is_dir():
            return None
        own = load_joint_clip(folder, torch.float32)
        aligner = load_joint_clip(find_part(self._clip), torch.float32) if self._clip else None
        return ClipEncoder(f"{self.folder.name}/{CLIP_FOLDER}", own.text, own.image, aligner, whole_words=True)


def predict(
    unet: Any, x_t: Latents, t: Int[Tensor, "B"], planes: Float[Tensor, "B C S S"], said: TextTokens | None = None
) -> Latents:
    """Equation (1); differentiable in the network's weights."""
    said = TextTokens.empty(len(x_t)) if said is None else said
    stacked = torch.nn.functional.pixel_unshuffle(torch.cat([x_t, planes], 1), PATCH_SIDE)
    mask = None if bool(said.mask.all()) else said.mask
    residual = unet(stacked, t, encoder_hidden_states=said.tokens, encoder_attention_mask=mask).sample
    return planes[:, :3] + torch.nn.functional.pixel_shuffle(residual, PATCH_SIDE)


def condition_planes(condition: Condition, size: int) -> Float[Tensor, "C S S"]:
    """Returns the network's inputs beside x_t: the render (gray if absent), alpha, uncertainty, references."""
    render = torch.zeros(4, size, size)
    if condition.render is not None:
        render = torch.cat([2 * condition.render[:3] - 1, condition.render[3:]])
    u = torch.ones(size, size) if condition.uncertainty is None else condition.uncertainty
    warped = torch.zeros(MAX_REFERENCES, 4, size, size)
    references = condition.references
    if references is not None and references.depths is not None and condition.camera is not None:
        assert condition.depth is not None
        found = warp(
            condition.camera,
            condition.depth,
            render[3],
            references.images[:MAX_REFERENCES],
            references.alphas[:MAX_REFERENCES],
            references.depths[:MAX_REFERENCES],
            references.cameras[:MAX_REFERENCES],
        )
        warped[: len(found)] = found
    return torch.cat([render, u[None], confidence_weighted(warped).flatten(0, 1)])


def confidence_weighted(warped: Float[Tensor, "*B 4 S S"]) -> Float[Tensor, "*B 4 S S"]:
    """Returns colors in [-1, 1] times their confidence, and the confidence."""
    colors, confidence = warped[..., :3, :, :], warped[..., 3:, :, :]
    return torch.cat([(2 * colors - 1) * confidence, confidence], -3)


def side_multiple() -> int:
    """Returns the divisor of valid image sides: a patch, halved between every two levels."""
    return int(PATCH_SIDE * 2 ** (len(UNET_WIDTHS) - 1))


def cosine_schedule() -> NoiseSchedule:
    """Nichol & Dhariwal 2021, eq. 17, in closed form; the signal of the last step is a millionth."""
    t = torch.arange(1, NOISE_STEPS + 1, dtype=torch.float64) / NOISE_STEPS
    f = torch.cos((t + 0.008) / 1.008 * torch.pi / 2).square()
    return NoiseSchedule.of((f / torch.cos(torch.tensor(0.008 / 1.008) * torch.pi / 2).square()).clamp(1e-6, 1))


def make_unet(seed: int) -> Any:
    """Returns an untrained network whose last layer is zero, so that x0_hat is the render."""
    diffusers = require("diffusers", "sds", "Training a diffusion prior")
    torch.manual_seed(seed)
    plain, attending = "DownBlock2D", "CrossAttnDownBlock2D"
    unet = diffusers.UNet2DConditionModel(
        in_channels=INPUT_CHANNELS * PATCH_SIDE**2,
        out_channels=3 * PATCH_SIDE**2,
        block_out_channels=UNET_WIDTHS,
        down_block_types=(plain, attending, attending),
        up_block_types=("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
        layers_per_block=1,
        cross_attention_dim=TOKEN_WIDTH,
        attention_head_dim=4,
        norm_num_groups=16,
    )
    torch.nn.init.zeros_(unet.conv_out.weight)
    torch.nn.init.zeros_(unet.conv_out.bias)
    return unet


def zero_text_attention(unet: Any) -> None:
    """Zeroes the text attention of a network trained without text, so that tokens have no effect at first."""
    for name, module in unet.named_modules():
        if name.endswith("attn2.to_v"):
            torch.nn.init.zeros_(module.weight)


def is_view_prior(folder: Path) -> bool:
    return (folder / CARD_FILE).is_file()


def read_card(folder: Path) -> PriorCard:
    """Reads the card; raises InputError for an invalid one."""
    path = folder / CARD_FILE
    try:
        size = json.loads(path.read_text("utf-8"))["size"]
        if not isinstance(size, int) or not 16 <= size <= 1024 or size % side_multiple():
            raise ValueError(f"size {size!r}")
        return PriorCard(size)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"Cannot read {path} ({error}). Restore it or name another --prior.") from error
