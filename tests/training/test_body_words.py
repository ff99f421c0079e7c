"""The line of a run about the body that it completes: shapes with their shares, known words, or why none."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsopt.shape_library.completion import Completion, Hypothesis
from gsopt.shape_library.entry import Entry
from gsopt.training import library_body, shape_prior_body


def found(*shares: float, words: float = 0.0) -> Any:
    hypotheses = [
        SimpleNamespace(share=s, words=words, entry=SimpleNamespace(title=f"t{i}")) for i, s in enumerate(shares)
    ]
    return SimpleNamespace(hypotheses=hypotheses)


@pytest.mark.parametrize(
    ("shares", "words", "told"),
    [
        ((0.5, 0.25, 0.125, 0.125), 0.0, "the unseen sides follow t0 50%, t1 25%, t2 12% (chosen by the photo)"),
        ((0.99, 0.01), 1.0, "the unseen sides follow t0 99%, t1 1% (chosen by the photo and by words)"),
        ((0.991, 0.009), 0.0, "the unseen sides follow t0 99% (chosen by the photo)"),
    ],
)
def test_up_to_three_shapes_of_a_hundredth_or_more_are_named(
    shares: tuple[float, ...], words: float, told: str
) -> None:
    assert library_body.sentence(found(*shares, words=words)) == told


@pytest.mark.parametrize(
    ("words", "told"),
    [([], "told no word that it knows"), (list("ab"), "told a, b"), (list("abcdefgh"), "told a, b, c, d, e, f")],
)
def test_up_to_six_known_words_are_named(words: list[str], told: str) -> None:
    assert shape_prior_body.sentence("p", words) == f"the unseen sides are a guess of p ({told})"


@pytest.mark.parametrize("unused", [library_body.unused, shape_prior_body.unused])
def test_why_a_body_is_not_completed_counts_views_and_masks(unused: Any) -> None:
    def scene(views: int, alpha: bool, mirrored: bool = False) -> Any:
        return SimpleNamespace(train=(None,) * views, has_alpha=alpha, mirrored=(None,) if mirrored else ())

    assert "got 1 input view with masks: it is not used" in unused(scene(1, True))
    assert "got 2 input views without masks: it is not used" in unused(scene(2, False))
    assert "got 0 input views" in unused(scene(0, False))
    assert "--sparse.symmetry off" in unused(scene(1, True, mirrored=True))


@pytest.mark.parametrize(("views", "used"), [(3, True), (4, False)])
def test_a_shape_prior_completes_up_to_three_photos(monkeypatch: pytest.MonkeyPatch, views: int, used: bool) -> None:
    class Reached(Exception):
        pass

    def read(path: object) -> None:
        raise Reached

    told: list[str] = []
    monkeypatch.setattr(shape_prior_body, "read_prior", read)
    monkeypatch.setattr(shape_prior_body, "guesses", lambda config, count: True)
    config: Any = SimpleNamespace(guidance=SimpleNamespace(prior="shape:x"))
    scene: Any = SimpleNamespace(train=(None,) * views, has_alpha=True, mirrored=())
    directory: Any = SimpleNamespace(warn=told.append)
    if used:
        with pytest.raises(Reached):
            shape_prior_body.with_shape_prior_body(config, scene, None, directory)  # type: ignore[arg-type]
    else:
        assert shape_prior_body.with_shape_prior_body(config, scene, None, directory) is scene  # type: ignore[arg-type]
    assert len(told) == int(not used)


def hypothesis(row: int, share: float) -> Any:
    return Hypothesis(Entry(f"id{row}", f"n{row}"), share, 0.5, 0.25)


@pytest.mark.parametrize(("bundled", "earlier"), [(True, None), (False, {"cpu_seconds": 9.0})])
def test_up_to_six_shapes_and_eight_texts_are_recorded_once(
    bundled: bool, earlier: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a hundredth or more; a resumed run keeps the record that it has."""
    shares = [0.3, 0.2, 0.15, 0.12, 0.11, 0.1, 0.02, 0.01, 0.009] if bundled else [0.99, 0.01, 0.009]
    count = 6 if bundled else 2
    made = Completion(None, tuple(hypothesis(row, share) for row, share in enumerate(shares)))  # type: ignore[arg-type]
    entries = tuple(one.entry for one in reversed(made.hypotheses))
    path = library_body.BUNDLED if bundled else Path("own.safetensors")

    class Library:
        """The shape of a row is its number."""

        def __init__(self) -> None:
            self.entries, self.path = entries, path

        def __len__(self) -> int:
            return len(entries)

        def shape(self, row: int) -> int:
            return row

    saved: list[Any] = []
    monkeypatch.setattr(library_body, "picture", lambda shape, backend: shape)
    monkeypatch.setattr(library_body, "save_stills", lambda folder, pictures, overwrite: saved.extend(pictures))
    recorded: dict[str, Any] = {}
    told: list[Any] = []
    directory: Any = SimpleNamespace(
        path=tmp_path,
        recorded=lambda key: earlier,
        record=lambda **fields: recorded.update(fields),
        emit=lambda kind, **fields: told.append((kind, fields)),
    )
    texts = [f"text {i}" for i in range(9)]
    library: Any = Library()
    library_body._record(made, library, texts, 1.23456, None, directory)  # type: ignore[arg-type]
    summary = json.loads((tmp_path / "library" / "summary.json").read_text())
    assert [shape["id"] for shape in summary["shapes"]] == [f"id{row}" for row in range(count)]
    assert [shape["share"] for shape in summary["shapes"]] == shares[:count]
    assert summary["texts"] == texts[:8]
    assert (summary["library"], summary["entries"]) == ("bundled" if bundled else "own.safetensors", len(shares))
    assert saved == [(f"shape_{row:02d}", len(shares) - 1 - row) for row in range(count)]
    assert [fields["shapes"] for _, fields in told] == [[f"id{row}" for row in range(count)]]
    assert (recorded.get("library", {}).get("cpu_seconds") == 1.235) == (earlier is None)
    assert ("library" in recorded) == (earlier is None)
