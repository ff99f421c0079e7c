"""Every panel draws in every state of the work, and names only properties and operators that there are."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from in_panel import bring_in


class Layout:
    """Stands in for Blender's layout, which only a window has; notes the texts."""

    def __init__(self, texts: list[str]) -> None:
        self.texts = texts

    def part(self, **_: Any) -> Layout:
        return Layout(self.texts)

    row = column = box = part

    def separator(self) -> None:
        pass

    def label(self, text: str = "", icon: str = "NONE") -> None:
        self.texts.append(text)

    def progress(self, factor: float, text: str) -> None:
        assert 0 <= factor <= 1
        self.texts.append(text)

    def prop(self, owner: Any, name: str, **_: Any) -> None:
        assert name in owner.bl_rna.properties, name

    def prop_enum(self, owner: Any, name: str, value: str, text: str = "") -> None:
        assert name in owner.bl_rna.properties, name
        self.texts.append(text or value)

    def operator(self, name: str, text: str = "", icon: str = "NONE") -> Any:
        import bpy

        properties = getattr(bpy.ops.gsopt, name.removeprefix("gsopt.")).get_rna_type().properties
        return Settings({key for key in properties.keys()})  # noqa: SIM118

    def template_list(self, kind: str, _: str, owner: Any, name: str, active: Any, index: str, **__: Any) -> None:
        assert {name, index} <= set(owner.bl_rna.properties.keys())


class Settings:
    """Properties passed to a button; only properties that its operator has."""

    def __init__(self, known: set[str]) -> None:
        object.__setattr__(self, "known", known)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self.known, name


def drawn(shading: str = "SOLID") -> str:
    """The texts of all panels."""
    import bpy

    from blender_addon import panel

    view = SimpleNamespace(shading=SimpleNamespace(type=shading, bl_rna=bpy.types.View3DShading.bl_rna))
    context = SimpleNamespace(scene=bpy.context.scene, view_layer=bpy.context.view_layer, space_data=view)
    texts: list[str] = []
    for kind in panel.CLASSES:
        if issubclass(kind, panel.Sidebar):
            kind.draw(SimpleNamespace(layout=Layout(texts)), context)
    return "\n".join(texts)


def test_an_empty_file_draws(panel: Any) -> None:
    for source in ("MESH", "DATASET", "PHOTOS"):
        panel.source = source
        assert "Earlier runs" in drawn()
    panel.domain, panel.prior, panel.preset = "own", "FOLDER", "own"
    drawn()


def test_work_that_goes_on_draws_with_its_progress(panel: Any) -> None:
    for kind in ("dataset", "poses", "prompts", "page", "clean", "mesh", "measure", "import"):
        entry = getattr(panel, f"job_{kind}")
        entry.state, entry.share, entry.message = "RUNNING", 0.5, f"half of the {kind}"
    panel.run_status, panel.run_path = "waiting", "/runs/a"
    assert "reading the data" in drawn()
    panel.run_status, panel.run_step, panel.run_total, panel.run_count = "running", 250, 1000, 4321
    panel.run_psnr, panel.run_eta, panel.run_message = 24.5, 75.0, "few views"
    text = drawn()
    for said in ("half of the import", "250 of 1,000", "PSNR 24.50 dB", "1:15 left", "4,321 Gaussians", "few views"):
        assert said in text
    assert "Material Preview" in text, "Solid view is gray"
    assert "Standard" in drawn("MATERIAL") or panel.id_data.view_settings.view_transform == "Standard"


def test_a_finished_run_can_be_shared_and_cleaned(panel: Any) -> None:
    panel.run_status, panel.run_path, panel.run_step = "done", "/runs/a", 7
    panel.job_clean.state, panel.job_clean.message = "FAILED", "no input views"
    assert "no input views" in drawn()
    panel.job_page.state, panel.job_page.message = "RUNNING", "half of the page"
    assert "half of the page" in drawn()


def test_what_failed_draws_with_its_reason(panel: Any) -> None:
    panel.message = panel.doctor = "there is no gsopt"
    panel.job_dataset.state, panel.job_dataset.message = "FAILED", "the disk is full"
    panel.run_status, panel.run_path, panel.run_message = "killed", "/runs/a", "go on with Resume " * 50
    assert all(said in drawn() for said in ("there is no gsopt", "the disk is full", "a: killed"))


def test_lists_and_splats_draw(panel: Any, tmp_path: Path) -> None:
    import bpy

    panel.proposals.add().text = "one"
    for text in ("two", "three"):
        bpy.ops.gsopt.prompt_add(text=text)
    panel.runs.add().path = panel.references.add().path = str(tmp_path)
    bring_in(tmp_path / "a.ply")
    panel.farthest = 2.0
    text = drawn()
    assert "1 proposal, by user" in text
    assert "100 splats, 0 outliers" in text
