"""The error for photos that give no scene: the reasons, and what the user can do."""

from __future__ import annotations

from gsopt.data.sfm.diagnosis import Diagnosis
from gsopt.data.sfm.features import ViewGraph
from gsopt.errors import InputError

OBJECT_PATH = (
    "If they show one object and more photos cannot be had: cut the object out (transparent PNG, or a folder masks/), "
    "write its camera into a transforms.json, and train with a diffusion model as prior (--lambda-sds in "
    "`gsopt train --help`). What no photo shows is invented there, not measured."
)


def too_few(report: Diagnosis, graph: ViewGraph | None) -> InputError:
    """The error for fewer than three placed photos: it carries the whole report."""
    usable = len(graph.features) if graph is not None else report.given - refused(report)
    lines = [f"No scene: fewer than 3 of {report.given} photos can be placed, at least 3 are needed."]
    lines += report.lines()[1:]
    lines.append(f"  {_what_can_be_done(usable, graph)}")
    return InputError("\n".join(lines))


def refused(report: Diagnosis) -> int:
    return sum(left.kind == "refused" for left in report.left)


def _what_can_be_done(usable: int, graph: ViewGraph | None) -> str:
    if usable == 0:
        return "None of the files can be used. Mend or replace them."
    if usable == 1:
        return (
            "One photo alone has no parallax: neither where the camera stood nor how far things are can be computed "
            f"from it. Add at least two that overlap it. {OBJECT_PATH}"
        )
    if usable == 2:
        common = sum(graph.inliers.values()) if graph is not None else 0
        overlap = f"they have {common} features in common" if common else "they have nothing in common"
        return (
            f"Two photos: {overlap}. Two views fix depth only where both see the same thing, and nothing checks them; "
            f"add a third that overlaps both. {OBJECT_PATH}"
        )
    return "Take 20 or more photos around the thing, each sharing two thirds of its picture with the one before."
