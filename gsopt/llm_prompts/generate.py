"""From an expert's notes to a prompts.json: the words as they are, then a language model's prompts or a template's."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsopt import check
from gsopt._optional import require
from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, write_atomic
from gsopt.llm_prompts.deduplicate import without_repetitions
from gsopt.llm_prompts.expand import Wish, expand, filled_up, own_words
from gsopt.llm_prompts.schema import LONGEST_NAME, LONGEST_NOTES, MOST_WARNINGS, Made, Prompt, PromptSet
from gsopt.llm_prompts.subject import find_object
from gsopt.llm_prompts.templates import Template, load_template
from gsopt.llm_prompts.tokens import LONGEST, Counter, counter_for

if TYPE_CHECKING:
    from PIL import Image

    from gsopt.llm_prompts.query import Conversation
    from gsopt.sds.priors.protocol import Encoder

MOST = 64
"""Prompts that may be asked for."""
LONGEST_TIMEOUT = 24 * 3600.0
NOT_SCORED = "the prompts are not scored: the prior has no CLIP that joins words and pictures; give one with --clip"


@dataclass(frozen=True)
class Job:
    """What is to be made, and how."""

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
            raise UsageError('`--notes` is needed, got nothing. Say what the object is: --notes "worn oak chair".')
        if len(self.notes) > LONGEST_NOTES:
            raise UsageError(f"`--notes` may have {LONGEST_NOTES} characters, got {len(self.notes)}. Shorten them.")
        if len(self.category) > LONGEST_NAME:
            raise UsageError(f"`--category` may have {LONGEST_NAME} characters, got {len(self.category)}. Shorten it.")
        Prompt(" ".join(self.notes.split())[:1000])
        check.within("-n", self.n, 1, MOST, "8 is usual.")
        check.within("--negatives", self.negatives, 0, MOST, "0 makes none.")
        check.within("--timeout", self.timeout, 1.0, LONGEST_TIMEOUT, "It is in seconds; 120 is the default.")
        check.within("--temperature", self.temperature, 0.0, 2.0, "0.8 is the default.")
        if not self.prior:
            raise UsageError("`--prior` is empty. Give embedded, sd21, a diffusers folder or a hub id.")


@dataclass(frozen=True)
class Result:
    """Prompts, and what else there is to tell."""

    made: PromptSet
    record: dict[str, Any] | None
    """The conversation with the model; None where there was none."""
    counter: Counter
    talk: Conversation | None = None


def make_prompts(job: Job, report: Report) -> Result:
    """Prompts for the job. `report` gets the progress.

    Raises UsageError and InputError for a job that cannot be done, Refusal where the model cannot be had and no
    fallback to the template is allowed.
    """
    template = load_template(job.domain)
    wish = Wish(job.notes.strip(), job.category.strip() or find_object(job.notes), job.n, job.negatives)
    folder = prior_folder(job.prior)
    counter = counter_for(folder)
    views = _views(job)
    clip = _clip(job.clip) if views and job.clip else None  # before a model is asked, whose answers may cost money
    own = own_words(wish)
    if job.llm == "none":
        result = Result(_set(job, wish, template, (own, *expand(template, wish, counter))), None, counter)
    else:
        result = _with_model(job, wish, template, counter, views, report)
    made = result.made
    if views and (clip is not None or (folder is not None and (folder / "text_encoder").is_dir())):
        made = scored(made, clip or _encoder(job.prior), views)
    elif views:
        made = replace(made, made=_warned(made, (NOT_SCORED,)))
    return replace(result, made=replace(made, made=_warned(made, _too_long(made.prompts, counter))))


def prior_folder(prior: str) -> Path | None:
    """The folder of a prior, None where it does not lie on this machine. Fetches nothing.

    Raises UsageError for what is neither a folder nor a name that a prior could have.
    """
    from gsopt.sds.select_prior import EMBEDDED, what_embedded_lacks

    if prior in ("auto", "embedded"):
        return EMBEDDED if what_embedded_lacks() is None else None
    path = Path(prior).expanduser()
    return path if path.is_dir() else _cached(prior)


def _cached(prior: str) -> Path | None:
    """What the hub's client has on this machine."""
    from gsopt.sds.priors.folder import HUB_ID, SD21

    name = SD21 if prior == "sd21" else prior
    if not HUB_ID.fullmatch(name) or name.startswith("."):
        raise UsageError(
            f"`--prior` {prior!r:.200} is no folder that exists, no hub id and none of embedded, sd21. Correct it."
        )
    try:
        from huggingface_hub import snapshot_download

        return Path(snapshot_download(name, local_files_only=True))
    except Exception:  # not installed, or not in the cache: the estimate does
        return None


def raw_file(output: Path) -> Path:
    """Where the model's answers are kept, beside the prompts."""
    return output.with_name(f"{output.stem}.raw.json")


def write_record(path: Path, record: dict[str, Any]) -> None:
    """The conversation as JSON in ASCII: whatever the model said, opening the file does nothing to a terminal."""
    write_atomic(path, (json.dumps(record, indent=1, ensure_ascii=True) + "\n").encode("ascii"))


def scored(made: PromptSet, clip: tuple[Encoder | None, int], views: Sequence[Image.Image]) -> PromptSet:
    """With the alignment of the views, seen by an encoder at that size; prompts that say other things are warned of."""
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
    """A CLIP of its own, and the side of its images."""
    import torch

    from gsopt.sds.priors.clip import ClipEncoder, load_joint_clip
    from gsopt.sds.priors.stable_diffusion import find_part

    joint = load_joint_clip(find_part(name), torch.float32)
    return ClipEncoder(name, joint.text, None, joint), joint.image.size


def _encoder(name: str) -> tuple[Encoder | None, int]:
    """The prior's own."""
    from gsopt.sds.load_prior import open_prior

    name = "embedded" if name == "auto" else name
    prior = open_prior(name, GuidanceConfig(prior=name))
    return prior.encoder(), prior.size


def _views(job: Job) -> tuple[Image.Image, ...]:
    if not job.images:
        return ()
    from gsopt.llm_prompts.expert_images import read_views

    return read_views(job.images)


def _with_model(
    job: Job, wish: Wish, template: Template, counter: Counter, views: Sequence[Image.Image], report: Report
) -> Result:
    from gsopt.llm_prompts.client import Refusal, connect
    from gsopt.llm_prompts.expert_images import to_jpegs
    from gsopt.llm_prompts.query import Request, converse, source_of

    require("pydantic", "llm", "Asking a language model")
    own = own_words(wish)
    try:
        server = connect(job.llm, job.model, job.timeout)
        source = source_of(server.model)
        report(f"asking {source} at {server.url}, for at most {job.timeout:g} s")
        request = Request(template, wish, job.temperature, job.seed, to_jpegs(views))
        talk = converse(server, request, counter, report)
    except Refusal as refusal:
        if not job.fallback:
            raise
        warning = f"{refusal} The prompts are the template's."
        made = _set(job, wish, template, (own, *expand(template, wish, counter)), warnings=(warning,))
        return Result(made, None, counter)
    record = {
        "version": 1,
        "url": server.url,
        "model": server.model,
        "rounds": [asdict(each) for each in talk.rounds],
        "notes": list(talk.notes),
    }
    warnings = list(talk.notes)
    prompts = filled_up(talk.prompts, template, wish, counter)
    if not talk.prompts:
        warnings.insert(0, f"the model {source} gave nothing that can be used")
    elif len(prompts) > len(talk.prompts):
        filled = len(prompts) - len(talk.prompts)
        warnings.insert(0, f"{len(talk.prompts)} prompts are from the model, {filled} from the template")
    everything = without_repetitions((own, *prompts))
    return Result(_set(job, wish, template, everything, source, tuple(warnings)), record, counter, talk)


def require_model_prompts(result: Result, job: Job, raw: Path) -> None:
    """InputError where a model was asked, gave nothing, and the template may not stand in for it."""
    if result.talk is not None and not result.talk.prompts and not job.fallback:
        reasons = "; ".join(result.talk.notes[:4]) or "no reason known"
        raise InputError(
            f"The model gave no prompt that can be used after {len(result.talk.rounds)} answers ({reasons}). Its "
            f"answers are in {raw}. Use a larger model, allow the template to step in with --fallback, or --llm none."
        )


def _set(
    job: Job,
    wish: Wish,
    template: Template,
    prompts: tuple[Prompt, ...],
    source: str = "template",
    warnings: tuple[str, ...] = (),
) -> PromptSet:
    made = Made(source=source, template=template.name)
    everything = PromptSet(prompts, notes=job.notes.strip(), object=wish.object, domain=template.name, made=made)
    return replace(everything, made=_warned(everything, warnings))


def _warned(made: PromptSet, warnings: Sequence[str]) -> Made:
    before = made.made or Made()
    return replace(before, warnings=tuple(dict.fromkeys((*before.warnings, *warnings)))[:MOST_WARNINGS])


def _too_long(prompts: Sequence[Prompt], counter: Counter) -> tuple[str, ...]:
    longest = min(LONGEST, counter.longest)
    return tuple(
        f"the prompt {prompt.text[:60]!r} has {count} tokens by {counter.name}; {longest} are read"
        for prompt in prompts
        if (count := counter.count(prompt.text)) > longest
    )
