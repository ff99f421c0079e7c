"""Fixtures of the architecture tests: the files git tracks, and a clean interpreter."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def tracked(root: Path) -> list[Path]:
    """Every file of the project that git knows and that is there, absolute."""
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, check=True).stdout.decode()
    files = [root / name for name in listing.split("\0") if name]
    return [file for file in files if file.is_file()]


class CleanPython:
    """Runs code in an interpreter of its own and returns the modules it loaded."""

    def loaded_after(self, code: str) -> set[str]:
        """Top-level names of `modules_after`."""
        return {name.partition(".")[0] for name in self.modules_after(code)}

    def modules_after(self, code: str) -> set[str]:
        """Names in sys.modules after `code`; whatever `code` itself prints is dropped."""
        script = (
            "import contextlib, io, json, sys\n"
            f"with contextlib.redirect_stdout(io.StringIO()):\n    exec({code!r})\n"
            "print(json.dumps(sorted(sys.modules)))"
        )
        done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return set(json.loads(done.stdout))


@pytest.fixture(scope="session")
def clean_python() -> CleanPython:
    return CleanPython()
