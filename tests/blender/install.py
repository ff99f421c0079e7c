"""Install the built extension from its zip, enable, disable, enable again, uninstall; nothing may be left behind.

    BLENDER_USER_RESOURCES=FOLDER python tests/blender/install.py -- gsopt-0.2.0.zip      (or blender -b -P ... -- ZIP)

Prints what it found as one line of JSON, beginning with `found `.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any

import bpy

MODULE = "bl_ext.user_default.gsopt"


def traces() -> list[str]:
    """Whatever of the extension Blender still knows."""
    found = [f"type {name}" for name in dir(bpy.types) if name.startswith(("GSOPT_", "Gsopt"))]
    found += [f"property of {name}" for name in ("Scene", "Object") if hasattr(getattr(bpy.types, name), "gsopt")]
    groups = [getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)]
    handlers = [handler for group in groups if isinstance(group, list) for handler in group]
    found += [f"handler {h.__module__}" for h in handlers if "gsopt" in getattr(h, "__module__", "")]
    menus = (bpy.types.TOPBAR_MT_file_import, bpy.types.TOPBAR_MT_file_export)
    drawn = [function for kind in menus for function in getattr(kind.draw, "_draw_funcs", [])]
    found += [f"menu entry of {function.__module__}" for function in drawn if "gsopt" in function.__module__]
    found += [f"operator {name}" for name in dir(bpy.ops.gsopt)]
    return found


def main(package: str) -> None:
    folder = bpy.utils.user_resource("EXTENSIONS")
    assert folder.startswith(os.environ["BLENDER_USER_RESOURCES"]), "tests do not touch a user's own extensions"
    repository = next((r for r in bpy.context.preferences.extensions.repos if r.module == "user_default"), None)
    assert repository is not None, "no repository `user_default`"
    found: dict[str, Any] = {"blender": bpy.app.version_string}
    bpy.ops.extensions.package_install_files(filepath=package, repo="user_default", enable_on_install=True)
    found["enabled"] = MODULE in bpy.context.preferences.addons and hasattr(bpy.types.Scene, "gsopt")
    found["panel"] = hasattr(bpy.types, "GSOPT_PT_main")
    for _ in range(2):
        bpy.ops.preferences.addon_disable(module=MODULE)
        found["after disabling"] = traces()
        bpy.ops.preferences.addon_enable(module=MODULE)
    found["enabled again"] = hasattr(bpy.context.scene, "gsopt")
    index = list(bpy.context.preferences.extensions.repos).index(repository)
    bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="gsopt")
    found["after uninstalling"] = traces()
    found["files left"] = (
        sorted(os.listdir(os.path.join(folder, "user_default", "gsopt")))
        if os.path.isdir(os.path.join(folder, "user_default", "gsopt"))
        else []
    )
    print("found " + json.dumps(found), flush=True)


if __name__ == "__main__":
    main(os.path.abspath(sys.argv[sys.argv.index("--") + 1]))
