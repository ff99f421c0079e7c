"""The line of a run about the body that it completes: shapes with their shares, known words, or why none."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

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
