"""Reads what gsopt reads of a USD file, in a process of its own, since Pixar's library may end the process over it.

Run as a program: python usd_probe.py FILE. Imports nothing of gsopt, so that it starts quickly.
"""

from __future__ import annotations

import sys
from contextlib import suppress


def probe(path: str) -> None:
    import numpy as np
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.OpenAsAnonymous(path)
    if layer is None or layer.GetCompositionAssetDependencies():
        return
    dict(layer.customLayerData)
    stage = Usd.Stage.Open(layer, None)
    UsdGeom.GetStageUpAxis(stage)
    for prim in stage.Traverse():
        prim.GetTypeName()
        np.array(UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
        for attribute in prim.GetAttributes():
            with suppress(Exception):
                np.array(attribute.Get(), np.float32)


if __name__ == "__main__":
    with suppress(Exception):  # the caller meets it too, and names it
        probe(sys.argv[1])
