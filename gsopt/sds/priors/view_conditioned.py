"""The view-conditioned prior: a small U-Net that sees the render it is to improve and the input views beside it.

    (1)  x0_hat = r + f(x_t, t, r, alpha, u, w_1, c_1, ..., w_K, c_K)

r is the current render, u its uncertainty (`coverage`), w_k the input views carried into the camera by the render's
depth with confidence c_k (`warp`): all aligned, pixel by pixel. f predicts what is wrong with the render; an untrained
network changes nothing. Where the folder holds a CLIP, f attends to the tokens of words and pictures as well. It works
on pixels in [-1, 1], cut into PATCH x PATCH tiles for speed (Li & He 2025: x0 is the prediction that patches of pixels
need), on sides that are multiples of SIDE_MULTIPLE.
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

PATCH = 4
WARPED = 3
"""References carried into the camera, those nearest to it."""
CHANNELS = 3 + 4 + 1 + 4 * WARPED
"""Of x_t, the render with alpha, its uncertainty, and the references with their confidence."""
WIDTHS = (96, 128, 192)
TOKEN_WIDTH = 192
CLIP = "clip"
"""Folder of the CLIP whose words and pictures the network knows, in the prior's; a prior without one takes none."""
STEPS = 1000
CARD = "gsopt_prior.json"
"""Marks a folder as this kind of prior."""


@dataclass(frozen=True)
class Card:
    """What the folder says of itself."""

    size: int
    """Side of the renders it was trained for, px."""


@dataclass(frozen=True)
class Said:
    """Tokens for cross-attention, row by row."""

    tokens: Float[Tensor, "B L D"]
    heard: Bool[Tensor, "B L"]
    """The others only fill up."""

    @staticmethod
    def nothing(count: int) -> Said:
        """A token of zeros: it adds nothing."""
        return Said(torch.zeros(count, 1, TOKEN_WIDTH), torch.ones(count, 1, dtype=torch.bool))

    @staticmethod
    def by(conditions: Sequence[Condition]) -> Said:
        """What these conditions say."""
        rows = [torch.zeros(1, TOKEN_WIDTH) if c.tokens is None else c.tokens for c in conditions]
        heard = [torch.ones(len(row), dtype=torch.bool) for row in rows]
        pad = torch.nn.utils.rnn.pad_sequence
        return Said(pad(rows, batch_first=True), pad(heard, batch_first=True))


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
        if unet.config.in_channels != CHANNELS * PATCH**2 or unet.config.out_channels != 3 * PATCH**2:
            raise InputError(
                f"The prior in {self.folder} takes {unet.config.in_channels} channels instead of "
                f"{CHANNELS * PATCH**2}: it was made by another version of gsopt. Train it anew with `gsopt finetune`."
            )
        return unet.eval().requires_grad_(False)

    def encode(self, images: Images) -> Latents:
        """Pixels in [-1, 1]."""
        return 2 * images - 1

    @torch.no_grad()
    def decode(self, x0: Latents) -> Images:
        return (x0 / 2 + 0.5).clamp(0, 1)

    @torch.no_grad()
    def denoise(self, x_t: Latents, t: Int[Tensor, "B"], conditions: Sequence[Condition]) -> Latents:
        """Equation (1)."""
        planes = torch.stack([condition_planes(condition, x_t.shape[-1]) for condition in conditions])
        return predict(self.unet, x_t, t, planes, Said.by(conditions))

    def encoder(self) -> Encoder | None:
        """None where the network was not taught words. A CLIP of some hundred captions does not judge whether a prompt
        fits a picture; the one that --guidance.clip names does."""
        folder = self.folder / CLIP
        if not folder.is_dir():
            return None
        own = load_joint_clip(folder, torch.float32)
        judge = load_joint_clip(find_part(self._clip), torch.float32) if self._clip else None
        return ClipEncoder(f"{self.folder.name}/{CLIP}", own.text, own.image, judge, whole_words=True)


def predict(
    unet: Any, x_t: Latents, t: Int[Tensor, "B"], planes: Float[Tensor, "B C S S"], said: Said | None = None
) -> Latents:
    """Equation (1); differentiable in the network's weights."""
    said = Said.nothing(len(x_t)) if said is None else said
    stacked = torch.nn.functional.pixel_unshuffle(torch.cat([x_t, planes], 1), PATCH)
    mask = None if bool(said.heard.all()) else said.heard
    residual = unet(stacked, t, encoder_hidden_states=said.tokens, encoder_attention_mask=mask).sample
    return planes[:, :3] + torch.nn.functional.pixel_shuffle(residual, PATCH)


def condition_planes(condition: Condition, size: int) -> Float[Tensor, "C S S"]:
    """What the network sees beside x_t: the render (grey where there is none), alpha, uncertainty, references."""
    render = torch.zeros(4, size, size)
    if condition.render is not None:
        render = torch.cat([2 * condition.render[:3] - 1, condition.render[3:]])
    u = torch.ones(size, size) if condition.uncertainty is None else condition.uncertainty
    warped = torch.zeros(WARPED, 4, size, size)
    references = condition.references
    if references is not None and references.depths is not None and condition.camera is not None:
        assert condition.depth is not None
        found = warp(
            condition.camera,
            condition.depth,
            render[3],
            references.images[:WARPED],
            references.alphas[:WARPED],
            references.depths[:WARPED],
            references.cameras[:WARPED],
        )
        warped[: len(found)] = found
    return torch.cat([render, u[None], weighed(warped).flatten(0, 1)])


def weighed(warped: Float[Tensor, "*B 4 S S"]) -> Float[Tensor, "*B 4 S S"]:
    """Colors in [-1, 1] times their confidence, and the confidence."""
    colors, confidence = warped[..., :3, :, :], warped[..., 3:, :, :]
    return torch.cat([(2 * colors - 1) * confidence, confidence], -3)


def side_multiple() -> int:
    """What the side of an image must be a multiple of: a patch, halved between every two levels."""
    return int(PATCH * 2 ** (len(WIDTHS) - 1))


def cosine_schedule() -> NoiseSchedule:
    """Nichol & Dhariwal 2021, eq. 17, by its closed form; the last step is all noise but for a millionth."""
    t = torch.arange(1, STEPS + 1, dtype=torch.float64) / STEPS
    f = torch.cos((t + 0.008) / 1.008 * torch.pi / 2).square()
    return NoiseSchedule.of((f / torch.cos(torch.tensor(0.008 / 1.008) * torch.pi / 2).square()).clamp(1e-6, 1))


def make_unet(seed: int) -> Any:
    """An untrained network: its last layer is zero, so that x0_hat is the render."""
    diffusers = require("diffusers", "sds", "Training a diffusion prior")
    torch.manual_seed(seed)
    plain, attending = "DownBlock2D", "CrossAttnDownBlock2D"
    unet = diffusers.UNet2DConditionModel(
        in_channels=CHANNELS * PATCH**2,
        out_channels=3 * PATCH**2,
        block_out_channels=WIDTHS,
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


def make_deaf(unet: Any) -> None:
    """Let a network that was never told anything ignore what it will be told, until it learns to listen."""
    for name, module in unet.named_modules():
        if name.endswith("attn2.to_v"):
            torch.nn.init.zeros_(module.weight)


def is_view_prior(folder: Path) -> bool:
    return (folder / CARD).is_file()


def read_card(folder: Path) -> Card:
    """InputError for what is no card."""
    path = folder / CARD
    try:
        size = json.loads(path.read_text("utf-8"))["size"]
        if not isinstance(size, int) or not 16 <= size <= 1024 or size % side_multiple():
            raise ValueError(f"size {size!r}")
        return Card(size)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"Cannot read {path} ({error}). Restore it or name another --prior.") from error
