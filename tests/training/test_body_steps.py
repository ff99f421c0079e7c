"""How a run gets its prior and its body, with stand-ins for networks and libraries: who is asked, what is recorded."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import SparseConfig, TrainConfig
from gsopt.errors import InputError
from gsopt.sds.prompts import Prompt, PromptSet, write_set
from gsopt.training import library_body, shape_prior_body
from gsopt.training.guided import start
from gsopt.training.guided.guard import Verdict


class Directory:
    """A run's folder that keeps what it is told."""

    def __init__(self, path: Path, **recorded: Any) -> None:
        self.path, self.kept = path, dict(recorded)
        self.events: list[tuple[str, dict[str, Any]]] = []
        path.mkdir(exist_ok=True)

    def recorded(self, key: str) -> Any:
        return self.kept.get(key)

    def record(self, **fields: Any) -> None:
        self.kept.update(fields)

    def emit(self, kind: str, **fields: Any) -> None:
        self.events.append((kind, fields))

    def warn(self, message: str) -> None:
        self.emit("warning", message=message)


@dataclass(frozen=True)
class Scene:
    train: tuple[Any, ...]
    has_alpha: bool = True
    mirrored: tuple[Any, ...] = ()
    extent: float = 1.5
    body: Any = None
    body_colors: Any = None


@dataclass(frozen=True)
class Setup:
    weight: float

    @property
    def prior(self) -> Any:
        return SimpleNamespace(name="p", aligned=True)

    def on(self, scene: Any, backend: Any, plans: Any) -> Any:
        return SimpleNamespace(weight=self.weight, plan=SimpleNamespace(guided_steps=4))


def test_what_a_prior_needs_is_read_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    for name in ("read_guidance_prompts", "reference_paths", "select_prior"):
        monkeypatch.setattr(start, name, lambda config, name=name: asked.append(name))
    start.require_guidance(GuidanceConfig())
    assert asked == ["read_guidance_prompts", "reference_paths", "select_prior"]


@pytest.mark.parametrize("resumed", [False, True])
def test_the_guard_decides_once_and_its_word_stands_in_the_record(
    resumed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded: dict[str, Any] = {"prior": "p", "lambda_sds": 0.5, "reason": "asked"}
    if resumed:
        recorded["guard"] = {"factor": 0.5, "reason": "why", "trials": []}
        (tmp_path / "run" / "guidance").mkdir(parents=True)
    directory, checked = Directory(tmp_path / "run"), list[Any]()
    monkeypatch.setattr(start, "recorded_choice", lambda plan, directory: recorded)
    monkeypatch.setattr(start, "_opened", lambda config, scene, recorded, directory: Setup(0.5))
    monkeypatch.setattr(start, "_verdict", lambda *_: (checked.append(None), Verdict(0.5, "why", []))[1])
    plan: Any = SimpleNamespace(guidance=SimpleNamespace(for_prior=lambda aligned: SimpleNamespace(policy="recon")))
    found: Any = start.start_guidance(TrainConfig(), plan, None, None, directory)  # type: ignore[arg-type]
    assert found.guidance.weight == 0.25
    assert (directory.path / "guidance").is_dir()
    assert len(checked) == int(not resumed)
    if resumed:
        assert directory.events == []
        assert directory.kept == {}
    else:
        guard = {"factor": 0.5, "reason": "why", "trials": []}
        assert directory.kept == {"guidance": {**recorded, "model": "p", "policy": "recon", "guard": guard}}
        assert directory.events == [("guidance", {"message": "lambda_sds 0.25, lowered from 0.5 (why)", **guard})]
    monkeypatch.setattr(start, "recorded_choice", lambda plan, directory: {"prior": None})
    assert start.start_guidance(TrainConfig(), plan, None, None, directory) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("guarded", "saved", "kept"),
    [(True, True, True), (True, False, False), (False, True, False), (False, False, False)],
)
def test_words_of_a_run_that_was_decided_are_kept_and_others_encoded(
    guarded: bool, saved: bool, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = Directory(tmp_path / "run")
    recorded: dict[str, Any] = {"prior": "sd21", "reason": "asked for", "lambda_sds": 0.25}
    recorded |= {"guard": {}} if guarded else {}
    if saved:
        (tmp_path / "run" / "guidance").mkdir()
        (tmp_path / "run" / "guidance" / "conditioning.safetensors").touch()
    monkeypatch.setattr(start, "front_camera", lambda config, scene: "front")
    monkeypatch.setattr(start, "open_prior", lambda name, config: SimpleNamespace(name=f"opened {name}"))
    monkeypatch.setattr(start.Conditioning, "load", staticmethod(lambda path: ("loaded", path.name)))
    monkeypatch.setattr(start, "make_conditioning", lambda config, scene, prior, folder, warn: ("made", folder.name))
    found: Any = start._opened(TrainConfig(), None, recorded, directory)  # type: ignore[arg-type]
    assert (found.prior.name, found.front, found.weight) == ("opened sd21", "front", 0.25)
    assert found.conditioning == (("loaded", "conditioning.safetensors") if kept else ("made", "guidance"))
    message = "prior opened sd21, asked for"
    assert directory.events == [("guidance", {"message": message, "prior": "opened sd21"})]


@pytest.mark.parametrize("decide", [True, False])
def test_nothing_is_checked_where_the_input_views_decide_everywhere(
    decide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start, "inputs_decide", lambda plan, scene, guidance: decide)
    monkeypatch.setattr(start, "evaluate_guidance", lambda *_: Verdict(0.25, "checked", []))
    plan: Any = SimpleNamespace(guidance=None)
    found = start._verdict(TrainConfig(), plan, None, None, Setup(0.5))  # type: ignore[arg-type]
    assert (found.factor, found.reason[:11]) == ((1.0, "not checked") if decide else (0.25, "checked"))


def config_of(prior: str = "auto", **sparse: Any) -> TrainConfig:
    weight = None if prior == "auto" else 0.2
    return TrainConfig(guidance=GuidanceConfig(prior=prior, lambda_sds=weight), sparse=SparseConfig(**sparse))


@pytest.mark.parametrize(
    ("prior", "scene", "sparse", "library", "warned"),
    [
        ("auto", Scene((1,)), {}, "bundled", 0),
        ("library", Scene((1,)), {}, "bundled", 0),
        ("library:own.safetensors", Scene((1,)), {}, "own.safetensors", 0),
        ("auto", Scene((1, 2)), {}, "", 0),
        ("library", Scene((1, 2)), {}, "", 1),
        ("library", Scene((1,), has_alpha=False), {}, "", 1),
        ("library", Scene((1,), mirrored=(1,)), {}, "", 1),
        ("library", Scene((1,)), {"inflate": "off"}, "", 1),
        ("sd21", Scene((1,)), {}, "", 0),
    ],
)
def test_one_masked_photo_without_mirrors_takes_a_library_where_one_is_asked_for_or_nothing_else(
    prior: str, scene: Scene, sparse: dict[str, Any], library: str, warned: int, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Whoever asks for one is told why it is not used."""
    opened: list[str] = []
    written: list[tuple[Any, ...]] = []
    now = [10.0]

    def complete(photo: Any, extent: float, library: Any, texts: list[str]) -> Any:
        assert (photo, extent, texts) == ("photo", 1.5, [])
        now[0] += 2.5
        return SimpleNamespace(body="body")

    monkeypatch.setattr(library_body, "time", SimpleNamespace(process_time=lambda: now[0]))
    monkeypatch.setattr(library_body, "small_photos", lambda views, most: ["photo"] * most)
    monkeypatch.setattr(
        library_body, "ShapeLibrary",
        lambda path: (opened.append("bundled" if path == library_body.BUNDLED else str(path)), "library")[1],
    )  # fmt: skip
    monkeypatch.setattr(library_body, "completion", complete)
    monkeypatch.setattr(library_body, "_record", lambda *args: written.append(args))
    directory: Any = Directory(tmp_path / "run")
    found: Any = library_body.with_library_body(config_of(prior, **sparse), scene, "backend", directory)  # type: ignore[arg-type]
    assert opened == [library] * bool(library)
    assert found == (replace(scene, body="body") if library else scene)
    assert [args[3] for args in written] == [2.5] * bool(library)
    assert len(directory.events) == warned
    monkeypatch.setattr(library_body, "completion", lambda *_: None)
    assert library_body.with_library_body(config_of(prior, **sparse), scene, "backend", directory) is scene  # type: ignore[arg-type]


def test_a_folder_of_meshes_becomes_a_library_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsopt.shape_library.meshes import build

    (tmp_path / "meshes").mkdir()
    built: list[Any] = []

    def make(path: Path, out: Path, threads: int, report: Any) -> Any:
        built.append((path.name, threads))
        report("1 of 2")
        out.touch()
        return SimpleNamespace(entries=1234, skipped=5)

    monkeypatch.setattr(build, "build_library", make)
    monkeypatch.setattr(library_body, "ShapeLibrary", lambda path: path)
    directory: Any = Directory(tmp_path / "run")
    for _ in range(2):
        found = library_body._opened(str(tmp_path / "meshes"), directory)
        assert found == directory.path / "library" / "library.safetensors"
    assert built == [("meshes", 1)]
    told = [fields["message"] for kind, fields in directory.events if kind == "library"]
    assert told == ["1 of 2", f"1,234 shapes of {tmp_path / 'meshes'}, 5 skipped"]
    assert library_body._opened("", directory) == library_body.BUNDLED
    assert library_body._opened("own", directory) == Path("own")


def test_a_library_that_is_named_is_opened_before_any_work_unless_it_is_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []
    monkeypatch.setattr(library_body, "ShapeLibrary", opened.append)
    for prior in ("auto", "sd21", f"library:{tmp_path}"):
        library_body.require_library(GuidanceConfig(prior=prior))
    assert opened == []
    library_body.require_library(GuidanceConfig(prior="library"))
    library_body.require_library(GuidanceConfig(prior="library:own"))
    assert opened == [library_body.BUNDLED, Path("own")]


def test_words_of_the_expert_are_prompts_notes_and_positive_weights(tmp_path: Path) -> None:
    prompts = (
        Prompt("an oak chair", source="template"),
        Prompt("a light one", source="template", weight=0.0),
        Prompt("blur", source="template", polarity="negative"),
        Prompt("a heavy one", source="template", weight=0.01),
    )
    write_set(tmp_path / "prompts.json", PromptSet(prompts, object="chair", notes="old"))  # type: ignore[arg-type]
    config = GuidanceConfig(prior="sd21", prompt=("a", " "), prompts=str(tmp_path / "prompts.json"))
    assert library_body.expert_texts(config) == ["a", "chair", "old", "an oak chair", "a heavy one"]
    assert library_body.expert_texts(GuidanceConfig()) == []


def completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: Any, recorded: Any = None, scene: Scene | None = None
) -> tuple[Any, Directory, list[Any]]:
    """What a shape prior makes of a scene of one photo, the run's folder, and what was shown."""
    shown: list[Any] = []
    texts = [f"t{i}" for i in range(9)]
    now = [1.0]
    prior = SimpleNamespace(
        vocabulary="words", digest="abc", network=SimpleNamespace(to=lambda device: shown.append(device))
    )

    def see(photos: Any, extent: float, prior: Any, known: list[str], seed: int) -> Any:
        now[0] += 1.23456
        assert (photos, extent, seed) == (["photo"] * len((scene or Scene((1,))).train), 1.5, 7)
        return body

    monkeypatch.setattr(shape_prior_body, "time", SimpleNamespace(process_time=lambda: now[0]))
    monkeypatch.setattr(shape_prior_body, "read_prior", lambda path: prior)
    monkeypatch.setattr(shape_prior_body, "expert_texts", lambda config: texts)
    monkeypatch.setattr(
        shape_prior_body,
        "known_words",
        lambda texts, words: ([f"k{i}" for i in range(50)], [f"u{i}" for i in range(50)]),
    )
    monkeypatch.setattr(shape_prior_body, "small_photos", lambda views, most: ["photo"] * most)
    monkeypatch.setattr(shape_prior_body, "prior_body", see)
    monkeypatch.setattr(shape_prior_body, "_show", lambda *args: shown.append(args))
    directory = Directory(tmp_path / "run", **({"shape_prior": recorded} if recorded is not None else {}))
    config = replace(config_of("shape:folders/mine"), seed=7)
    backend: Any = SimpleNamespace(device="cpu")
    found = shape_prior_body.with_shape_prior_body(config, scene or Scene((1,)), backend, directory)  # type: ignore[arg-type]
    return found, directory, shown


def test_a_shape_prior_gives_body_and_colors_and_is_recorded_with_its_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = SimpleNamespace(grid="grid", colors="colors")
    found, directory, shown = completed(tmp_path, monkeypatch, body)
    assert (found.body, found.body_colors) == ("grid", "colors")
    record = directory.kept["shape_prior"]
    assert (record["prior"], record["digest"], record["seed"], record["photos"]) == ("mine", "abc", 7, 1)
    assert (len(record["texts"]), len(record["words"]), len(record["unknown_words"])) == (8, 40, 40)
    assert record["cpu_seconds"] == 1.235
    (event,) = directory.events
    assert event[0] == "shape_prior"
    assert "a guess of mine" in event[1]["message"]
    assert shown[0] == "cpu"
    assert shown[1][0] is body
    assert shown[1][4] == directory.path / "shape_prior"
    assert "cpu_seconds" not in shown[1][2]


def test_the_record_of_a_resumed_run_stays_and_another_prior_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = SimpleNamespace(grid="grid", colors="colors")
    _, directory, _ = completed(tmp_path, monkeypatch, body, {"digest": "abc", "cpu_seconds": 9})
    assert directory.kept["shape_prior"] == {"digest": "abc", "cpu_seconds": 9}
    with pytest.raises(InputError, match=r"began with another shape prior \(xyz\), got abc"):
        completed(tmp_path, monkeypatch, body, {"digest": "xyz"})


def test_a_prior_that_sees_nothing_and_a_scene_that_it_does_not_fit_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene((1,))
    for given, told in (
        (scene, "saw no body"),
        (Scene((1,), has_alpha=False), "without masks"),
        (Scene((1,), mirrored=(1,)), "symmetric"),
        (Scene((1, 2, 3, 4)), "got 4 input views"),
    ):
        found, directory, _ = completed(tmp_path, monkeypatch, None, scene=given)
        assert found is given
        (event,) = directory.events
        assert told in event[1]["message"]
        assert directory.kept == {}
    other: Any = Directory(tmp_path / "run")
    assert shape_prior_body.with_shape_prior_body(config_of("sd21"), scene, None, other) is scene  # type: ignore[arg-type]
    assert other.events == []


def test_four_sides_of_the_body_are_shown_on_white(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved: dict[str, list[int]] = {}
    asked: list[Any] = []
    grid = SimpleNamespace(centers=lambda: torch.tensor([[0.0, 0, 0], [2.0, 4.0, 6.0]]))

    def draw(shape: Any, photos: Any, cameras: Any, backend: Any, colors: Any) -> torch.Tensor:
        asked.append((list(cameras), colors))
        return torch.tensor([255, 102, 0, 51]).to(torch.uint8).expand(4, 1, 1, 4)

    monkeypatch.setattr(
        shape_prior_body, "surrounding_cameras",
        lambda camera, middle, count: (asked.append((camera, middle.tolist(), count)), list(range(count)))[1],
    )  # fmt: skip
    monkeypatch.setattr(shape_prior_body, "drawn_voxels", draw)
    monkeypatch.setattr(
        shape_prior_body, "save_stills",
        lambda folder, pictures, overwrite: saved.update({name: image[0, 0].tolist() for name, image in pictures}),
    )  # fmt: skip
    body: Any = SimpleNamespace(grid=grid, colors="colors")
    photos: Any = [SimpleNamespace(camera="first"), SimpleNamespace(camera="second")]
    shape_prior_body._show(body, photos, {"words": ["a"]}, None, tmp_path / "shape_prior")  # type: ignore[arg-type]
    assert asked == [("first", [1, 2, 3], 16), ([2, 6, 10, 14], "colors")]
    assert saved == {f"side_{i:02d}": [255, 224, 204] for i in range(4)}
    assert json.loads((tmp_path / "shape_prior" / "summary.json").read_text()) == {"words": ["a"]}
