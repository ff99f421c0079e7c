"""Prompts in the panel: saved, read, written, and proposed by a language model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from in_panel import fails_with


def test_prompts_stay_in_the_blend_and_in_the_file(panel: Any, tmp_path: Path) -> None:
    import bpy

    made = {"source": "llm:qwen", "raw": "raw.txt"}
    prompts = [
        {"text": "春", "weight": 0.5, "view": "back", "polarity": "negative", "source": "llm:qwen", "score": 0.25}
    ]
    (tmp_path / "a.json").write_text(json.dumps({"version": 1, "made": made, "prompts": prompts}))
    bpy.ops.gsopt.prompts_read(filepath=str(tmp_path / "a.json"))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.gsopt.prompts_write(filepath=str(tmp_path / "b.json"))
    written = json.loads((tmp_path / "b.json").read_text(encoding="utf-8"))
    assert written == {"version": 1, "made": made, "prompts": [{**prompts[0], "rationale": ""}]}


def test_a_damaged_blend_ends_in_a_message(panel: Any, tmp_path: Path) -> None:
    import bpy

    panel.prompts.add().text = "a chair"
    for rest in ("{", "[]", "[" * 100_000, '{"notes": Infinity}', '{"notes": "\\ud800"}'):
        panel.prompts_rest = rest
        fails_with(". ", bpy.ops.gsopt.prompts_write, filepath=str(tmp_path / "a.json"))
    assert not (tmp_path / "a.json").exists()


def test_proposals_are_taken_one_by_one(panel: Any) -> None:
    import bpy

    for text in ("one", "two", "three", "four"):
        panel.proposals.add().text = text
    bpy.ops.gsopt.proposal(accept=True)
    bpy.ops.gsopt.proposal(accept=False)
    panel.proposals[0].text = "three, edited"
    bpy.ops.gsopt.proposal(accept=True, all=True)
    assert [entry.text for entry in panel.prompts] == ["one", "three, edited", "four"]
    fails_with("no proposal", bpy.ops.gsopt.proposal)


WRITTEN = {
    "all": [{"text": "a brass lantern with a worn wooden handle", "why": "typical wear"}],
    "back": [{"text": "the back of the lantern, a plain door with a hinge", "why": "no photo shows it"}],
    "negative": [{"text": "blurry, floating specks", "why": "artifacts"}],
}


def propose(panel: Any, address: str) -> None:
    """Press the button, with this address in the preferences."""
    import bpy

    settings = bpy.context.preferences.addons["blender_addon"].preferences
    settings.llm, settings.model = address, "tiny"
    panel.notes, panel.domain = "lantern, brass; -- wood, 春", "generic"
    assert bpy.ops.gsopt.propose() == {"FINISHED"}


def test_what_a_language_model_proposes_is_accepted_edited_or_rejected(panel: Any, tmp_path: Path) -> None:
    import bpy
    from scripted_server import completion, serving

    with serving([completion(json.dumps(WRITTEN))]) as server:
        propose(panel, server.url)
    assert "brass; -- wood, 春" in json.dumps(server.asked[0]["body"], ensure_ascii=False)
    proposed = {entry.text: entry for entry in panel.proposals}
    assert {proposed[entry["text"]].source for entries in WRITTEN.values() for entry in entries} == {"llm:tiny"}
    back = proposed[WRITTEN["back"][0]["text"]]
    assert (back.view, back.polarity, back.rationale) == ("back", "positive", "no photo shows it")
    assert proposed["blurry, floating specks"].polarity == "negative"
    taken = []
    while len(panel.proposals):
        entry = panel.proposals[0]
        accept = entry.polarity == "positive"
        if entry.view == "back":
            entry.text, entry.weight = "its back: a door with two hinges", 0.5
        taken += [(entry.text, entry.weight, entry.view)] if accept else []
        bpy.ops.gsopt.proposal(accept=accept)
    assert [(entry.text, entry.weight, entry.view) for entry in panel.prompts] == taken
    assert ("its back: a door with two hinges", 0.5, "back") in taken
    bpy.ops.gsopt.prompts_write(filepath=str(tmp_path / "prompts.json"))
    assert json.loads((tmp_path / "prompts.json").read_text(encoding="utf-8"))["notes"] == panel.notes


def test_templates_propose_where_there_is_no_language_model(panel: Any) -> None:
    propose(panel, "")
    assert len(panel.proposals) > 4
    assert {entry.source for entry in panel.proposals} <= {"template", "user"}
    assert {"front", "side", "back", "top"} <= {entry.view for entry in panel.proposals}


def test_a_server_that_fails_is_told(panel: Any) -> None:
    import bpy
    from scripted_server import error, serving

    panel.notes = "lantern"
    settings = bpy.context.preferences.addons["blender_addon"].preferences
    with serving([error(401, "no such key")]) as server:
        settings.llm, settings.model = server.url, "tiny"
        fails_with("no such key", bpy.ops.gsopt.propose)
    fails_with("127.0.0.1", bpy.ops.gsopt.propose)
    assert len(panel.proposals) == 0


def test_what_was_chosen_for_one_call_is_not_chosen_for_the_next(panel: Any) -> None:
    """Blender keeps the properties of a call from a button, and gives them to the next one that does not set them."""
    import bpy

    for text in ("one", "two", "three"):
        panel.proposals.add().text = text
    assert bpy.ops.gsopt.proposal("INVOKE_DEFAULT", True, accept=True, all=True) == {"FINISHED"}
    for text in ("four", "five", "six"):
        panel.proposals.add().text = text
    assert bpy.ops.gsopt.proposal("INVOKE_DEFAULT", True, accept=False) == {"FINISHED"}
    assert len(panel.proposals) == 2


def test_pictures_that_were_accepted_become_reference_images(panel: Any, tmp_path: Path) -> None:
    import bpy

    (tmp_path / "a-images").mkdir()
    (tmp_path / "a-images" / "1.png").touch()
    images = [{"file": "a-images/1.png", "prompt": "a", "accepted": True}]
    (tmp_path / "a.json").write_text(json.dumps({"version": 1, "images": images, "prompts": [{"text": "a chair"}]}))
    for _ in range(2):  # once, however often the file is read
        bpy.ops.gsopt.prompts_read(filepath=str(tmp_path / "a.json"))
    assert [entry.path for entry in panel.references] == [str(tmp_path / "a-images" / "1.png")]
    (tmp_path / "elsewhere").mkdir()
    bpy.ops.gsopt.prompts_write(filepath=str(tmp_path / "elsewhere" / "b.json"))
    assert "images" not in json.loads((tmp_path / "elsewhere" / "b.json").read_text())
    bpy.ops.gsopt.prompts_write(filepath=str(tmp_path / "c.json"))
    assert json.loads((tmp_path / "c.json").read_text())["images"] == images
