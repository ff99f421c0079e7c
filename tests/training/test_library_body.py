"""Runs on one photo whose other sides follow a shape library."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from balls import Ball, ring, write_balls
from tiny_scenes import tiny_config

from gsopt.config.guidance import GuidanceConfig, library_of
from gsopt.config.train import InitConfig, SparseConfig, TrainConfig
from gsopt.errors import InputError
from gsopt.events import read_events
from gsopt.results.report.library_section import library_section
from gsopt.sds.prompts import Prompt, PromptSet, write_set
from gsopt.sds.select_prior import LIBRARY, NOT_ASKED, select_prior
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary
from gsopt.training.library_body import expert_texts, require_library
from gsopt.training.loop import train
from gsopt.training.reconstruct import reconstruct

pytestmark = pytest.mark.usefixtures("coarse_hull")

SPARSE = SparseConfig(steps_per_view=0, symmetry="off")
BALL = [Ball((0.0, 0.0, 0.0), 0.6, (200, 60, 30))]


@pytest.fixture(scope="module")
def one_photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball, seen by one camera."""
    return write_balls(tmp_path_factory.mktemp("one") / "ball", BALL, ring(8, size=48)[0])


def config_of(dataset: Path, prior: str = "library", **changes: object) -> TrainConfig:
    config = tiny_config(dataset, iterations=20, init=InitConfig("auto", 800), sparse=SPARSE)
    return replace(config, guidance=GuidanceConfig(prior=prior, prompt=("a soccer ball",)), **changes)  # type: ignore[arg-type]


def events_of(run: Path, kind: str) -> list[dict[str, object]]:
    return [event for event in read_events(run / "events.jsonl")[0] if event["kind"] == kind]


@pytest.fixture(scope="module")
def run(one_photo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with the library that ships."""
    return train(config_of(one_photo), tmp_path_factory.mktemp("run") / "run").run


def test_the_shapes_found_stand_in_the_record_with_names_and_licenses(run: Path) -> None:
    record = json.loads((run / "config.json").read_text())["library"]
    assert record["library"] == "bundled"
    assert record["texts"] == ["a soccer ball"]
    assert record["shapes"][0]["name"] == "Soccer ball"
    assert all(shape["license"].startswith("CC") for shape in record["shapes"])
    assert "Soccer ball" in str(events_of(run, "library")[-1]["message"])
    assert "shapes of a library" in str(events_of(run, "started")[0]["init"])


def test_the_report_shows_them_and_escapes_what_a_file_says(run: Path, tmp_path: Path) -> None:
    messages: list[str] = []
    section = library_section(run, messages)
    assert "Soccer ball" in section
    assert section.count("<img") >= 1
    assert "CC" in section
    (tmp_path / "library").mkdir()
    bad = {
        "shapes": [{"name": "<script>", "share": "much", "license": ["<b>"]}, 3],
        "texts": "no list",
        "entries": "<i>",
    }
    (tmp_path / "library" / "summary.json").write_text(json.dumps(bad))
    section = library_section(tmp_path, messages)
    assert "<script>" not in section
    assert "<i>" not in section
    assert messages == []
    assert library_section(tmp_path / "elsewhere", messages) == ""


def test_the_body_of_the_library_is_the_one_that_a_run_learns_from(one_photo: Path, run: Path, tmp_path: Path) -> None:
    result = train(config_of(one_photo, iterations=20), tmp_path / "again")
    assert result.scene.body is not None
    assert result.scene.guessed
    plain = train(replace(config_of(one_photo), guidance=GuidanceConfig(lambda_sds=0)), tmp_path / "plain")
    assert plain.scene.body is None
    same, other = ((folder / "splat.ply").read_bytes() for folder in (tmp_path / "again", tmp_path / "plain"))
    assert (run / "splat.ply").read_bytes() == same != other


def test_one_photo_takes_the_bundled_library_where_nobody_names_a_prior(
    one_photo: Path, run: Path, tmp_path: Path
) -> None:
    words = GuidanceConfig(prompt=("a soccer ball",))
    assert train(replace(config_of(one_photo), guidance=words), tmp_path / "words").scene.body is not None
    assert (tmp_path / "words" / "splat.ply").read_bytes() == (run / "splat.ply").read_bytes()
    silent = train(replace(config_of(one_photo), guidance=GuidanceConfig()), tmp_path / "silent")
    assert silent.scene.body is not None
    recorded = json.loads((tmp_path / "silent" / "config.json").read_text())
    assert recorded["library"]["texts"] == []
    assert recorded["guidance"] == {"prior": None, "lambda_sds": 0.0, "reason": LIBRARY}


def test_several_photos_take_no_library_by_themselves_and_no_warning(tmp_path: Path) -> None:
    scene = write_balls(tmp_path / "two", BALL, ring(2, size=48))
    result = train(replace(config_of(scene), guidance=GuidanceConfig()), tmp_path / "run")
    assert result.scene.body is None
    assert not any("library" in str(event["message"]) for event in events_of(result.run, "warning"))
    assert json.loads((tmp_path / "run" / "config.json").read_text())["guidance"]["reason"] == NOT_ASKED


def test_a_library_leaves_several_photos_alone_and_says_so(tmp_path: Path) -> None:
    scene = write_balls(tmp_path / "two", BALL, ring(2, size=48))
    result = train(config_of(scene), tmp_path / "run")
    assert result.scene.body is None
    assert any(
        "got 2 input views with masks: it is not used" in str(e["message"]) for e in events_of(result.run, "warning")
    )


def test_a_folder_of_meshes_becomes_a_library_of_the_run(one_photo: Path, tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    sys.path.insert(0, str(Path(__file__).parents[1] / "shape_library"))
    try:
        from meshes import library_folder
    finally:
        sys.path.pop(0)
    meshes = library_folder(tmp_path / "meshes")
    (meshes / "broken.obj").write_text("nothing")
    result = train(config_of(one_photo, f"library:{meshes}"), tmp_path / "run")
    assert len(ShapeLibrary(tmp_path / "run" / "library" / "library.safetensors")) == 3
    assert any("1 skipped" in str(event["message"]) for event in events_of(result.run, "library"))


def test_a_library_that_is_missing_is_an_error_before_any_work(one_photo: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Cannot read the shape library"):
        reconstruct(one_photo, tmp_path / "run", config=config_of(one_photo, f"library:{tmp_path / 'none'}"))
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="1000"):
        reconstruct(one_photo, tmp_path / "run", guidance={"prior": "library", "prompt": ["x" * 10_000]})
    assert not (tmp_path / "run").exists()


def test_a_library_loads_no_diffusion_model() -> None:
    choice = select_prior(GuidanceConfig(prior="library", prompt=("a chair",)))
    assert choice.name is None
    assert choice.weight == 0
    require_library(GuidanceConfig())
    require_library(GuidanceConfig(prior="library"))
    assert (library_of("library"), library_of("library:a:b"), library_of("librarian")) == ("", "a:b", None)


def test_words_are_the_experts_the_notes_and_the_language_models(tmp_path: Path) -> None:
    prompts = (Prompt("an oak chair"), Prompt("a table", polarity="negative"), Prompt("off", weight=0.0))
    write_set(tmp_path / "prompts.json", PromptSet(prompts, notes="of my aunt", object="chair"))
    config = GuidanceConfig(prior="library", prompt=("a seat",), prompts=str(tmp_path / "prompts.json"))
    assert expert_texts(config) == ["a seat", "chair", "of my aunt", "an oak chair"]


def test_the_library_that_ships_is_small_and_open() -> None:
    library = ShapeLibrary(BUNDLED)
    assert BUNDLED.stat().st_size <= 12e6
    assert len(library) > 600
    open_licenses = {"CC0-1.0", "CC-BY-3.0", "CC-BY-3.0-US"}
    assert {entry.license for entry in library.entries} == open_licenses
    assert all(entry.creator for entry in library.entries if entry.license != "CC0-1.0")
    assert all(library.shape(row).occupied.any() for row in range(0, len(library), 50))
