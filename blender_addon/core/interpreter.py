"""Finds the Python that has gsopt and reads the answer of its `gsopt doctor`."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import InputError, UsageError, printable

KNOWN = ("0.1", "0.2")
"""Versions of gsopt whose flags and files this extension knows, as far as the second number."""
SCRIPT = Path("scripts") / "synth_views.py"
PYTHONS = ("python.exe",) if sys.platform == "win32" else ("python", "python3")


@dataclass(frozen=True)
class Answer:
    """Findings of `gsopt doctor`."""

    version: str
    rasterizer: str
    """Its instruction set and speed, or why there is none."""
    missing: tuple[str, ...]
    """Extras of gsopt that are not installed."""

    @property
    def line(self) -> str:
        lacking = f"; not installed: {', '.join(self.missing)}" if self.missing else ""
        return printable(f"gsopt {self.version}: {self.rasterizer}{lacking}")


def find(preferred: str, allowed: Collection[str], project: Path | None, environment: Mapping[str, str]) -> Path:
    """The interpreter to run. UsageError, with what to do, where there is none or nobody has allowed it.

    The preferences or the variable GSOPT_PYTHON name it. Otherwise it is the first of `candidates` in `allowed`.
    """
    name = preferred.strip() or environment.get("GSOPT_PYTHON", "")
    if name:
        return usable(name)
    found = candidates(project, environment)
    for path in found:
        if str(path) in allowed:
            return usable(str(path))
    if found:
        raise UsageError(
            f"The Python {found[0]} was found, but you have not allowed it to run. If you trust whoever made it, press "
            "Allow Interpreter; otherwise set another one in the preferences."
        )
    raise UsageError("No Python with gsopt was found. Install gsopt and set its interpreter in the preferences.")


def candidates(project: Path | None, environment: Mapping[str, str]) -> list[Path]:
    """Pythons beside a file called `gsopt`: in the .venv of the project's folder, then on PATH. Runs nothing."""
    places = environment.get("PATH", "").split(os.pathsep)
    folders = [python_of(project / ".venv").parent] if project is not None else []
    folders += [Path(place) for place in places if os.path.isabs(place)]
    found = {}
    for folder in folders:
        script = folder / console_script()
        if os.path.isfile(script):
            beside = [place / name for place in (folder, Path(os.path.realpath(script)).parent) for name in PYTHONS]
            found.update({real(path): None for path in beside if os.path.isfile(path)})
    return list(found)


def real(path: Path) -> Path:
    """The path without symlinks among its folders. The last one stays: in a venv it leads to a Python without gsopt."""
    return Path(os.path.realpath(path.parent)) / path.name


def usable(name: str) -> Path:
    """The real path of an interpreter. UsageError where there is none, or where others may change it."""
    path = Path(name).expanduser()
    if not path.is_absolute() or not os.path.isfile(path) or not os.access(path, os.X_OK):
        raise UsageError(f"The interpreter {path} is not there or not a program. Correct the preferences.")
    path = real(path)
    root = path.parent.parent if path.parent.name == "bin" else path.parent
    target = Path(os.path.realpath(path))
    refuse_shared(path, root, path.parent, target, target.parent)
    return path


def refuse_shared(program: Path, *places: Path) -> None:
    """UsageError where another user may change one of these folders or files, and so what would be run."""
    if sys.platform == "win32":
        return
    for place in places:
        status = place.stat()
        if status.st_mode & 0o022 or status.st_uid not in (0, os.geteuid()):
            raise UsageError(
                f"{program} is not run: others may change {place} (mode {status.st_mode & 0o7777:o}, user "
                f"{status.st_uid}). Make it yours alone (chown, chmod go-w), or set another one in the preferences."
            )


def python_of(venv: Path) -> Path:
    return venv / "Scripts" / "python.exe" if sys.platform == "win32" else venv / "bin" / "python"


def console_script() -> str:
    return "gsopt.exe" if sys.platform == "win32" else "gsopt"


def checkout(interpreter: Path, preferred: str = "") -> Path:
    """The source folder of gsopt with scripts/synth_views.py: the preferred one, or that with the interpreter's venv.

    UsageError where it is not found, or where others may change the script.
    """
    places = [Path(preferred.strip()).expanduser()] if preferred.strip() else list(interpreter.parents)[:3]
    for folder in places:
        if os.path.isfile(folder / SCRIPT):
            refuse_shared(folder / SCRIPT, folder / SCRIPT.parent, folder / SCRIPT)
            return folder
    raise UsageError(
        f"{SCRIPT.as_posix()} was not found near {interpreter}. Set the source folder of gsopt in the preferences."
    )


def read_answer(output: str, interpreter: str) -> Answer:
    """Reads the output of `gsopt doctor --json`. InputError when that Python has no gsopt, or an unknown one."""
    start = output.find("{")
    try:
        found = json.loads(output[start:]) if start >= 0 else {}
        version = str(found["gsopt"])
        speed = found["rasterizer"]
        missing = tuple(sorted(str(extra) for extra in found.get("missing_extras", {}) if extra))
        kernels = f"{speed['isa'] or speed['backend']}, {speed['ms_per_step']} ms a step"
        rasterizer = str(speed["problem"]) if speed.get("problem") else kernels
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        lines = output.strip().splitlines() or ["it said nothing"]
        raise InputError(f"{interpreter} has no working gsopt: {lines[-1][:200]}. Choose another one.") from None
    if ".".join(version.split(".")[:2]) not in KNOWN:
        raise InputError(
            f"{interpreter} has gsopt {version[:40]}, this extension knows {', '.join(KNOWN)}. "
            "Install the extension that came with it, or choose another interpreter."
        )
    return Answer(version, rasterizer, missing)
