"""A pipeline in Stable Diffusion 2.1's layout behind the Prior interface."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import tiny_sd21
import torch
from analytic_priors import scale

from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError, NumericalError, UsageError
from gsopt.sds import policies
from gsopt.sds.load_prior import open_prior
from gsopt.sds.noise import eps_from
from gsopt.sds.priors import stable_diffusion
from gsopt.sds.priors.folder import find_folder
from gsopt.sds.priors.protocol import Condition, Pair, guided_x0
from gsopt.sds.priors.stable_diffusion import DiffusersPrior, choose_dtype, padded_tokens

CPU = torch.device("cpu")


def opened(folder: Path, **changes: object) -> DiffusersPrior:
    prior = open_prior(str(folder), GuidanceConfig(**changes))  # type: ignore[arg-type]
    assert isinstance(prior, DiffusersPrior)
    return prior


@pytest.fixture(scope="module")
def prior(sd21: Path) -> DiffusersPrior:
    return opened(sd21)


def tokens(seed: int, length: int = 77) -> torch.Tensor:
    return torch.randn(length, tiny_sd21.WIDTH, generator=torch.Generator().manual_seed(seed))


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def pair() -> Pair:
    return Pair(Condition(tokens=tokens(1)), Condition(tokens=tokens(2)))


def test_it_says_what_it_is(prior: DiffusersPrior) -> None:
    assert prior.prediction == "v_prediction"
    assert (prior.size, prior.class_embedding_width, len(prior.schedule)) == (tiny_sd21.SIZE, None, 1000)
    assert "v_prediction" in prior.name
    assert "float32 on cpu" in prior.name
    assert float(prior.schedule.alphas_cumprod[-1]) == pytest.approx(0.0047, abs=2e-4)  # SD 2.1's last step


def test_the_answer_is_that_of_the_pipelines_own_scheduler(prior: DiffusersPrior) -> None:
    """diffusers' DDIMScheduler converts the same output to the same x0 and eps."""
    from diffusers import DDIMScheduler

    x_t, t = noise(1, 4, 8, 8), torch.tensor([600])
    x0 = prior.denoise(x_t, t, [Condition(tokens=tokens(1))])
    with torch.no_grad():
        v = prior.unet(x_t, t, encoder_hidden_states=tokens(1)[None]).sample
    scheduler = DDIMScheduler.from_config(prior.folder.scheduler)
    scheduler.set_timesteps(1000)
    theirs = scheduler.step(v, 600, x_t)
    torch.testing.assert_close(x0, theirs.pred_original_sample, rtol=1e-4, atol=1e-4)
    signal = prior.schedule.signal(t, x_t)
    a = float(signal)
    torch.testing.assert_close(eps_from(x0, x_t, signal), a**0.5 * v + (1 - a) ** 0.5 * x_t, rtol=1e-4, atol=1e-4)


def test_pipelines_of_one_model_that_predict_eps_v_and_x0_agree(sd21_copy: Path, prior: DiffusersPrior) -> None:
    """The same U-Net's output, declared and rewritten as each kind, gives the same guidance."""
    from gsopt.sds.noise import output_for

    z, eps = noise(1, 4, 8, 8), noise(1, 4, 8, 8, seed=1)
    found = {}
    for kind in ("v_prediction", "epsilon", "sample"):
        tiny_sd21.write_json(
            sd21_copy / "scheduler" / "scheduler_config.json", {**tiny_sd21.SCHEDULER, "prediction_type": kind}
        )
        other = opened(sd21_copy)

        def unet(x_t, t, kind=kind, **conditions):
            x0 = prior.denoise(x_t, t, [Condition(tokens=row) for row in conditions["encoder_hidden_states"]])
            signal = prior.schedule.signal(t, x_t)
            output = output_for(x0, eps_from(x0, x_t, signal), signal, kind)
            return type("Output", (), {"sample": output})()

        other.__dict__["unet"] = unet
        seen = policies.NoiseSample(500, eps, pair(), scale(3.0))
        found[kind] = policies.sds(other, z, seen).g
    torch.testing.assert_close(found["epsilon"], found["v_prediction"], rtol=0, atol=1e-4)
    torch.testing.assert_close(found["sample"], found["v_prediction"], rtol=0, atol=1e-4)


def test_the_autoencoder_is_given_and_gives_colors_from_minus_1_to_1(sd21: Path, monkeypatch) -> None:
    prior = opened(sd21)
    images, given = torch.rand(1, 3, 64, 64), []
    images[..., 0, 0], images[..., 0, 1] = 0.0, 1.0

    def encode(x: torch.Tensor) -> SimpleNamespace:
        given.append(x)
        return SimpleNamespace(latents=x)

    monkeypatch.setattr(prior.vae, "encode", encode)
    monkeypatch.setattr(prior.vae, "decode", lambda x: SimpleNamespace(sample=x))
    back = prior.decode(prior.encode(images))
    assert (float(given[0].min()), float(given[0].max())) == (-1.0, 1.0)
    torch.testing.assert_close(back, images, rtol=0, atol=1e-6)


def test_no_gradient_reaches_any_network_and_one_reaches_the_image(sd21: Path) -> None:
    prior = opened(sd21)
    images = torch.rand(1, 3, 64, 64).requires_grad_()
    with torch.enable_grad():
        z = prior.encode(images)
        pull = policies.sds(prior, z, policies.NoiseSample(500, noise(1, 4, 8, 8), pair(), scale(3.0)))
        policies.loss(z, pull.g, torch.ones(1, 1, 8, 8)).backward()
    assert not pull.g.requires_grad
    assert images.grad is not None
    assert float(images.grad.abs().max()) > 0
    for network in (prior.unet, prior.vae):
        assert all(not p.requires_grad and p.grad is None for p in network.parameters())
        assert not network.training


def test_recomputed_encoder_blocks_give_the_same_gradient_and_keep_less(sd21: Path, monkeypatch) -> None:
    gradients, kept = [], []

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept[-1] += tensor.numel()
        return tensor

    for plain in (False, True):
        if plain:
            monkeypatch.setattr(stable_diffusion, "recompute", lambda vae: None)
        prior = opened(sd21)
        images = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0)).requires_grad_()
        kept.append(0)
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            z = prior.encode(images)
        z.square().sum().backward()
        gradients.append(images.grad)
    torch.testing.assert_close(gradients[0], gradients[1], rtol=0, atol=0)
    assert kept[0] < 0.5 * kept[1]


def test_the_encoders_gradient_is_the_central_difference(prior: DiffusersPrior) -> None:
    images = 0.5 + 0.2 * noise(1, 3, 64, 64).clamp(-2, 2)
    direction, probe = noise(1, 3, 64, 64, seed=3), noise(1, 4, 8, 8, seed=4)
    leaf = images.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((prior.encode(leaf) * probe).sum(), leaf)
    h = 1e-2
    with torch.no_grad():
        ahead, behind = ((prior.encode(images + s * h * direction) * probe).sum() for s in (1, -1))
    assert float((gradient * direction).sum()) == pytest.approx(float(ahead - behind) / (2 * h), rel=2e-2)


def test_halves_of_different_length_are_padded_and_the_padding_is_not_read(prior: DiffusersPrior) -> None:
    x_t, t = noise(1, 4, 8, 8), torch.tensor([500, 500])
    rows = [Condition(tokens=torch.cat([tokens(1), tokens(3, 2)])), Condition(tokens=tokens(2))]
    together = prior.denoise(x_t.repeat(2, 1, 1, 1), t, rows)
    for row, condition in enumerate(rows):
        alone = prior.denoise(x_t, t[:1], [condition])
        torch.testing.assert_close(together[row : row + 1], alone, rtol=1e-4, atol=1e-5)
    batch, mask = padded_tokens([tokens(1), tokens(2)])
    assert batch is not None
    assert batch.shape == (2, 77, tiny_sd21.WIDTH)
    assert mask is None


def test_guidance_of_one_calls_the_network_once_with_one_row(sd21: Path) -> None:
    prior, rows = opened(sd21), []
    prior.unet.register_forward_pre_hook(lambda module, args: rows.append(len(args[0])))
    for s, sequential in ((1.0, False), (3.0, False), (3.0, True)):
        guided_x0(prior, noise(1, 4, 8, 8), 500, pair(), scale(s, sequential=sequential))
    assert rows == [1, 2, 1, 1]


def test_a_class_embedding_is_given_where_the_model_has_one(unclip: Path) -> None:
    prior = opened(unclip)
    assert prior.class_embedding_width == tiny_sd21.WIDTH
    x_t, t = noise(1, 4, 8, 8), torch.tensor([500])
    embedding = torch.ones(tiny_sd21.WIDTH)
    with_image, without, other = (
        prior.denoise(x_t, t, [Condition(tokens=tokens(1), class_embedding=e)]) for e in (embedding, None, -embedding)
    )
    assert not torch.allclose(with_image, without)
    assert not torch.allclose(with_image, other)
    labels = prior._class_labels([Condition(class_embedding=embedding), Condition()])
    assert labels is not None
    assert labels.shape == (2, 2 * tiny_sd21.WIDTH)
    assert labels[0, tiny_sd21.WIDTH :].tolist() == [1.0] * 16 + [0.0] * 16  # cos 0 and sin 0: noise level 0
    assert labels[1].abs().max() == 0


def test_the_noise_level_is_the_one_of_diffusers() -> None:
    from diffusers.models.embeddings import get_timestep_embedding

    theirs = get_timestep_embedding(torch.tensor([0]), tiny_sd21.WIDTH, flip_sin_to_cos=True, downscale_freq_shift=0)
    assert theirs[0].tolist() == [1.0] * 16 + [0.0] * 16


def test_half_precision_weights_are_converted_for_a_cpu(sd21_copy: Path, prior: DiffusersPrior) -> None:
    from safetensors.torch import load_file, save_file

    for part in ("unet", "vae"):
        file = sd21_copy / part / "diffusion_pytorch_model.safetensors"
        save_file({k: v.half() for k, v in load_file(file).items()}, file, metadata={"format": "pt"})
    half = opened(sd21_copy)
    assert {p.dtype for p in half.unet.parameters()} | {p.dtype for p in half.vae.parameters()} == {torch.float32}
    x_t, t = noise(1, 4, 8, 8), torch.tensor([500])
    condition = [Condition(tokens=tokens(1))]
    torch.testing.assert_close(half.denoise(x_t, t, condition), prior.denoise(x_t, t, condition), rtol=0, atol=2e-2)


def test_bfloat16_answers_nearly_the_same(sd21: Path, prior: DiffusersPrior) -> None:
    small = opened(sd21, dtype="bfloat16")
    x_t, t = noise(1, 4, 8, 8), torch.tensor([500])
    answers = [p.denoise(x_t, t, [Condition(tokens=tokens(1))]) for p in (small, prior)]
    assert answers[0].dtype == torch.float32
    torch.testing.assert_close(*answers, rtol=0, atol=0.1)


def test_a_tiny_autoencoder_takes_the_place_of_the_vae(sd21: Path, tmp_path: Path) -> None:
    from diffusers import AutoencoderTiny

    config = {"encoder_block_out_channels": (8,) * 4, "decoder_block_out_channels": (8,) * 4}
    AutoencoderTiny(**config, num_encoder_blocks=(1,) * 4, num_decoder_blocks=(1,) * 4).save_pretrained(
        tmp_path / "taesd"
    )
    prior = opened(sd21, tiny_vae=str(tmp_path / "taesd"))
    images = torch.rand(1, 3, 64, 64).requires_grad_()
    z = prior.encode(images)
    assert z.shape == (1, 4, 8, 8)
    z.sum().backward()
    assert float(images.grad.abs().max()) > 0
    assert prior.decode(z.detach()).shape == (1, 3, 64, 64)


def test_the_text_encoder_is_not_kept_and_nothing_loads_before_it_is_needed(sd21: Path) -> None:
    prior = opened(sd21)
    encoder = prior.encoder()
    assert encoder is not None
    assert encoder.texts(["a chair"]).shape == (1, 77, tiny_sd21.WIDTH)
    assert not {"unet", "vae"} & set(vars(prior))
    assert not any(value is encoder for value in vars(prior).values())


def test_nan_from_the_network_is_named(sd21: Path) -> None:
    prior = opened(sd21)
    with torch.no_grad():
        prior.unet.conv_out.bias.fill_(float("nan"))
    with pytest.raises(NumericalError, match=r"tiny-sd21.*nan.*float32"):
        guided_x0(prior, noise(1, 4, 8, 8), 500, pair(), scale(3.0))


@pytest.mark.parametrize(
    ("name", "device", "size", "dtype"),
    [
        ("auto", "cpu", 1 << 20, torch.float32),
        ("auto", "cuda", 2 << 30, torch.float16),
        ("bfloat16", "cpu", 1, torch.bfloat16),
        ("float32", "cuda", 1, torch.float32),
    ],
)
def test_the_number_format_follows_device_and_size(name: str, device: str, size: int, dtype: torch.dtype) -> None:
    assert choose_dtype(name, torch.device(device), size) == dtype


@pytest.mark.parametrize(("capability", "dtype"), [("AVX512", torch.bfloat16), ("AVX2", torch.float32)])
def test_large_models_are_halved_where_the_cpu_is_fast_at_it(
    capability: str, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    assert choose_dtype("auto", torch.device("cpu"), 2 << 30) == dtype
    assert choose_dtype("auto", torch.device("cpu"), 1 << 20) == torch.float32


def test_half_precision_on_a_cpu_is_a_usage_error(sd21: Path) -> None:
    with pytest.raises(UsageError, match="bfloat16"):
        opened(sd21, dtype="float16")


def test_a_size_the_autoencoder_cannot_have_is_a_usage_error(sd21: Path) -> None:
    with pytest.raises(UsageError, match="multiple of 8"):
        opened(sd21, size=60)


def test_an_unknown_prediction_is_an_input_error(sd21_copy: Path) -> None:
    file = sd21_copy / "scheduler" / "scheduler_config.json"
    tiny_sd21.write_json(file, {**tiny_sd21.SCHEDULER, "prediction_type": "flow"})
    with pytest.raises(InputError, match="flow"):
        opened(sd21_copy)


def test_a_whole_pipeline_of_diffusers_loads_the_same_folder(sd21: Path) -> None:
    """The layout is the real one: the stock pipeline takes it."""
    from diffusers import StableDiffusionPipeline

    pipeline = StableDiffusionPipeline.from_pretrained(str(sd21), local_files_only=True, feature_extractor=None)
    pipeline.set_progress_bar_config(disable=True)
    image = pipeline("a chair", num_inference_steps=2, height=64, width=64, output_type="np").images
    assert image.shape == (1, 64, 64, 3)
    folder = find_folder(str(sd21))
    assert replace(folder, name="x").takes_text
