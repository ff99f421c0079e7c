"""The tables and charts of docs/performance.md that come from runs of whole scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsopt.benchmark.charts import Axis, Series, chart
from gsopt.benchmark.markdown import replace_block, table
from gsopt.benchmark.scenes import pareto_front
from gsopt.config.presets import PRESETS
from gsopt.events import write_atomic

SECONDS = "CPU seconds, 1 thread"
METRICS = {"psnr": ("PSNR", "PSNR, dB"), "lpips_alex": ("LPIPS", "LPIPS (Alex), lower is better")}


def write_page(result: dict[str, Any], page: Path) -> None:
    """Rewrite the block `scenes` of the page and the charts beside it, in img/."""
    for scene in scenes(result):
        for name, svg in charts(result, scene).items():
            write_atomic(page.parent / "img" / f"{name}.svg", svg.encode())
    replace_block(page, "scenes", "\n\n".join(page_parts(result)))


def scenes(result: dict[str, Any]) -> list[str]:
    """Names of the scenes, in the order of their first measurement."""
    return list(dict.fromkeys(run["scene"] for run in result["runs"]))


def runs_of(result: dict[str, Any], scene: str, kind: str) -> list[dict[str, Any]]:
    """A scene's runs of one kind: presets from draft to high, the grid by budget and length."""
    found = [run for run in result["runs"] if run["scene"] == scene and run["kind"] == kind]
    order = list(PRESETS)
    return sorted(found, key=lambda run: (order.index(run["preset"]), run["max_gaussians"] or 0, run["iterations"]))


def charts(result: dict[str, Any], scene: str) -> dict[str, str]:
    """SVG by file name without suffix."""
    drawn, x = {}, Axis(SECONDS, log=True)
    for key, (word, label) in METRICS.items():
        curves = [
            Series(run["preset"], [(p["cpu_seconds"], p[key]) for p in run["points"] if p[key] is not None])
            for run in runs_of(result, scene, "curve")
        ]
        drawn[f"presets-{scene}-{word.lower()}"] = chart(f"{scene}: {word} over time", x, Axis(label), curves)
    drawn[f"pareto-{scene}"] = pareto_chart(result, scene)
    return drawn


def pareto_chart(result: dict[str, Any], scene: str) -> str:
    """PSNR over time at the end of every run of the grid, one series per budget, and the Pareto front."""
    series: dict[int, list[tuple[float, float]]] = {}
    for run in runs_of(result, scene, "grid"):
        last = run["points"][-1]
        series.setdefault(run["max_gaussians"] or 0, []).append((last["cpu_seconds"], last["psnr"]))
    lines = [Series(f"N = {count:,}", points) for count, points in series.items()]
    best = pareto_front([point for points in series.values() for point in points])
    return chart(
        f"{scene}: budgets and lengths", Axis(SECONDS, True), Axis("PSNR, dB"), [*lines, Series("front", best)]
    )


def page_parts(result: dict[str, Any]) -> list[str]:
    machine = result["machine"]
    parts = [f"`{result['command']}` on {machine['cpu']}; gsopt {machine['commit'] or machine['gsopt']}."]
    for scene in scenes(result):
        if curves := runs_of(result, scene, "curve"):
            names = [f"presets-{scene}-{word.lower()}" for word, _ in METRICS.values()]
            parts += [preset_table(scene, curves), image_links(names)]
        if grid := runs_of(result, scene, "grid"):
            parts += [front_table(scene, grid), image_links([f"pareto-{scene}"])]
    return parts


def image_links(names: list[str]) -> str:
    return "\n".join(f"![{name.replace('-', ' ')}](img/{name}.svg)" for name in names)


def preset_table(scene: str, runs: list[dict[str, Any]]) -> str:
    head = [f"{scene}: preset", "steps", "Gaussians", "CPU time", "PSNR, dB", "SSIM", "LPIPS (Alex)"]
    return table(head, [[run["preset"], *figures(run)] for run in runs])


def front_table(scene: str, runs: list[dict[str, Any]]) -> str:
    """Every run of the grid; those on the front in bold."""
    ends = [(run["points"][-1]["cpu_seconds"], run["points"][-1]["psnr"]) for run in runs]
    best = set(pareto_front(ends))
    rows = []
    for run, end in zip(runs, ends, strict=True):
        budget = f"{run['max_gaussians'] or 0:,}"
        rows.append([f"**{budget}**" if end in best else budget, *figures(run)])
    return table([f"{scene}: budget", "steps", "Gaussians", "CPU time", "PSNR, dB", "SSIM", "LPIPS (Alex)"], rows)


def figures(run: dict[str, Any]) -> list[str]:
    last = run["points"][-1]
    lpips = "" if last["lpips_alex"] is None else f"{last['lpips_alex']:.4f}"
    head = [f"{last['step']:,}", f"{last['gaussians']:,}", f"{last['cpu_seconds']:.0f} s"]
    return [*head, f"{last['psnr']:.2f}", f"{last['ssim']:.4f}", lpips]
