"""The expert's prompts and images as a prior's tokens, encoded once and saved with the run.

Text: every prompt with the word of every side it describes. Each guided step draws one positive and one negative prompt
with probability proportional to their weights; over the run that is the weighted sum of their scores.
Images: CLIP embeddings of the input views (their mean) and of every reference image, appended to the text tokens and
scaled to these tokens' root mean square. Stable Diffusion was not trained on such tokens, and no measurement shows that
they raise PSNR. A model with a class embedding of an image (SD 2.1-unCLIP) receives that as well.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gsopt.errors import InputError
from gsopt.events import write_atomic
from gsopt.sds.priors.protocol import Encoder, Images
from gsopt.sds.prompts import Prompt, prompts_document, prompts_from

VERSION = 1
VIEW_WORDS = {"front": "front view", "side": "side view", "back": "back view", "top": "overhead view"}
NEUTRAL_PROMPT = "a photo of an object"
"""A prompt that aligns worse with the input views than this one describes something else."""
NO_IMAGE_ENCODER = (
    "The reference images are not used: the prior has no CLIP image encoder. Give one with --guidance.clip."
)


@dataclass(frozen=True)
class SampledConditioning:
    """The two halves of one step's conditioning."""

    positive: Float[Tensor, "L D"] | None
    negative: Float[Tensor, "L' D"] | None
    class_embedding: Float[Tensor, "E"] | None
    text: str
    """The positive prompt, with its view word."""


@dataclass(frozen=True)
class Conditioning:
    """Encoded prompts and images."""

    encoder: str
    """Name of the encoder; empty for a prior without one."""
    prompts: tuple[Prompt, ...]
    """Prompts with their alignment scores, if measured."""
    texts: tuple[str, ...]
    """Texts of `tokens`, without repetition; the first is empty."""
    tokens: Float[Tensor, "n L D"] | None
    image_tokens: Float[Tensor, "m D"] | None
    """Image tokens, RMS-matched and weighted."""
    class_embedding: Float[Tensor, "E"] | None
    notes: tuple[str, ...] = ()
    """Warnings to the user: truncated prompts, bad alignment, unused inputs."""

    def draw(self, side: str, generator: torch.Generator) -> SampledConditioning:
        """Draws the conditions of a camera on this side ("" for an unknown side)."""
        text = self._drawn_text("positive", side, generator)
        negative = self._drawn_text("negative", side, generator)
        if self.tokens is None:
            return SampledConditioning(None, None, self.class_embedding, text)
        positive = self.tokens[self.texts.index(text)]
        if self.image_tokens is not None:
            positive = torch.cat([positive, self.image_tokens])
        return SampledConditioning(positive, self.tokens[self.texts.index(negative)], self.class_embedding, text)

    def _drawn_text(self, polarity: str, side: str, generator: torch.Generator) -> str:
        """Draws one prompt that fits this side, with its view word; the empty text without any."""
        number = torch.rand(
            1, generator=generator, dtype=torch.float64
        )  # always drawn: the other half must not depend on it
        candidates = [p for p in self.prompts if p.polarity == polarity and p.view in ("all", side) and p.weight > 0]
        if not candidates:
            return ""
        edges = torch.tensor([p.weight for p in candidates], dtype=torch.float64).cumsum(0)
        row = int(torch.searchsorted(edges, number * edges[-1], right=True).clamp(max=len(candidates) - 1))
        return with_view_word(candidates[row], side)

    def save(self, path: Path) -> None:
        """Writes one safetensors file: the tensors, and all else as JSON in its header."""
        named = {"tokens": self.tokens, "image_tokens": self.image_tokens, "class_embedding": self.class_embedding}
        document = {
            "version": VERSION,
            "encoder": self.encoder,
            "prompts": prompts_document(self.prompts),
            "texts": list(self.texts),
            "notes": list(self.notes),
        }
        tensors = {name: tensor.contiguous() for name, tensor in named.items() if tensor is not None}
        write_atomic(path, save(tensors, metadata={"gsopt": json.dumps(document, ensure_ascii=False)}))

    @staticmethod
    def load(path: Path) -> Conditioning:
        """Inverse of `save`; raises InputError for any other file."""
        try:
            with safe_open(path, framework="pt") as file:
                document = json.loads((file.metadata() or {})["gsopt"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            if document["version"] != VERSION:
                raise ValueError(f"version {document['version']} instead of {VERSION}")
            return Conditioning(
                encoder=str(document["encoder"]),
                prompts=prompts_from(document["prompts"]),
                texts=tuple(map(str, document["texts"])),
                notes=tuple(map(str, document["notes"])),
                **{name: tensors.get(name) for name in ("tokens", "image_tokens", "class_embedding")},
            )
        except (OSError, SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(
                f"Cannot read the conditioning {path} ({error}). Start the run in another folder."
            ) from error


def with_view_word(prompt: Prompt, side: str) -> str:
    """Returns the prompt for a side: `a chair, back view` (Poole et al. 2022, section 3.2)."""
    return f"{prompt.text}, {VIEW_WORDS[side]}" if side else prompt.text


def encode(
    encoder: Encoder | None,
    prompts: Sequence[Prompt],
    inputs: Images,
    references: Images,
    image_weight: float,
    class_embedding_width: int | None,
) -> Conditioning:
    """Encodes prompts and images: `inputs` are views of the scene, `references` the expert's (either may be empty)."""
    if encoder is None:
        ignored = "The prior takes no words and no reference images: they are not used."
        unused = bool(prompts) or len(references) > 0
        return Conditioning("", tuple(prompts), ("",), None, None, None, (ignored,) if unused else ())
    texts = tuple(dict.fromkeys(["", *(with_view_word(p, side) for p in prompts for side in _sides(p))]))
    tokens = encoder.texts(texts)
    embeddings = _image_embeddings(encoder, inputs, references)
    scored, notes = _scored(encoder, prompts, inputs)
    notes += [_truncation_note(p, encoder) for p in prompts if encoder.length(p.text) > encoder.max_tokens]
    notes += [_unknown_words_note(p, words) for p in prompts if (words := encoder.unknown_words(p.text))]
    image_tokens = None
    if embeddings is not None and image_weight > 0:
        image_tokens, note = rms_matched(embeddings, tokens, image_weight)
        notes += note
    elif len(references) and embeddings is None:
        notes.append(NO_IMAGE_ENCODER)
    wants_class = embeddings is not None and class_embedding_width == embeddings.shape[1]
    return Conditioning(
        encoder=encoder.name,
        prompts=scored,
        texts=texts,
        tokens=tokens,
        image_tokens=image_tokens,
        class_embedding=embeddings.mean(0) if embeddings is not None and wants_class else None,
        notes=tuple(notes),
    )


def _sides(prompt: Prompt) -> tuple[str, ...]:
    return ("", *VIEW_WORDS) if prompt.view == "all" else (prompt.view,)


def _image_embeddings(encoder: Encoder, inputs: Images, references: Images) -> Float[Tensor, "m E"] | None:
    """Returns the mean of the input views' embeddings, then one row per reference image."""
    rows = []
    if len(inputs):
        embedded = encoder.images(inputs)
        rows += [] if embedded is None else [embedded.mean(0, keepdim=True)]
    if len(references):
        embedded = encoder.images(references)
        rows += [] if embedded is None else [embedded]
    return torch.cat(rows) if rows else None


def rms_matched(
    embeddings: Float[Tensor, "m E"], tokens: Float[Tensor, "n L D"], weight: float
) -> tuple[Float[Tensor, "m D"] | None, list[str]]:
    """Scales embeddings to the root mean square of the text tokens, times the weight."""
    if embeddings.shape[1] != tokens.shape[2]:
        return None, [
            f"Image tokens are left out: CLIP's embeddings have {embeddings.shape[1]} numbers, the prior's tokens "
            f"{tokens.shape[2]}."
        ]
    rms = embeddings.square().mean(1, keepdim=True).sqrt().clamp_min(1e-12)
    return embeddings / rms * tokens.square().mean().sqrt() * weight, []


def _scored(encoder: Encoder, prompts: Sequence[Prompt], inputs: Images) -> tuple[tuple[Prompt, ...], list[str]]:
    """Returns the prompts with their mean alignment with the input views, and a warning for every bad one."""
    positive = [p for p in prompts if p.polarity == "positive" and not encoder.unknown_words(p.text)]
    alignment = (
        encoder.alignment([NEUTRAL_PROMPT, *(p.text for p in positive)], inputs) if positive and len(inputs) else None
    )
    if alignment is None:
        return tuple(prompts), []
    neutral, *scores = [round(score, 4) for score in alignment.mean(1).clamp(-1, 1).tolist()]
    found = iter(scores)
    scored = tuple(dataclasses.replace(p, score=next(found)) if p in positive else p for p in prompts)
    bad = [p for p in scored if p.score is not None and p.score < neutral]
    return scored, [
        f"The prompt {p.text[:60]!r} fits the input views worse ({p.score:.3f}) than {NEUTRAL_PROMPT!r} "
        f"({neutral:.3f}): such prompts can lower the quality. Rephrase or drop it."
        for p in bad
    ]


def _unknown_words_note(prompt: Prompt, words: Sequence[str]) -> str:
    return (
        f"The prior does not know {', '.join(map(repr, words[:5]))} of the prompt {prompt.text[:60]!r}: it uses "
        "the spelling. Use common words, or name a prior with a larger vocabulary by --prior."
    )


def _truncation_note(prompt: Prompt, encoder: Encoder) -> str:
    return (
        f"The prompt {prompt.text[:60]!r}... has {encoder.length(prompt.text)} tokens; the prior reads the first "
        f"{encoder.max_tokens} and ignores the rest."
    )
