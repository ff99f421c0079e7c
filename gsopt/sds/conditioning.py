"""What the expert knows, encoded once and saved with the run: prompts and images as a prior's tokens.

Text: every prompt with the word of every view it may be seen from. Each guided step draws one positive and one
negative prompt with probability proportional to their weights; over the run that is the weighted sum of their scores.
Images: CLIP embeddings of the input views (their mean) and of every reference image, appended to the text tokens and
scaled to these tokens' root mean square. That is training-free: Stable Diffusion never saw such tokens, and nobody has
shown that they raise PSNR. Where the model has a class embedding of an image (SD 2.1-unCLIP) it gets that as well.
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
from gsopt.llm_prompts.schema import Prompt, prompts_document, prompts_from
from gsopt.sds.priors.protocol import Encoder, Images

VERSION = 1
WORDS = {"front": "front view", "side": "side view", "back": "back view", "top": "overhead view"}
NEUTRAL = "a photo of an object"
"""A prompt that aligns with the input views worse than this says something else than they do."""
NO_IMAGE_ENCODER = (
    "The reference images are not used: the prior has no CLIP image encoder. Give one with --guidance.clip."
)


@dataclass(frozen=True)
class Drawn:
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
    """What encoded them; empty for a prior that takes none."""
    prompts: tuple[Prompt, ...]
    """With their alignment scores where those could be measured."""
    texts: tuple[str, ...]
    """What `tokens` encode, without repetition; the first is the empty text."""
    tokens: Float[Tensor, "n L D"] | None
    image_tokens: Float[Tensor, "m D"] | None
    """RMS-matched and weighted."""
    class_embedding: Float[Tensor, "E"] | None
    notes: tuple[str, ...] = ()
    """What the user should know: cut prompts, bad alignment, what could not be used."""

    def draw(self, side: str, generator: torch.Generator) -> Drawn:
        """Conditions for a camera on this side ("" where nobody knows)."""
        text = self._drawn_text("positive", side, generator)
        negative = self._drawn_text("negative", side, generator)
        if self.tokens is None:
            return Drawn(None, None, self.class_embedding, text)
        positive = self.tokens[self.texts.index(text)]
        if self.image_tokens is not None:
            positive = torch.cat([positive, self.image_tokens])
        return Drawn(positive, self.tokens[self.texts.index(negative)], self.class_embedding, text)

    def _drawn_text(self, polarity: str, side: str, generator: torch.Generator) -> str:
        """One prompt that may be seen from here, with its view word; the empty text where there is none."""
        number = torch.rand(1, generator=generator, dtype=torch.float64)  # drawn always: the other half must not shift
        fitting = [p for p in self.prompts if p.polarity == polarity and p.view in ("all", side) and p.weight > 0]
        if not fitting:
            return ""
        edges = torch.tensor([p.weight for p in fitting], dtype=torch.float64).cumsum(0)
        row = int(torch.searchsorted(edges, number * edges[-1], right=True).clamp(max=len(fitting) - 1))
        return worded(fitting[row], side)

    def save(self, path: Path) -> None:
        """One safetensors file: the tensors, and all else as JSON in its header."""
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
        """What `save` wrote; InputError for anything else."""
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


def worded(prompt: Prompt, side: str) -> str:
    """The prompt as it is said for a side: `a chair, back view` (Poole et al. 2022, section 3.2)."""
    return f"{prompt.text}, {WORDS[side]}" if side else prompt.text


def encode(
    encoder: Encoder | None,
    prompts: Sequence[Prompt],
    inputs: Images,
    references: Images,
    image_weight: float,
    class_embedding_width: int | None,
) -> Conditioning:
    """Everything encoded. `inputs` are views of the scene, `references` the expert's images (either may be empty)."""
    if encoder is None:
        ignored = "The prior takes no words and no reference images: they are not used."
        unused = bool(prompts) or len(references) > 0
        return Conditioning("", tuple(prompts), ("",), None, None, None, (ignored,) if unused else ())
    texts = tuple(dict.fromkeys(["", *(worded(p, side) for p in prompts for side in _sides(p))]))
    tokens = encoder.texts(texts)
    embeddings = _image_embeddings(encoder, inputs, references)
    scored, notes = _scored(encoder, prompts, inputs)
    notes += [_cut(p, encoder) for p in prompts if encoder.length(p.text) > encoder.longest]
    notes += [_unknown(p, words) for p in prompts if (words := encoder.unknown_words(p.text))]
    image_tokens = None
    if embeddings is not None and image_weight > 0:
        image_tokens, note = matched(embeddings, tokens, image_weight)
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
    return ("", *WORDS) if prompt.view == "all" else (prompt.view,)


def _image_embeddings(encoder: Encoder, inputs: Images, references: Images) -> Float[Tensor, "m E"] | None:
    """The mean of the input views' embeddings, then one row per reference image."""
    rows = []
    if len(inputs):
        embedded = encoder.images(inputs)
        rows += [] if embedded is None else [embedded.mean(0, keepdim=True)]
    if len(references):
        embedded = encoder.images(references)
        rows += [] if embedded is None else [embedded]
    return torch.cat(rows) if rows else None


def matched(
    embeddings: Float[Tensor, "m E"], tokens: Float[Tensor, "n L D"], weight: float
) -> tuple[Float[Tensor, "m D"] | None, list[str]]:
    """Embeddings with the root mean square of the text tokens, times the weight."""
    if embeddings.shape[1] != tokens.shape[2]:
        return None, [
            f"Image tokens are left out: CLIP's embeddings have {embeddings.shape[1]} numbers, the prior's tokens "
            f"{tokens.shape[2]}."
        ]
    rms = embeddings.square().mean(1, keepdim=True).sqrt().clamp_min(1e-12)
    return embeddings / rms * tokens.square().mean().sqrt() * weight, []


def _scored(encoder: Encoder, prompts: Sequence[Prompt], inputs: Images) -> tuple[tuple[Prompt, ...], list[str]]:
    """The prompts with their mean alignment with the input views, and a warning for every bad one."""
    positive = [p for p in prompts if p.polarity == "positive" and not encoder.unknown_words(p.text)]
    alignment = encoder.alignment([NEUTRAL, *(p.text for p in positive)], inputs) if positive and len(inputs) else None
    if alignment is None:
        return tuple(prompts), []
    neutral, *scores = [round(score, 4) for score in alignment.mean(1).clamp(-1, 1).tolist()]
    found = iter(scores)
    scored = tuple(dataclasses.replace(p, score=next(found)) if p in positive else p for p in prompts)
    bad = [p for p in scored if p.score is not None and p.score < neutral]
    return scored, [
        f"The prompt {p.text[:60]!r} fits the input views worse ({p.score:.3f}) than {NEUTRAL!r} ({neutral:.3f}): "
        "such prompts can lower the quality. Rephrase or drop it."
        for p in bad
    ]


def _unknown(prompt: Prompt, words: Sequence[str]) -> str:
    return (
        f"The prior never met {', '.join(map(repr, words[:5]))} of the prompt {prompt.text[:60]!r}: there it guesses "
        "from the spelling. Say it in common words, or name a prior that knows more with --prior."
    )


def _cut(prompt: Prompt, encoder: Encoder) -> str:
    return (
        f"The prompt {prompt.text[:60]!r}... has {encoder.length(prompt.text)} tokens; the prior reads the first "
        f"{encoder.longest} and ignores the rest."
    )
