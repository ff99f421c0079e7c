"""Parts that the panels of the sidebar share."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

CATEGORY = "gsopt"


class Rows:
    """A list whose rows need nothing but their item. Blender counts the arguments, so that none may be left out."""

    def draw_item(
        self,
        context: Any,
        layout: Any,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
        index: int = 0,
        flag: int = 0,
    ) -> None:
        self.draw_row(layout, item)  # type: ignore[attr-defined]


class Sidebar:
    """Place of all panels."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = CATEGORY


def tell(layout: Any, text: str, icon: str = "NONE", most: int = 8) -> None:
    """A text in lines that fit into the sidebar."""
    region, scale = bpy.context.region, bpy.context.preferences.system.ui_scale
    width = int(region.width / (6.5 * scale)) - 9 if region else 36
    column = layout.column(align=True)
    for place, line in enumerate(textwrap.wrap(text, max(20, width))[:most]):
        column.label(text=line, icon=icon if place == 0 or icon == "NONE" else "BLANK1")


def values(layout: Any, owner: Any, *names: str) -> None:
    """Properties under one another, their names to the left."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    for name in names:
        column.prop(owner, name)


def show_job(layout: Any, entry: Any, kind: str) -> bool:
    """Draws a program's progress, or why it failed; true while it runs."""
    if entry.state == "RUNNING":
        row = layout.row(align=True)
        row.progress(factor=entry.share, text=entry.message[:60] or "working ...")
        if kind != "import":
            row.operator("gsopt.cancel", text="", icon="CANCEL").kind = kind
        return True
    if entry.state == "FAILED" and entry.message:
        tell(layout.box(), entry.message, "ERROR")
    return False


class Child(Sidebar):
    bl_parent_id = "GSOPT_PT_main"
