"""Where a prior's words come from: the CLIP of the prior it starts from, or one trained on its scenes' captions."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch

from gsopt.events import Report
from gsopt.finetune.captions import said_of
from gsopt.finetune.clip import save_clip, train_clip
from gsopt.finetune.pair_cache import Library
from gsopt.finetune.training_config import Course
from gsopt.sds.priors.clip import ClipEncoder, load_joint_clip
from gsopt.sds.priors.view_conditioned import CLIP

FEWEST = 2
"""Different captions that a CLIP can learn anything from."""
SHOWN = 4
"""Pictures per held-out scene that captions are matched with."""


def said_of_all(library: Library) -> list[tuple[str, ...]]:
    """The texts of every scene; none where nobody wrote any."""
    return [said_of(scene) for scene in library.scenes]


def find_encoder(
    library: Library, course: Course, folder: Path, base: Path | None, report: Report
) -> ClipEncoder | None:
    """The encoder of the words to be taught, kept in `folder`; None where there are none to teach."""
    if not folder.is_dir():
        unfinished = folder.with_name(f"{folder.name}.part")
        if base is not None and (base / CLIP).is_dir():
            shutil.copytree(base / CLIP, unfinished, dirs_exist_ok=True)
        else:
            said = said_of_all(library)
            if course.clip_steps == 0 or len({texts[0] for texts in said if texts}) < FEWEST:
                report(
                    "no words: " + ("--clip-steps is 0" if course.clip_steps == 0 else "the scenes have no captions")
                )
                return None
            model, tokenizer = train_clip(library, said, course.clip_steps, course.seed, report)
            save_clip(model, tokenizer, unfinished)
        unfinished.rename(folder)
    clip = load_joint_clip(folder, torch.float32)
    return ClipEncoder(CLIP, clip.text, clip.image, clip, whole_words=True)


def words_known(encoder: ClipEncoder, library: Library) -> dict[str, Any]:
    """How well held-out scenes are understood: the share of their captions' words that were never met, and how often a
    picture fits its own caption better than all others, beside the share that guessing gives."""
    said = said_of_all(library)
    captions = [texts[0] for texts in said if texts]
    words = {word for caption in captions for word in caption.split()}
    unknown = {word for caption in captions for word in encoder.unknown_words(caption)}
    different = sorted(set(captions))
    if not different:
        return {}
    right = []
    for index, texts in enumerate(said):
        if not texts:
            continue
        rows = torch.nonzero(library.scene == index)[:, 0][:SHOWN]
        rgba = library.pairs.truth[rows].float() / 255
        found = encoder.alignment(different, rgba[:, :3] + 1 - rgba[:, 3:])
        assert found is not None
        right += (found.argmax(0) == different.index(texts[0])).tolist()
    return {
        "captions": len(different),
        "unknown_words": round(len(unknown) / len(words), 3),
        "right_caption": round(sum(right) / len(right), 3),
        "by_guessing": round(1 / len(different), 3),
    }
