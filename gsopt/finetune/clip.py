"""Trains a small CLIP (Radford et al. 2021) on the captions and images of the training scenes.

Its vocabulary is that of these captions. Its tokenizer has one token for every known word, so a word that takes several
tokens is unknown (`unknown_words`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt._optional import require
from gsopt.events import Report
from gsopt.finetune.captions import generic_texts
from gsopt.finetune.half_precision import in_half_precision
from gsopt.finetune.pair_cache import PairCache
from gsopt.sds.noise import generator
from gsopt.sds.priors.clip import CLIP_MEAN, CLIP_STD, MAX_TOKENS
from gsopt.sds.priors.protocol import Images
from gsopt.sds.priors.view_conditioned import TOKEN_WIDTH

IMAGE_SIDE, PATCH_SIDE = 64, 8
"""Sides of the images and of their patches, px."""
TEXT_LAYERS, IMAGE_LAYERS, IMAGE_WIDTH = 2, 3, 160
SCENES_PER_STEP = 48
"""Number of scenes contrasted in one step."""
LEARNING_RATE, WEIGHT_DECAY = 1e-3, 0.1
WARMUP_SHARE = 0.05
MAX_LOGIT_SCALE = 50.0
"""Upper bound of the learned factor on cosines."""
MIN_CROP_SHARE = 0.6
"""Smallest share of an image's side that a random crop keeps."""
BEGIN_TOKEN, END_TOKEN = "<|startoftext|>", "<|endoftext|>"


def make_tokenizer(texts: Sequence[str]) -> Any:
    """Merges byte pairs until every word of `texts` is one token; other words take several."""
    trainers = require("tokenizers", "sds", "Training a tokenizer").trainers
    kind = require("transformers", "sds", "Training a tokenizer").CLIPTokenizer
    learner = kind().backend_tokenizer
    learner.train_from_iterator(
        list(texts),
        trainers.BpeTrainer(vocab_size=1 << 16, min_frequency=1, end_of_word_suffix="</w>", show_progress=False),
    )
    merges = [tuple(pair) for pair in json.loads(learner.to_str())["model"]["merges"]]
    alphabet = sorted(require("tokenizers", "sds", "Training a tokenizer").pre_tokenizers.ByteLevel.alphabet())
    symbols = [
        *alphabet,
        *(letter + "</w>" for letter in alphabet),
        *(a + b for a, b in merges),
        BEGIN_TOKEN,
        END_TOKEN,
    ]
    vocabulary = {symbol: number for number, symbol in enumerate(dict.fromkeys(symbols))}
    return kind(vocab=vocabulary, merges=merges, model_max_length=MAX_TOKENS)


def make_clip(tokenizer: Any, seed: int) -> Any:
    """An untrained CLIPModel."""
    transformers = require("transformers", "sds", "Training a CLIP")
    torch.manual_seed(seed)
    text = {
        "vocab_size": len(tokenizer),
        "hidden_size": TOKEN_WIDTH,
        "projection_dim": TOKEN_WIDTH,
        "intermediate_size": 3 * TOKEN_WIDTH,
        "num_hidden_layers": TEXT_LAYERS,
        "num_attention_heads": 4,
        "max_position_embeddings": MAX_TOKENS,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
    }
    image = {
        "hidden_size": IMAGE_WIDTH,
        "projection_dim": TOKEN_WIDTH,
        "intermediate_size": 3 * IMAGE_WIDTH,
        "num_hidden_layers": IMAGE_LAYERS,
        "num_attention_heads": 4,
        "image_size": IMAGE_SIDE,
        "patch_size": PATCH_SIDE,
    }
    return transformers.CLIPModel(
        transformers.CLIPConfig(text_config=text, vision_config=image, projection_dim=TOKEN_WIDTH)
    )


def train_clip(
    cache: PairCache, texts_by_scene: Sequence[tuple[str, ...]], steps: int, seed: int, report: Report
) -> tuple[Any, Any]:
    """Returns a CLIPModel and its tokenizer, trained to distinguish the cached scenes by their texts."""
    tokenizer = make_tokenizer([text for texts in texts_by_scene for text in texts] + list(generic_texts()))
    model = make_clip(tokenizer, seed).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=steps + 1, pct_start=WARMUP_SHARE)
    described = [index for index, texts in enumerate(texts_by_scene) if texts]
    mean = 0.0
    for step in range(steps):
        random = generator(seed, step, 0, "clip")
        chosen = [described[int(i)] for i in torch.randperm(len(described), generator=random)[:SCENES_PER_STEP]]
        images = torch.stack([_picture(cache, index, random) for index in chosen])
        texts = [
            texts_by_scene[index][int(torch.randint(len(texts_by_scene[index]), (1,), generator=random))]
            for index in chosen
        ]
        found = contrastive_loss(model, tokenizer, images, texts, [texts_by_scene[index][0] for index in chosen])
        optimizer.zero_grad(set_to_none=True)
        found.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        rate.step()
        with torch.no_grad():
            model.logit_scale.clamp_(max=float(torch.tensor(MAX_LOGIT_SCALE).log()))
        mean = float(found.detach()) if step == 0 else mean + 0.02 * (float(found.detach()) - mean)
        if (step + 1) % 100 == 0:
            report(f"words: step {step + 1}/{steps}  loss {mean:.4f}")
    return model.eval().requires_grad_(False), tokenizer


def contrastive_loss(model: Any, tokenizer: Any, images: Images, texts: list[str], captions: list[str]) -> Tensor:
    """Symmetric cross-entropy of texts and images; equal captions count as one, generic texts target a uniform
    match."""
    both = tokenizer([*texts, *generic_texts()], padding="longest", truncation=True, return_tensors="pt").input_ids
    normalize = torch.nn.functional.normalize
    words = normalize(model.text_projection(model.text_model(both).pooler_output), dim=-1)
    seen = normalize(model.visual_projection(model.vision_model(images).pooler_output), dim=-1)
    logits = model.logit_scale.exp() * words @ seen.T
    same = torch.tensor([[float(a == b) for b in captions] for a in captions])
    same = same / same.sum(1, keepdim=True)
    count = len(texts)
    entropy = torch.nn.functional.cross_entropy
    neutral = entropy(logits[count:], torch.full_like(logits[count:], 1 / count))
    return (entropy(logits[:count], same) + entropy(logits[:count].T, same)) / 2 + 0.1 * neutral


def _picture(cache: PairCache, scene: int, random: torch.Generator) -> Float[Tensor, "3 s s"]:
    """Returns a random view of the scene: cropped, possibly mirrored, on a random background, normalized for CLIP."""
    rows = torch.nonzero(cache.scene == scene)[:, 0]
    row = int(rows[torch.randint(len(rows), (1,), generator=random)])
    rgba = cache.pairs.truth[row].float() / 255
    size = rgba.shape[-1]
    side = int(size * (MIN_CROP_SHARE + (1 - MIN_CROP_SHARE) * float(torch.rand(1, generator=random))))
    top, left = (int(torch.randint(size - side + 1, (1,), generator=random)) for _ in range(2))
    rgba = rgba[:, top : top + side, left : left + side]
    if int(torch.randint(2, (1,), generator=random)):
        rgba = rgba.flip(2)
    background = torch.ones(3) if float(torch.rand(1, generator=random)) < 0.5 else torch.rand(3, generator=random)
    picture = rgba[:3] + (1 - rgba[3:]) * background[:, None, None]
    picture = torch.nn.functional.interpolate(picture[None], (IMAGE_SIDE, IMAGE_SIDE), mode="bilinear", antialias=True)[
        0
    ]
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (CLIP_MEAN, CLIP_STD))
    return (picture - mean) / std


def save_clip(model: Any, tokenizer: Any, folder: Path) -> None:
    """Writes a folder that transformers reads, in half precision (converts `model` in place)."""
    in_half_precision(model).save_pretrained(folder, safe_serialization=True)
    tokenizer.save_pretrained(folder)
    for file in folder.iterdir():
        file.chmod(0o644)
