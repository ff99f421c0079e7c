"""Words and pictures become tokens: the right ones for a side, with the right share, the same after saving."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_sd21
import torch
from safetensors import safe_open
from safetensors.torch import save

from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError
from gsopt.sds.conditioning import VIEW_WORDS, Conditioning, encode, with_view_word
from gsopt.sds.load_prior import open_prior
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import Encoder
from gsopt.sds.prompts import Prompt

NOTHING = torch.empty(0, 3, 8, 8)


class FakeEncoder:
    """Every text is one token that tells its length; images are their mean color; alignment is what the test says."""

    name = "fake"
    max_tokens = 77

    def __init__(
        self,
        width: int = 3,
        aligned: dict[str, float] | None = None,
        has_images: bool = True,
        unknown: tuple[str, ...] = (),
    ) -> None:
        self.width, self.aligned, self.has_images, self.unknown = width, aligned, has_images, unknown

    def unknown_words(self, text: str) -> list[str]:
        return [word for word in text.split() if word in self.unknown]

    def texts(self, texts):
        return torch.tensor([[[float(len(text) + 1)] * self.width] * 2 for text in texts])

    def length(self, text: str) -> int:
        return len(text.split()) + 2

    def images(self, images):
        return images.mean((2, 3)) + 0.1 if self.has_images else None

    def alignment(self, texts, images):
        if self.aligned is None:
            return None
        return torch.tensor([[self.aligned.get(text, 0.2)] * len(images) for text in texts])


def made(prompts, encoder=None, inputs=NOTHING, references=NOTHING, weight=0.5, width=None) -> Conditioning:
    return encode(encoder or FakeEncoder(), prompts, inputs, references, weight, width)


def drawn(conditioning: Conditioning, side: str, count: int = 400) -> Counter:
    return Counter(conditioning.draw(side, generator(0, i, 0, "prompt")).text for i in range(count))


@pytest.mark.parametrize("side", ["", *VIEW_WORDS])
def test_a_prompt_gets_the_word_of_its_side(side: str) -> None:
    found = made([Prompt("a chair")]).draw(side, generator(0, 0, 0, "prompt"))
    assert found.text == (f"a chair, {VIEW_WORDS[side]}" if side else "a chair")
    assert found.positive is not None
    assert float(found.positive[0, 0]) == len(found.text) + 1


def test_a_prompt_for_one_side_is_drawn_there_only() -> None:
    conditioning = made([Prompt("a chair"), Prompt("its carved back", view="back")])
    assert set(drawn(conditioning, "front")) == {"a chair, front view"}
    assert set(drawn(conditioning, "back")) == {"a chair, back view", "its carved back, back view"}
    assert set(drawn(conditioning, "")) == {"a chair"}


def test_weights_are_shares_of_the_draws() -> None:
    counts = drawn(made([Prompt("a", weight=3), Prompt("b", weight=1), Prompt("c", weight=0)]), "", 2000)
    assert counts["c"] == 0
    assert counts["a"] / 2000 == pytest.approx(0.75, abs=0.04)


def test_negatives_make_the_negative_half_and_the_empty_text_stands_in_for_them() -> None:
    for prompts, text in (([Prompt("ok"), Prompt("blurry", polarity="negative")], "blurry"), ([Prompt("ok")], "")):
        found = made(prompts).draw("", generator(0, 0, 0, "prompt"))
        assert found.negative is not None
        assert float(found.negative[0, 0]) == len(text) + 1
        assert found.text == "ok"


def test_a_negative_prompt_does_not_change_which_positive_is_drawn() -> None:
    positives = [Prompt("a"), Prompt("bb")]
    assert drawn(made(positives), "") == drawn(made([*positives, Prompt("c", polarity="negative")]), "")


def test_the_same_key_draws_the_same() -> None:
    conditioning = made([Prompt("a"), Prompt("b")])
    texts = [conditioning.draw("", generator(3, 7, 1, "prompt")).text for _ in range(3)]
    assert len(set(texts)) == 1


def test_image_tokens_are_appended_with_the_rms_of_the_text() -> None:
    inputs, references = torch.rand(4, 3, 8, 8), torch.rand(2, 3, 8, 8)
    conditioning = made([Prompt("a chair")], inputs=inputs, references=references, weight=0.5)
    assert conditioning.image_tokens is not None
    assert conditioning.tokens is not None
    assert len(conditioning.image_tokens) == 3  # the inputs' mean, and one each
    rms = conditioning.image_tokens.square().mean(1).sqrt()
    torch.testing.assert_close(rms, torch.full((3,), 0.5 * float(conditioning.tokens.square().mean().sqrt())))
    found = conditioning.draw("", generator(0, 0, 0, "prompt"))
    assert found.positive is not None
    assert found.negative is not None
    assert (len(found.positive), len(found.negative)) == (2 + 3, 2)


def test_no_weight_means_no_image_tokens() -> None:
    assert made([], inputs=torch.rand(4, 3, 8, 8), weight=0.0).image_tokens is None


def test_a_class_embedding_is_the_mean_where_the_width_fits() -> None:
    inputs = torch.rand(4, 3, 8, 8)
    found = made([], inputs=inputs, width=3).class_embedding
    torch.testing.assert_close(found, inputs.mean((0, 2, 3)) + 0.1)
    assert made([], inputs=inputs, width=7).class_embedding is None
    assert made([], inputs=inputs, width=None).class_embedding is None


def test_what_cannot_be_used_is_said() -> None:
    image = torch.rand(1, 3, 8, 8)
    assert any("--guidance.clip" in n for n in made([], FakeEncoder(has_images=False), references=image).notes)
    wider = made([], FakeEncoder(width=5), references=image)
    assert wider.image_tokens is None
    assert any("left out" in n for n in wider.notes)
    assert any("no words" in n for n in encode(None, [Prompt("a")], NOTHING, NOTHING, 0.5, None).notes)
    assert encode(None, [], NOTHING, NOTHING, 0.5, None).notes == ()


def test_a_badly_aligned_prompt_is_scored_and_warned_about() -> None:
    encoder = FakeEncoder(aligned={"a chair": 0.3, "a fish": 0.1})
    found = made(
        [Prompt("a chair"), Prompt("a fish"), Prompt("x", polarity="negative")], encoder, torch.rand(2, 3, 8, 8)
    )
    assert [prompt.score for prompt in found.prompts] == [pytest.approx(0.3), pytest.approx(0.1), None]
    assert [("fish" in note, "chair" in note) for note in found.notes] == [(True, False)]


def test_words_that_were_never_met_are_named_and_not_scored() -> None:
    """A score would only say how their letters sound to the encoder."""
    encoder = FakeEncoder(aligned={"a femur": 0.1}, unknown=("femur",))
    found = made([Prompt("a femur"), Prompt("a chair")], encoder, torch.rand(2, 3, 8, 8))
    assert [prompt.score for prompt in found.prompts] == [None, pytest.approx(0.2)]
    assert [note for note in found.notes if "'femur'" in note and "--prior" in note]
    assert not [note for note in found.notes if "chair" in note]


def test_a_long_prompt_is_cut_and_said_to_be() -> None:
    notes = made([Prompt("word " * 100), Prompt("short")]).notes
    assert len(notes) == 1
    assert "102 tokens" in notes[0]


def test_saved_and_loaded_is_the_identity(tmp_path: Path) -> None:
    prompts = [Prompt("a chair 🪑", weight=2, score=None), Prompt("x", polarity="negative")]
    before = made(prompts, inputs=torch.rand(4, 3, 8, 8), width=3)
    before.save(tmp_path / "conditioning.safetensors")
    after = Conditioning.load(tmp_path / "conditioning.safetensors")
    tensors = ("tokens", "image_tokens", "class_embedding")
    for name in tensors:
        assert torch.equal(getattr(after, name), getattr(before, name))
    nothing = dict.fromkeys(tensors)
    assert replace(after, **nothing) == replace(before, **nothing)
    empty = encode(None, [], NOTHING, NOTHING, 0.5, None)
    empty.save(tmp_path / "empty.safetensors")
    assert Conditioning.load(tmp_path / "empty.safetensors") == empty


@pytest.mark.parametrize("data", [b"", b"not a file of tensors", b"\x02\x00\x00\x00\x00\x00\x00\x00{}"])
def test_a_broken_file_is_an_input_error(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "c.safetensors").write_bytes(data)
    with pytest.raises(InputError, match=r"c\.safetensors"):
        Conditioning.load(tmp_path / "c.safetensors")


@pytest.mark.parametrize("version", [0, 2, None])
def test_another_version_is_refused(tmp_path: Path, version: int | None) -> None:
    path = tmp_path / "c.safetensors"
    conditioning = made([Prompt("a chair")])
    conditioning.save(path)
    with safe_open(path, framework="pt") as file:
        document = json.loads(file.metadata()["gsopt"])
    assert document["version"] == 1
    tensors = {"tokens": conditioning.tokens}
    path.write_bytes(save(tensors, metadata={"gsopt": json.dumps({**document, "version": version})}))
    with pytest.raises(InputError, match=rf"c\.safetensors \(version {version} instead of 1\)"):
        Conditioning.load(path)


@pytest.fixture(scope="module")
def real(sd21: Path) -> Encoder:
    encoder = open_prior(str(sd21), GuidanceConfig()).encoder()
    assert encoder is not None
    return encoder


def test_the_legacy_tokenizer_tells_words_apart_and_pads_as_it_says(real: Encoder) -> None:
    """transformers 5 builds a vocabulary of two tokens out of the same files when they are passed the wrong way."""
    tower = real._text  # type: ignore[attr-defined]
    ids = tower.ids(["a red chair", "a blue chair", ""])
    assert len(tower.tokenizer) > 500
    assert not torch.equal(ids[0], ids[1])
    pad = tower.tokenizer.convert_tokens_to_ids("!")
    assert (tower.tokenizer.pad_token, int(ids[2, -1])) == ("!", pad)
    assert tower.tokenizer.tokenize("a red chair") == ["a</w>", "red</w>", "chair</w>"]


def test_hidden_states_are_those_of_the_text_model(sd21: Path, real: Encoder) -> None:
    """Old checkpoints carry a key prefix and half precision: both must arrive as float32 values, not as fresh noise."""
    from safetensors.torch import load_file

    tower = real._text  # type: ignore[attr-defined]
    stored = load_file(sd21 / "text_encoder" / "model.safetensors")
    key = "text_model.embeddings.token_embedding.weight"
    loaded = next(v for k, v in tower.model.state_dict().items() if k.endswith("token_embedding.weight"))
    assert loaded.dtype == torch.float32
    torch.testing.assert_close(loaded, stored[key].float())
    hidden = real.texts(["a red chair", "a blue chair"])
    assert hidden.shape == (2, 77, tiny_sd21.WIDTH)
    assert not torch.allclose(hidden[0], hidden[1])


@pytest.mark.parametrize("text", ["🪑", "椅子", "a\nchair", "a" * 1000, "!!!", "<|endoftext|>"])
def test_any_text_that_the_schema_lets_through_can_be_encoded(real: Encoder, text: str) -> None:
    found = encode(real, [Prompt(text)], NOTHING, NOTHING, 0.5, None)
    assert found.tokens is not None
    assert bool(torch.isfinite(found.tokens).all())
    assert real.max_tokens == 77
    assert (real.length(text) > 77) == (len(text) == 1000) == bool(found.notes)


def test_an_image_encoder_in_the_folder_is_used(unclip: Path) -> None:
    prior = open_prior(str(unclip), GuidanceConfig())
    encoder, images = prior.encoder(), torch.rand(3, 3, 64, 64)
    assert encoder is not None
    found = encode(encoder, [Prompt("a chair")], images, images[:1], 0.5, prior.class_embedding_width)
    assert found.image_tokens is not None
    assert found.image_tokens.shape == (2, tiny_sd21.WIDTH)
    assert found.class_embedding is not None
    assert found.class_embedding.shape == (tiny_sd21.WIDTH,)
    assert encoder.alignment(["a chair"], images) is None
    assert not torch.allclose(encoder.images(images)[0], encoder.images(1 - images)[0])  # type: ignore[index]


def test_a_whole_clip_scores_prompts(sd21: Path, clip_folder: Path) -> None:
    encoder = open_prior(str(sd21), GuidanceConfig(clip=str(clip_folder))).encoder()
    assert encoder is not None
    images = torch.rand(2, 3, 64, 64)
    cosines = encoder.alignment(["a red chair", "a blue chair"], images)
    assert cosines is not None
    assert cosines.shape == (2, 2)
    assert float(cosines.abs().max()) <= 1 + 1e-6
    scored = encode(encoder, [Prompt("a red chair")], images, NOTHING, 0.5, None).prompts
    assert scored[0].score == pytest.approx(float(cosines[0].mean()), abs=1e-4)


def test_without_clip_there_is_no_score_and_no_image_embedding(real: Encoder) -> None:
    assert real.alignment(["a"], torch.rand(1, 3, 64, 64)) is None
    assert real.images(torch.rand(1, 3, 64, 64)) is None
    assert with_view_word(Prompt("a"), "") == "a"
