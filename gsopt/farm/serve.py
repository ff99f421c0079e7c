"""The far end of a worker: reads a request a line from standard input, answers a line on standard output.

Whatever else the process prints goes to standard error. It ends when its input ends, in the middle of a job if need be:
neither a worker nor its children outlive the process that started it.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

from gsopt.errors import GsoptError, refused

ANSWER = "gsopt answers "
"""Begins the line that ends a job."""


def serve(handle: Callable[[dict[str, Any]], Any]) -> NoReturn:
    """Answers requests by `handle`, in this thread, until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    requests: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(requests,), daemon=True).start()
    while True:
        request = requests.get()
        try:
            answer = {"answer": handle(request)}
        except GsoptError as error:
            answer = {"error": str(error)}
        except OSError as error:
            answer = {"error": refused(error)}
        except Exception as error:  # a defect of ours: printed, reported, and the next job gets its turn
            traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {error}. The log has the traceback; please report it."}
        print(ANSWER + json.dumps(answer), file=answers, flush=True)


def _receive(requests: queue.SimpleQueue[dict[str, Any]]) -> None:
    with contextlib.suppress(ValueError):
        for line in sys.stdin:
            requests.put(json.loads(line))
    if hasattr(os, "killpg") and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)  # this process and its children
    os._exit(0)
