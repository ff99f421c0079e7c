"""CLIP through transformers: encodes text and images as tokens of a prior, and measures their alignment.

Every model is loaded with an explicit dtype (transformers takes the checkpoint's otherwise) and from safetensors only.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt._optional import require
from gsopt.errors import InputError
from gsopt.sds.priors.protocol import Images

MAX_TOKENS = 77
"""Token limit of CLIP's text models."""
CLIP_MEAN, CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Mean and standard deviation of CLIP's training images (Radford et al. 2021), unless preprocessor_config.json
differs."""
ROWS_AT_ONCE = 8
"""Number of texts or images encoded at once."""


@dataclass(frozen=True)
class TextTower:
    """Tokenizer and text model."""

    tokenizer: Any
    model: Any
    max_tokens: int

    def ids(self, texts: Sequence[str]) -> Tensor:
        """Returns token ids, padded and truncated to the model's length."""
        encoded = self.tokenizer(
            list(texts), padding="max_length", max_length=self.max_tokens, truncation=True, return_tensors="pt"
        )
        return encoded.input_ids

    def hidden(self, texts: Sequence[str]) -> Float[Tensor, "n L D"]:
        """Returns the last hidden states, as Stable Diffusion attends to them."""
        chunks = [texts[i : i + ROWS_AT_ONCE] for i in range(0, len(texts), ROWS_AT_ONCE)]
        return torch.cat([self.model(self.ids(chunk)).last_hidden_state.float() for chunk in chunks])


@dataclass(frozen=True)
class ImageTower:
    """Vision model with its projection, and the images it was trained on."""

    model: Any
    size: int
    mean: tuple[float, ...]
    std: tuple[float, ...]

    def embeddings(self, images: Images) -> Float[Tensor, "n E"]:
        """Returns embeddings in CLIP's joint space, not normalized."""
        mean, std = (torch.tensor(values).view(1, 3, 1, 1) for values in (self.mean, self.std))
        resized = torch.nn.functional.interpolate(images, (self.size,) * 2, mode="bicubic", antialias=True)
        pixels = (resized.clamp(0, 1) - mean) / std
        return torch.cat([self.model(chunk).image_embeds.float() for chunk in pixels.split(ROWS_AT_ONCE)])


class ClipEncoder:
    """A prior's text encoder, its image encoder if any, and optionally a whole CLIP for alignment."""

    def __init__(
        self,
        name: str,
        text: TextTower,
        image: ImageTower | None,
        joint: JointClip | None,
        *,
        whole_words: bool = False,
    ) -> None:
        """`whole_words`: the tokenizer has one token for every known word, as those of `gsopt finetune` have."""
        self.name, self._whole_words = name, whole_words
        self._text, self._image, self._joint = text, image, joint

    @property
    def max_tokens(self) -> int:
        return self._text.max_tokens

    def length(self, text: str) -> int:
        return len(self._text.tokenizer(text, truncation=False).input_ids)

    def unknown_words(self, text: str) -> list[str]:
        """Returns the words that a tokenizer of whole words splits; empty for other tokenizers."""
        if not self._whole_words:
            return []
        tokenizer = self._text.tokenizer
        words = dict.fromkeys(re.findall(r"[^\W\d_]+", text.lower()))
        return [word for word in words if len(tokenizer.tokenize(word)) > 1]

    @torch.no_grad()
    def texts(self, texts: Sequence[str]) -> Float[Tensor, "n L D"]:
        return self._text.hidden(texts)

    @torch.no_grad()
    def images(self, images: Images) -> Float[Tensor, "n E"] | None:
        tower = self._image or (self._joint.image if self._joint else None)
        return None if tower is None else tower.embeddings(images)

    @torch.no_grad()
    def alignment(self, texts: Sequence[str], images: Images) -> Float[Tensor, "n m"] | None:
        return None if self._joint is None else self._joint.cosine(texts, images)


@dataclass(frozen=True)
class JointClip:
    """Text and vision models of one CLIP, both projected."""

    text: TextTower
    image: ImageTower

    def cosine(self, texts: Sequence[str], images: Images) -> Float[Tensor, "n m"]:
        """Returns the cosine of every text with every image."""
        words = self.text.model(self.text.ids(texts)).text_embeds.float()
        pictures = self.image.embeddings(images)
        return torch.nn.functional.normalize(words, dim=-1) @ torch.nn.functional.normalize(pictures, dim=-1).T


def load_text_tower(tokenizer: Path, model: Path, dtype: torch.dtype, *, projected: bool = False) -> TextTower:
    """Loads the folders of a tokenizer and of a CLIPTextModel."""
    transformers = _transformers()
    kind = transformers.CLIPTextModelWithProjection if projected else transformers.CLIPTextModel
    tokens = _loaded(transformers.CLIPTokenizer, tokenizer)
    network = _loaded(kind, model, dtype=dtype, use_safetensors=True)
    limit = min(int(tokens.model_max_length), int(network.config.max_position_embeddings), MAX_TOKENS)
    if len(tokens) > network.config.vocab_size:
        raise InputError(
            f"The tokenizer {tokenizer} knows {len(tokens)} tokens, the text encoder {model} only "
            f"{network.config.vocab_size}. They belong to different models: restore the folder."
        )
    return TextTower(tokens, network.eval().requires_grad_(False), limit)


def load_image_tower(model: Path, preprocessor: Path, dtype: torch.dtype) -> ImageTower:
    """Loads the folder of a CLIPVisionModelWithProjection; `preprocessor` may hold a preprocessor_config.json."""
    network = _loaded(_transformers().CLIPVisionModelWithProjection, model, dtype=dtype, use_safetensors=True)
    mean, std = _normalization(preprocessor / "preprocessor_config.json")
    return ImageTower(network.eval().requires_grad_(False), int(network.config.image_size), mean, std)


def load_joint_clip(folder: Path, dtype: torch.dtype) -> JointClip:
    """Loads a folder with a whole CLIPModel and its tokenizer."""
    return JointClip(load_text_tower(folder, folder, dtype, projected=True), load_image_tower(folder, folder, dtype))


def _normalization(file: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    if not file.is_file():
        return CLIP_MEAN, CLIP_STD
    try:
        document = json.loads(file.read_bytes()[: 1 << 20])
        return tuple(map(float, document["image_mean"])), tuple(map(float, document["image_std"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return CLIP_MEAN, CLIP_STD


def _transformers() -> Any:
    """Imports transformers without its warnings on unused weights."""
    transformers = require("transformers", "sds", "Encoding prompts")
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    return transformers


def _loaded(kind: Any, folder: Path, **options: Any) -> Any:
    try:
        return kind.from_pretrained(str(folder), local_files_only=True, **options)
    except Exception as error:  # transformers raises whatever its parsers raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"Cannot load {kind.__name__} from {folder}: {reason:.200}. Download the model again, or name another one."
        ) from error
