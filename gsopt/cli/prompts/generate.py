"""`gsopt prompts --notes TEXT`: writes prompts.json from an expert's notes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import arg

from gsopt import check
from gsopt.cli.console import report
from gsopt.cli.prompts.review import review_file
from gsopt.errors import UsageError

if TYPE_CHECKING:
    from gsopt.llm_prompts.generate import PromptJob, PromptResult
    from gsopt.llm_prompts.reference_images import ImageSettings
    from gsopt.sds.prompts import PromptSet


@dataclass(frozen=True)
class Flags:
    """Write prompts.json from an expert's notes, with a language model or a template. `gsopt prompts review FILE` goes
    through a file again, `gsopt prompts compare DATA FILE ...` tries files on a scene."""

    notes: Annotated[str, arg(metavar="TEXT")]
    """Description of the object in the expert's words; best in English, the object first: "femur, osteoporotic, CT"."""
    domain: Annotated[str, arg(metavar="NAME|FILE")] = "generic"
    """generic, medicine, robotics, arvr, environment, or a template of your own (Markdown)."""
    images: Annotated[tuple[Path, ...], arg(metavar="PATH ...")] = ()
    """Photos, folders of photos or a dataset: for models that see, and to score the prompts."""
    category: Annotated[str, arg(metavar="NOUN")] = ""
    """Noun for the object; found in the notes when not given."""
    n: Annotated[int, arg(aliases=["-n"], metavar="N")] = 8
    """Prompts to write beside the expert's own words; from 6 on one each is for front, side, back and top."""
    negatives: Annotated[int, arg(metavar="N")] = 3
    """Negative prompts to write."""
    llm: Annotated[str, arg(metavar="URL|none")] = "none"
    """Base address of an OpenAI-compatible server (ollama: http://localhost:11434/v1); none: the template. A key is
    read from the environment variable GSOPT_LLM_KEY."""
    model: Annotated[str, arg(metavar="NAME")] = ""
    """The server's model; needed where it has several."""
    timeout: Annotated[float, arg(metavar="SECONDS")] = 120.0
    """For all requests to the server together."""
    temperature: float = 0.8
    """Temperature of the language model; 0 always takes the likeliest word."""
    seed: int = 0
    """For the language model, where it takes one, and for pictures."""
    price: Annotated[str, arg(metavar="IN,OUT")] = ""
    """Price of a million tokens in and out, to print the cost."""
    fallback: tyro.conf.FlagCreatePairsOff[bool] = False
    """Let the template step in where the model cannot be had or gives nothing usable; the file says so."""
    prior: Annotated[str, arg(metavar="PRIOR")] = "auto"
    """Prior whose tokenizer, CLIP and pipeline are used: embedded, sd21, a diffusers folder, a hub id; or library, for
    which a language model is asked more."""
    clip: Annotated[str, arg(metavar="FOLDER")] = ""
    """A CLIP model that scores the prompts, where the prior has none."""
    review: tyro.conf.FlagCreatePairsOff[bool] = False
    """Go through the prompts one by one: accept, edit, reject."""
    images_from_prompts: Annotated[int, arg(metavar="K")] = 0
    """Make reference images with the prior's text-to-image pipeline; they guide only after a review accepted them."""
    image_steps: int = 25
    """Denoising steps of such an image."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="FILE")] = Path("prompts.json")
    """File to write; a model's answers go to FILE.raw.json beside it."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace the file if it exists."""


def main(argv: Sequence[str]) -> int:
    """Write the prompts; the exit code."""
    return write(tyro.cli(Flags, prog="gsopt prompts", args=list(argv)))


def write(flags: Flags) -> int:
    """Make the prompts, let the expert see them, write the file."""
    from gsopt.llm_prompts.generate import make_prompts, raw_file, require_model_prompts, write_record
    from gsopt.llm_prompts.reference_images import ImageSettings
    from gsopt.sds.prompts import write_set

    prices = read_prices(flags.price)
    settings = ImageSettings(flags.images_from_prompts, flags.seed, flags.image_steps)
    check.writable(flags.out, flags.force)
    job = read_job(flags)
    result = make_prompts(job, report)
    made = result.made
    raw = raw_file(flags.out)
    if result.record is not None:
        write_record(raw, result.record)
        made = replace(made, made=replace(made.made, raw=raw.name)) if made.made else made
        report(spent(result, prices))
    require_model_prompts(result, job, raw)
    made = with_pictures(made, flags, settings)
    show(made)
    write_set(flags.out, made)
    report(f"{flags.out}: {len(made.prompts)} prompts, tokens by {result.counter.name}")
    if flags.review:
        return review_file(flags.out, made)
    report(f"not reviewed; go through them with: gsopt prompts review {flags.out}")
    return 0


def read_job(flags: Flags) -> PromptJob:
    """Returns the job that the flags describe."""
    from gsopt.llm_prompts.generate import PromptJob

    return PromptJob(
        notes=flags.notes,
        domain=flags.domain,
        category=flags.category,
        images=flags.images,
        n=flags.n,
        negatives=flags.negatives,
        llm=flags.llm,
        model=flags.model,
        timeout=flags.timeout,
        temperature=flags.temperature,
        seed=flags.seed,
        fallback=flags.fallback,
        prior=flags.prior,
        clip=flags.clip,
    )


def with_pictures(made: PromptSet, flags: Flags, settings: ImageSettings) -> PromptSet:
    """With the pictures that were asked for; a prior that makes none says why."""
    if not settings.count:
        return made
    from gsopt.llm_prompts.reference_images import PAGE, generate_images

    folder = flags.out.with_name(f"{flags.out.stem}-images")
    pictures, reason = generate_images(flags.prior, made.prompts, settings, folder, report)
    if reason is not None:
        report(f"no pictures: {reason}")
        return made
    report(f"{folder / PAGE}: {len(pictures)} pictures; a review accepts or rejects them")
    return replace(made, images=pictures)


def show(made: PromptSet) -> None:
    """The prompts as a list, warnings below."""
    from gsopt.llm_prompts.review import line

    report(f"object: {made.object}, domain: {made.domain}")
    for number, prompt in enumerate(made.prompts, 1):
        report(line(number, len(made.prompts), prompt))
    for warning in made.made.warnings if made.made else ():
        report(f"warning: {warning}")


def spent(result: PromptResult, prices: tuple[float, float] | None) -> str:
    """Requests, tokens, time and cost of the model."""
    assert result.conversation is not None
    taken, given = result.conversation.tokens
    counted = [f"{taken:,} tokens in" if taken is not None else "tokens in unknown"]
    counted.append(f"{given:,} out" if given is not None else "out unknown")
    cost = "cost unknown (give --price IN,OUT)"
    if prices is not None and taken is not None and given is not None:
        cost = f"cost {(taken * prices[0] + given * prices[1]) / 1e6:.4f}"
    count = len(result.conversation.rounds)
    answers, seconds = f"{count} answer{'s' * (count != 1)}", f"{result.conversation.seconds:.1f} s"
    return f"language model: {answers}, {', '.join(counted)}, {seconds}, {cost}"


def read_prices(text: str) -> tuple[float, float] | None:
    """Returns IN,OUT as two numbers, or None for an empty text."""
    if not text:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"`--price` must be two numbers, got {text[:60]!r}. Try 0.15,0.6.") from error
    if not (0 <= first < 1e9 and 0 <= second < 1e9):
        raise UsageError(f"`--price` must not be negative, got {text[:60]!r}. Try 0.15,0.6.")
    return first, second
