"""The machine that a figure was measured on: its processor, its load, and the peak rates of one core."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from gsopt._version import __version__


def machine() -> dict[str, Any]:
    """Metadata of every result (`schema.MACHINE`)."""
    return {
        "cpu": cpu_name(),
        "cores": os.cpu_count() or 1,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": importlib.metadata.version("torch"),
        "gsopt": __version__,
        "commit": commit(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def commit() -> str | None:
    """Commit of the sources, with + when files differ from it, or None for an installed package."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        command = ["git", "describe", "--always", "--dirty=+"]
        found = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return None
    return found.stdout.strip()


def calibration() -> dict[str, dict[str, float]]:
    """Fused multiply-adds and exponentials per second of one core, by instruction set, in CPU time."""
    from gsopt.raster import _cpu  # type: ignore[attr-defined]

    rates = {}
    for isa in _cpu.instruction_sets():
        fma, exp = _cpu.Workspace(1, isa).calibrate()
        rates[isa] = {"fma_per_second": fma, "exp_per_second": exp}
    return rates


def resident_mb() -> float | None:
    """Resident memory of this process, MB (10^6 bytes), or None where the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
