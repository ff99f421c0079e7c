"""Installs gsopt into a virtual environment of its own: python install_gsopt.py FOLDER PACKAGE. Needs no compiler.

Blender's own Python runs this as a program: pip takes minutes, and its output is the job's log.
"""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path


def main(folder: str, package: str) -> int:
    """Makes the environment anew and installs `package`, a name on the package index or a wheel's path, into it."""
    print(f"making {folder}", flush=True)
    venv.create(folder, with_pip=True, clear=True)
    bin_folder = Path(folder) / ("Scripts" if sys.platform == "win32" else "bin")
    python = bin_folder / ("python.exe" if sys.platform == "win32" else "python")
    print(f"installing {package}", flush=True)
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--only-binary", ":all:", "--", package]
    return subprocess.run(pip, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
