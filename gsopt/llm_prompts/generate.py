"""Makes a prompt set from an expert's notes: the notes themselves, then prompts of a language model or a template."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsopt import check
from gsopt._optional import require
from gsopt.config.guidance import GuidanceConfig, completes_bodies
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, write_atomic
from gsopt.llm_prompts.deduplicate import without_duplicates
from gsopt.llm_prompts.expand import PromptSpec, expand, expert_prompt, fill_with_template
from gsopt.llm_prompts.subject import find_object
from gsopt.llm_prompts.templates import Template, for_library, load_template
from gsopt.llm_prompts.tokens import MAX_TOKENS, TokenCounter, counter_for
from gsopt.sds.prompts import MAX_NAME_LENGTH, MAX_NOTES_LENGTH, MAX_WARNINGS, Prompt, PromptSet, Provenance

if TYPE_CHECKING:
    from PIL import Image

    from gsopt.llm_prompts.query import Conversation
    from gsopt.sds.priors.protocol import Encoder

MAX_REQUESTED = 64
"""Largest number of prompts per request."""
MAX_TIMEOUT = 24 * 3600.0
NOT_SCORED = "the prompts are not scored: the prior has no CLIP with a joint space of text and images; give --clip"


@dataclass(frozen=True)
class PromptJob:
    """Settings of `gsopt prompts`."""

    notes: str
    domain: str = "generic"
    category: str = ""
    images: tuple[Path, ...] = ()
    n: int = 8
    negatives: int = 3
    llm: str = "none"
    model: str = ""
    timeout: float = 120.0
    temperature: float = 0.8
    seed: int = 0
    fallback: bool = False
    prior: str = "auto"
    clip: str = ""

    def __post_init__(self) -> None:
        if not self.notes.strip():
            raise UsageError('`--notes` is needed, got nothing. Describe the object: --notes "worn oak chair".')
        if len(self.notes) > MAX_NOTES_LENGTH:
            raise UsageError(f"`--notes` may have {MAX_NOTES_LENGTH} characters, got {len(self.notes)}. Shorten them.")
        if len(self.category) > MAX_NAME_LENGTH:
            raise UsageError(
                f"`--category` may have {MAX_NAME_LENGTH} characters, got {len(self.category)}. Shorten it."
            )
        Prompt(" ".join(self.notes.split())[:1000])
        check.within("-n", self.n, 1, MAX_REQUESTED, "8 is usual.")
        check.within("--negatives", self.negatives, 0, MAX_REQUESTED, "0 makes none.")
        check.within("--timeout", self.timeout, 1.0, MAX_TIMEOUT, "It is in seconds; 120 is the default.")
        check.within("--temperature", self.temperature, 0.0, 2.0, "0.8 is the default.")
        if not self.prior:
            raise UsageError("`--prior` is empty. Give embedded, sd21, a diffusers folder or a hub id.")


@dataclass(frozen=True)
class PromptResult:
    """A prompt set with the record of its generation."""

    made: PromptSet
    record: dict[str, Any] | None
    """The conversation with the model, or `None`."""
    counter: TokenCounter
    conversation: Conversation | None = None


def make_prompts(job: PromptJob, report: Report) -> PromptResult:
    """Prompts for the job. `report` gets the progress.

    Raises UsageError and InputError for a job that cannot be done, ServerError where the model cannot be had and no
    fallback to the template is allowed.
    """
    template = load_template(job.domain)
    if completes_bodies(job.prior):
        template = for_library(template)
    spec = PromptSpec(job.notes.strip(), job.category.strip() or find_object(job.notes), job.n, job.negatives)
    folder = prior_folder(job.prior)
    counter = counter_for(folder)
    views = _views(job)
    clip = _clip(job.clip) if views and job.clip else None  # before the request to a model, which may cost money
    own = expert_prompt(spec)
    if job.llm == "none":
        result = PromptResult(_set(job, spec, template, (own, *expand(template, spec, counter))), None, counter)
    else:
        result = _with_model(job, spec, template, counter, views, report)
    made = result.made
    if views and (clip is not None or (folder is not None and (folder / "text_encoder").is_dir())):
        made = scored(made, clip or _encoder(job.prior), views)
    elif views:
        made = replace(made, made=_warned(made, (NOT_SCORED,)))
    return replace(result, made=replace(made, made=_warned(made, _too_long(made.prompts, counter))))


def prior_folder(prior: str) -> Path | None:
    """Returns the folder of a prior, or `None` if it is not on this machine. Fetches nothing.

    Raises UsageError for an invalid name.
    """
    from gsopt.sds.select_prior import EMBEDDED, embedded_prior_obstacle

    if completes_bodies(prior):
        return None
    if prior in ("auto", "embedded"):
        return EMBEDDED if embedded_prior_obstacle() is None else None
    path = Path(prior).expanduser()
    return path if path.is_dir() else _cached(prior)


def _cached(prior: str) -> Path | None:
    """Returns the folder in the hub's cache, if any."""
    from gsopt.sds.priors.folder import HUB_ID, SD21

    name = SD21 if prior == "sd21" else prior
    if not HUB_ID.fullmatch(name) or name.startswith("."):
        raise UsageError(
            f"`--prior` {prior!r:.200} is no folder that exists, no hub id and none of embedded, sd21. Correct it."
        )
    try:
        from huggingface_hub import snapshot_download

        return Path(snapshot_download(name, local_files_only=True))
    except Exception:  # not installed or not in the cache: use the estimate
        return None


def raw_file(output: Path) -> Path:
    """Returns the path of the model's replies, beside the prompts."""
    return output.with_name(f"{output.stem}.raw.json")


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Writes the conversation as JSON in ASCII, which is safe to print on a terminal whatever the model wrote."""
    write_atomic(path, (json.dumps(record, indent=1, ensure_ascii=True) + "\n").encode("ascii"))


def scored(made: PromptSet, clip: tuple[Encoder | None, int], views: Sequence[Image.Image]) -> PromptSet:
    """Adds alignment scores with the views, encoded at that size, and warnings about mismatching prompts."""
    import torch

    from gsopt.llm_prompts.expert_images import to_squares
    from gsopt.sds.conditioning import encode

    encoder, size = clip
    if encoder is None:
        return replace(made, made=_warned(made, (NOT_SCORED,)))
    with torch.no_grad():
        squares = to_squares(views, size)
        known = encode(encoder, made.prompts, squares, squares[:0], 0.0, None)
    notes = known.notes
    if all(prompt.score is None for prompt in known.prompts):
        notes += (NOT_SCORED,)
    return replace(made, prompts=known.prompts, made=_warned(made, notes))


def _clip(name: str) -> tuple[Encoder, int]:
    """Loads a separate CLIP; returns it with the side of its images."""
    import torch

    from gsopt.sds.priors.clip import ClipEncoder, load_joint_clip
    from gsopt.sds.priors.stable_diffusion import find_part

    joint = load_joint_clip(find_part(name), torch.float32)
    return ClipEncoder(name, joint.text, None, joint), joint.image.size


def _encoder(name: str) -> tuple[Encoder | None, int]:
    """Returns the prior's own encoder and image side."""
    from gsopt.sds.load_prior import open_prior

    name = "embedded" if name == "auto" else name
    prior = open_prior(name, GuidanceConfig(prior=name))
    return prior.encoder(), prior.size


def _views(job: PromptJob) -> tuple[Image.Image, ...]:
    if not job.images:
        return ()
    from gsopt.llm_prompts.expert_images import read_views

    return read_views(job.images)


def _with_model(
    job: PromptJob,
    spec: PromptSpec,
    template: Template,
    counter: TokenCounter,
    views: Sequence[Image.Image],
    report: Report,
) -> PromptResult:
    from gsopt.llm_prompts.client import ServerError, connect
    from gsopt.llm_prompts.expert_images import to_jpegs
    from gsopt.llm_prompts.query import QuerySettings, converse, source_of

    require("pydantic", "llm", "Asking a language model")
    own = expert_prompt(spec)
    try:
        server = connect(job.llm, job.model, job.timeout)
        source = source_of(server.model)
        report(f"asking {source} at {server.url}, for at most {job.timeout:g} s")
        settings = QuerySettings(template, spec, job.temperature, job.seed, to_jpegs(views))
        conversation = converse(server, settings, counter, report)
    except ServerError as refusal:
        if not job.fallback:
            raise
        warning = f"{refusal} The prompts are the template's."
        made = _set(job, spec, template, (own, *expand(template, spec, counter)), warnings=(warning,))
        return PromptResult(made, None, counter)
    record = {
        "version": 1,
        "url": server.url,
        "model": server.model,
        "rounds": [asdict(each) for each in conversation.rounds],
        "notes": list(conversation.notes),
    }
    warnings = list(conversation.notes)
    prompts = fill_with_template(conversation.prompts, template, spec, counter)
    if not conversation.prompts:
        warnings.insert(0, f"the model {source} gave nothing that can be used")
    elif len(prompts) > len(conversation.prompts):
        filled = len(prompts) - len(conversation.prompts)
        warnings.insert(0, f"{len(conversation.prompts)} prompts are from the model, {filled} from the template")
    everything = without_duplicates((own, *prompts))
    return PromptResult(_set(job, spec, template, everything, source, tuple(warnings)), record, counter, conversation)


def require_model_prompts(result: PromptResult, job: PromptJob, raw: Path) -> None:
    """Raises InputError if a model returned no prompt and the job does not allow the template as fallback."""
    if result.conversation is not None and not result.conversation.prompts and not job.fallback:
        reasons = "; ".join(result.conversation.notes[:4]) or "no reason known"
        raise InputError(
            f"The model gave no usable prompt after {len(result.conversation.rounds)} answers ({reasons}). "
            f"Its answers are in {raw}. Use a larger model, allow the template with --fallback, or use --llm none."
        )


def _set(
    job: PromptJob,
    spec: PromptSpec,
    template: Template,
    prompts: tuple[Prompt, ...],
    source: str = "template",
    warnings: tuple[str, ...] = (),
) -> PromptSet:
    made = Provenance(source=source, template=template.name)
    everything = PromptSet(prompts, notes=job.notes.strip(), object=spec.object, domain=template.name, made=made)
    return replace(everything, made=_warned(everything, warnings))


def _warned(made: PromptSet, warnings: Sequence[str]) -> Provenance:
    before = made.made or Provenance()
    return replace(before, warnings=tuple(dict.fromkeys((*before.warnings, *warnings)))[:MAX_WARNINGS])


def _too_long(prompts: Sequence[Prompt], counter: TokenCounter) -> tuple[str, ...]:
    longest = min(MAX_TOKENS, counter.max_tokens)
    return tuple(
        f"the prompt {prompt.text[:60]!r} has {count} tokens by {counter.name}; {longest} are read"
        for prompt in prompts
        if (count := counter.count(prompt.text)) > longest
    )
