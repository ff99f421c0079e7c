"""Training examples of Stable Diffusion: latents encoded once; noise, step and text tokens drawn per example."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gsopt.errors import InputError, NumericalError, UsageError
from gsopt.events import Report, write_atomic
from gsopt.finetune.on_views.images import MAX_VARIANTS, TrainingImage, variants
from gsopt.finetune.on_views.training_config import ImagePreparation
from gsopt.sds.noise import Latents, generator
from gsopt.sds.priors.stable_diffusion import DiffusersPrior

LATENTS = "latents.safetensors"
EMPTY_TEXT_SHARE = 0.1
"""Share of examples with the empty text, for classifier-free guidance (Ho & Salimans 2022)."""
REPORT_EVERY = 10


@dataclass(frozen=True)
class TrainingExample:
    """Clean latents of one image with noise, step and tokens."""

    z: Latents
    eps: Latents
    t: Int[Tensor, "1"]
    tokens: Float[Tensor, "1 L D"] | None


@dataclass(frozen=True)
class TrainingExamples:
    """Latents and tokens that examples are drawn from."""

    latents: Float[Tensor, "n v C h w"]
    """Latents of every image and variant, float32."""
    tokens: Float[Tensor, "m L D"] | None
    """Tokens of the empty text, then of all others; `None` for a model without text."""
    said: Int[Tensor, "n"]
    """Row of `tokens` of every image."""

    def draw(self, seed: int, step: int, row: int, steps: int) -> TrainingExample:
        """Draws example `row` of a training step: images, variants and noise steps are equally likely."""
        random = generator(seed, step, row, "lesson")
        image = int(torch.randint(len(self.latents), (1,), generator=random))
        variant = int(torch.randint(self.latents.shape[1], (1,), generator=random))
        t = torch.randint(steps, (1,), generator=random)
        wordless = bool(torch.rand(1, generator=random) < EMPTY_TEXT_SHARE)
        return self._lesson(image, variant, t, 0 if wordless else int(self.said[image]), random)

    def fixed(self, image: int, t: int) -> TrainingExample:
        """Returns a fixed evaluation example of the unmodified image."""
        return self._lesson(image, 0, torch.tensor([t]), int(self.said[image]), generator(0, t, image, "exam"))

    def _lesson(self, image: int, variant: int, t: Tensor, text: int, random: torch.Generator) -> TrainingExample:
        z = self.latents[image, variant][None]
        eps = torch.randn(z.shape, generator=random)
        return TrainingExample(z, eps, t, None if self.tokens is None else self.tokens[text : text + 1])


def make_examples(
    prior: DiffusersPrior,
    images: Sequence[TrainingImage],
    preparation: ImagePreparation,
    seed: int,
    folder: Path,
    report: Report,
) -> TrainingExamples:
    """Encodes these images into `folder`, or loads them from it. Raises InputError for an unreadable image."""
    path = folder / LATENTS
    if path.exists():
        return _load(path)
    if len(images) * preparation.count > MAX_VARIANTS:
        raise UsageError(
            f"{len(images)} images in {preparation.count} variants are more than {MAX_VARIANTS}. Give fewer images, or "
            "lower --variants."
        )
    small = sum(image.side < prior.size for image in images)
    if small:
        report(
            f"{small} of {len(images)} images are smaller than {prior.size} px and are enlarged; --size sets the side"
        )
    texts = tuple(dict.fromkeys(["", *(image.text for image in images)]))
    tokens = _tokens(prior, texts, report)
    said = torch.tensor([texts.index(image.text) for image in images])
    examples = TrainingExamples(_encoded(prior, images, preparation, seed, report), tokens, said)
    _save(examples, path)
    return examples


def _tokens(prior: DiffusersPrior, texts: Sequence[str], report: Report) -> Float[Tensor, "m L D"] | None:
    encoder = prior.encoder()
    if encoder is None:
        report("the model takes no text")
        return None
    for text in texts:
        if encoder.length(text) > encoder.max_tokens:
            report(
                f"the prompt {text[:60]!r}... has {encoder.length(text)} tokens; {encoder.max_tokens} of them are read"
            )
    return encoder.texts(texts)


@torch.no_grad()
def _encoded(
    prior: DiffusersPrior, images: Sequence[TrainingImage], preparation: ImagePreparation, seed: int, report: Report
) -> Float[Tensor, "n v C h w"]:
    rows = []
    for row, image in enumerate(images):
        row_variants = variants(images, row, prior.size, preparation, seed)
        latents = torch.cat([prior.encode(image).cpu() for image in row_variants])
        if not bool(torch.isfinite(latents).all()):
            raise NumericalError(
                f"The autoencoder made latents of {image.name} that are not finite. Use --dtype float32."
            )
        rows.append(latents)
        if (row + 1) % REPORT_EVERY == 0 or row + 1 == len(images):
            report(f"encoded {row + 1} of {len(images)} images, {len(latents)} variants each")
    return torch.stack(rows)


def _save(examples: TrainingExamples, path: Path) -> None:
    tensors = {"latents": examples.latents, "said": examples.said}
    if examples.tokens is not None:
        tensors["tokens"] = examples.tokens
    write_atomic(path, save({k: v.contiguous() for k, v in tensors.items()}))


def _load(path: Path) -> TrainingExamples:
    try:
        with safe_open(path, framework="pt") as file:
            # Cloned: in the file they may be unaligned, where matrix products round differently.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
        return TrainingExamples(tensors["latents"], tensors.get("tokens"), tensors["said"])
    except (OSError, SafetensorError, KeyError) as error:
        raise InputError(f"Cannot read {path} ({error}). Delete it: it is computed again.") from error
