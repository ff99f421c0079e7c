"""Priors and guidance at their limits: sizes of cards and models, what an absent condition is, when coverage is old."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import json_schema
import pytest
import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError, UsageError
from gsopt.gaussians import Gaussians
from gsopt.sds import coverage, guidance_step, warp
from gsopt.sds import prompts as schema
from gsopt.sds.guidance_memory import CoverageRecord, GuidanceMemory
from gsopt.sds.guidance_step import Guidance
from gsopt.sds.policies import clipped, resized, wanted
from gsopt.sds.priors import clip, stable_diffusion, view_conditioned
from gsopt.sds.priors.protocol import Condition, _rescaled
from gsopt.sds.priors.view_conditioned import CARD_FILE, ViewPrior, condition_planes, confidence_weighted, read_card

COMMITTED = json.loads(Path(schema.__file__).with_name("prompts.schema.json").read_text(encoding="utf-8"))


def card(folder: Path, size: object) -> Path:
    (folder / CARD_FILE).write_text(json.dumps({"size": size}))
    return folder


@pytest.mark.parametrize("size", [16, 64, 1024])
def test_a_card_names_a_side_that_its_network_can_halve(tmp_path: Path, size: int) -> None:
    assert read_card(card(tmp_path, size)).size == size
    prior = ViewPrior(tmp_path, GuidanceConfig())
    assert (prior.size, prior.x0_limit, prior.aligned) == (size, 1.0, True)


@pytest.mark.parametrize("size", [0, 15, 17, 1025, 1040, 64.0, "64", None])
def test_a_card_of_another_side_is_refused(tmp_path: Path, size: object) -> None:
    with pytest.raises(InputError, match="Restore it"):
        read_card(card(tmp_path, size))


@pytest.mark.parametrize(("asked", "tried"), [(24, 16), (40, 32), (8, 16), (63, 48)])
def test_a_side_that_does_not_fit_is_refused_with_one_that_does(tmp_path: Path, asked: int, tried: int) -> None:
    with pytest.raises(UsageError, match=rf"multiple of 16 for this prior, got {asked}\. Try {tried}\."):
        ViewPrior(card(tmp_path, 64), GuidanceConfig(size=asked))


def test_pixels_of_a_view_prior_lie_between_minus_1_and_1(tmp_path: Path) -> None:
    prior = ViewPrior(card(tmp_path, 16), GuidanceConfig())
    images = torch.tensor([0.0, 0.25, 1.0]).expand(1, 3, 3)
    assert prior.encode(images)[0, 0].tolist() == [-1, -0.5, 1]
    assert torch.equal(prior.decode(prior.encode(images)), images)
    assert prior.decode(torch.tensor([-3.0, 3.0])).tolist() == [0, 1]


def test_an_absent_condition_is_gray_uncertain_and_without_references() -> None:
    planes = condition_planes(Condition(), 8)
    assert planes.shape == (view_conditioned.INPUT_CHANNELS - 3, 8, 8)
    assert planes[:4].abs().max() == 0
    assert planes[4].unique().tolist() == [1]
    assert planes[5:].abs().max() == 0
    render = torch.cat([torch.full((3, 8, 8), 0.75), torch.full((1, 8, 8), 0.5)])
    shown = condition_planes(Condition(render=render, uncertainty=torch.full((8, 8), 0.25)), 8)
    assert [float(plane.mean()) for plane in shown[:5]] == [0.5, 0.5, 0.5, 0.5, 0.25]


def test_colors_of_references_count_by_their_confidence() -> None:
    warped = torch.tensor([0.0, 0.5, 1.0, 0.25]).view(1, 4, 1, 1)
    assert confidence_weighted(warped).flatten().tolist() == [-0.25, 0, 0.25, 0.25]


def test_one_token_of_zeros_stands_for_no_text() -> None:
    tokens = view_conditioned.TextTokens.empty(2)
    assert tokens.tokens.shape == (2, 1, view_conditioned.TOKEN_WIDTH)
    assert not tokens.tokens.any()
    assert tokens.mask.all()
    width = view_conditioned.TOKEN_WIDTH
    rows = view_conditioned.TextTokens.from_conditions([Condition(tokens=torch.ones(3, width)), Condition()])
    assert rows.mask.tolist() == [[True] * 3, [True, False, False]]
    assert rows.tokens.sum((1, 2)).tolist() == [3 * width, 0]


def folder(unet: dict[str, Any], blocks: int | None = 4) -> Any:
    vae = {} if blocks is None else {"block_out_channels": [8] * blocks}
    return SimpleNamespace(unet=unet, vae=vae)


@pytest.mark.parametrize(
    ("unet", "blocks", "side"),
    [({"sample_size": 96}, 4, 768), ({"sample_size": [64, 48]}, 3, 256), ({}, None, 512), ({"sample_size": 0}, 1, 64)],
)
def test_the_side_of_a_model_is_that_of_its_latents_times_what_its_autoencoder_halves(
    unet: dict[str, Any], blocks: int | None, side: int
) -> None:
    assert stable_diffusion._side(folder(unet, blocks)) == side


@pytest.mark.parametrize(
    ("unet", "width"),
    [
        ({}, None),
        ({"class_embed_type": "projection", "projection_class_embeddings_input_dim": 1536}, 768),
        ({"class_embed_type": "projection"}, 1024),
    ],
)
def test_a_class_embedding_is_half_of_what_the_network_projects(unet: dict[str, Any], width: int | None) -> None:
    assert stable_diffusion._class_width(folder(unet)) == width


def test_a_gpu_is_taken_where_there_is_one_and_nobody_says_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    for available in (False, True):
        monkeypatch.setattr(torch.cuda, "is_available", lambda found=available: found)
        assert stable_diffusion.choose_device("auto").type == ("cuda" if available else "cpu")
        assert stable_diffusion.choose_device("cpu").type == "cpu"
        if available:
            assert stable_diffusion.choose_device("cuda").type == "cuda"
        else:
            with pytest.raises(UsageError, match="finds no GPU"):
                stable_diffusion.choose_device("cuda")


def test_an_error_of_a_library_is_cut_to_one_line_of_200_characters(tmp_path: Path) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise ValueError("x" * 300 + "\nsecond line")

    def silent(*_: Any, **__: Any) -> None:
        raise ValueError

    for module in (stable_diffusion, clip):
        for load, told in ((fails, "x" * 200), (silent, "ValueError")):
            kind = type("Network", (), {"from_pretrained": staticmethod(load)})
            args = (kind, tmp_path, torch.float32) if module is stable_diffusion else (kind, tmp_path)
            with pytest.raises(InputError) as caught:
                module._loaded(*args)  # type: ignore[arg-type]
            assert f": {told}. " in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_rescaling_mixes_with_the_contrast_of_the_conditional_half(share: float) -> None:
    random = torch.Generator().manual_seed(0)
    x0, conditional = (torch.randn(2, 3, 4, 4, generator=random) * scale + 1 for scale in (3.0, 0.5))
    expected = x0.clone()
    for row in range(2):
        ratio = conditional[row].std() / x0[row].std()
        full = x0[row].mean() + (x0[row] - x0[row].mean()) * ratio
        expected[row] = share * full + (1 - share) * x0[row]
    torch.testing.assert_close(_rescaled(x0, conditional, share), expected)


def test_rescaling_reaches_the_contrast_of_the_conditional_half_from_a_faint_image() -> None:
    random = torch.Generator().manual_seed(0)
    x0, conditional = (scale * torch.randn(1, 3, 4, 4, generator=random) for scale in (0.01, 0.5))
    assert float(_rescaled(x0, conditional, 1.0).std()) == pytest.approx(float(conditional.std()), rel=1e-4)


def test_images_are_given_to_clip_as_it_was_trained() -> None:
    seen: list[torch.Tensor] = []

    def model(pixels: torch.Tensor) -> Any:
        seen.append(pixels)
        return SimpleNamespace(image_embeds=pixels.mean((2, 3)))

    tower = clip.ImageTower(model, 4, clip.CLIP_MEAN, clip.CLIP_STD)
    images = torch.rand(20, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    found = tower.embeddings(images)
    assert [len(chunk) for chunk in seen] == [8, 8, 4]
    mean, std = (torch.tensor(values) for values in (clip.CLIP_MEAN, clip.CLIP_STD))
    torch.testing.assert_close(found, (images.mean((2, 3)) - mean) / std, atol=1e-5, rtol=0)


def test_the_numbers_of_clip_are_those_of_its_authors_unless_a_file_says_otherwise(tmp_path: Path) -> None:
    """Radford et al. 2021: the mean gray of photos, their spread, both a little larger for blue."""
    assert clip._normalization(tmp_path / "absent") == (clip.CLIP_MEAN, clip.CLIP_STD)
    file = tmp_path / "preprocessor_config.json"
    file.write_text(json.dumps({"image_mean": [0, 0.5, 1], "image_std": [1, 2, 3]}))
    assert clip._normalization(file) == ((0.0, 0.5, 1.0), (1.0, 2.0, 3.0))
    for broken in ("{", "[]", json.dumps({"image_mean": 1, "image_std": 1})):
        file.write_text(broken)
        assert clip._normalization(file) == (clip.CLIP_MEAN, clip.CLIP_STD)
    transformers = pytest.importorskip("transformers")
    from transformers.utils import constants

    assert transformers is not None
    assert tuple(constants.OPENAI_CLIP_MEAN) == clip.CLIP_MEAN
    assert tuple(constants.OPENAI_CLIP_STD) == clip.CLIP_STD


def disc(cosine: float, flat: float = 0.0) -> tuple[Gaussians, torch.Tensor]:
    """A disc in the plane z = 0, and an eye from which its normal lies at this cosine."""
    sizes = torch.tensor([[1.0, 1.0, max(flat, 1e-9)]])
    gaussians = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), sizes.log(), torch.zeros(1), torch.zeros(1, 1, 3),
        torch.zeros(1, 0, 3),
    )  # fmt: skip
    return gaussians, 5 * torch.tensor([math.sqrt(1 - cosine**2), 0, cosine])


@pytest.mark.parametrize(
    ("cosine", "flat", "share"),
    [(0.1, 0.0, 0.0), (0.05, 0.0, 0.0), (0.3, 0.0, 0.5), (0.2, 0.0, 0.15625), (0.5, 0.0, 1.0), (0.9, 0.0, 1.0),
     (-0.3, 0.0, 0.5), (0.1, 0.25, 0.25), (0.3, 0.5, 0.75)],
)  # fmt: skip
def test_a_disc_is_seen_by_a_smooth_step_from_edge_on_to_half_way(cosine: float, flat: float, share: float) -> None:
    """x = (|cos| - 0.1) / 0.4 and 3 x² - 2 x³; what is less flat is seen the more from the side."""
    gaussians, eye = disc(cosine, flat)
    assert float(coverage.facing(gaussians, eye)) == pytest.approx(share, abs=1e-5)


@pytest.mark.parametrize(("age", "anew"), [(0, False), (99, False), (100, True)])
def test_coverage_is_taken_anew_after_a_hundred_steps(age: int, anew: bool) -> None:
    asked: list[int] = []

    def take(step: int, gaussians: Any) -> CoverageRecord:
        asked.append(step)
        return CoverageRecord(step, torch.zeros(1), torch.zeros(1))

    memory = GuidanceMemory(coverage=CoverageRecord(7, torch.zeros(1), torch.zeros(1)))
    guidance: Any = SimpleNamespace(memory=memory, observer=SimpleNamespace(coverage=take))
    found = Guidance._coverage(guidance, 7 + age, None)  # type: ignore[arg-type]
    assert asked == ([7 + age] if anew else [])
    assert found.step == (7 + age if anew else 7)
    memory.coverage = None
    assert Guidance._coverage(guidance, 3, None).step == 3  # type: ignore[arg-type]


@pytest.mark.parametrize(("age", "kept"), [(0, True), (4, True), (5, False)])
def test_a_target_is_kept_until_it_is_as_old_as_it_may_be(age: int, kept: bool) -> None:
    memory = GuidanceMemory()
    images = torch.rand(1, 3, 2, 2, generator=torch.Generator().manual_seed(0))
    assert not memory.has_target(1, 0, 5)
    memory.keep_target(1, 10, images, 1 - images)
    assert memory.has_target(1, 10 + age, 5) == kept
    before, target = memory.target(1)
    torch.testing.assert_close(before, images, atol=0.5 / 255 + 1e-6, rtol=0)
    torch.testing.assert_close(target, 1 - images, atol=0.5 / 255 + 1e-6, rtol=0)


def test_a_third_failure_in_a_row_ends_guidance_and_says_so() -> None:
    told: list[str] = []
    guidance: Any = SimpleNamespace(memory=GuidanceMemory(), _warn=told.append)
    for _ in range(3):
        assert not guidance.memory.counts.ended
        Guidance._fail(guidance, 5, ValueError("x"))
    assert guidance.memory.counts.ended
    assert guidance.memory.counts.failed == 3
    assert [text.startswith("Step 5 is not guided: x") for text in told] == [True] * 3
    assert ["without guidance" in text for text in told] == [False, False, True]
    assert guidance_step.MAX_PSNR > 50


def test_the_confidence_of_a_warped_view_falls_with_its_distance_from_the_surface() -> None:
    """A camera that looks at itself, with a surface two hundredths farther away than the render's."""
    from gsopt.geometry.cameras import Cameras, intrinsics

    camera = Cameras(torch.eye(4)[None], intrinsics(0.8, 6, 6)[None].float(), 6, 6)
    depth = torch.full((6, 6), 2.0)
    image = torch.rand(1, 3, 6, 6, generator=torch.Generator().manual_seed(1))
    for farther, share in ((1.0, 1.0), (1 / 0.98, math.exp(-1)), (1 / 0.96, math.exp(-4))):
        found = warp.warp(
            camera, depth, torch.full((6, 6), 0.5), image, torch.ones(1, 1, 6, 6), farther * depth[None], camera
        )
        torch.testing.assert_close(found[0, :3], image[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(found[0, 3], torch.full((6, 6), 0.5 * share), atol=1e-3, rtol=0)


def test_a_change_of_a_twentieth_counts_half_and_one_that_was_passed_not_at_all() -> None:
    asked, target = torch.zeros(4), torch.tensor([0.05, -0.05, 0.15, 0.0])
    assert wanted(asked, asked, target).tolist() == pytest.approx([0.5, 0.5, 0.9, 0.0])  # type: ignore[arg-type]
    passed = torch.tensor([0.06, -0.04, 0.15, 1.0])
    assert wanted(passed, asked, target).tolist() == pytest.approx([0.0, 0.5, 0.0, 0.0])  # type: ignore[arg-type]


def test_a_gradient_is_cut_to_its_root_mean_square() -> None:
    g = torch.tensor([3.0, -4.0])
    rms = math.sqrt(12.5)
    torch.testing.assert_close(clipped(g, rms / 2), g / 2)  # type: ignore[arg-type]
    assert torch.equal(clipped(g, 0.0), g)  # type: ignore[arg-type]
    torch.testing.assert_close(clipped(g, 2 * rms), g)  # type: ignore[arg-type]
    weights = torch.arange(16.0).view(4, 4)
    assert resized(weights, torch.zeros(1, 4, 2, 2))[0, 0].tolist() == [[2.5, 4.5], [10.5, 12.5]]


@pytest.mark.parametrize(
    ("where", "most"),
    [("notes", 4000), ("object", 200), ("domain", 200), ("text", 1000), ("rationale", 4000), ("image prompt", 1000),
     ("image source", 200), ("template", 200), ("warning", 4000), ("prompts", 256), ("images", 64), ("warnings", 64)],
)  # fmt: skip
def test_texts_and_lists_may_be_as_long_as_the_committed_schema_says(where: str, most: int) -> None:
    def document(size: int) -> dict[str, Any]:
        text, prompt = "x" * size, {"text": "a"}
        made: dict[str, Any] = {"source": "user"}
        picture = {"file": "a.png"}
        changed: dict[str, dict[str, Any]] = {
            "text": {"prompts": [{"text": text}]},
            "rationale": {"prompts": [{**prompt, "rationale": text}]},
            "image prompt": {"images": [{**picture, "prompt": text}]},
            "image source": {"images": [{**picture, "source": text}]},
            "template": {"made": {**made, "template": text}},
            "warning": {"made": {**made, "warnings": [text]}},
            "warnings": {"made": {**made, "warnings": ["w"] * size}},
            "prompts": {"prompts": [prompt] * size},
            "images": {"images": [picture] * size},
        }
        return {"version": 1, "prompts": [prompt], **changed.get(where, {where: text})}

    assert json_schema.is_valid(document(most), COMMITTED)
    schema.set_from(document(most))
    assert not json_schema.is_valid(document(most + 1), COMMITTED)
    with pytest.raises(InputError):
        schema.set_from(document(most + 1))


def test_a_word_of_one_token_is_known_to_a_tokenizer_of_whole_words() -> None:
    tokenizer = SimpleNamespace(tokenize=lambda word: [word] if word in ("oak", "chair") else list(word))
    tower: Any = SimpleNamespace(tokenizer=tokenizer)
    encoder = clip.ClipEncoder("a", tower, None, None, whole_words=True)
    assert encoder.unknown_words("Oak chair, oaken chair_2 oaken") == ["oaken"]
    assert clip.ClipEncoder("a", tower, None, None).unknown_words("oaken") == []
