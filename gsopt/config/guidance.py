"""The settings of guidance by a diffusion model: a part of `TrainConfig`, in a file of its own. No torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsopt import check
from gsopt.errors import UsageError

MOST = 1e9
"""Upper bound of weights: keeps infinities and typing errors out."""


@dataclass(frozen=True)
class GuidanceConfig:
    """Guidance by a diffusion model where the input views leave the scene open."""

    lambda_sds: float | None = None
    """Weight of the guidance loss in the steps that are guided; 0 loads no diffusion model. When not given: 0.2 if the
    prior `auto` stands for is at hand, else 0, and the run says which and why."""
    prior: str = "auto"
    """auto (the embedded prior), embedded, sd21, a diffusers folder, or a model id of the Hugging Face hub."""
    policy: Literal["auto", "sds", "recon", "sdi"] = "auto"
    """auto: what suits the prior, recon for a view-conditioned one, sds for text-to-image. sds: one noisy look per step
    (Poole et al. 2022); recon: a denoised target, cached and refreshed (Zhou & Tulsiani 2023); sdi: the noise is found
    by DDIM inversion (Lukoianov et al. 2024)."""
    prompt: tuple[str, ...] = ()
    """What the object is, in the expert's words; one prompt per flag."""
    negative: tuple[str, ...] = ()
    """What it is not."""
    prompts: str = ""
    """A prompts.json: prompts with weights, views and polarity."""
    ref_image: tuple[str, ...] = ()
    """Further images of the object or of its like."""
    front_view: int | None = None
    """Input view (0-based, in name order) that shows the front; with it prompts get view words."""
    clip: str = ""
    """Folder or hub id of a CLIP model for image embeddings and alignment scores, where the prior has none."""
    image_weight: float = 0.5
    """Length of the appended image tokens relative to the text tokens; 0 leaves them out."""
    guidance_scale: float | None = None
    """Classifier-free guidance (Ho & Salimans 2022); 1 asks the model once, without the negative prompts. When not
    given: 3 for a text-to-image prior, 1 for a view-conditioned one."""
    rescale: float = 0.5
    """How far the guided estimate is brought back to the contrast of the conditional one (Lin et al. 2024), 0 to 1."""
    weighting: Literal["sigma2", "fantasia", "one", "x0"] = "sigma2"
    """w(t) of sds and sdi: 1-a (Poole et al. 2022), sqrt(a)(1-a) (Chen et al. 2023), 1, or sqrt((1-a)/a): the plain
    difference to the denoised estimate."""
    t_min: float = 0.02
    """Least noise, as a share of the model's steps."""
    t_max: float = 0.70
    """Most noise when guidance starts, as a share of the model's steps."""
    t_max_end: float = 0.25
    """Most noise when guidance stops."""
    anneal: Literal["sqrt", "linear"] = "sqrt"
    """How the most noise goes from the one to the other."""
    start: float = 0.25
    """Share of the run before the first guided step."""
    stop: float = 0.95
    """Share of the run after which no step is guided."""
    every: int | None = None
    """Steps between two guided ones. When not given: 2 with recon, whose targets last; else 10."""
    min_uncertainty: float | None = None
    """Mean uncertainty of a view below which it is not guided: the input views decide there. When not given: 0.05; 0
    for a view-conditioned prior, which the guard asks whether it knows more."""
    certain_weight: float | None = None
    """Weight of a pixel that the input views decide, next to 1 for one that none of them shows. When not given: 1 for a
    view-conditioned prior, which knows these views; 0 for a text-to-image prior, which knows better nowhere."""
    geometry: float = 1.0
    """Factor on the guidance gradient of positions, rotations, scales and opacities; 0 guides colors only."""
    clip_rms: float = 1.0
    """Largest root mean square of the guidance gradient before the weights; 0 = any."""
    denoise_steps: int | None = None
    """recon: DDIM steps from the noisy render to the target. When not given: 5 for a text-to-image prior; 1 for a
    view-conditioned one, which is trained to repair a render at once."""
    refresh_every: int = 300
    """recon: steps after which a cached target is made again."""
    inversion_steps: int = 5
    """sdi: DDIM steps from the render to its noise."""
    references: int = 4
    """Input views that a view-conditioned prior sees, those nearest to the guided camera."""
    guard_views: int = 2
    """Input views left out in turn by the short runs that say whether guidance would help; 0 = no such check."""
    guard_steps: int = 240
    """Length of these runs."""
    size: int = 0
    """Side of the guided renders, px; 0 = what the prior was made for."""
    sequential: bool = False
    """Ask for the two halves of classifier-free guidance one after the other: less memory, more time."""
    tiny_vae: str = ""
    """Folder or hub id of a tiny autoencoder (TAESD) to use in place of the prior's."""
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Of the diffusion model. auto: float16 on a GPU; on a CPU with AVX-512 bfloat16 for large models, else float32."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the diffusion model runs. auto: the GPU when there is one."""

    def __post_init__(self) -> None:
        if self.lambda_sds is not None:
            check.within("--lambda_sds", self.lambda_sds, 0.0, MOST, "0 turns guidance off; 0.2 is a sound start.")
        if not self.prior:
            raise UsageError("`--prior` is empty. Give embedded, sd21, a diffusers folder or a hub id.")
        check.one_of("--guidance.policy", self.policy, ("auto", "sds", "recon", "sdi"))
        check.one_of("--guidance.weighting", self.weighting, ("sigma2", "fantasia", "one", "x0"))
        check.one_of("--guidance.anneal", self.anneal, ("sqrt", "linear"))
        check.one_of("--guidance.dtype", self.dtype, ("auto", "float32", "bfloat16", "float16"))
        check.one_of("--guidance.device", self.device, ("auto", "cpu", "cuda"))
        check.at_least("--guidance.front-view", self.front_view or 0, 0, "Input views count from 0.")
        check.within("--guidance.image-weight", self.image_weight, 0.0, 10.0, "0 leaves image tokens out.")
        if self.guidance_scale is not None:
            check.within("--guidance.guidance-scale", self.guidance_scale, 0.0, 1000.0, "1 to 10 is usual here.")
        check.within("--guidance.rescale", self.rescale, 0.0, 1.0, "0 leaves the contrast alone.")
        check.within("--guidance.t-min", self.t_min, 0.001, 0.98, "The default is 0.02.")
        check.within("--guidance.t-max", self.t_max, self.t_min, 0.98, "It must not lie below t-min.")
        check.within("--guidance.t-max-end", self.t_max_end, self.t_min, 0.98, "It must not lie below t-min.")
        check.within("--guidance.start", self.start, 0.0, 1.0, "It is a share of the run; the default is 0.25.")
        check.within("--guidance.stop", self.stop, self.start, 1.0, "It must not lie before the start.")
        if self.every is not None:
            check.at_least("--guidance.every", self.every, 1, "1 guides every step.")
        if self.min_uncertainty is not None:
            check.within("--guidance.min-uncertainty", self.min_uncertainty, 0.0, 1.0, "0 guides every view.")
        if self.certain_weight is not None:
            check.within("--guidance.certain-weight", self.certain_weight, 0.0, 1.0, "0 guides what is uncertain.")
        check.within("--guidance.geometry", self.geometry, 0.0, MOST, "0 guides colors only.")
        check.within("--guidance.clip-rms", self.clip_rms, 0.0, MOST, "0 lets any gradient pass.")
        if self.denoise_steps is not None:
            check.within("--guidance.denoise-steps", self.denoise_steps, 1, 1000, "1 to 5 is usual.")
        check.at_least("--guidance.refresh-every", self.refresh_every, 1, "The default is 300.")
        check.within("--guidance.inversion-steps", self.inversion_steps, 1, 1000, "The default is 5.")
        check.within("--guidance.references", self.references, 0, 64, "The default is 4.")
        check.within("--guidance.guard-views", self.guard_views, 0, 16, "0 makes no check; the default is 2.")
        check.at_least("--guidance.guard-steps", self.guard_steps, 2, "The default is 240.")
        if self.size:
            check.within("--guidance.size", self.size, 8, 4096, "0 takes what the prior was made for.")
