"""`gsopt prompts`: fast and light without a model, reviewed by the expert, read by training."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from scripted_server import completion, serving
from tiny_scenes import write_dataset

from gsopt import cli
from gsopt.config.guidance import GuidanceConfig
from gsopt.errors import InputError
from gsopt.llm_prompts.review import ReviewAborted, edited, review
from gsopt.sds.prompts import Prompt, PromptSet, ReferenceImage, read_set, write_set
from gsopt.training.guided.references import reference_paths
from gsopt.training.guided.start import require_guidance

NOTES = ["--notes", "femur, osteoporotic, CT", "--domain", "medicine"]
HEAVY = {"torch", "numpy", "PIL", "pydantic", "tokenizers", "transformers", "diffusers", "urllib.request"}


def run(folder: Path, *more: str) -> int:
    return cli.main(["prompts", *NOTES, "-o", str(folder / "prompts.json"), *more])


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Puts lines where the expert's keyboard is."""

    def install(lines: str) -> None:
        keys: Iterator[str] = iter(lines.split("|"))

        def ask(prompt: str = "") -> str:
            try:
                return next(keys)
            except StopIteration as end:
                raise EOFError from end

        monkeypatch.setattr(builtins, "input", ask)

    return install


def test_without_a_model_nothing_heavy_is_loaded(tmp_path: Path) -> None:
    """Looked at in an interpreter of its own: tests of other folders have long loaded torch here."""
    import subprocess
    import sys

    code = (
        "import sys, gsopt.cli\n"
        f"assert gsopt.cli.main(['prompts', *{NOTES}, '--llm', 'none', '-o', 'p.json']) == 0\n"
        f"assert not {HEAVY} & set(sys.modules), {HEAVY} & set(sys.modules)\n"
        "import urllib.request  # the check would notice\n"
        f"assert {HEAVY} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(read_set(tmp_path / "p.json").prompts) == 12


def test_same_words_same_file(tmp_path: Path) -> None:
    assert run(tmp_path) == 0
    first = (tmp_path / "prompts.json").read_bytes()
    assert run(tmp_path, "--force") == 0
    assert (tmp_path / "prompts.json").read_bytes() == first
    assert not (tmp_path / "prompts.raw.json").exists()


def test_the_file_says_what_it_is(tmp_path: Path) -> None:
    run(tmp_path)
    made = read_set(tmp_path / "prompts.json")
    assert (made.notes, made.object, made.domain, made.reviewed) == (NOTES[1], "femur", "medicine", False)
    assert made.made is not None
    assert made.made.source == "template"
    assert [prompt.source for prompt in made.prompts] == ["user"] + ["template"] * 11


def test_the_category_wins_over_the_noun_that_is_found(tmp_path: Path) -> None:
    run(tmp_path, "--category", "thigh bone", "-n", "2")
    made = read_set(tmp_path / "prompts.json")
    assert made.object == "thigh bone"
    assert any("a thigh bone" in prompt.text for prompt in made.prompts)


def test_the_review_accepts_edits_rejects_and_goes_back(tmp_path: Path, typed) -> None:
    run(tmp_path, "-n", "2", "--negatives", "1")
    before = read_set(tmp_path / "prompts.json").prompts
    typed("r|b|a|e|a femur with a healed fracture|w|2.5|v|back|a|x|r|all")
    assert cli.main(["prompts", "review", str(tmp_path / "prompts.json")]) == 0
    after = read_set(tmp_path / "prompts.json")
    assert after.reviewed
    mine = Prompt("a femur with a healed fracture", 2.5, "back", rationale=f"edited; template wrote: {before[1].text}")
    assert after.prompts == (before[0], mine, before[3])


@pytest.mark.parametrize("lines", ["a|a", "a|q", ""])
def test_a_review_that_is_left_changes_nothing(tmp_path: Path, typed, capsys, lines: str) -> None:
    run(tmp_path)
    before = (tmp_path / "prompts.json").read_bytes()
    typed(lines)
    assert cli.main(["prompts", "review", str(tmp_path / "prompts.json")]) == 2
    assert (tmp_path / "prompts.json").read_bytes() == before
    assert "as it was" in capsys.readouterr().err


def test_review_right_after_writing(tmp_path: Path, typed) -> None:
    typed("a|all")
    assert run(tmp_path, "--review") == 0
    assert read_set(tmp_path / "prompts.json").reviewed


def test_an_answer_that_cannot_be_used_asks_again(capsys) -> None:
    lines = iter(["w", "much", "v", "below", "e", "x" * 2000, "a"])
    said: list[str] = []
    everything = PromptSet((Prompt("a chair"),))
    assert review(everything, lambda _: next(lines), said.append).prompts == everything.prompts
    assert sum("got" in line for line in said) == 3


def test_a_picture_is_used_only_when_it_is_accepted_in_so_many_words() -> None:
    everything = PromptSet(images=tuple(ReferenceImage(f"{i}.png") for i in range(5)))
    answers = iter(["", "r", "what?", "a", "y", "n"])
    reviewed = review(everything, lambda _: next(answers), lambda _: None)
    assert [picture.accepted for picture in reviewed.images] == [False, False, True, True, False]
    with pytest.raises(ReviewAborted):
        review(everything, lambda _: "q", lambda _: None)


def test_an_edited_prompt_is_the_experts_and_an_unchanged_one_is_not() -> None:
    prompt = Prompt("a chair", source="llm:m", rationale="why", score=0.3)
    assert edited(prompt, " a  chair ") == prompt
    assert edited(prompt, "a stool") == Prompt("a stool", rationale="edited; llm:m wrote: a chair")
    with pytest.raises(InputError):
        edited(prompt, "a \x1b chair")


def test_training_reads_the_prompts_and_the_pictures_that_were_accepted(tmp_path: Path) -> None:
    pictures = (ReferenceImage("prompts-images/001.png", accepted=True), ReferenceImage("prompts-images/002.png"))
    (tmp_path / "prompts-images").mkdir()
    for picture in pictures:
        Image.new("RGB", (8, 8)).save(tmp_path / picture.file)
    write_set(tmp_path / "prompts.json", PromptSet((Prompt("a chair"),), images=pictures))
    config = GuidanceConfig(prompts=str(tmp_path / "prompts.json"), prior="a/b", ref_image=("mine.png",))
    accepted = str(tmp_path / "prompts-images" / "001.png")
    assert reference_paths(config) == ("mine.png", accepted)
    old = replace(config, ref_image=("mine.png", accepted))  # a run of gsopt 0.1.0 recorded both
    assert reference_paths(old) == ("mine.png", accepted)
    require_guidance(config)
    (tmp_path / "prompts.json").write_text("{}")
    with pytest.raises(InputError):
        require_guidance(config)


@pytest.mark.parametrize("with_prior", [False, True])
def test_views_and_a_clip_score_the_prompts(
    tmp_path: Path, photo: Path, sd21: Path, clip_folder: Path, with_prior: bool
) -> None:
    models = ["--clip", str(clip_folder), "--images", str(photo.parent)]
    assert run(tmp_path, *models, *(["--prior", str(sd21)] if with_prior else [])) == 0
    prompts = read_set(tmp_path / "prompts.json").prompts
    assert all((prompt.score is not None) == (prompt.polarity == "positive") for prompt in prompts)
    assert len({prompt.score for prompt in prompts if prompt.score is not None}) > 1


@pytest.mark.parametrize("with_prior", [False, True])
def test_without_a_joint_space_nothing_is_scored_and_it_is_said(
    tmp_path: Path, photo: Path, sd21: Path, with_prior: bool
) -> None:
    assert run(tmp_path, "--images", str(photo), *(["--prior", str(sd21)] if with_prior else [])) == 0
    made = read_set(tmp_path / "prompts.json")
    assert {prompt.score for prompt in made.prompts} == {None}
    assert made.made is not None
    assert any("not scored" in warning for warning in made.made.warnings)


def test_a_clip_that_cannot_be_opened_stops_before_the_model_is_asked(tmp_path: Path, photo: Path) -> None:
    """Answers may cost money, and they would be lost."""
    with serving([completion("{}")]) as server:
        models = ["--llm", server.url, "--model", "m", "--clip", str(tmp_path / "none"), "--images", str(photo)]
        assert run(tmp_path, *models) in (2, 3)
    assert server.asked == []
    assert not (tmp_path / "prompts.json").exists()


def test_a_dataset_gives_its_input_views(tmp_path: Path) -> None:
    from gsopt.llm_prompts.expert_images import KEPT_SIDE, MAX_SENT_IMAGES, read_views, to_jpegs, to_squares

    scene = write_dataset(tmp_path / "cloud", train=20)
    views = read_views([scene])
    assert 4 <= len(views) <= 8
    assert all(max(view.size) <= KEPT_SIDE and view.mode == "RGB" for view in views)
    assert views[0].getpixel((0, 0)) == (255, 255, 255)  # transparent pixels are white
    assert 1 <= len(to_jpegs(views)) <= MAX_SENT_IMAGES
    assert to_squares(views, 16).shape == (len(views), 3, 16, 16)
    assert to_squares(views, 16)[0, :, 0, 0].tolist() == [1, 1, 1]


def test_a_prior_that_cannot_exist_is_a_usage_error(tmp_path: Path, capsys) -> None:
    assert run(tmp_path, "--prior", "no such thing") == 2
    assert "--prior" in capsys.readouterr().err


def test_a_hub_id_that_is_not_on_this_machine_is_not_fetched(tmp_path: Path, capsys) -> None:
    assert run(tmp_path, "--prior", "nobody/nothing-of-this-name") == 0
    assert "estimate" in capsys.readouterr().out


def test_invisible_characters_of_a_file_do_not_reach_the_terminal() -> None:
    from gsopt.llm_prompts.review import line

    assert line(1, 1, Prompt("a \u202echair\nof \u200boak")).endswith("  a chair of oak")


@pytest.mark.parametrize("broken", ["absent.png", "text.png", "empty"])
def test_photos_that_cannot_be_read_are_named(tmp_path: Path, capsys, broken: str) -> None:
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "empty").mkdir()
    assert run(tmp_path, "--images", str(tmp_path / broken)) == 3
    assert broken in capsys.readouterr().err
    assert not (tmp_path / "prompts.json").exists()


def test_pictures_from_prompts_are_drawn_shown_and_not_accepted(tmp_path: Path, sd21: Path, capsys) -> None:
    draw = ["--images-from-prompts", "2", "--image-steps", "2", "--prior", str(sd21)]
    assert run(tmp_path, *draw) == 0
    made = read_set(tmp_path / "prompts.json")
    assert [picture.accepted for picture in made.images] == [False, False]
    assert [picture.prompt for picture in made.images] == [prompt.text for prompt in made.prompts[:2]]
    drawn = [(tmp_path / picture.file).read_bytes() for picture in made.images]
    with Image.open(tmp_path / made.images[0].file) as image:
        assert image.size == (64, 64)
    assert drawn[0] != drawn[1]
    assert run(tmp_path, *draw, "--force") == 0  # same seed, same pictures; those of before are kept
    again = read_set(tmp_path / "prompts.json").images
    assert [(tmp_path / picture.file).read_bytes() for picture in again] == drawn
    assert len(list((tmp_path / "prompts-images").glob("*.png"))) == 4
    page = (tmp_path / "prompts-images" / "index.html").read_text(encoding="utf-8")
    assert all(f'src="{Path(picture.file).name}"' in page and picture.prompt in page for picture in again)


def test_a_prior_that_cannot_draw_says_so_and_the_prompts_are_written_all_the_same(tmp_path: Path, capsys) -> None:
    assert run(tmp_path, "--images-from-prompts", "2") == 0
    assert "--prior sd21" in capsys.readouterr().out
    assert read_set(tmp_path / "prompts.json").images == ()


def test_json_of_the_file_is_readable_by_hand(tmp_path: Path) -> None:
    run(tmp_path, "--notes", "Stuhl, Eiche, geölt")
    text = (tmp_path / "prompts.json").read_text(encoding="utf-8")
    assert "geölt" in text
    assert list(json.loads(text)) == ["version", "notes", "object", "domain", "reviewed", "made", "prompts", "images"]
