"""Evaluation of a run on its held-out views: metrics.json and renders."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from gsopt._version import __version__
from gsopt.data.refined_poses import with_refined_poses
from gsopt.data.scene import Scene, View, load_scene
from gsopt.errors import InputError
from gsopt.events import LARGEST_METRICS, refuse_links, to_json, write_atomic
from gsopt.gaussians import Gaussians
from gsopt.metrics import PSNR_CAP, Lpips, capped_psnr, color_corrected, object_psnr
from gsopt.raster.backend import Backend, RasterSettings
from gsopt.raster.threads import available_cores, one_torch_thread
from gsopt.results.finished_run import FinishedRun, draw, open_run, truth
from gsopt.results.video import safe_name, save_stills

MAX_TRAIN_VIEWS = 16
"""Input views to evaluate, evenly spread, when none is held out."""
METRICS = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "cc_psnr", "psnr_object", "cc_psnr_object")
"""Metrics of a view; those of the object only where it has alpha."""
METRIC_DIGITS = 6
"""Decimals of a metric; further ones depend on the version of torch."""
MAX_WORKERS = 8
"""Views that are compared at a time: each takes some 100 MB at 800 x 800 px, three times that with VGG."""

NO_TEST_VIEWS = (
    "This run held out no views, so its quality on new views is unknown: metrics of training views stand under `train` "
    "and are not reported as held-out. Train with --eval to hold out every 8th image."
)

OnView = Callable[[int, int], None]


def networks(vgg: bool = False) -> dict[str, Lpips]:
    """The networks of LPIPS by metric. Raises InputError where weights are missing or broken; call it before the work
    that is to be evaluated."""
    return {"lpips_alex": Lpips("alex")} | ({"lpips_vgg": Lpips("vgg")} if vgg else {})


def evaluate_views(
    gaussians: Gaussians,
    views: Sequence[View],
    backend: Backend,
    settings: RasterSettings,
    background: Float[Tensor, "3"],
    save_dir: Path | None,
    *,
    vgg: bool = False,
    threads: int = 0,
    on_view: OnView | None = None,
) -> dict[str, Any]:
    """Returns `{"mean": {psnr, ssim, lpips_alex}, "per_view": [{name, ..., render}]}`, with `vgg` lpips_vgg too.

    Renders and truths are rounded to 8 bit first. A value that cannot be computed (an image too small for the network)
    is None, and so is its mean. `render` is the PNG's name in `save_dir`; `on_view(done, total)` reports. While one
    view is drawn, `threads` others (0: one per core) are compared, with the same figures for any number of them.
    """
    nets, per_view = networks(vgg), list[dict[str, Any]]()
    running: deque[Future[dict[str, Any]]] = deque()
    workers = min(threads or available_cores(), MAX_WORKERS)

    def collect() -> None:
        per_view.append(running.popleft().result())
        if on_view is not None:
            on_view(len(per_view), len(views))

    with one_torch_thread(), ThreadPoolExecutor(workers) as pool:
        try:
            for index, view in enumerate(views):
                render, seen = draw(gaussians, view.camera, backend, settings, background), truth(view, background)
                similarity = _ssim(render, seen, backend)
                path = None if save_dir is None else save_dir / safe_name(index, view.name)
                running.append(pool.submit(_compared, render, seen, view, similarity, nets, path))
                if len(running) > workers:
                    collect()
            while running:
                collect()
        finally:
            pool.shutdown(cancel_futures=True)
    return {"mean": _mean(per_view), "per_view": per_view}


def _ssim(render: UInt8[Tensor, "H W 3"], target: UInt8[Tensor, "H W 3"], backend: Backend) -> float:
    """The SSIM of gsopt/raster/ssim.py by the backend's kernel: a hundredth of the time on a CPU."""
    a, b = (image.to(backend.device).float() / 255 for image in (render, target))
    return backend.photometric(a, b, 0.0).ssim


def _compared(
    render: UInt8[Tensor, "H W 3"],
    seen: UInt8[Tensor, "H W 3"],
    view: View,
    similarity: float,
    nets: dict[str, Lpips],
    path: Path | None,
) -> dict[str, Any]:
    """The row of one view, whose render is saved as `path` with the suffix .png."""
    row: dict[str, Any] = {"name": view.name, **_image_metrics(render, seen, similarity, nets)}
    row |= _further_metrics(render, seen, view)
    if path is not None:
        (saved,) = save_stills(path.parent, [(path.name, render)], overwrite=True)
        row["render"] = saved.name
    return row


def _image_metrics(
    render: UInt8[Tensor, "H W 3"], target: UInt8[Tensor, "H W 3"], similarity: float, nets: dict[str, Lpips]
) -> dict[str, float | None]:
    a, b = (image[None].float() / 255 for image in (render, target))
    values: dict[str, float | None] = {"psnr": capped_psnr(a, b).item(), "ssim": similarity}
    for name, network in nets.items():
        values[name] = network(a, b).item() if network.fits(*render.shape[:2]) else None
    return {name: None if value is None else round(value, METRIC_DIGITS) for name, value in values.items()}


def _further_metrics(
    render: UInt8[Tensor, "H W 3"], target: UInt8[Tensor, "H W 3"], view: View
) -> dict[str, float | None]:
    """PSNR after color correction, and both inside the mask; the latter absent for a view without alpha, None where
    the alpha is empty."""
    pixels = view.pixels()
    a, b = (image[None].float() / 255 for image in (render, target))
    alphas = pixels[None, ..., 3].float() / 255 if pixels.shape[2] == 4 else None
    corrected = color_corrected(a[0], b[0], None if alphas is None else alphas[0])[None]
    values: dict[str, float | None] = {"cc_psnr": capped_psnr(corrected, b).item()}
    if alphas is not None:
        shown = bool(alphas.any())
        values["psnr_object"] = object_psnr(a, b, alphas).item() if shown else None
        values["cc_psnr_object"] = object_psnr(corrected, b, alphas).item() if shown else None
    return {name: None if value is None else round(value, METRIC_DIGITS) for name, value in values.items()}


def _mean(per_view: list[dict[str, Any]]) -> dict[str, float | None] | None:
    """Mean of each metric over views (None when some view lacks it), or None without views."""
    if not per_view:
        return None
    keys = [key for key in METRICS if all(key in row for row in per_view)]
    columns = {key: [row[key] for row in per_view] for key in keys}
    return {
        key: None if any(value is None for value in column) else round(sum(column) / len(column), METRIC_DIGITS)
        for key, column in columns.items()
    }


@torch.no_grad()
def evaluate(
    run: Path,
    *,
    backend: str | None = None,
    threads: int | None = None,
    vgg: bool = False,
    scene: Scene | None = None,
    on_view: OnView | None = None,
) -> dict[str, Any]:
    """Evaluates a finished run on its held-out views and writes metrics.json, whose other fields are kept. `vgg`: LPIPS
    by VGG too, at many times the cost of the rest.

    `scene` saves loading it again. With nothing held out `mean` is null, `reason` explains it, and some input views are
    evaluated under `train`, at their refined poses if the run has any. Renders go to RUN/renders/{test,train}. Raises
    InputError when run or data cannot be read.
    """
    refuse_links(Path(run))
    finished = open_run(Path(run), backend, threads)
    kept = _kept(finished)  # before the work, so that a broken file is not replaced
    scene = with_refined_poses(scene or load_scene(finished.config.data), finished.path)
    results = _results(finished, scene, vgg, finished.config.threads if threads is None else threads, on_view)
    document = {**kept, **results, "protocol": _protocol(finished, scene, results)}
    write_atomic(finished.path / "metrics.json", to_json(document))
    return document


def _kept(finished: FinishedRun) -> dict[str, Any]:
    """The fields of metrics.json that are kept and the facts about the run; InputError when they are no strict JSON."""
    kept = {**read_metrics(finished.path), **_about(finished)}
    try:
        to_json(kept)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"metrics.json and config.json in {finished.path} must be strict JSON, got {error}. Move metrics.json away."
        ) from error
    return kept


def read_metrics(run: Path) -> dict[str, Any]:
    """Content of metrics.json, {} without the file; InputError when it cannot be parsed."""
    path = run / "metrics.json"
    if not path.exists():
        return {}
    try:
        with open(path, "rb") as file:
            document = json.loads(file.read(LARGEST_METRICS))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"Cannot read {path}: {error}. Move it away and evaluate again.") from error
    if not isinstance(document, dict):
        raise InputError(f"{path} must hold an object, got {type(document).__name__}. Move it away and evaluate again.")
    return document


def _results(finished: FinishedRun, scene: Scene, vgg: bool, threads: int, on_view: OnView | None) -> dict[str, Any]:
    split, views = ("test", scene.test) if scene.test else ("train", evenly_spread(scene.train, MAX_TRAIN_VIEWS))
    drawing = finished.backend, finished.settings, finished.background, finished.path / "renders" / split
    evaluated = evaluate_views(finished.gaussians, views, *drawing, vgg=vgg, threads=threads, on_view=on_view)
    for row in evaluated["per_view"]:
        row["render"] = f"renders/{split}/{row['render']}"
    if split == "test":
        return {**evaluated, "reason": None, "train": None, "notes": []}
    return {"mean": None, "per_view": [], "reason": NO_TEST_VIEWS, "train": evaluated, "notes": []}


def evenly_spread(views: Sequence[View], count: int) -> list[View]:
    """At most `count` of the views, evenly spread over their order."""
    count = min(count, len(views))
    return [views[i * len(views) // count] for i in range(count)]


def _about(finished: FinishedRun) -> dict[str, Any]:
    """Facts about the run that accompany its metrics."""
    recorded = json.loads((finished.path / "config.json").read_bytes())
    about = {
        "n_gaussians": len(finished.gaussians),
        "seed": finished.config.seed,
        "config": finished.config.to_dict(),
    }
    return {**about, **({"versions": recorded["versions"]} if "versions" in recorded else {})}


def _protocol(finished: FinishedRun, scene: Scene, results: dict[str, Any]) -> str:
    """The evaluation protocol, as a note below a table."""
    evaluated = len(results["per_view"]) or len(results["train"]["per_view"])
    asked = (results["per_view"] or results["train"]["per_view"] or [{}])[0]
    lpips = "LPIPS v0.1 Alex" + (
        " and VGG (the Inria code feeds VGG [0,1] unscaled, which gives other values)" if "lpips_vgg" in asked else ""
    )
    named = finished.config.data.background
    color = "(" + ", ".join(f"{value:g}" for value in finished.background.tolist()) + ")"
    background = {"random": "white (trained on random)", "auto": color}.get(named, named)
    return (
        "PSNR per image then mean; psnr_object inside the truth's alpha; cc_psnr after an affine fit of RGB per image; "
        f"SSIM 11x11 sigma 1.5 zero padding; {lpips}, inputs mapped to [-1,1]; renders and truths rounded to 8 bit as "
        f"the field does; equal images count as {PSNR_CAP:g} dB; background "
        f"{background}; split: trained on {len(scene.train)} views, held out "
        f"{len(scene.test)}, evaluated on {evaluated} {'held-out' if scene.test else 'training'} views; images "
        f"{_sizes(scene.test or scene.train)}; gsopt {__version__}, torch {torch.__version__}, "
        f"backend {finished.backend.name}."
    )


def _sizes(views: Sequence[View]) -> str:
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    return ", ".join(f"{width}x{height}" for width, height in sizes[:3]) + (" and others" if len(sizes) > 3 else "")
