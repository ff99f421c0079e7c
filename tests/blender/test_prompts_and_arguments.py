"""prompts.json means the same here and in gsopt; what stands in the panel becomes flags that gsopt takes."""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from blender_addon.core import arguments, prompts
from blender_addon.core.errors import InputError
from blender_addon.core.prompts import Document, Prompt, read_prompts, write_prompts

PROMPTS = (
    Prompt("ein alter Stuhl, 春"),
    Prompt("blurry", 0.5, "back", "negative", "llm:qwen3:4b", "seen from behind\nit is open", -0.2),
)


def test_what_is_written_is_read_with_all_that_stands_beside(odd_folder: Path) -> None:
    document = Document(PROMPTS, {"notes": "oak", "made": {"source": "template", "raw": ""}, "images": []})
    write_prompts(odd_folder / "prompts.json", document)
    assert read_prompts(odd_folder / "prompts.json") == document


def test_gsopt_reads_the_same_prompts(tmp_path: Path) -> None:
    schema = pytest.importorskip("gsopt.sds.prompts")
    write_prompts(tmp_path / "a.json", Document(PROMPTS))
    theirs = schema.read_prompts(tmp_path / "a.json")
    found = tuple(getattr(theirs, "prompts", theirs))
    assert [asdict(prompt) for prompt in found] == [asdict(prompt) for prompt in PROMPTS]


def test_pictures_are_named_only_where_they_lie(tmp_path: Path) -> None:
    """A copy of the file elsewhere must not name what is not beside it: gsopt refuses that."""
    images = [{"file": "a-images/1.png", "accepted": True}, {"file": "a-images/2.png"}, {"file": "../x"}, 3]
    images += [{"file": True}, {"file": 1.5}, {"file": ["a.png"]}, {"accepted": True}]
    longer = Document(PROMPTS, {"images": [{"file": "春" * 100, "accepted": True}]})
    assert longer.accepted(tmp_path) == []
    document = Document(PROMPTS, {"notes": "oak", "images": images})
    assert document.accepted(tmp_path) == []
    assert document.beside(tmp_path) == Document(PROMPTS, {"notes": "oak"})
    (tmp_path / "a-images").mkdir()
    for name in ("1.png", "2.png"):
        (tmp_path / "a-images" / name).touch()
    assert document.accepted(tmp_path) == [tmp_path / "a-images" / "1.png"]
    assert document.beside(tmp_path) == document


@pytest.mark.parametrize(
    "prompts",
    [
        [{}],
        [{"text": ""}],
        [{"text": "  "}],
        [{"text": 3}],
        [{"text": "a\x1b[2J"}],
        [{"text": "a" * 1001}],
        [{"text": "a", "hue": 1}],
        [{"text": "a", "weight": "1"}],
        [{"text": "a", "weight": -1}],
        [{"text": "a", "weight": 10**400}],
        [{"text": "a", "weight": True}],
        [{"text": "a", "view": "below"}],
        [{"text": "a", "view": ["all"]}],
        [{"text": "a", "polarity": "neutral"}],
        [{"text": "a", "source": "llm:"}],
        [{"text": "a", "source": "llm:\ud800"}],
        [{"text": "a\udcff"}],
        [{"text": "a", "rationale": "\ud800"}],
        [{"text": "a", "score": 2}],
        [{"text": "a"}] * 257,
        "a",
        None,
    ],
)
def test_what_is_no_prompt_is_refused_as_gsopt_does(tmp_path: Path, prompts: object) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"version": 1, "prompts": prompts}))
    with pytest.raises(InputError):
        read_prompts(tmp_path / "a.json")


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b"[" * 100_000, b"{}", b'{"version": 2, "prompts": []}'])
def test_a_file_that_is_none_is_refused_by_name(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.json").write_bytes(data)
    with pytest.raises(InputError):
        read_prompts(tmp_path / "a.json")
    (tmp_path / "b.json").write_bytes(b" " * (2 << 20))
    with pytest.raises(InputError, match=r"b\.json.*larger"):
        read_prompts(tmp_path / "b.json")


@pytest.mark.parametrize("notes", ["Infinity", "[-Infinity]", "NaN", "1e999", '"\\ud800"', '{"\\udcff": 1}'])
def test_what_could_not_be_written_back_is_refused_when_it_is_read(tmp_path: Path, notes: str) -> None:
    (tmp_path / "a.json").write_text(f'{{"version": 1, "prompts": [{{"text": "a chair"}}], "notes": {notes}}}')
    with pytest.raises(InputError, match=r"a\.json.*No JSON file can hold"):
        read_prompts(tmp_path / "a.json")


@pytest.mark.parametrize("depth", [100, 300, 500, 900, 990, 3000, 100_000])
def test_nesting_that_python_cannot_follow_is_refused(tmp_path: Path, depth: int) -> None:
    deep = "[" * depth + "]" * depth
    (tmp_path / "a.json").write_text(f'{{"version": 1, "prompts": [{{"text": "a chair"}}], "notes": {deep}}}')
    with contextlib.suppress(InputError):
        write_prompts(tmp_path / "b.json", read_prompts(tmp_path / "a.json"))


def test_a_failed_write_leaves_the_file_that_was_there(tmp_path: Path) -> None:
    write_prompts(tmp_path / "a.json", Document(PROMPTS))
    for notes in (float("inf"), "\ud800"):
        with pytest.raises(InputError, match="No JSON file can hold"):
            write_prompts(tmp_path / "a.json", Document(PROMPTS, {"notes": notes}))
    assert read_prompts(tmp_path / "a.json") == Document(PROMPTS)
    assert list(tmp_path.iterdir()) == [tmp_path / "a.json"]


EVERYTHING = (
    arguments.Training("", 50, 2, 999, 4, True, "mcmc", "black", 7, 1, "reference"),
    arguments.Guidance("off"),
)


@pytest.mark.parametrize(
    ("training", "guidance"),
    [
        (arguments.Training(), arguments.Guidance()),
        (arguments.Training(preset="high", views=4), arguments.Guidance("off")),
        (replace(EVERYTHING[0], preset="draft"), arguments.Guidance("off")),
        EVERYTHING,
        (arguments.Training(), arguments.Guidance("embedded", 0.3, None, (Path("a b.png"),), "cpu", 2)),
    ],
)
def test_gsopt_takes_the_flags(
    tmp_path: Path,
    training: arguments.Training,
    guidance: arguments.Guidance,
) -> None:
    pytest.importorskip("tyro")
    from gsopt.cli.train import read_flags
    from gsopt.cli.train_flags import parse
    from gsopt.config.presets import PRESETS

    words = arguments.train(Path("python"), tmp_path / "a b", tmp_path / "-run", training, guidance)
    assert words[:4] == ["python", "-m", "gsopt", "train"]
    config, run = read_flags(parse(words[4:]))
    assert config.preset == (training.preset or "default")
    preset = PRESETS[training.preset or "default"]
    own = training if not training.preset else arguments.Training(iterations=preset.get("iterations", 4000))
    assert (config.iterations, config.data.downscale or 0, config.seed) == (
        own.iterations,
        own.downscale,
        training.seed,
    )
    assert (config.data.views or 0, config.density.max_gaussians or 0) == (training.views, training.max_gaussians)
    assert (config.density.strategy, config.data.background) == (own.strategy, own.background)
    assert (config.threads, config.backend, config.data.eval) == (training.threads, training.backend, own.hold_out)
    assert (config.data.path, run) == (str(tmp_path / "a b"), tmp_path / "-run")
    weight = {"off": 0.0, "auto": None}.get(guidance.prior, guidance.weight)
    assert config.guidance.lambda_sds == weight
    assert config.guidance.ref_image == tuple(map(str, guidance.references))


def test_gsopt_sfm_takes_the_flags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pycolmap")
    from gsopt.cli import sfm
    from gsopt.data.sfm import pipeline

    class Asked(Exception):
        pass

    def recorded(photos: Path, out: Path, config: object, report: object) -> None:
        raise Asked(photos, out, config.seed, config.threads)  # type: ignore[attr-defined]

    monkeypatch.setattr(pipeline, "pose_photos", recorded)
    words = arguments.poses(Path("python"), tmp_path, tmp_path / "a posed", 3, 1)
    with pytest.raises(Asked) as asked:
        sfm.main(words[4:])
    assert asked.value.args == (tmp_path, tmp_path / "a posed", 3, 1)


def test_gsopt_masks_takes_the_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tyro")
    from gsopt.cli import masks
    from gsopt.errors import MissingDependency

    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    monkeypatch.delenv("GSOPT_MASK_MODEL", raising=False)
    words = arguments.masks(Path("python"), tmp_path / "a dataset")
    with pytest.raises(MissingDependency, match="mask model"):  # the flags were understood
        masks.main(words[4:])


def test_gsopt_prompts_takes_the_flags(tmp_path: Path) -> None:
    tyro = pytest.importorskip("tyro")
    from gsopt.cli.prompts.generate import Flags

    writing = arguments.Writing("-- a chair; rm", "medicine", 6, "http://localhost:1/v1", "qwen", (tmp_path,))
    flags = tyro.cli(Flags, args=arguments.prompts(Path("python"), writing, tmp_path / "p.json")[4:])
    assert (flags.notes, flags.domain, flags.n) == ("-- a chair; rm", "medicine", 6)
    assert (flags.llm, flags.model, flags.images) == ("http://localhost:1/v1", "qwen", (tmp_path,))
    assert flags.out == tmp_path / "p.json"


def test_synth_views_takes_the_flags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "scripts"))
    import synth_views

    rendering = arguments.Rendering(views=3, test_views=1, resolution=32, masks=True)
    words = arguments.render("blender", "", Path("s.py"), tmp_path / "a.glb", tmp_path / "out", rendering)
    items, settings, how = synth_views.parse(synth_views.own_arguments(words))
    assert ([str(item.mesh) for item in items], how["out"]) == ([str(tmp_path / "a.glb")], tmp_path / "out")
    assert (settings.views, settings.test_views, settings.resolution, settings.masks) == (3, 1, (32, 32), True)
    plain = arguments.render("", "python", Path("s.py"), tmp_path / "a.glb", tmp_path / "out", rendering)
    assert synth_views.own_arguments(plain[1:]) == synth_views.own_arguments(words)


@pytest.mark.parametrize(
    ("name", "fine", "refused"),
    [
        ("score", (-1.0, 1.0, None, 0), (-1.001, 1.001, math.nan)),
        ("weight", (0.0, prompts.LARGEST_WEIGHT, 1), (-0.001, prompts.LARGEST_WEIGHT * 1.001, math.inf)),
        ("text", ("a", "a" * prompts.LONGEST_TEXT), ("", " ", "a" * (prompts.LONGEST_TEXT + 1))),
        ("rationale", ("", "a" * prompts.LONGEST_RATIONALE), ("a" * (prompts.LONGEST_RATIONALE + 1), 3)),
    ],
)
def test_values_of_a_prompt_may_be_their_bounds(name: str, fine: tuple[Any, ...], refused: tuple[Any, ...]) -> None:
    for value in fine:
        assert getattr(prompts.Prompt(**{"text": "a", name: value}), name) == value
    for value in refused:
        with pytest.raises(InputError):
            prompts.Prompt(**{"text": "a", name: value})


def test_what_the_panel_begins_with_is_what_gsopt_does_by_itself(tmp_path: Path) -> None:
    pytest.importorskip("tyro")
    from gsopt.cli.train import read_flags
    from gsopt.cli.train_flags import parse
    from gsopt.sds.select_prior import DEFAULT_WEIGHT

    training, guidance = arguments.Training(), arguments.Guidance()
    words = arguments.train(Path("python"), tmp_path, tmp_path / "run", training, guidance)
    asked, _ = read_flags(parse(words[4:]))
    plain, _ = read_flags(parse([str(tmp_path), "-m", str(tmp_path / "run")]))
    # A number of steps that somebody names is not stretched for few photos.
    assert replace(asked, preview_every=plain.preview_every, sparse=plain.sparse) == plain
    assert (training.downscale, training.max_gaussians, training.views, training.hold_out) == (0, 0, 0, False)
    assert (guidance.weight, guidance.references, guidance.front_view) == (DEFAULT_WEIGHT, (), -1)


def test_prompts_and_renderings_begin_with_what_their_programs_do_by_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tyro = pytest.importorskip("tyro")
    from gsopt.cli.prompts.generate import Flags

    words = arguments.prompts(Path("python"), arguments.Writing("a chair"), tmp_path / "p.json")
    plain = tyro.cli(Flags, args=["--notes=a chair", "-o", str(tmp_path / "p.json")])
    assert tyro.cli(Flags, args=words[4:]) == plain
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "scripts"))
    synth_views = pytest.importorskip("synth_views")
    rendering = arguments.Rendering()
    words = arguments.render("", "python", Path("s.py"), tmp_path / "a.glb", tmp_path / "out", rendering)
    asked, alone = (synth_views.make_parser().parse_args(w) for w in (words[2:], [words[2], "-o", words[4]]))
    for name in ("views", "layout", "samples", "lighting", "seed", "masks"):
        assert getattr(asked, name) == getattr(alone, name)
    assert (rendering.resolution, rendering.test_views, rendering.total) == (256, 10, 60)
    assert words[words.index("--threads") + 1] == "0"


def test_work_begins_with_seed_0_and_all_cores() -> None:
    python, folder = Path("python"), Path("a")
    assert arguments.resume(python, folder)[-2:] == ["--threads", "0"]
    assert arguments.poses(python, folder, Path("b"))[-4:] == ["--seed", "0", "--threads", "0"]
    assert arguments.resume(python, folder, 3)[-1] == "3"
