"""Low-rank changes of a U-Net's weights (LoRA, Hu et al. 2022) in peft's format, merged into the weights at loading.

    (1)  W' = W + (alpha / r) B A          A: [r, in], B: [out, r]

A folder of `gsopt finetune --on-views` holds its base's U-Net and the trained change, a few MB. Only safetensors are
read, without peft.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open

from gsopt.errors import InputError

ADAPTER = "lora"
"""Folder of the change, in a diffusers folder."""
WEIGHTS, CONFIG = "adapter_model.safetensors", "adapter_config.json"
PREFIX, DOWN, UP = "base_model.model.", ".lora_A.weight", ".lora_B.weight"
MAX_CONFIG_BYTES = 1 << 20
REMEDY = "Restore it, or train it again: gsopt finetune --on-views."
UNSUPPORTED = ("use_dora", "rank_pattern", "alpha_pattern", "modules_to_save", "layer_replication", "lora_bias")
"""Settings of peft that change more than (1)."""


@dataclass(frozen=True)
class Adapter:
    """A checked change."""

    file: Path
    scale: float
    layers: tuple[str, ...]


def read_adapter(folder: Path) -> Adapter:
    """Reads and checks a folder, but not its weights. Raises InputError for an incomplete or unsupported one."""
    try:
        with open(folder / CONFIG, "rb") as file:
            config = json.loads(file.read(MAX_CONFIG_BYTES))
        rank, alpha = int(config["r"]), float(config["lora_alpha"])
        strange = [name for name in UNSUPPORTED if config.get(name)]
        if config.get("peft_type") != "LORA" or rank < 1 or not math.isfinite(alpha) or strange:
            raise ValueError(f"only a plain LoRA is known, got {config.get('peft_type')} {' '.join(strange)}".rstrip())
        with safe_open(folder / WEIGHTS, framework="pt") as weights:
            names = set(weights.keys())
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"The LoRA in {folder} cannot be used: {error}. {REMEDY}") from error
    layers = sorted(name.removeprefix(PREFIX).removesuffix(DOWN) for name in names if name.endswith(DOWN))
    if names != {f"{PREFIX}{layer}{end}" for layer in layers for end in (DOWN, UP)} or not layers:
        raise InputError(f"The LoRA in {folder} is not made of pairs of matrices ({len(names)} tensors). {REMEDY}")
    return Adapter(folder / WEIGHTS, alpha / (math.sqrt(rank) if config.get("use_rslora") else rank), tuple(layers))


@torch.no_grad()
def merge(unet: Any, adapter: Adapter) -> None:
    """Applies (1) in float32, rounded to the dtype of each weight. Raises InputError for a layer of another shape."""
    own = dict(unet.named_parameters())
    with safe_open(adapter.file, framework="pt") as file:
        for layer in adapter.layers:
            down, up = (file.get_slice(f"{PREFIX}{layer}{end}") for end in (DOWN, UP))
            weight = own.get(f"{layer}.weight")
            inner, outer = list(down.get_shape()), list(up.get_shape())
            found = None if weight is None else list(weight.shape)
            if weight is None or len(inner) != 2 or [*outer[:1], *inner[1:]] != found or inner[0] != outer[-1]:
                raise InputError(
                    f"The LoRA {adapter.file} changes {layer} by {outer} x {inner}, the U-Net has {found} there: it "
                    "was made for another model. Put it beside its own."
                )
            change = adapter.scale * (up[:].float() @ down[:].float())
            if not bool(torch.isfinite(change).all()):
                raise InputError(f"The LoRA {adapter.file} holds numbers that are not finite in {layer}. {REMEDY}")
            weight.copy_(weight.float() + change.to(weight.device))
