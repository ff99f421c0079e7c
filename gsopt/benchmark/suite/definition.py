"""A suite: which scenes are learned how, declared in gsopt/benchmark/suites/NAME.toml, and the list of its runs."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from gsopt import check
from gsopt.benchmark.suite import arm_flags
from gsopt.errors import InputError, UsageError

BUILT_IN_SUITES = ("sparse", "paper", "smoke")
PACKAGE = Path(__file__).resolve().parents[2]
EVALUATIONS = 5
"""How often a run is judged on its way, its end included."""


@dataclass(frozen=True)
class Group:
    """Scenes that are learned alike and stand in one table."""

    name: str
    title: str
    why: str
    """One sentence for the reader: what the group asks, and why its lengths are what they are."""
    scenes: tuple[str, ...]
    """Folders below the root."""
    views: tuple[str, ...]
    """`all`, a number of well spread input views, or their ids."""
    runs: tuple[tuple[str, int], ...]
    """Arm and number of steps; the first is what the others are compared with."""
    flags: tuple[str, ...]
    """Of every run, after those of the arm."""
    get: str
    """What to do when its scenes are missing."""


@dataclass(frozen=True)
class Suite:
    """A parsed declaration."""

    name: str
    title: str
    about: str
    root: Path | None
    """Where its scenes ship with gsopt; None where the user says."""
    groups: tuple[Group, ...]


@dataclass(frozen=True)
class Case:
    """One run of a suite."""

    group: str
    scene: str
    views: str
    arm: str
    iterations: int
    seed: int
    flags: tuple[str, ...]
    """Of `gsopt train`, without the folders and what is made for this machine."""

    @property
    def id(self) -> str:
        """Names the run in the result file: two cases with one id are the same run."""
        return f"{self.group}|{self.scene}|{self.views}|{self.arm}|{self.iterations}|{self.seed}"


def load(name: str) -> Suite:
    """The suite of that name; UsageError for an unknown one."""
    check.one_of("--suite", name, BUILT_IN_SUITES)
    return parse((resources.files("gsopt.benchmark") / "suites" / f"{name}.toml").read_text(encoding="utf-8"), name)


def parse(text: str, name: str) -> Suite:
    """InputError where the declaration is not one."""
    try:
        document = tomllib.loads(text)
        root = PACKAGE if document.get("root") == "package" else None
        groups = tuple(_group(values) for values in document["groups"])
        suite = Suite(name, document["title"], document["about"].strip(), root, groups)
    except (tomllib.TOMLDecodeError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            f"The suite {name} cannot be read: {error!r}. See gsopt/benchmark/suites for the form."
        ) from error
    return suite


def _group(values: dict[str, Any]) -> Group:
    runs = tuple((arm, int(steps)) for arm, steps in (text.split() for text in values["runs"]))
    arm_flags.require(tuple(arm for arm, _ in runs))
    return Group(
        name=values["name"],
        title=values["title"],
        why=values["why"],
        scenes=tuple(values["scenes"]),
        views=tuple(str(views) for views in values["views"]),
        runs=runs,
        flags=tuple(values.get("flags", ())),
        get=values["get"],
    )


def with_groups(suite: Suite, groups: Sequence[str]) -> Suite:
    """The suite with these groups only, all when none is named."""
    names = tuple(group.name for group in suite.groups)
    for name in groups:
        check.one_of("--groups", name, names)
    kept = tuple(group for group in suite.groups if not groups or group.name in groups)
    return Suite(suite.name, suite.title, suite.about, suite.root, kept)


def cases(suite: Suite, seeds: int, arms: Sequence[str] = ()) -> Iterator[Case]:
    """Every run: a seed through all groups before the next seed, so that what is there early already says something."""
    arm_flags.require(tuple(arms))
    for seed in range(seeds):
        for group in suite.groups:
            for views in group.views:
                for scene in group.scenes:
                    for arm, steps in group.runs:
                        if not arms or arm in arms:
                            flags = (*arm_flags.ARMS[arm], *group.flags, *_view_flags(views))
                            flags = (*flags, "--iterations", str(steps), "--seed", str(seed))
                            yield Case(group.name, scene, views, arm, steps, seed, flags)


def _view_flags(views: str) -> tuple[str, ...]:
    if views == "all":
        return ()
    return ("--view-ids", views) if "," in views else ("--views", views)


def view_count(views: str) -> str:
    """all, or how many."""
    return str(len(views.split(","))) if "," in views else views


def find_root(suite: Suite, given: Path | None) -> Path:
    """Where the scenes lie; errors name those that are missing and say how to get them."""
    if suite.root is None and given is None:
        folders = ", ".join(sorted({scene.split("/")[0] for group in suite.groups for scene in group.scenes}))
        raise UsageError(f"The suite {suite.name} needs `--root`, got none. Give the folder that holds {folders}.")
    root = given if suite.root is None else suite.root
    assert root is not None
    for group in suite.groups:
        missing = [scene for scene in group.scenes if not (root / scene).is_dir()]
        if missing:
            raise InputError(
                f"{root} lacks {', '.join(missing)}, wanted by the group {group.name} of the suite {suite.name}. "
                f"{group.get} Or name other groups with --groups."
            )
    return root.absolute()
