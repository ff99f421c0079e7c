"""Seconds of CPU and megabytes that importing takes, added to a list in a file. For people, not for the test suite.

python tests/blender/measure_import.py experiments/results/blender.json 10000 100000 1000000      (needs bpy)
"""

from __future__ import annotations

import gc
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from made_splats import random_splats  # noqa: E402

from blender_addon import loading, nodes, splat_object  # noqa: E402
from blender_addon.core import statistics  # noqa: E402
from blender_addon.core.ply import write_ply  # noqa: E402

FILTERS = {
    "opacity": statistics.Filter(opacity=(0.5, 1.0)),
    "scale": statistics.Filter(largest_scale=0.1),
    "distance": statistics.Filter(farthest=1.0),
    "box": statistics.Filter(box_from_local=np.eye(4)),
    "outliers": statistics.Filter(without_outliers=True),
}


def megabytes() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def clocked(work: Callable[[], Any]) -> tuple[Any, float]:
    began = time.process_time()
    result = work()
    return result, round(time.process_time() - began, 4)


def measure(path: Path, count: int) -> dict[str, Any]:
    before = megabytes()
    splats, read = clocked(lambda: loading.read(path))
    summary, sums = clocked(lambda: statistics.summary(splats))
    parts, prepared = clocked(lambda: splat_object.parts_of(splats))
    steps, slices = splat_object.mesh_in_steps(bpy, "measured", parts), []
    mesh = None
    while mesh is None:
        mesh, seconds = clocked(lambda: next(steps))
        slices.append(seconds)
    del splats, parts, steps
    gc.collect()
    home = bpy.context.scene.collection
    thing = splat_object.make_object(bpy, home, mesh, summary.median_size, 100_000, "Spheres")
    _, shown = clocked(bpy.context.view_layer.update)
    filtered = {name: clocked(lambda f=f: f.keeps(splat_object.MeshShapes(mesh)))[1] for name, f in FILTERS.items()}
    found = {
        "blender": bpy.app.version_string,
        "splats": count,
        "read_s": read,
        "statistics_s": sums,
        "prepare_s": prepared,
    }
    found |= {"mesh_s": round(sum(slices), 4), "longest_slice_s": max(slices), "nodes_100k_s": shown}
    found |= {"filters_s": filtered, "longest_filter_s": max(filtered.values())}
    found |= {"more_MB": round(megabytes() - before)}
    bpy.data.objects.remove(thing)
    bpy.data.meshes.remove(mesh)
    return found


def main(results: Path, counts: list[int]) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    splat_object.splat_material(bpy)
    nodes.node_group(bpy)
    found = json.loads(results.read_text()) if results.exists() else []
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{count}.ply"
            write_ply(path, random_splats(count))
            gc.collect()
            found.append(measure(path, count))
    results.write_text("[\n" + ",\n".join(json.dumps(entry) for entry in found) + "\n]\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(word) for word in sys.argv[2:]])
