"""What is said of a scene that a prior learns from: the captions that the renderer of its mesh wrote beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsopt.data.files import is_regular, read_json
from gsopt.sds.conditioning import NEUTRAL, WORDS

LONGEST_TEXT = 120
"""Characters that are taken of a caption."""


def said_of(scene: Path) -> tuple[str, ...]:
    """Texts that describe the scene, the shortest whole description first; none where nobody wrote a caption.

    From captions.json and object.json of `scripts/synth_views.py`. InputError for one that is no JSON.
    """
    captions, known = _read(scene / "captions.json"), _read(scene / "object.json")
    caption, name, category = (
        _text(d.get(k)) for d, k in ((captions, "caption"), (known, "name"), (known, "category"))
    )
    if not caption:
        return ()
    views = captions.get("views")
    seen = {_text(text) for text in views.values()} if isinstance(views, dict) else set()
    named = [name, f"{name}, {category}"] if name else []
    sided = [f"{caption}, {word}" for word in WORDS.values()]
    return tuple(dict.fromkeys(filter(None, [caption, f"a photo of {caption}", *named, *sided, *sorted(seen)])))


def common_texts() -> tuple[str, ...]:
    """What fits any scene."""
    return (NEUTRAL,)


def _read(path: Path) -> dict[str, Any]:
    document = read_json(path) if is_regular(path) else {}
    return document if isinstance(document, dict) else {}


def _text(value: object) -> str:
    """One line of printable lower-case words."""
    if not isinstance(value, str):
        return ""
    return " ".join("".join(c if c.isprintable() else " " for c in value[:LONGEST_TEXT]).lower().split())
