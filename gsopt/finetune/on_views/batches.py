"""What Stable Diffusion is asked while it learns: images as latents, made once; noise, step and words per lesson."""

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
from gsopt.finetune.on_views.images import MOST, Picture, variants
from gsopt.finetune.on_views.training_config import Preparation
from gsopt.sds.noise import Latents, generator
from gsopt.sds.priors.stable_diffusion import DiffusersPrior

LATENTS = "latents.safetensors"
WORDLESS = 0.1
"""Share of lessons with the empty text: classifier-free guidance needs to know it (Ho & Salimans 2022)."""
TOLD_EVERY = 10


@dataclass(frozen=True)
class Lesson:
    """One image to be found in its noise."""

    z: Latents
    eps: Latents
    t: Int[Tensor, "1"]
    tokens: Float[Tensor, "1 L D"] | None


@dataclass(frozen=True)
class Lessons:
    """Everything lessons are drawn from."""

    latents: Float[Tensor, "n v C h w"]
    """Of every picture and variant, float32."""
    tokens: Float[Tensor, "m L D"] | None
    """Of the empty text, then of all others; None for a model without words."""
    said: Int[Tensor, "n"]
    """Row of `tokens` of every picture."""

    def draw(self, seed: int, step: int, row: int, steps: int) -> Lesson:
        """The lesson `row` of a training step: any picture, variant and noise step are equally likely."""
        random = generator(seed, step, row, "lesson")
        picture = int(torch.randint(len(self.latents), (1,), generator=random))
        variant = int(torch.randint(self.latents.shape[1], (1,), generator=random))
        t = torch.randint(steps, (1,), generator=random)
        wordless = bool(torch.rand(1, generator=random) < WORDLESS)
        return self._lesson(picture, variant, t, 0 if wordless else int(self.said[picture]), random)

    def fixed(self, picture: int, t: int) -> Lesson:
        """Always the same lesson about the untouched picture."""
        return self._lesson(picture, 0, torch.tensor([t]), int(self.said[picture]), generator(0, t, picture, "exam"))

    def _lesson(self, picture: int, variant: int, t: Tensor, text: int, random: torch.Generator) -> Lesson:
        z = self.latents[picture, variant][None]
        eps = torch.randn(z.shape, generator=random)
        return Lesson(z, eps, t, None if self.tokens is None else self.tokens[text : text + 1])


def make_lessons(
    prior: DiffusersPrior, pictures: Sequence[Picture], how: Preparation, seed: int, folder: Path, report: Report
) -> Lessons:
    """Lessons of these pictures, kept in `folder`. Raises InputError for a picture that cannot be read."""
    path = folder / LATENTS
    if path.exists():
        return _load(path)
    if len(pictures) * how.count > MOST:
        raise UsageError(
            f"{len(pictures)} images in {how.count} variants are more than {MOST}. Give fewer images, or lower "
            "--variants."
        )
    small = sum(picture.side < prior.size for picture in pictures)
    if small:
        report(
            f"{small} of {len(pictures)} images are smaller than {prior.size} px and are enlarged; --size sets the side"
        )
    texts = tuple(dict.fromkeys(["", *(picture.text for picture in pictures)]))
    tokens = _tokens(prior, texts, report)
    said = torch.tensor([texts.index(picture.text) for picture in pictures])
    lessons = Lessons(_encoded(prior, pictures, how, seed, report), tokens, said)
    _save(lessons, path)
    return lessons


def _tokens(prior: DiffusersPrior, texts: Sequence[str], report: Report) -> Float[Tensor, "m L D"] | None:
    encoder = prior.encoder()
    if encoder is None:
        report("the model takes no words")
        return None
    for text in texts:
        if encoder.length(text) > encoder.longest:
            report(f"the prompt {text[:60]!r}... has {encoder.length(text)} tokens; {encoder.longest} of them are read")
    return encoder.texts(texts)


@torch.no_grad()
def _encoded(
    prior: DiffusersPrior, pictures: Sequence[Picture], how: Preparation, seed: int, report: Report
) -> Float[Tensor, "n v C h w"]:
    rows = []
    for row, picture in enumerate(pictures):
        row_variants = variants(pictures, row, prior.size, how, seed)
        latents = torch.cat([prior.encode(image).cpu() for image in row_variants])
        if not bool(torch.isfinite(latents).all()):
            raise NumericalError(
                f"The autoencoder made latents of {picture.name} that are not finite. Use --dtype float32."
            )
        rows.append(latents)
        if (row + 1) % TOLD_EVERY == 0 or row + 1 == len(pictures):
            report(f"encoded {row + 1} of {len(pictures)} images, {len(latents)} variants each")
    return torch.stack(rows)


def _save(lessons: Lessons, path: Path) -> None:
    tensors = {"latents": lessons.latents, "said": lessons.said}
    if lessons.tokens is not None:
        tensors["tokens"] = lessons.tokens
    write_atomic(path, save({k: v.contiguous() for k, v in tensors.items()}))


def _load(path: Path) -> Lessons:
    try:
        with safe_open(path, framework="pt") as file:
            # Cloned: in the file they begin at any byte, and matrix products round by where their operands begin.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
        return Lessons(tensors["latents"], tensors.get("tokens"), tensors["said"])
    except (OSError, SafetensorError, KeyError) as error:
        raise InputError(f"Cannot read {path} ({error}). Delete it: it is made again.") from error
