"""Misses of the outlines by which reconstructions are compared: of which photos, and where there are none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsopt.data.sfm import held_by_silhouettes as held
from gsopt.data.sfm.masks import FeatureInput

NAMES = {1: "a.png", 2: "b.png", 3: "c.png"}
MADE: Any = SimpleNamespace(reg_image_ids=lambda: list(NAMES), image=lambda i: SimpleNamespace(name=NAMES[i]))


def misses(
    monkeypatch: pytest.MonkeyPatch, *, contradicted: bool, wrong: list[int], loose: bool, outlines: bool = True
) -> tuple[float | None, list[int]]:
    """All views miss by 5 px and those without the second one by 1 px: the view found, and how many were asked."""
    views = [SimpleNamespace(name=f"images/{name}") for name in NAMES.values()]
    asked: list[int] = []

    def coherent(given: Sequence[Any]) -> Any:
        asked.append(len(given))
        after = 5.0 if len(given) == 3 else 1.0
        return SimpleNamespace(contradicted=contradicted, after=after) if outlines else None

    monkeypatch.setattr(held, "_views", lambda *_: views)
    monkeypatch.setattr(held, "coherent_poses", coherent)
    monkeypatch.setattr(held, "contradicting", lambda given: wrong)
    monkeypatch.setattr(held, "loosely_held", lambda made, numbers: loose and numbers == {2})
    inputs: Any = None
    return held.outline_misses(MADE, inputs, Path()), asked


@pytest.mark.parametrize(
    ("contradicted", "wrong", "loose", "found", "asked"),
    [
        (False, [1], True, 5.0, [3]),
        (True, [1], True, 1.0, [3, 2]),
        (True, [1], False, 5.0, [3]),
        (True, [], True, 5.0, [3]),
    ],
)
def test_a_photo_that_contradicts_the_others_and_that_few_points_hold_is_not_counted(
    contradicted: bool, wrong: list[int], loose: bool, found: float, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert misses(monkeypatch, contradicted=contradicted, wrong=wrong, loose=loose) == (found, asked)


def test_where_a_photo_has_no_outline_there_are_no_misses(monkeypatch: pytest.MonkeyPatch) -> None:
    found = misses(monkeypatch, contradicted=False, wrong=[], loose=True, outlines=False)
    assert found == (None, [3])
    monkeypatch.setattr(held, "_views", lambda *_: ())
    monkeypatch.setattr(held, "coherent_poses", lambda views: pytest.fail("there is nothing to compare"))
    inputs: Any = None
    assert held.outline_misses(MADE, inputs, Path()) is None


@pytest.mark.parametrize(
    ("masks", "unmasked", "compared"),
    [(Path("masks"), [], True), (Path("masks"), ["z.png"], True), (Path("masks"), ["b.png"], False), (None, [], False)],
)
def test_outlines_are_compared_where_every_placed_photo_has_a_mask(
    masks: Path | None, unmasked: list[str], compared: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The remains of an earlier look go first; images are read anew, without a cache."""
    opened: list[Any] = []
    folder = tmp_path / "silhouettes"
    folder.mkdir()
    (folder / "left over").touch()

    def found_scene(made: Any, target: Path, inputs: FeatureInput) -> Path:
        assert not target.exists()
        return target

    monkeypatch.setattr(held, "found_scene", found_scene)
    monkeypatch.setattr(held, "load_scene", lambda config: opened.append(config) or SimpleNamespace(train=("views",)))
    inputs = FeatureInput(Path("photos"), masks, "folder", unmasked)
    assert held._views(MADE, inputs, folder) == (("views",) if compared else ())
    assert folder.exists() != compared
    assert [(config.path, config.cache_mb) for config in opened] == [(str(folder), 0)] * compared
    if compared:
        assert held._views(MADE, inputs, folder) == ("views",)  # where nothing is left over
