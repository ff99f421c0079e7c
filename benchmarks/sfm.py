"""How well `gsopt sfm` finds poses that are known: each mapper on one database, and what training makes of them.

python benchmarks/sfm.py --photos DATA/fox --work WORK [--train] writes benchmarks/results/sfm.json. DATA/fox has photos
and transforms.json; the poses in it are the truth. Features and matches are made once; each mapper then runs in a
process of its own, so that its time and memory are its own. Times are CPU seconds (user + system) of one thread.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import time
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results" / "sfm.json"
MAPPERS = ("incremental", "global", "hybrid")
TRAINING = ("-r", "4", "--eval", "--threads", "1", "--iterations", "7000")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, required=True, help="folder with photos and their transforms.json")
    parser.add_argument("--work", type=Path, required=True, help="folder for databases, scenes and runs; reused")
    parser.add_argument("--name", default="", help="key in the results; the folder's name when not given")
    parser.add_argument("--mappers", default=",".join(MAPPERS))
    parser.add_argument("--train", action="store_true", help="train on every scene, and on the given poses")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Any] = {"features": once(options.work / "features.json", find_features, options)}
    for mapper in options.mappers.split(","):
        rows[mapper] = once(options.work / f"{mapper}.json", find_poses, options, mapper)
        if options.train:
            rows[mapper] |= trained(options.work / mapper, options.work / f"run-{mapper}")
    if options.train:
        rows["given"] = trained(options.photos, options.work / "run-given")
    record(options.name or options.photos.name, rows)


def once(path: Path, function: Any, *arguments: Any) -> dict[str, Any]:
    """What `function` found, measured in a fresh process; kept in `path`, so that an interrupted benchmark goes on."""
    if not path.is_file():
        with get_context("spawn").Pool(1) as pool:
            found = pool.apply(measured, (function, *arguments))
            pool.close()
            pool.join()
        path.write_text(json.dumps(found, indent=1))
    return json.loads(path.read_text())


def measured(function: Any, *arguments: Any) -> dict[str, Any]:
    """The function's figures with CPU seconds and peak memory of this process."""
    import pycolmap  # its import is no part of the time

    pycolmap.logging.minloglevel = 3
    began = time.process_time()
    found: dict[str, Any] = function(pycolmap, *arguments)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    return {**found, "cpu_seconds": round(time.process_time() - began, 1), "peak_memory_mb": round(peak)}


def find_features(pycolmap: Any, options: argparse.Namespace) -> dict[str, Any]:
    from gsopt.data.sfm import features, masks, photos
    from gsopt.data.sfm.settings import SfmConfig

    config = SfmConfig(threads=1)
    read, _ = photos.read_photos(photos.find_photos(options.photos), options.work)
    masked = masks.prepare_masks("none", options.photos, read, options.work)
    database = options.work / "database.db"
    began = time.process_time()
    features.extract(pycolmap, database, read, masked, config)
    extracted = time.process_time()
    graph = features.match(pycolmap, database, [photo.name for photo in read], "exhaustive", config, print)
    return {
        "photos": len(read),
        "pairs_with_matches": len(graph.inliers),
        "extraction_cpu_seconds": round(extracted - began, 1),
        "matching_cpu_seconds": round(time.process_time() - extracted, 1),
    }


def find_poses(pycolmap: Any, options: argparse.Namespace, mapper: str) -> dict[str, Any]:
    from gsopt.data.sfm import features, mapping, masks, pipeline, placement, writing
    from gsopt.data.sfm.settings import SfmConfig

    work = options.work / f"{mapper}-work"
    work.mkdir()
    for name in ("photos", "database.db"):
        (work / name).symlink_to((options.work / name).absolute())
    config = SfmConfig(mapper=mapper, threads=1)  # type: ignore[arg-type]
    graph = features.read_graph(pycolmap, work / "database.db")
    mapped = mapping.find_poses(pycolmap, work / "database.db", work / "photos", graph, config, print)
    if mapped is None:
        return {"registered": 0}
    found = mapped.reconstruction
    similarity = placement.place(pipeline.poses(found)[1], pipeline.points(found)[0])
    masked = masks.Masked(work / "photos", None, "none", [])
    figures = {
        "registered": len(mapped.names),
        "reprojection_error_px": round(found.compute_mean_reprojection_error(), 4),
        "track_length": round(found.compute_mean_track_length(), 3),
        "points": found.num_points3D(),
    }
    writing.write_scene(pycolmap, found, work, masked, similarity, undistort=True).rename(options.work / mapper)
    return figures | trajectory(options.work / mapper, options.photos)


def trajectory(scene: Path, truth: Path) -> dict[str, Any]:
    """Errors after similarity alignment, over the photos both know."""
    from gsopt.data.sfm.trajectory import compare

    found, known = named_poses(scene), named_poses(truth)
    names = sorted(found.keys() & known.keys())
    error = compare(np.stack([found[name] for name in names]), np.stack([known[name] for name in names]))
    return {"compared": len(names), **error.summary()}


def named_poses(folder: Path) -> dict[str, Any]:
    from gsopt.data.scene import read_source

    source = read_source(folder)
    return {Path(frame.name).stem: frame.viewmat.numpy() for frame in [*source.frames, *(source.held_out or [])]}


def trained(scene: Path, run: Path) -> dict[str, Any]:
    """Held-out figures after training; an earlier run in the same folder is taken as it is."""
    if not (run / "metrics.json").is_file():
        command = [sys.executable, "-m", "gsopt", "train", str(scene), "-m", str(run), *TRAINING]
        subprocess.run(command, check=True)
    metrics = json.loads((run / "metrics.json").read_text())
    mean = metrics["mean"]
    return {
        "psnr": round(mean["psnr"], 3),
        "ssim": round(mean["ssim"], 4),
        "held_out": len(metrics["per_view"]),
        "init": metrics["init"],
    }


def record(name: str, rows: dict[str, Any]) -> None:
    """Put the rows into the results file, beside those of other scenes."""
    results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {"scenes": {}}
    results["command"] = "python benchmarks/sfm.py --photos DATA --work WORK --train"
    results["machine"] = f"{platform.machine()}, one thread; CPU seconds, because other work ran beside it"
    results["training"] = " ".join(TRAINING)
    results["scenes"][name] = rows
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
