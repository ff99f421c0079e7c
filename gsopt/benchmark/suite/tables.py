"""The tables and charts of a suite, made from its result file alone, in sections for Markdown and HTML."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsopt.benchmark.charts import Axis, Series, chart
from gsopt.benchmark.markdown import replace_block, table
from gsopt.benchmark.suite import aggregate, arm_flags
from gsopt.benchmark.suite import definition as declared
from gsopt.benchmark.suite.aggregate import Difference, Run, Variant, variant
from gsopt.benchmark.suite.definition import Group, Suite, view_count
from gsopt.benchmark.suite.result_file import run_id
from gsopt.events import write_atomic

METRICS = {
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 4),
    "lpips_alex": ("LPIPS Alex", 4),
    "lpips_vgg": ("LPIPS VGG", 4),
    "mask_iou": ("mask IoU", 4),
    "depth_error": ("depth error", 4),
}
COMPARED = ("psnr", "ssim", "lpips_alex", "lpips_vgg")
SEEDS = 3
Table = tuple[list[str], list[list[str]]]


@dataclass
class GroupSection:
    """Tables and charts of one group at one number of views."""

    title: str
    lines: list[str] = field(default_factory=list)
    tables: list[tuple[str, Table]] = field(default_factory=list)
    """(sentence above the table, table)."""
    charts: dict[str, str] = field(default_factory=dict)
    """SVG by file name without suffix."""
    scenes: list[str] = field(default_factory=list)
    """Rows of the image grid, in the suite's order."""
    views: str = ""
    variants: list[Variant] = field(default_factory=list)


def group_sections(document: dict[str, Any]) -> list[GroupSection]:
    """Every group and number of views that has a run, in the suite's order."""
    suite = declared.of_document(document)
    return [
        group_section(suite, group, views, found)
        for group in suite.groups
        for views in group.views
        if (found := [r for r in document["runs"] if r["group"] == group.name and r["views"] == views])
    ]


def group_section(suite: Suite, group: Group, views: str, runs: list[Run]) -> GroupSection:
    """The tables of runs that were trained alike."""
    variants = [one for one in group.runs if any(variant(run) == one for run in runs)]
    several = len(group.views) > 1
    title = group.title + (f": {view_count(views)} views" if several else "")
    section = GroupSection(title, [group.why], views=views, variants=variants)
    section.scenes = [scene for scene in group.scenes if any(run["scene"] == scene for run in runs)]
    seeds = sorted({run["seed"] for run in runs})
    which = ("seed " if len(seeds) == 1 else "seeds ") + ", ".join(map(str, seeds))
    section.lines.append(f"{len(runs)} runs, {_count(len(section.scenes), 'scene')}, {which}.")
    whole = aggregate.complete(runs, variants)
    same = aggregate.common(runs, whole)
    note = "Means over scenes, seeds averaged first; " + (
        "only runs that every arm has." if same else "arms differ in scenes."
    )
    if lacking := [_name(one) for one in variants if one not in whole] if same else []:
        note += f" Without {', '.join(lacking)}: scenes or seeds are missing."
    section.tables.append((note, figures(same or runs, whole if same else variants)))
    pairs = list(comparisons(group, variants))
    if rows := [row for a, b in pairs if (row := compared(runs, a, b))]:
        what = "scenes" if len(section.scenes) > 1 else "seeds of the one scene"
        head = ["paired difference", what, *(f"Δ {METRICS[m][0]}" for m in COMPARED), "PSNR worst", "PSNR better in"]
        section.tables.append(("Mean with its 95 % confidence interval (Student's t); losses included.", (head, rows)))
    if len(variants) > 1 and (rows := [row for a in variants if (row := time_row(runs, a, variants[0]))]):
        note = f"CPU seconds until a run reaches the final PSNR of {_name(variants[0])} on the same scene (mean of "
        note += f"{max(run['curve_views'] for run in runs)} held-out views, evaluated {declared.EVALUATIONS} times)."
        section.tables.append(
            (note, (["arm", "median of the runs that reach it", "reach it", "whole run, median"], rows))
        )
    if len(section.scenes) > 1:
        section.tables.append(("PSNR of every scene.", scene_rows(runs, section.scenes, variants)))
    section.charts = charts(
        f"suite-{suite.name}-{group.name}" + (f"-{view_count(views)}" if several else ""), section, runs
    )
    return section


def figures(runs: Sequence[Run], variants: Sequence[Variant]) -> Table:
    """Means of every arm."""
    shown = [m for m in METRICS if any(run["mean"][m] is not None for run in runs)]
    head = ["arm", "scenes", *(METRICS[m][0] for m in shown), "Gaussians", "CPU s", "peak MB"]
    rows = []
    for one in variants:
        mine = [run for run in runs if variant(run) == one]
        row = [_name(one), str(len({run["scene"] for run in mine}))]
        for metric in shown:
            values = aggregate.by_scene(mine, metric).values()
            row.append(f"{statistics.fmean(values):.{METRICS[metric][1]}f}" if values else "")
        row.append(f"{statistics.fmean(run['n_gaussians'] for run in mine):,.0f}")
        row.append(f"{statistics.fmean(seconds(run) for run in mine):.0f}")
        peaks = [run["peak_memory_mb"] for run in mine if run["peak_memory_mb"] is not None]
        rows.append([*row, f"{statistics.fmean(peaks):.0f}" if peaks else ""])
    return head, rows


def seconds(run: Run) -> float:
    """CPU seconds of reading, first Gaussians, the guard and all steps."""
    return float(run["setup_cpu_seconds"] + run["train_cpu_seconds"])


def comparisons(group: Group, variants: Sequence[Variant]) -> Iterator[tuple[Variant, Variant]]:
    """Pairs to compare: each variant with the first, guided with unguided arms, ours with longer runs of 3dgs."""
    base = variants[0]
    for one in variants[1:]:
        yield one, base
    for arm, steps in variants:
        if arm_flags.is_guided(arm) and ("ours-0", steps) in variants:
            yield (arm, steps), ("ours-0", steps)
    for arm, steps in variants:
        longer = [(a, n) for a, n in variants if a == base[0] and n > steps and (a, n) != base]
        yield from (((arm, steps), other) for other in longer if arm != base[0])


def compared(runs: Sequence[Run], a: Variant, b: Variant) -> list[str]:
    """A row of the table of differences, empty without a pair."""
    found = {m: aggregate.summarized(aggregate.differences(runs, a, b, m)) for m in COMPARED}
    psnr = found["psnr"]
    if psnr is None:
        return []
    row = [f"{_name(a)} minus {_name(b)}", str(psnr.count)]
    row += [_interval(found[m], METRICS[m][1]) for m in COMPARED]
    return [*row, f"{psnr.lowest:+.2f}", f"{psnr.positive} of {psnr.count}"]


def _interval(found: Difference | None, digits: int) -> str:
    if found is None:
        return ""
    return f"{found.mean:+.{digits}f}" + ("" if found.half is None else f" ± {found.half:.{digits}f}")


def time_row(runs: Sequence[Run], a: Variant, base: Variant) -> list[str]:
    times, pairs = aggregate.times_to_match(runs, a, base)
    if not pairs:
        return []
    whole = statistics.median(seconds(run) for run in runs if variant(run) == a)
    median = f"{statistics.median(times):.0f} s" if times else ""
    return [_name(a), median, f"{len(times)} of {pairs}", f"{whole:.0f} s"]


def scene_rows(runs: Sequence[Run], scenes: Sequence[str], variants: Sequence[Variant]) -> Table:
    """One row per scene: means over the seeds that its arms share, and the guard's factor."""
    rows = []
    for scene in scenes:
        row = [scene.rpartition("/")[2]]
        here = [run for run in runs if run["scene"] == scene]
        here = aggregate.common(here, [one for one in variants if any(variant(run) == one for run in here)]) or here
        for one in variants:
            value = aggregate.by_scene([run for run in here if variant(run) == one], "psnr").get(scene)
            row.append("" if value is None else f"{value:.2f}")
        factors = [run["guidance"]["factor"] for run in here]
        rows.append([*row, ", ".join(f"{factor:g}" for factor in factors if factor is not None)])
    return ["scene", *(_name(one) for one in variants), "guard's factor"], rows


def charts(stem: str, section: GroupSection, runs: Sequence[Run]) -> dict[str, str]:
    """Quality over CPU seconds of the complete arms, over the scenes and seeds that all of them have."""
    whole = aggregate.complete(runs, section.variants)
    same = aggregate.common(runs, whole)
    if not same:
        return {}
    drawn = {}
    for metric, label in (("psnr", "PSNR, dB"), ("lpips_alex", "LPIPS (Alex), lower is better")):
        series = [Series(_name(v), aggregate.mean_curve([r for r in same if variant(r) == v], metric)) for v in whole]
        title = f"{section.title} ({_count(len({run['scene'] for run in same}), 'scene')})"
        drawn[f"{stem}-{metric.partition('_')[0]}"] = chart(title, Axis("CPU seconds"), Axis(label), series)
    return drawn


def about(document: dict[str, Any]) -> list[str]:
    """Origin and protocol of the figures."""
    places = [f"{m['cpu']}, {m['cores']} cores, gsopt {m['commit'] or m['gsopt']}" for m in document["machines"]]
    codes = Counter(run["code"] for run in document["runs"])
    mixed = "" if len(codes) < 2 else f" The runs are of {len(codes)} versions of the code: run the suite again."
    suite = declared.of_document(document)
    lines = [suite.about.replace("\n", " "), f"`{document['command']}` on {'; '.join(places)}.{mixed}"]
    lines.append(
        "CPU seconds of all threads: reading, first Gaussians, the guard's short runs and the steps; other work on the "
        "machine slows them through shared caches, but does not add to them."
    )
    if document["protocols"]:
        lines.append("Protocol: " + document["protocols"][0].partition("; background")[0] + ".")
    return lines


def missing(document: dict[str, Any]) -> list[str]:
    """Runs that the suite declares (with three seeds) and the file lacks, and skipped runs with their reasons."""
    suite = declared.of_document(document)
    known = {run_id(record) for record in (*document["runs"], *document["skipped"])}
    lines, lacking = [], Counter[str]()
    for case in declared.cases(suite, SEEDS):
        if case.id not in known:
            begun = any(run["seed"] == case.seed for run in document["runs"])
            where = f"{case.group}, {view_count(case.views)} views, " if begun else ""
            lacking[f"{where}seed {case.seed}"] += 1
    if lacking:
        lines.append("Not run yet: " + "; ".join(f"{what} ({count} runs)" for what, count in lacking.items()) + ".")
    reasons: dict[str, Counter[str]] = {}
    for skip in document["skipped"]:
        reasons.setdefault(skip["reason"], Counter())[skip["arm"]] += 1
    for reason, arms in reasons.items():
        lines.append("Skipped: " + ", ".join(f"{arm} ({count})" for arm, count in arms.items()) + f": {reason}.")
    return lines


def write_page(document: dict[str, Any], page: Path) -> None:
    """Rewrites the block of the suite in a Markdown page, and the charts beside it in img/."""
    blocks = [*about(document)]
    (page.parent / "img").mkdir(exist_ok=True)
    for section in group_sections(document):
        blocks += [f"### {section.title}", " ".join(section.lines)]
        for note, (head, rows) in section.tables:
            blocks += [note, table(head, rows)]
        for name, svg in section.charts.items():
            write_atomic(page.parent / "img" / f"{name}.svg", svg.encode())
        if section.charts:
            blocks.append("\n".join(f"![{section.title}](img/{name}.svg)" for name in section.charts))
    blocks.append("\n".join(f"- {line}" for line in missing(document)))
    replace_block(page, document["suite"], "\n\n".join(blocks))


def _name(one: Variant) -> str:
    return f"{one[0]}, {one[1]:,}"


def _count(count: int, thing: str) -> str:
    return f"{count} {thing}{'' if count == 1 else 's'}"
