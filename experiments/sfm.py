"""Measures the accuracy of `gsopt sfm`: each mapper on one database with known poses, and training on the result.

python experiments/sfm.py --photos DATA/fox --work WORK [--video] [--train] writes its results/sfm.json. DATA/fox
has photos and transforms.json; its poses are the truth, hidden from `gsopt sfm`. --video first encodes the
photos as H.264 and starts from that file. Features and matches are computed once; each mapper then runs in a process of
its own, for separate time and memory. Times are CPU seconds (user + system) of one thread. --train compares training
with the found poses and with the given ones, on the same pixels and photos.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import sys
import time
from dataclasses import replace
from fractions import Fraction
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results" / "sfm.json"
MAPPERS = ("incremental", "global", "hybrid")
FRAMES_A_SECOND = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, required=True, help="folder with photos and their transforms.json")
    parser.add_argument("--work", type=Path, required=True, help="folder for databases, scenes and runs; reused")
    parser.add_argument("--name", default="", help="key in the results; the folder's name when not given")
    parser.add_argument("--mappers", default=",".join(MAPPERS))
    parser.add_argument("--video", action="store_true", help="start from a video made of the photos")
    parser.add_argument("--train", action="store_true", help="train on every scene, and on the given poses")
    parser.add_argument("--resolution", default="1", help="of the training: divide width and height by this")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Any] = {"features": once(options.work / "features.json", find_features, options)}
    for mapper in options.mappers.split(","):
        rows[mapper] = once(options.work / f"{mapper}.json", find_poses, options, mapper)
        if options.train and rows[mapper]["registered"]:
            rows[mapper] |= compared(options, mapper)
    record(options.name or options.photos.name + ("-video" if options.video else ""), rows, options)


def once(path: Path, function: Any, *arguments: Any) -> dict[str, Any]:
    """Result of `function` in a fresh process, kept in `path`, so that an interrupted experiment can continue."""
    if not path.is_file():
        with get_context("spawn").Pool(1) as pool:
            found = pool.apply(measured, (function, *arguments))
            pool.close()
            pool.join()
        path.write_text(json.dumps(found, indent=1))
    found = json.loads(path.read_text())
    return dict(found)


def measured(function: Any, *arguments: Any) -> dict[str, Any]:
    """The function's figures with CPU seconds and peak memory of this process."""
    import pycolmap  # its import is not measured

    pycolmap.logging.minloglevel = 3
    began = time.process_time()
    found: dict[str, Any] = function(pycolmap, *arguments)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    return {**found, "cpu_seconds": round(time.process_time() - began, 1), "peak_memory_mb": round(peak)}


def input_photos(options: argparse.Namespace) -> list[Path]:
    """The photos, or the frames that are taken from a video made of them."""
    from gsopt.data.sfm.photos import find_photos
    from gsopt.data.sfm.settings import SfmConfig
    from gsopt.data.sfm.video import extract_frames

    photos = find_photos(options.photos)
    if not options.video:
        return photos
    video = options.work / "photos.mp4"
    write_video(photos, video)
    return extract_frames(video, options.work / "frames", SfmConfig().frames).paths


def write_video(photos: list[Path], video: Path) -> None:
    """H.264 of near-original quality."""
    import av
    from PIL import Image

    from gsopt.data.image_files import IMAGE_FORMATS

    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(FRAMES_A_SECOND), options={"crf": "16"})
        stream.width, stream.height = Image.open(photos[0], formats=IMAGE_FORMATS).size
        stream.pix_fmt = "yuv420p"
        for path in photos:
            image = Image.open(path, formats=IMAGE_FORMATS).convert("RGB")
            container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())


def find_features(pycolmap: Any, options: argparse.Namespace) -> dict[str, Any]:
    from gsopt.data.sfm import features, photos
    from gsopt.data.sfm.settings import SfmConfig

    config = SfmConfig(threads=1)
    read, _ = photos.read_photos(input_photos(options), options.work)
    inputs = masks(options, read)
    database = options.work / "database.db"
    chosen = time.process_time()
    project = features.ColmapProject(pycolmap, database, inputs.photos, config)
    features.extract(project, read, inputs.masks)
    extracted = time.process_time()
    matching = features.choose_matching(config, len(read), options.video)
    graph = features.match(project, [photo.name for photo in read], matching, print)
    return {
        "photos": len(read),
        "masks": inputs.kind,
        "matching": matching,
        "pairs_with_matches": len(graph.inliers),
        "extraction_cpu_seconds": round(extracted - chosen, 1),
        "matching_cpu_seconds": round(time.process_time() - extracted, 1),
    }


def masks(options: argparse.Namespace, read: list[Any]) -> Any:
    from gsopt.data.sfm.masks import prepare_masks

    return prepare_masks("auto", options.photos, read, options.work)


def find_poses(pycolmap: Any, options: argparse.Namespace, mapper: str) -> dict[str, Any]:
    from gsopt.data.sfm import features, mapping, pipeline, placement, write_scene
    from gsopt.data.sfm.masks import FeatureInput
    from gsopt.data.sfm.settings import SfmConfig

    work = options.work / f"{mapper}-work"
    work.mkdir()
    for name in ("photos", "database.db", "opaque"):
        if (options.work / name).exists():
            (work / name).symlink_to((options.work / name).absolute())
    config = SfmConfig(mapper=mapper, threads=1)  # type: ignore[arg-type]
    opaque = work / "opaque" if (work / "opaque").exists() else work / "photos"
    project = features.ColmapProject(pycolmap, work / "database.db", opaque, config)
    graph = features.read_graph(project)
    mapped = mapping.find_poses(project, graph, print)
    if mapped is None:
        return {"registered": 0}
    found = mapped.reconstruction
    similarity = placement.place(mapping.poses(found)[1], pipeline.points(found)[0])
    figures = {
        "registered": len(mapped.names),
        "reprojection_error_px": round(found.compute_mean_reprojection_error(), 4),
        "track_length": round(found.compute_mean_track_length(), 3),
        "points": found.num_points3D(),
    }
    inputs = FeatureInput(opaque, None, "none", [])
    write_scene.write_scene(pycolmap, found, work, inputs, similarity, undistort=True).rename(options.work / mapper)
    return figures | trajectory(options, options.work / mapper)


def trajectory(options: argparse.Namespace, scene: Path) -> dict[str, Any]:
    """Errors after similarity alignment, over the photos both know."""
    from gsopt.data.sfm.trajectory import compare

    truth = {name: frame.viewmat.numpy() for name, frame in truths(options).items()}
    found = {Path(frame.name).stem: frame.viewmat.numpy() for frame in all_frames(scene)}
    names = sorted(found.keys() & truth.keys())
    error = compare(np.stack([found[name] for name in names]), np.stack([truth[name] for name in names]))
    return {"compared": len(names), **error.summary()}


def truths(options: argparse.Namespace) -> dict[str, Any]:
    """The given frames by the name (without suffix) that the photo has in a found scene."""
    from gsopt.data.sfm.photos import find_photos

    frames = {Path(frame.name).stem: frame for frame in all_frames(options.photos)}
    stems = [path.stem for path in find_photos(options.photos)]
    names = [f"frame_{i:05d}" for i in range(1, len(stems) + 1)] if options.video else stems
    return {name: frames[stem] for name, stem in zip(names, stems, strict=True) if stem in frames}


def all_frames(folder: Path) -> list[Any]:
    from gsopt.data.scene import read_dataset

    source = read_dataset(folder)
    return [*source.frames, *(source.held_out or [])]


def compared(options: argparse.Namespace, mapper: str) -> dict[str, Any]:
    """Held-out figures with the found poses, and with the given poses of the same photos."""
    found = trained(options, options.work / mapper, options.work / f"run-{mapper}")
    names = sorted(Path(frame.name).stem for frame in all_frames(options.work / mapper))
    given = given_scene(options, names)
    beside = trained(options, given, options.work / f"run-{given.name}")
    return found | {f"{key}_with_given_poses": beside[key] for key in ("psnr", "ssim", "init")}


def given_scene(options: argparse.Namespace, names: list[str]) -> Path:
    """A scene with these photos, as `gsopt sfm` reads them, and the given poses and lenses."""
    scene = options.work / f"given-{len(names)}"
    if scene.exists():
        return scene
    from gsopt.events import to_json
    from gsopt.geometry.cameras import opengl_from_viewmats

    known = truths(options)
    (scene / "images").mkdir(parents=True)
    rows = []
    for photo in sorted((options.work / "photos").iterdir()):
        if photo.stem in names:
            (scene / "images" / photo.name).symlink_to(photo.resolve())
            rows.append(frame_row(replace(known[photo.stem], name=f"images/{photo.name}"), opengl_from_viewmats))
    (scene / "transforms.json").write_bytes(to_json({"frames": rows}))
    return scene


def frame_row(frame: Any, opengl_from_viewmats: Any) -> dict[str, Any]:
    """One frame of a nerfstudio transforms.json, its lens included."""
    K, lens = frame.K, frame.lens
    radial = [*lens.radial, 0.0, 0.0, 0.0, 0.0][:4]
    return {
        "file_path": frame.name,
        "transform_matrix": opengl_from_viewmats(frame.viewmat).tolist(),
        "w": frame.width,
        "h": frame.height,
        **{"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])},
        "camera_model": "OPENCV_FISHEYE" if lens.fisheye else "OPENCV",
        **dict(zip(("k1", "k2", "k3", "k4"), radial, strict=True)),
        **({} if lens.is_pinhole else dict(zip(("p1", "p2"), lens.tangential, strict=True))),
    }


def trained(options: argparse.Namespace, scene: Path, run: Path) -> dict[str, Any]:
    """Held-out metrics after training; an earlier run in the same folder is reused."""
    if not (run / "metrics.json").is_file():
        command = [sys.executable, "-m", "gsopt", "train", str(scene), "-m", str(run), *training(options), "--resume"]
        subprocess.run(command, check=True)
    metrics = json.loads((run / "metrics.json").read_text())
    mean = metrics["mean"]
    return {
        "psnr": round(mean["psnr"], 3),
        "ssim": round(mean["ssim"], 4),
        "held_out": len(metrics["per_view"]),
        "init": metrics["init"],
    }


def training(options: argparse.Namespace) -> list[str]:
    return ["-r", options.resolution, "--eval", "--threads", "1", "--iterations", "7000"]


def record(name: str, rows: dict[str, Any], options: argparse.Namespace) -> None:
    """Put the rows into the results file, beside those of other scenes."""
    results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {"scenes": {}}
    results["command"] = "python experiments/sfm.py --photos DATA --work WORK --train [--video]"
    results["machine"] = f"{platform.machine()}, one thread; CPU seconds, because other work ran beside it"
    if options.train:
        rows["training"] = " ".join(training(options))
    results["scenes"][name] = rows
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
