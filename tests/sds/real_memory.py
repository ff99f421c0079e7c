"""Memory of a guided step at the real size, counted per tensor on networks that compute nothing (fake tensors)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import real_sd21
import tiny_sd21
import torch
from real_step import size
from tensor_meter import Meter, Phase
from torch._subclasses.fake_tensor import FakeTensorMode

import gsopt.sds.priors.protocol
from gsopt.config.guidance import GuidanceConfig
from gsopt.sds import policies
from gsopt.sds.priors import stable_diffusion
from gsopt.sds.priors.folder import DiffusersFolder
from gsopt.sds.priors.protocol import Condition, Pair, Scale
from gsopt.sds.priors.stable_diffusion import DiffusersPrior


@dataclass(frozen=True)
class Account:
    """Bytes of one guided step."""

    weights: dict[str, int]
    phases: dict[str, Phase]

    @property
    def total(self) -> int:
        """Weights, and the most that is alive beside them."""
        return sum(self.weights.values()) + self.phases["step"].peak


def account(
    side: int,
    dtype: torch.dtype = torch.float16,
    *,
    checkpointed: bool = True,
    sequential: bool = False,
    tiny: bool = False,
    unet: dict[str, Any] = real_sd21.UNET,
    vae: dict[str, Any] = real_sd21.VAE,
) -> Account:
    """A step as `gsopt.sds.guidance_step` does: encode, two halves of classifier-free guidance, the encoder backwards;
    then the picture for the report."""
    prior = _prior(side, dtype, unet, vae)
    with FakeTensorMode(allow_non_fake_inputs=True), Meter() as meter:
        _give_networks(prior, tiny)
        if checkpointed and not tiny:
            stable_diffusion.recompute(prior.vae)
        images = torch.rand(1, 3, side, side).requires_grad_()
        with meter.phase("step"):
            step(prior, images, meter, sequential)
        with meter.phase("decode"):
            prior.decode(torch.rand(1, 4, side // 8, side // 8))
    phases = {phase.name: phase for phase in meter.phases}
    return Account({"unet": size(prior.unet), "vae": size(prior.vae)}, phases)


def step(prior: DiffusersPrior, images: torch.Tensor, meter: Meter, sequential: bool) -> None:
    with torch.enable_grad(), meter.phase("encode"):
        z = prior.encode(images)
    width = prior.folder.unet["cross_attention_dim"]
    look = policies.NoiseSample(
        t=500,
        eps=torch.randn(z.shape),
        pair=Pair(Condition(tokens=torch.rand(77, width)), Condition(tokens=torch.rand(77, width))),
        scale=Scale(3.0, 0.5, sequential),
    )
    inner = prior.denoise

    def denoise(*args: Any) -> Any:
        with meter.phase("denoise"):
            return inner(*args)

    prior.denoise = denoise  # type: ignore[method-assign]
    with pytest.MonkeyPatch.context() as patch:  # what looks at numbers, which fake tensors have not
        patch.setattr(gsopt.sds.priors.protocol, "_finite", lambda prior, x0, t: x0)
        patch.setattr(stable_diffusion, "padded_tokens", lambda rows: (torch.stack(rows), None))
        g = policies.sds(prior, z, look).g
    with meter.phase("backward"):
        torch.autograd.grad(z, images, g)


def _give_networks(prior: DiffusersPrior, tiny: bool) -> None:
    from diffusers import AutoencoderKL, AutoencoderTiny, UNet2DConditionModel

    usual = torch.get_default_dtype()
    torch.set_default_dtype(prior.dtype)
    try:
        vae = AutoencoderTiny() if tiny else AutoencoderKL(**prior.folder.vae)
        networks = {"unet": UNet2DConditionModel(**prior.folder.unet), "vae": vae}
    finally:
        torch.set_default_dtype(usual)
    prior.__dict__.update({name: network.eval().requires_grad_(False) for name, network in networks.items()})


def _prior(side: int, dtype: torch.dtype, unet: dict[str, Any], vae: dict[str, Any]) -> DiffusersPrior:
    folder = DiffusersFolder(Path(), "SD 2.1", unet, vae, tiny_sd21.SCHEDULER)
    prior = DiffusersPrior(folder, GuidanceConfig(size=side, dtype="float32", device="cpu"))
    prior.dtype = dtype
    return prior
