"""gsopt in Blender: from a mesh or photos, through an expert's words, to splats one can look at, filter and export.

Everything that learns runs in another process; the run directory is all that is shared with it. `core` needs no
Blender.
"""

from __future__ import annotations


def register() -> None:
    from . import registration

    registration.register()


def unregister() -> None:
    from . import registration

    registration.unregister()
