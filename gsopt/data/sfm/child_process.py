"""Structure from motion in a process of its own, because COLMAP ends its process where it finds the disk full.

The child is given what to do as JSON and answers with JSON lines on stdout: lines of progress, and at last the
diagnosis or an error. Its other output goes to a file in the working folder. It ends when its stdin is closed, so that
it never outlives a killed parent.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from gsopt import errors
from gsopt.data.sfm.diagnosis import Diagnosis, UnplacedPhoto
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import GsoptError, InputError
from gsopt.events import Report

LOG = "colmap.log"


def run_in_child(source: Path, work: Path, config: SfmConfig, report: Report) -> tuple[Diagnosis, dict[str, float]]:
    """Writes WORK/scene in a child process. Raises the child's error, or InputError when the child crashed."""
    package = str(Path(__file__).parents[3])
    job = json.dumps({"source": str(source), "work": str(work), "config": asdict(config)})
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    with (
        (work / LOG).open("wb") as log,
        subprocess.Popen(
            [sys.executable, "-m", __name__, job],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            text=True,
            encoding="utf-8",
        ) as child,
    ):
        try:
            return _answer(child, work, report)
        finally:
            child.kill()


def _answer(child: subprocess.Popen[str], work: Path, report: Report) -> tuple[Diagnosis, dict[str, float]]:
    """The child's last answer, after its lines."""
    assert child.stdout is not None
    stage = "started"
    for line in child.stdout:
        message = json.loads(line) if line.endswith("\n") else {}
        if "line" in message:
            stage = message["line"]
            report(stage)
        elif "error" in message:
            raise _error(message)
        elif "diagnosis" in message:
            found = message["diagnosis"]
            found["left"] = [UnplacedPhoto(**photo) for photo in found["left"]]
            return Diagnosis(**found), message["seconds"]
    raise _crash(child.wait(), work, stage)


def _error(message: dict[str, Any]) -> Exception:
    """The child's error."""
    if message["error"] == "OSError":
        return OSError(message["errno"], message["text"], message["filename"])
    kind = getattr(errors, message["error"], InputError)
    return kind(message["text"]) if issubclass(kind, GsoptError) else InputError(message["text"])


def _crash(code: int, work: Path, stage: str) -> InputError:
    """The error for a child that ended without an answer."""
    how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
    free = shutil.disk_usage(work).free / 1e6
    return InputError(
        f"COLMAP crashed ({how}) after: {stage}. A full disk or too little memory does that; {free:,.0f} MB are free "
        f"beside the output. Make room, or choose another `--out`, and give the command again."
    )


def main() -> None:
    """The child: read the job, do it, answer."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # COLMAP writes to stdout where it likes
    job = json.loads(sys.argv[1])
    threading.Thread(target=_end_with, args=(sys.stdin,), daemon=True).start()
    _say(answers, _done(job, lambda line: _say(answers, {"line": line})))
    os._exit(0)  # COLMAP's threads need not be waited for


def _done(job: dict[str, Any], report: Report) -> dict[str, Any]:
    """The last answer: the diagnosis, or what went wrong."""
    from gsopt.data.sfm.pipeline import write_posed_scene

    try:
        diagnosis, seconds = write_posed_scene(
            Path(job["source"]), Path(job["work"]), SfmConfig(**job["config"]), report
        )
    except GsoptError as error:
        return {"error": type(error).__name__, "text": str(error)}
    except OSError as error:
        name = None if error.filename is None else str(error.filename)
        return {"error": "OSError", "errno": error.errno, "text": error.strerror or str(error), "filename": name}
    except (RuntimeError, ValueError) as error:  # what COLMAP raises
        reason = (str(error) or type(error).__name__).splitlines()[0][:200]
        return {"error": "InputError", "text": f"COLMAP failed: {reason}. Check the photos and the space on the disk."}
    return {"diagnosis": asdict(diagnosis), "seconds": seconds}


def _say(answers: IO[str], message: dict[str, Any]) -> None:
    answers.write(json.dumps(message) + "\n")
    answers.flush()


def _end_with(stdin: IO[str]) -> None:
    """Ends this process when the parent is gone."""
    stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
