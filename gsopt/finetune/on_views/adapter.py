"""Attaches a trainable low-rank change (LoRA) to a U-Net with peft, and writes its files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor

from gsopt._optional import require
from gsopt.events import to_json, write_atomic
from gsopt.sds.priors.lora import ADAPTER, CONFIG, PREFIX, WEIGHTS

NAME = "default"
TARGETS = ["to_q", "to_k", "to_v", "to_out.0"]
"""Matrices of the attention layers, which LoRAs of Stable Diffusion change since Ryu 2022."""
PIPELINE = "pytorch_lora_weights.safetensors"
"""File name that `load_lora_weights` of diffusers' pipelines expects."""


def attach(unet: Any, rank: int, seed: int) -> None:
    """Adds a trainable float32 change of this rank to every attention matrix, zero at first."""
    peft = require("peft", "sds", "Training a LoRA")
    config = peft.LoraConfig(r=rank, lora_alpha=rank, target_modules=TARGETS)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        unet.add_adapter(config, NAME)
    for parameter in unet.parameters():
        if parameter.requires_grad:
            parameter.data = parameter.data.float()


def save_adapter(unet: Any, folder: Path) -> None:
    """Writes `lora/` for peft and one file for diffusers' pipelines. alpha = r: every tool scales by 1."""
    peft = require("peft", "sds", "Training a LoRA")
    learned: dict[str, Tensor] = peft.get_peft_model_state_dict(unet, adapter_name=NAME)
    learned = {name: value.detach().cpu().contiguous() for name, value in learned.items()}
    (folder / ADAPTER).mkdir(exist_ok=True)
    settings = {**unet.peft_config[NAME].to_dict(), "inference_mode": True}
    plain = {key: sorted(value) if isinstance(value, set) else value for key, value in settings.items()}
    write_atomic(folder / PIPELINE, save({f"unet.{name}": value for name, value in learned.items()}, {"format": "pt"}))
    write_atomic(folder / ADAPTER / WEIGHTS, save({f"{PREFIX}{n}": v for n, v in learned.items()}, {"format": "pt"}))
    write_atomic(folder / ADAPTER / CONFIG, to_json(plain))
