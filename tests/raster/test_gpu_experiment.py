"""experiments/gpu.py, which a machine with a GPU runs: the same at tiny size on this CPU."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from simt_runtime import compiler

SCRIPT = Path(__file__).resolve().parents[2] / "experiments" / "gpu.py"


def test_it_measures_and_judges(tmp_path: Path) -> None:
    compiler()
    out = tmp_path / "gpu.json"
    parts = ["oracle", "stress", "repeatability", "speed", "lego"]
    done = subprocess.run(
        [sys.executable, SCRIPT, "--tiny", "--out", out, "--parts", *parts], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert all(found[part]["passed"] for part in ("oracle", "stress", "repeatability"))
    (row,) = found["speed"]["rows"]
    assert row["ms"] > 0
    assert row["pairs"] > 0
    assert row["bound_ms"] > 0
    assert found["lego"]["skipped"] == "no --lego"
