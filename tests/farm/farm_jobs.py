"""A worker with every way to end a job, and jobs for it. Run as a program, this file is the worker."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gsopt.errors import InputError
from gsopt.farm.job import Job
from gsopt.farm.serve import serve

MEGABYTE = 1 << 20
ERRORS = {
    "bad": InputError("It is bad. Mend it."),
    "defect": ZeroDivisionError("an oversight"),
    "full": OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
}
SLEEPER = "import time; time.sleep(600)"


def job(name: str, what: str = "work", folder: Path | None = None, **options: Any) -> Job:
    """`options`: fields of the job; `text` and `pids` go into the request."""
    request: dict[str, Any] = {"what": what, "name": name, "folder": None if folder is None else str(folder)}
    request |= {key: options.pop(key) for key in ("text", "source", "pids") if key in options}
    return Job(name, (sys.executable, str(Path(__file__).resolve())), request, folder, **options)


def handle(request: dict[str, Any]) -> Any:
    print(f"talks about {request['name']}")
    if pids := request.get("pids"):
        child = subprocess.Popen([sys.executable, "-c", SLEEPER])
        Path(pids).write_text(f"{os.getpid()} {child.pid}")
    match request["what"]:
        case "bad" | "defect" | "full" as way:
            raise ERRORS[way]
        case "die":
            os._exit(7)
        case "hang":
            time.sleep(600)
        case "leak":
            held = []
            while True:
                held.append(b"x" * MEGABYTE)
                time.sleep(0.001)
    time.sleep(float(request.get("seconds", 0)))
    text = Path(request["source"]).read_text() if "source" in request else request.get("text", "")
    if request["folder"]:
        folder = Path(request["folder"])
        (folder / "below").mkdir(parents=True)
        (folder / "below" / "text.txt").write_text(f"{request['name']} {text}")
        if request["what"] == "late death":
            os._exit(9)
    return {"pid": os.getpid(), "text": text, "environment": {k: os.environ.get(k) for k in ("OMP_NUM_THREADS", "X")}}


if __name__ == "__main__":
    serve(handle)
