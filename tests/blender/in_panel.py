"""Steps that tests of the panel share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from made_splats import random_splats

from blender_addon.core.ply import write_ply


def bring_in(path: Path, count: int = 100) -> Any:
    """Splats as an object, through the operator."""
    import bpy

    write_ply(path, random_splats(count))
    assert bpy.ops.gsopt.import_splats(filepath=str(path)) == {"FINISHED"}
    return bpy.context.view_layer.objects.active


def fails_with(said: str, operator: Any, **settings: Any) -> None:
    """The operator is canceled with a message in the panel; in a script that is a RuntimeError."""
    import bpy

    with pytest.raises(RuntimeError, match="Error: "):
        operator(**settings)
    assert said in bpy.context.scene.gsopt.message
    assert "Traceback" not in bpy.context.scene.gsopt.message


def event(kind: str, **fields: Any) -> str:
    return json.dumps({"v": 1, "seq": 0, "kind": kind, "time": 1.8e9, **fields}) + "\n"


def stand_in(folder: Path, script: str) -> Path:
    """A program that is called as gsopt's interpreter would be."""
    import bpy

    program = folder / "stand-in python"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    bpy.context.preferences.addons["blender_addon"].preferences.interpreter = str(program)
    return program
