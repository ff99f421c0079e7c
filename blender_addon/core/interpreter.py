"""Finds the Python that has gsopt and reads the answer of its `gsopt doctor`."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from .errors import InputError, UsageError

KNOWN = ("0.1", "0.2")
"""Versions of gsopt whose flags and files this extension knows, as far as the second number."""
SCRIPT = Path("scripts") / "synth_views.py"


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
        return f"gsopt {self.version}: {self.rasterizer}{lacking}"


def find(preferred: str, near: list[Path], environment: Mapping[str, str]) -> Path:
    """The interpreter to use. UsageError, with what to do, where none is found.

    Order: the preferences, the variable GSOPT_PYTHON, a .venv beside or above these places, the `gsopt` on PATH.
    """
    if preferred.strip():
        path = Path(preferred.strip()).expanduser()
        if not path.is_file() or not os.access(path, os.X_OK):
            raise UsageError(f"The interpreter {path} is not there or not a program. Correct it in the preferences.")
        return path
    for path in candidates(near, environment):
        if path.is_file() and (path.with_name(console_script())).is_file():
            return path
    raise UsageError("No Python with gsopt was found. Install gsopt and set its interpreter in the preferences.")


def candidates(near: list[Path], environment: Mapping[str, str]) -> Iterator[Path]:
    """Interpreters that may have gsopt, the likeliest first."""
    if environment.get("GSOPT_PYTHON"):
        yield Path(environment["GSOPT_PYTHON"])
    for place in near:
        for folder in (place, *place.parents):
            yield python_of(folder / ".venv")
    script = shutil.which("gsopt", path=environment.get("PATH"))
    if script:
        for folder in (Path(script).parent, Path(script).resolve().parent):
            yield from (folder / name for name in ("python", "python3", "python.exe"))


def python_of(venv: Path) -> Path:
    return venv / "Scripts" / "python.exe" if sys.platform == "win32" else venv / "bin" / "python"


def console_script() -> str:
    return "gsopt.exe" if sys.platform == "win32" else "gsopt"


def checkout(interpreter: Path, preferred: str = "") -> Path:
    """The source folder of gsopt with scripts/synth_views.py. UsageError where it is not found."""
    places = [Path(preferred.strip()).expanduser()] if preferred.strip() else list(interpreter.absolute().parents)
    for folder in places:
        if (folder / SCRIPT).is_file():
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
