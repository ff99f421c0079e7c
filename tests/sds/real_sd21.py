"""Stable Diffusion 2.1 at its real size with random weights: its configurations, and a folder of 2.6 GB in bfloat16.

U-Net 866 million numbers, CLIP's text encoder (OpenCLIP ViT-H) 340 million, autoencoder 84 million. The tokenizer is
that of `tiny_sd21`: words do not matter here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tiny_sd21
import torch
from safetensors.torch import save_file

UNET = {
    "sample_size": 96,
    "in_channels": 4,
    "out_channels": 4,
    "block_out_channels": [320, 640, 1280, 1280],
    "layers_per_block": 2,
    "down_block_types": [*["CrossAttnDownBlock2D"] * 3, "DownBlock2D"],
    "up_block_types": ["UpBlock2D", *["CrossAttnUpBlock2D"] * 3],
    "attention_head_dim": [5, 10, 20, 20],
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
    "upcast_attention": True,
}
VAE = {
    "block_out_channels": [128, 256, 512, 512],
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "layers_per_block": 2,
    "latent_channels": 4,
    "sample_size": 768,
}
TEXT = {
    "vocab_size": 49408,
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 23,
    "num_attention_heads": 16,
    "max_position_embeddings": 77,
    "hidden_act": "gelu",
    "projection_dim": 512,
}
PARAMETERS = {"unet": 865_910_724, "text_encoder": 340_387_840, "vae": 83_653_863}
"""As published."""
POOL = 1_000_003
"""Random numbers that are repeated: drawing a billion would take longer than the step."""


def models(device: str) -> dict[str, Any]:
    """The three networks with nothing in them, by the name of their folder."""
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    with torch.device(device):
        return {
            "unet": UNet2DConditionModel(**UNET),
            "vae": AutoencoderKL(**VAE),
            "text_encoder": CLIPTextModel(CLIPTextConfig(**TEXT)),
        }


def build(folder: Path) -> Path:
    """Write the folder."""
    pool = torch.rand(POOL, generator=torch.Generator().manual_seed(0)).mul_(2).sub_(1)
    for name, model in models("meta").items():
        assert sum(p.numel() for p in model.parameters()) == PARAMETERS[name]
        (folder / name).mkdir(parents=True)
        stem = "model" if name == "text_encoder" else "diffusion_pytorch_model"
        weights = {key: _filled(key, value, pool) for key, value in model.named_parameters()}
        save_file(weights, folder / name / f"{stem}.safetensors", metadata={"format": "pt"})
        if name == "text_encoder":
            model.config.save_pretrained(folder / name)
        else:
            model.save_config(folder / name)
    tiny_sd21.write_json(folder / "model_index.json", tiny_sd21.MODEL_INDEX)
    tiny_sd21.write_json(folder / "scheduler" / "scheduler_config.json", tiny_sd21.SCHEDULER)
    tiny_sd21.write_tokenizer(folder / "tokenizer")
    return folder


def _filled(name: str, like: torch.Tensor, pool: torch.Tensor) -> torch.Tensor:
    """Norms that change nothing, no biases, matrices that keep the size of what passes them."""
    if like.ndim == 1:
        return (torch.ones if "norm" in name and name.endswith("weight") else torch.zeros)(like.shape).bfloat16()
    fan_in = like[0].numel()
    numbers = pool.repeat(-(-like.numel() // POOL))[: like.numel()].view(like.shape)
    return (numbers * (3 / fan_in) ** 0.5).bfloat16()
