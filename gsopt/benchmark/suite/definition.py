"""A suite: the scenes and arms that a TOML file declares, and the list of its runs."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from gsopt import check
from gsopt.benchmark import schema
from gsopt.benchmark.suite import arm_flags
from gsopt.data.files import is_regular
from gsopt.errors import InputError, UsageError, shortened

BUILT_IN_SUITES = ("sparse", "paper", "smoke")
PACKAGE = Path(__file__).resolve().parents[2]
EVALUATIONS = 5
"""Evaluations during a run, the one at its end included."""
MAX_TOML_BYTES = 1 << 20
GROUP = {"name": str, "title": str, "why": str, "scenes": [str], "views": [(int, str)], "runs": [str]}
GROUP |= {"flags": [str], "get": str}
OPTIONAL: dict[str, Any] = {"why": "", "flags": [], "get": ""}
SUITE = {"title": str, "about": str, "root": str, "groups": [GROUP]}
PATTERNS = {
    "root": (r"(package)?", '"package" or absent, where --root names another folder'),
    "name": (r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", "letters, digits, `-`, `_` and `.`"),
    "scenes": (r"(?!(.*/)?\.\.(/|$))[^/|\\\0][^|\\\0]*", "folders below the root"),
    "views": (r"all|[1-9][0-9]{0,5}|[0-9]{1,6}(,[0-9]{1,6})+", '"all", a number of views, or ids such as "2,16"'),
    "runs": (r"[a-z0-9-]+ +[1-9][0-9]{0,6}", 'an arm and its steps, such as "ours 3000"'),
    "flags": (
        r"(?!(-m|--run|--model[-_]path|-s|--source[-_]path|--iterations|--seed|--views|--view[-_]ids)(=|$)).+",
        "flags of `gsopt train` that the suite does not set itself",
    ),
}
"""Allowed values: names become parts of file names, scenes and runs parts of ids."""


@dataclass(frozen=True)
class Group:
    """Scenes that are trained alike and share one table."""

    name: str
    title: str
    why: str
    """Question of the group and the reason for its lengths, in one sentence."""
    scenes: tuple[str, ...]
    """Folders below the root."""
    views: tuple[str, ...]
    """`all`, a number of evenly spread input views, or their ids."""
    runs: tuple[tuple[str, int], ...]
    """Arm and number of steps; the first is the baseline."""
    flags: tuple[str, ...]
    """Further flags of every run, after those of the arm."""
    get: str
    """Instruction for a reader whose root lacks the scenes."""


@dataclass(frozen=True)
class Suite:
    """A parsed declaration."""

    name: str
    title: str
    about: str
    root: Path | None
    """Folder of scenes that ship with gsopt, or None where the user names it."""
    groups: tuple[Group, ...]
    declaration: str | None = None
    """Text of a suite of one's own, which its result file repeats, or None for a built-in suite."""
    folder: Path | None = None
    """Folder of that file, which holds its scenes when no other root is given."""


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
    """Flags of `gsopt train`, without folders and without flags that only this machine needs."""

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of the run in the result file (`result_file.CASE`)."""
        return {name: value for name, value in vars(self).items() if name != "flags"}

    @property
    def id(self) -> str:
        """Name of the run in the result file: two cases with one id are the same run."""
        return "|".join(map(str, self.fields.values()))


def load(name: str) -> Suite:
    """The built-in suite of that name, or the suite that the file `name` declares."""
    if name.endswith(".toml"):
        path = Path(name).expanduser()
        return replace(parse_own(_read(path), path.stem), folder=path.parent)
    check.one_of("--suite", name, (*BUILT_IN_SUITES, "FILE.toml"))
    return parse((resources.files("gsopt.benchmark") / "suites" / f"{name}.toml").read_text(encoding="utf-8"), name)


def _read(path: Path) -> str:
    if not is_regular(path) or path.stat().st_size > MAX_TOML_BYTES:
        raise InputError(f"`--suite` must be a file of at most {MAX_TOML_BYTES:,} bytes, got {path}. Check the path.")
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} must be UTF-8 text, got {error}. Save it again as UTF-8.") from error


def of_document(document: dict[str, Any]) -> Suite:
    """The suite whose runs a result file holds."""
    text = document.get("declaration")
    return load(document["suite"]) if text is None else parse_own(text, document["suite"])


def parse_own(text: str, name: str) -> Suite:
    """A suite of one's own; InputError also for a name that no file may have or a built-in suite has."""
    if name in BUILT_IN_SUITES:
        raise InputError(f"A suite of your own must not be named {name}, got {name}.toml. Rename the file.")
    _match("suite", "name", name)
    return replace(parse(text, name), declaration=text)


def parse(text: str, name: str) -> Suite:
    """InputError that names the first wrong entry."""
    try:
        document = {"root": "", **tomllib.loads(text)}
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"The suite {name} must be valid TOML, got {error}. Correct the file.") from error
    if isinstance(document.get("groups"), list):
        document["groups"] = [OPTIONAL | group if isinstance(group, dict) else group for group in document["groups"]]
    schema.require(document, SUITE, name)
    names = [group["name"] for group in document["groups"]]
    if not names or len(set(names)) < len(names):
        raise InputError(f"`{name}.groups` must be groups with different names, got {names}. Correct the file.")
    _match(name, "root", document["root"])
    groups = tuple(_group(values, f"{name}.{values['name'][:40]}") for values in document["groups"])
    root = PACKAGE if document["root"] else None
    return Suite(name, document["title"], document["about"].strip(), root, groups)


def _match(where: str, key: str, value: object) -> None:
    pattern, want = PATTERNS[key]
    if not re.fullmatch(pattern, str(value)):
        raise InputError(f"`{where}.{key}` must be {want}, got {shortened(value)}. Correct the file.")


def _group(values: dict[str, Any], where: str) -> Group:
    lists = {key: tuple(map(str, values[key])) for key in ("scenes", "views", "runs", "flags")}
    for key, found in (("name", [values["name"]]), *lists.items()):
        for value in found:
            _match(where, key, value)
    runs = tuple((arm, int(steps)) for arm, steps in map(str.split, lists.pop("runs")))
    arm_flags.require(tuple(arm for arm, _ in runs))
    return Group(**{**values, **lists, "runs": runs})


def with_groups(suite: Suite, groups: Sequence[str]) -> Suite:
    """The suite with these groups only; all of them when none is named."""
    names = tuple(group.name for group in suite.groups)
    for name in groups:
        check.one_of("--groups", name, names)
    kept = tuple(group for group in suite.groups if not groups or group.name in groups)
    return replace(suite, groups=kept)


def cases(suite: Suite, seeds: int, arms: Sequence[str] = ()) -> Iterator[Case]:
    """Every run, one seed through all groups before the next, so that early results cover the whole suite."""
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
    """`all`, or the number of views."""
    return str(len(views.split(","))) if "," in views else views


def find_root(suite: Suite, given: Path | None) -> Path:
    """Folder of the scenes: the package, `given`, or the folder of the suite's file; errors name the missing scenes."""
    root = suite.root or given or suite.folder
    if root is None:
        folders = ", ".join(sorted({scene.split("/")[0] for group in suite.groups for scene in group.scenes}))
        raise UsageError(f"The suite {suite.name} needs `--root`, got none. Give the folder that holds {folders}.")
    for group in suite.groups:
        missing = [scene for scene in group.scenes if not (root / scene).is_dir()]
        if missing:
            raise InputError(
                f"{root} lacks {', '.join(missing)}, wanted by the group {group.name} of the suite {suite.name}. "
                f"{group.get or 'Name the folder that has them with --root.'} Or name other groups with --groups."
            )
    return root.absolute()
