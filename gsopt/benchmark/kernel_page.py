"""The tables and charts of docs/performance.md that come from kernels.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsopt.benchmark.charts import Axis, Series, chart
from gsopt.benchmark.markdown import replace_block, table
from gsopt.events import write_atomic

STAGES = ("project", "bin", "blend", "photometric", "blend_backward", "project_backward", "adam")


def write_page(result: dict[str, Any], page: Path) -> None:
    """Rewrite the block `kernels` of the page and the charts beside it, in img/."""
    charts = {
        "growth-gaussians.svg": growth_chart(result, "Gaussians"),
        "growth-pixels.svg": growth_chart(result, "pixels"),
    }
    charts["accuracy.svg"] = accuracy_chart(result)
    for name, svg in charts.items():
        write_atomic(page.parent / "img" / name, svg.encode())
    replace_block(page, "kernels", "\n\n".join(page_parts(result)))


def page_parts(result: dict[str, Any]) -> list[str]:
    machine = result["machine"]
    rates = "; ".join(
        f"{isa} {rate['fma_per_second'] / 1e9:.1f} and {rate['exp_per_second'] / 1e9:.2f}"
        for isa, rate in result["calibration"].items()
    )
    load = "" if machine["load"] is None else f", load {machine['load']:.1f} when it began"
    origin = (
        f"`{result['command']}` on {machine['cpu']}, {machine['cores']} cores{load}; "
        f"gsopt {machine['commit'] or machine['gsopt']}. "
        f"One core does this many billion multiply-adds and exponentials per second (lanes): {rates}."
    )
    return [origin, speed_table(result), stage_table(result), *growth_parts(result), *accuracy_parts(result)]


def speed_table(result: dict[str, Any]) -> str:
    head = ["scene", "threads", "set", "iteration, CPU ms", "wall ms", "useful pairs"]
    head += ["G pairs/s forward / backward", "of the bound", "render only"]
    rows = [
        [
            record["case"],
            str(record["threads"]),
            record["isa"],
            milliseconds(record["cpu_ms"]),
            milliseconds(record["wall_ms"]),
            f"{record['useful_pairs'] / 1e6:.1f} M",
            " / ".join(f"{record['pairs_per_second'][way] / 1e9:.2f}" for way in ("forward", "backward")),
            " / ".join(f"{100 * record['share_of_bound'][way]:.0f} %" for way in ("forward", "backward")),
            f"{record['render']['frames_per_second']:.0f} frames/s",
        ]
        for record in result["cases"]
    ]
    return table(head, rows)


def stage_table(result: dict[str, Any]) -> str:
    """CPU milliseconds by stage, one thread."""
    rows = [
        [record["case"], record["isa"], *(f"{record['stages'][stage]['cpu_ms']['median']:.2f}" for stage in STAGES)]
        for record in result["cases"]
        if record["threads"] == 1
    ]
    return table(["CPU ms, 1 thread", "set", *(stage.replace("_", " ") for stage in STAGES)], rows)


def milliseconds(spread: dict[str, float]) -> str:
    return f"{spread['median']:.1f} (IQR {spread['iqr']:.1f})"


def growth_parts(result: dict[str, Any]) -> list[str]:
    lines = [
        f"Time grows with the number of {series['what']} to the power {series['exponent']:.2f} "
        f"({series['fixed']}; from {series['from_size']:,} upward)."
        for series in result["growth"]
    ]
    names = {"Gaussians": "growth-gaussians", "pixels": "growth-pixels"}
    image_links = [
        f"![Time and memory over {series['what']}](img/{names[series['what']]}.svg)" for series in result["growth"]
    ]
    return [" ".join(lines), "\n".join(image_links)] if lines else []


def growth_chart(result: dict[str, Any], what: str) -> str:
    points: list[dict[str, Any]] = next((series["points"] for series in result["growth"] if series["what"] == what), [])
    time = [(point["size"], point["cpu_ms"]["median"]) for point in points]
    memory = [(point["size"], point["memory_mb"]) for point in points if point["memory_mb"]]
    series = [Series("CPU ms per iteration", time), Series("memory, MB", memory)]
    return chart(f"Cost over {what}", Axis(what, log=True), Axis("ms, MB", log=True), series)


def accuracy_parts(result: dict[str, Any]) -> list[str]:
    rows = [
        [row["backend"], milliseconds(row["ms"]), f"{row['image_max_error']:.1e}", f"{row['gradient_error']:.1e}"]
        for row in result["accuracy"]["rows"]
    ]
    if not rows:
        return []
    head = ["backend", "CPU ms", "image, max abs error", "gradient, worst relative error (L2)"]
    scene = f"Against the float64 reference, {result['accuracy']['scene']}:"
    return [scene, table(head, rows), "![Error over time](img/accuracy.svg)"]


def accuracy_chart(result: dict[str, Any]) -> str:
    series = [
        Series(row["backend"], [(row["ms"]["median"], max(row["image_max_error"], 1e-16))], line=False)
        for row in result["accuracy"]["rows"]
    ]
    axes = Axis("CPU ms, forward + backward", log=True), Axis("largest error of the image", log=True)
    return chart("Time against error (error 0 is drawn at 1e-16)", *axes, series)
