"""Where training meets guidance: who guides a run, what its steps add, and what it leaves for the report."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from gsopt.config.train import BACKGROUNDS, TrainConfig
from gsopt.data.files import is_regular
from gsopt.data.scene import Scene
from gsopt.errors import InputError, UsageError
from gsopt.events import Report, to_json, write_atomic
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.llm_prompts.schema import Prompt, accepted_images, read_prompts, write_prompts
from gsopt.raster.backend import Backend, Gradients, RasterSettings
from gsopt.results.finished_run import to_bytes
from gsopt.results.video import save_stills
from gsopt.sds import conditioning as knowledge
from gsopt.sds import coverage, schedule
from gsopt.sds.candidate_views import square_views
from gsopt.sds.conditioning import Conditioning
from gsopt.sds.guidance_step import Guide
from gsopt.sds.priors.protocol import Images, Prior

FOLDER, CONDITIONING = "guidance", "conditioning.safetensors"
EMBEDDED_INPUTS = 8
"""Input views whose CLIP embeddings are averaged."""
LARGEST_REFERENCE = 64 << 20
"""Pixels of a reference image."""
SHOWN_VIEWS = 3
APART = 0.7
"""Cosine below which two viewing directions are shown both."""
SHOWN_STEPS = 4


def make_conditioning(config: TrainConfig, scene: Scene, prior: Prior, folder: Path, warn: Report) -> Conditioning:
    """The run's conditioning, prompts and images encoded, saved for a session that resumes the run."""
    prompts = read_guidance_prompts(config)
    references = read_references(reference_paths(config), prior.size)
    step = max(1, -(-len(scene.train) // EMBEDDED_INPUTS))
    inputs = square_views(scene.train[::step], prior.size, torch.ones(3)).images
    made = knowledge.encode(
        prior.encoder(), prompts, inputs, references, config.guidance.image_weight, prior.class_embedding_width
    )
    folder.mkdir(exist_ok=True)
    write_prompts(folder / "prompts.json", made.prompts)
    made.save(folder / CONDITIONING)
    for note in made.notes:
        warn(note)
    if config.guidance.front_view is None and any(p.view not in ("all", "top") for p in prompts):
        warn(
            f"Some prompts are for one side, but nobody said which input view shows the front: "
            f"{scene.train[0].name} is taken for it. Name the right one with --guidance.front-view."
        )
    return made


def read_guidance_prompts(config: TrainConfig) -> list[Prompt]:
    """--prompt, --negative and --prompts together. InputError names the prompt that cannot be used."""
    guidance = config.guidance
    prompts = [Prompt(text) for text in guidance.prompt]
    prompts += [Prompt(text, polarity="negative") for text in guidance.negative]
    return prompts + (list(read_prompts(Path(guidance.prompts))) if guidance.prompts else [])


def reference_paths(config: TrainConfig) -> tuple[str, ...]:
    """Paths of the reference images: those of `ref_image`, then those accepted in the prompts.json."""
    given, prompts = config.guidance.ref_image, config.guidance.prompts
    accepted = map(str, accepted_images(Path(prompts)) if prompts else ())
    return (*given, *(path for path in accepted if path not in given))


def read_references(paths: tuple[str, ...], size: int) -> Images:
    """Reference images, their middle squares on white. InputError for a file that is no image or too large."""
    pictures = [_read_reference(Path(path), size) for path in paths]
    return torch.stack(pictures) if pictures else torch.empty(0, 3, size, size)


def _read_reference(path: Path, size: int) -> Tensor:
    try:
        if not is_regular(path):
            raise OSError("no such file")
        with Image.open(path, formats=("PNG", "JPEG", "WEBP", "BMP", "TIFF")) as image:
            if image.width * image.height > LARGEST_REFERENCE:
                raise ValueError(f"{image.width} x {image.height} px is too large")
            rgba = image.convert("RGBA")
        white = Image.new("RGBA", rgba.size, "white")
        picture = Image.alpha_composite(white, rgba).convert("RGB")
        side = min(picture.size)
        left, top = (picture.width - side) // 2, (picture.height - side) // 2
        picture = picture.resize((size, size), Image.Resampling.LANCZOS, (left, top, left + side, top + side))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"Cannot read the reference image {path}: {error}. Give a PNG, JPEG or WebP, or drop --ref-image."
        ) from error
    return torch.frombuffer(bytearray(picture.tobytes()), dtype=torch.uint8).view(size, size, 3).permute(2, 0, 1) / 255


def make_guide(
    config: TrainConfig,
    scene: Scene,
    backend: Backend,
    prior: Prior,
    conditioning: Conditioning,
    weight: float,
    front: Cameras,
    warn: Report,
) -> Guide:
    """A guide for this scene."""
    fixed = BACKGROUNDS.get(config.data.background)
    return Guide(
        prior,
        conditioning,
        config.guidance,
        scene,
        backend,
        weight=weight,
        front=front,
        iterations=config.iterations,
        seed=config.seed,
        background=None if fixed is None else torch.tensor(fixed),
        warn=warn,
    )


def front_camera(config: TrainConfig, scene: Scene) -> Cameras:
    """The input camera that shows the front: the one named, else the first. UsageError for one that is not there."""
    front = config.guidance.front_view
    if front is not None and front >= len(scene.train):
        raise UsageError(
            f"`--guidance.front-view` must be below {len(scene.train)}, the number of input views, got {front}. "
            "Input views count from 0."
        )
    return scene.train[front or 0].camera


def add_gradients(gradients: Gradients, more: Gradients) -> None:
    """Add what moves the parameters, in place. `means2d` stays: density control must not see guidance."""
    for name in PARAMETERS:
        getattr(gradients, name).add_(getattr(more, name))


class RunGuidance:
    """A guide at work in a run: adds its gradients and keeps pictures of what it saw."""

    def __init__(self, guide: Guide, folder: Path | None = None, facts: dict[str, Any] | None = None) -> None:
        """`folder` None: a short run that leaves nothing behind. `facts`: what else the report should tell."""
        self.guide = guide
        self._folder, self._facts = folder, facts or {}
        self._wanted = schedule.guided_steps(guide.config, guide.iterations)
        self._views: list[int] = []
        self._samples: list[dict[str, Any]] = []

    def add(self, step: int, gaussians: Gaussians, settings: RasterSettings, gradients: Gradients) -> None:
        """Guide this step if it is to be guided."""
        more = self.guide.gradients(step, gaussians, settings)
        if more is None:
            return
        add_gradients(gradients, more)
        if self._folder is None:
            return
        if not self._views:
            self._views = self._open_views()
            self._save_views(self._folder, "before", gaussians, settings)
        if self.guide.counts.guided in shown_counts(self._wanted):
            self._save_sample(self._folder)

    def forget(self) -> None:
        self.guide.forget()

    def finish(self, gaussians: Gaussians, settings: RasterSettings) -> None:
        """The last pictures and summary.json, what the report tells."""
        if self._folder is None:
            return
        if self._views:
            self._save_views(self._folder, "after", gaussians, settings)
        summary = {
            **self._facts,
            "wanted": self._wanted,
            **dataclasses.asdict(self.guide.counts),
            "views": self._views,
            "samples": self._samples,
        }
        write_atomic(self._folder / "summary.json", to_json(summary))

    def _open_views(self) -> list[int]:
        """Candidates whose views are the most uncertain, from different directions."""
        mean_u, candidates = self.guide.memory.mean_u, self.guide.cameras.candidates
        assert mean_u is not None
        chosen: list[int] = []
        for index in torch.sort(mean_u, descending=True, stable=True).indices.tolist():
            cosines = candidates.forwards[chosen] @ candidates.forwards[index]
            if len(chosen) < SHOWN_VIEWS and bool((cosines < APART).all()):
                chosen.append(index)
        return chosen

    def _save_views(self, folder: Path, when: str, gaussians: Gaussians, settings: RasterSettings) -> None:
        guide = self.guide
        covered = guide.memory.coverage
        if covered is None:
            covered = coverage.coverage(gaussians, guide.inputs, guide.backend)
        u = coverage.uncertainty(covered)
        white = torch.ones(3)
        for index in self._views:
            camera = guide.cameras.candidates[index]
            colors = guide.backend.forward(gaussians, camera, settings, white).colors
            shown = coverage.uncertainty_map(gaussians, u, camera, guide.backend)
            pictures = [(f"{when}_{index:02d}", to_bytes(colors)), (f"{when}_{index:02d}_uncertainty", _grey(shown))]
            save_stills(folder, pictures, overwrite=True)

    def _save_sample(self, folder: Path) -> None:
        """What the prior was shown in this step, and what it made of it."""
        sample = self.guide.sample
        assert sample is not None
        target = sample.target if sample.x0 is None else self.guide.prior.decode(sample.x0)[0]
        assert target is not None
        name = f"step_{sample.step:06d}"
        pictures = [
            (f"{name}_render", to_bytes(sample.render.permute(1, 2, 0))),
            (f"{name}_proposal", to_bytes(target.permute(1, 2, 0))),
            (f"{name}_uncertainty", _grey(sample.uncertainty)),
        ]
        save_stills(folder, pictures, overwrite=True)
        self._samples = [s for s in self._samples if s["step"] != sample.step]
        self._samples.append({"step": sample.step, "text": sample.text})

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """See `Guide.state`; what was shown is remembered too."""
        tensors, meta = self.guide.state()
        return tensors, {**meta, "views": self._views, "samples": self._samples}

    def restore(self, tensors: dict[str, Tensor], meta: dict[str, Any]) -> None:
        self.guide.restore(tensors, meta)
        self._views, self._samples = list(meta["views"]), list(meta["samples"])


def shown_counts(wanted: int) -> set[int]:
    """Which guided steps, by their count, are shown: the first and three more, evenly spread."""
    return {1 + i * (wanted - 1) // (SHOWN_STEPS - 1) for i in range(SHOWN_STEPS)} if wanted > 1 else {1}


def _grey(values: Tensor) -> Tensor:
    return to_bytes(values[..., None].expand(-1, -1, 3))
