"""A text-to-image pipeline in the exact folder layout of Stable Diffusion 2.1 at 768 px, with random weights.

model_index.json  scheduler/scheduler_config.json (v_prediction)  feature_extractor/preprocessor_config.json
tokenizer/{vocab.json, merges.txt, special_tokens_map.json, tokenizer_config.json}   the legacy files, pad "!"
text_encoder/{config.json, model.safetensors}   keys with the old prefix `text_model.`
unet/{config.json, diffusion_pytorch_model.safetensors}   vae/ the same
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

WIDTH = 32
"""Numbers per token."""
SIZE = 64
"""Side of the images, px: latents of 8 x 8."""
SCHEDULER = {
    "_class_name": "DDIMScheduler",
    "_diffusers_version": "0.8.0",
    "beta_end": 0.012,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "clip_sample": False,
    "num_train_timesteps": 1000,
    "prediction_type": "v_prediction",
    "set_alpha_to_one": False,
    "skip_prk_steps": True,
    "steps_offset": 1,
    "trained_betas": None,
}
MODEL_INDEX = {
    "_class_name": "StableDiffusionPipeline",
    "_diffusers_version": "0.8.0",
    "feature_extractor": ["transformers", "CLIPImageProcessor"],
    "requires_safety_checker": False,
    "safety_checker": [None, None],
    "scheduler": ["diffusers", "DDIMScheduler"],
    "text_encoder": ["transformers", "CLIPTextModel"],
    "tokenizer": ["transformers", "CLIPTokenizer"],
    "unet": ["diffusers", "UNet2DConditionModel"],
    "vae": ["diffusers", "AutoencoderKL"],
}
UNET = {
    "sample_size": 8,
    "in_channels": 4,
    "out_channels": 4,
    "block_out_channels": [16, 32],
    "layers_per_block": 1,
    "down_block_types": ["CrossAttnDownBlock2D", "DownBlock2D"],
    "up_block_types": ["UpBlock2D", "CrossAttnUpBlock2D"],
    "attention_head_dim": [2, 4],
    "cross_attention_dim": WIDTH,
    "norm_num_groups": 8,
    "use_linear_projection": True,
    "upcast_attention": True,
}
VAE = {
    "block_out_channels": [8, 8, 16, 16],
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "latent_channels": 4,
    "norm_num_groups": 4,
    "sample_size": SIZE,
}
MERGES = ["c h", "ch a", "cha i", "chai r</w>", "b l", "bl u", "blu e</w>", "r e", "re d</w>"]


def build(folder: Path, *, unet: dict[str, Any] | None = None, image_width: int | None = None) -> Path:
    """Write the pipeline. `unet` changes the U-Net's configuration; `image_width` adds an image encoder of that width,
    as SD 2.1-unCLIP has one."""
    from diffusers import AutoencoderKL, UNet2DConditionModel

    torch.manual_seed(0)
    UNet2DConditionModel(**{**UNET, **(unet or {})}).save_pretrained(folder / "unet")
    AutoencoderKL(**VAE).save_pretrained(folder / "vae")
    write_json(folder / "model_index.json", MODEL_INDEX)
    write_json(folder / "scheduler" / "scheduler_config.json", SCHEDULER)
    write_json(
        folder / "feature_extractor" / "preprocessor_config.json", {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
    )
    vocabulary = write_tokenizer(folder / "tokenizer")
    write_text_encoder(folder / "text_encoder", vocabulary)
    if image_width is not None:
        write_image_encoder(folder / "image_encoder", image_width)
    return folder


def write_json(path: Path, document: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=2), encoding="utf-8")


def write_tokenizer(folder: Path) -> int:
    """CLIP's byte-level BPE with a handful of merges; returns the size of the vocabulary."""
    letters = [*range(33, 127), *range(161, 173), *range(174, 256)]
    extra = [byte for byte in range(256) if byte not in letters]
    alphabet = [chr(code) for code in letters] + [chr(256 + i) for i in range(len(extra))]
    words = alphabet + [letter + "</w>" for letter in alphabet] + ["".join(merge.split()) for merge in MERGES]
    words += ["<|startoftext|>", "<|endoftext|>"]
    write_json(folder / "vocab.json", {word: number for number, word in enumerate(words)})
    (folder / "merges.txt").write_text("#version: 0.2\n" + "\n".join(MERGES) + "\n", encoding="utf-8")
    special = {
        name: {"content": text, "lstrip": False, "normalized": True, "rstrip": False, "single_word": False}
        for name, text in (
            ("bos_token", "<|startoftext|>"),
            ("eos_token", "<|endoftext|>"),
            ("unk_token", "<|endoftext|>"),
        )
    }
    write_json(folder / "special_tokens_map.json", {**special, "pad_token": "!"})
    config = {"model_max_length": 77, "tokenizer_class": "CLIPTokenizer", "do_lower_case": True, "errors": "replace"}
    added = {name: {**value, "__type": "AddedToken"} for name, value in special.items()}
    write_json(
        folder / "tokenizer_config.json", {**config, **added, "add_prefix_space": False, "pad_token": "<|endoftext|>"}
    )
    return len(words)


def text_config(vocabulary: int) -> dict[str, Any]:
    return {
        "vocab_size": vocabulary,
        "hidden_size": WIDTH,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "max_position_embeddings": 77,
        "hidden_act": "gelu",
        "projection_dim": 24,
        "bos_token_id": vocabulary - 2,
        "eos_token_id": vocabulary - 1,
        "pad_token_id": 0,
    }


def vision_config(width: int) -> dict[str, Any]:
    return {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "image_size": 32,
        "patch_size": 8,
        "projection_dim": width,
    }


def write_text_encoder(folder: Path, vocabulary: int) -> None:
    """With the key prefix of old checkpoints, in half precision, as the mirror's files are."""
    from transformers import CLIPTextConfig, CLIPTextModel

    CLIPTextModel(CLIPTextConfig(**text_config(vocabulary))).save_pretrained(folder)
    tensors = load_file(folder / "model.safetensors")
    old = {k if k.startswith("text_model.") else f"text_model.{k}": v.half().contiguous() for k, v in tensors.items()}
    save_file(old, folder / "model.safetensors", metadata={"format": "pt"})


def write_image_encoder(folder: Path, width: int) -> None:
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    CLIPVisionModelWithProjection(CLIPVisionConfig(**vision_config(width))).save_pretrained(folder)


def build_clip(folder: Path) -> Path:
    """A whole CLIP with its tokenizer, as a folder of transformers."""
    from transformers import CLIPConfig, CLIPModel

    torch.manual_seed(1)
    vocabulary = write_tokenizer(folder)
    config = CLIPConfig(text_config=text_config(vocabulary), vision_config=vision_config(24), projection_dim=24)
    CLIPModel(config).save_pretrained(folder)
    return folder
