"""A prior that is taught words: its CLIP learns captions and says what it never met; what is said is heard."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from gsopt.cli import main
from gsopt.config.guidance import GuidanceConfig
from gsopt.finetune import captions, evaluation, reconstruction_pairs, run, serve_pairs
from gsopt.finetune.caption_tokens import encode_captions
from gsopt.finetune.clip import make_tokenizer
from gsopt.finetune.text_encoder import evaluate_encoder, make_encoder, scene_texts
from gsopt.sds.load_prior import open_prior
from gsopt.sds.priors.protocol import Condition
from gsopt.sds.priors.view_conditioned import TOKEN_WIDTH, TextTokens, make_unet, predict, zero_text_attention

pytest.importorskip("diffusers")
from in_process_farm import InProcess
from tiny_scenes import write_dataset

SIZE = 64
CAPTIONS = {"one": "a red cup", "two": "a blue table", "three": "a red table"}


@pytest.fixture(scope="module", autouse=True)
def short_fits() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruction_pairs, "STEP_COUNTS", (12,))
        patch.setattr(evaluation, "MAX_RENDERS", 2)
        patch.setattr(run, "open_farm", lambda name, cpus: InProcess(serve_pairs.handle))
        yield


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("told")
    for name, caption in CAPTIONS.items():
        write_dataset(root / name, train=6, test=2)
        views = {"train_000": f"{caption}, seen from above"}
        (root / name / "captions.json").write_text(json.dumps({"caption": caption, "views": views}))
        (root / name / "object.json").write_text(json.dumps({"name": caption.split()[-1], "category": "Kitchen"}))
    return root


def command(scenes: Path, out: Path, *more: str) -> list[str]:
    flags = ["--val", "three", "--fits", "1", "--size", str(SIZE), "--steps", "2", "--batch", "2", "--threads", "1"]
    return ["finetune", str(scenes), "-o", str(out), *flags, "--clip-steps", "12", *more]


@pytest.fixture(scope="module")
def prior(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    out = tmp_path_factory.mktemp("priors") / "told"
    assert main(command(scenes, out)) == 0
    yield out
    shutil.rmtree(out)  # 200 MB: the optimizer's state of every weight


def test_a_scene_is_described_by_what_lies_beside_it(scenes: Path, tmp_path: Path) -> None:
    said = captions.read_captions(scenes / "one")
    assert said[0] == "a red cup"
    assert {"a photo of a red cup", "cup, kitchen", "a red cup, back view", "a red cup, seen from above"} <= set(said)
    assert captions.read_captions(tmp_path) == ()
    (tmp_path / "captions.json").write_text(json.dumps({"caption": "A\u202e\nCup " + "x" * 999, "views": 3}))
    hostile = captions.read_captions(tmp_path)
    assert all(text.isprintable() and len(text) < 200 for text in hostile)
    assert hostile[0].startswith("a cup")


def test_every_word_that_was_met_is_one_token_and_no_other_is() -> None:
    words = "a small red chair seen from directly above teapot"
    tokenizer = make_tokenizer([words])
    assert [tokenizer.decode([i]).strip() for i in tokenizer(words).input_ids[1:-1]] == words.split()
    for unknown in ("femur", "chairs", "über", "中文"):
        assert len(tokenizer.tokenize(unknown)) > 1
        assert tokenizer.unk_token not in tokenizer.tokenize(unknown)


def test_a_prior_with_captions_takes_words_and_one_without_does_not(prior: Path, scenes: Path, tmp_path: Path) -> None:
    encoder = open_prior(str(prior), GuidanceConfig()).encoder()
    assert encoder is not None
    assert encoder.unknown_words("a red femur") == ["femur"]
    assert encoder.texts(["", "a red cup"]).shape == (2, encoder.max_tokens, TOKEN_WIDTH)
    assert encoder.alignment(["a red cup"], torch.rand(1, 3, 8, 8)) is None
    judged = open_prior(str(prior), GuidanceConfig(clip=str(prior / "clip"))).encoder()
    assert judged is not None
    assert judged.alignment(["a red cup"], torch.rand(1, 3, 8, 8)) is not None
    card = json.loads((prior / "gsopt_prior.json").read_text())["measured"]
    assert card["words"]["unknown_words"] == 0
    assert "render, references, words" in card["x0"]
    assert "small CLIP" in (prior / "README.md").read_text()
    assert main(command(scenes, tmp_path / "mute", "--clip-steps", "0")) == 0
    assert open_prior(str(tmp_path / "mute"), GuidanceConfig()).encoder() is None
    assert "takes no words" in (tmp_path / "mute" / "README.md").read_text()


def test_a_prior_keeps_the_words_of_the_one_it_starts_from(prior: Path, scenes: Path, tmp_path: Path) -> None:
    assert main(command(scenes, tmp_path / "next", "--base", str(prior))) == 0
    for file in (prior / "clip").iterdir():
        assert (tmp_path / "next" / "clip" / file.name).read_bytes() == file.read_bytes()


def test_what_is_said_reaches_the_network_and_silence_is_silence() -> None:
    """Filling up changes nothing; a deaf network hears nothing; one that is not deaf hears every token."""
    unet = make_unet(0)
    torch.nn.init.normal_(unet.conv_out.weight, std=0.1)
    x, t, planes = torch.randn(2, 3, 32, 32), torch.tensor([300, 300]), torch.zeros(2, 17, 32, 32)
    tokens = torch.randn(5, TOKEN_WIDTH, generator=torch.Generator().manual_seed(0))
    rows = [Condition(tokens=tokens), Condition(tokens=tokens[:3])]
    with torch.no_grad():
        both = predict(unet, x, t, planes, TextTokens.from_conditions(rows))
        alone = predict(unet, x[1:], t[1:], planes[1:], TextTokens.from_conditions(rows[1:]))
        torch.testing.assert_close(both[1:], alone, atol=1e-4, rtol=1e-3)
        silent = predict(unet, x, t, planes)
        torch.testing.assert_close(
            silent, predict(unet, x, t, planes, TextTokens.from_conditions([Condition(), Condition()]))
        )
        assert float((both - silent).abs().max()) > 1e-3
        zero_text_attention(unet)
        torch.testing.assert_close(
            predict(unet, x, t, planes, TextTokens.from_conditions(rows)), predict(unet, x, t, planes)
        )


def test_lessons_say_what_belongs_to_their_scene(prior: Path, scenes: Path) -> None:
    """Some rows are told nothing, some the empty text; whoever hears a text hears one of their scene."""
    cache = run.collect_pairs([scenes / "one", scenes / "two"], 1, SIZE, 0, prior / "pairs", None, print)  # type: ignore[arg-type]
    encoder = make_encoder(cache, run.PriorTrainingConfig(), prior / "clip", None, print)
    assert encoder is not None
    captions = encode_captions(encoder, cache, scene_texts(cache))
    rows = torch.arange(len(cache.pairs)).repeat(8)
    said = captions.sample(rows, torch.Generator().manual_seed(0))
    nothing = said.tokens.flatten(1).abs().sum(1) == 0
    empty = (said.tokens[:, :-1] == captions.tokens[0]).flatten(1).all(1)
    assert 0.1 < float(nothing.float().mean()) < 0.6
    assert 0.05 < float(empty.float().mean()) < 0.5
    for row in torch.nonzero(~nothing & ~empty)[:, 0].tolist():
        own = captions.texts[int(cache.scene[rows[row]])]
        assert any(torch.equal(said.tokens[row, :-1], captions.tokens[i]) for i in own)
    assert 0 <= evaluate_encoder(encoder, cache)["right_caption"] <= 1


def test_scenes_without_captions_and_scenes_that_cannot_be_fitted_are_left_out(scenes: Path, tmp_path: Path) -> None:
    """Five scenes, one without captions and one broken: the words are those of the others."""
    for name in (*CAPTIONS, "silent"):
        write_dataset(tmp_path / "data" / name, train=6, test=2)
        if name in CAPTIONS:
            (tmp_path / "data" / name / "captions.json").write_text(json.dumps({"caption": CAPTIONS[name]}))
    write_dataset(tmp_path / "data" / "broken", train=6, test=2)
    (tmp_path / "data" / "broken" / "captions.json").write_text(json.dumps({"caption": "a femur"}))
    for image in (tmp_path / "data" / "broken").rglob("*.png"):
        image.write_bytes(b"no picture")
    out = tmp_path / "prior"
    assert main(command(tmp_path / "data", out)) == 0
    encoder = open_prior(str(out), GuidanceConfig()).encoder()
    assert encoder is not None
    assert encoder.unknown_words("a red cup, a blue table, a femur") == ["femur"]


def test_a_run_tells_the_prior_its_prompt(prior: Path, scenes: Path, tmp_path: Path) -> None:
    """Different words, different Gaussians; the same words, the same bits."""
    found = []
    for number, prompt in enumerate(("a red cup", "a blue table", "a red cup")):
        flags = ["--iterations", "16", "--prior", str(prior), "--guidance.guard-views", "0", "--guidance.every", "2"]
        flags += ["--guidance.min-uncertainty", "0", "--init-count", "60", "--backend", "cpu", "--threads", "1"]
        run_folder = tmp_path / str(number)
        assert main(["train", str(scenes / "three"), "-m", str(run_folder), *flags, "--prompt", prompt]) == 0
        found.append((run_folder / "splat.ply").read_bytes())
    assert found[0] == found[2]
    assert found[0] != found[1]
