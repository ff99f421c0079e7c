"""Provides a prior's text encoder: the CLIP of its base, or one trained on the captions of its scenes."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch

from gsopt.events import Report
from gsopt.finetune.captions import read_captions
from gsopt.finetune.clip import save_clip, train_clip
from gsopt.finetune.pair_cache import PairCache
from gsopt.finetune.training_config import PriorTrainingConfig
from gsopt.sds.priors.clip import ClipEncoder, load_joint_clip
from gsopt.sds.priors.view_conditioned import CLIP_FOLDER

MIN_CAPTIONS = 2
"""Least number of different captions for training a CLIP."""
SHOWN_IMAGES = 4
"""Images per held-out scene that are matched with captions."""


def scene_texts(cache: PairCache) -> list[tuple[str, ...]]:
    """Returns the texts of every scene, empty for a scene without captions."""
    return [read_captions(scene) for scene in cache.scenes]


def make_encoder(
    cache: PairCache, config: PriorTrainingConfig, folder: Path, base: Path | None, report: Report
) -> ClipEncoder | None:
    """Returns the text encoder kept in `folder`, trained if necessary, or `None` without captions."""
    if not folder.is_dir():
        unfinished = folder.with_name(f"{folder.name}.part")
        if base is not None and (base / CLIP_FOLDER).is_dir():
            shutil.copytree(base / CLIP_FOLDER, unfinished, dirs_exist_ok=True)
        else:
            texts_by_scene = scene_texts(cache)
            if config.clip_steps == 0 or len({texts[0] for texts in texts_by_scene if texts}) < MIN_CAPTIONS:
                report(
                    "no words: " + ("--clip-steps is 0" if config.clip_steps == 0 else "the scenes have no captions")
                )
                return None
            model, tokenizer = train_clip(cache, texts_by_scene, config.clip_steps, config.seed, report)
            save_clip(model, tokenizer, unfinished)
        unfinished.rename(folder)
    clip = load_joint_clip(folder, torch.float32)
    return ClipEncoder(CLIP_FOLDER, clip.text, clip.image, clip, whole_words=True)


def evaluate_encoder(encoder: ClipEncoder, cache: PairCache) -> dict[str, Any]:
    """Returns the share of unknown words in held-out captions, and the share of images that match their own caption
    best, beside the share by guessing."""
    texts_by_scene = scene_texts(cache)
    captions = [texts[0] for texts in texts_by_scene if texts]
    words = {word for caption in captions for word in caption.split()}
    unknown = {word for caption in captions for word in encoder.unknown_words(caption)}
    different = sorted(set(captions))
    if not different:
        return {}
    right = []
    for index, texts in enumerate(texts_by_scene):
        if not texts:
            continue
        rows = torch.nonzero(cache.scene == index)[:, 0][:SHOWN_IMAGES]
        rgba = cache.pairs.truth[rows].float() / 255
        found = encoder.alignment(different, rgba[:, :3] + 1 - rgba[:, 3:])
        assert found is not None
        right += (found.argmax(0) == different.index(texts[0])).tolist()
    return {
        "captions": len(different),
        "unknown_words": round(len(unknown) / len(words), 3),
        "right_caption": round(sum(right) / len(right), 3),
        "by_guessing": round(1 / len(different), 3),
    }
