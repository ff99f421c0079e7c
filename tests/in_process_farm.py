"""A farm whose jobs run in the test's own process, one after the other, where fixtures reach them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from gsopt.errors import GsoptError
from gsopt.events import Report
from gsopt.farm.job import Job, Outcome


class InProcess:
    """A farm of one worker, which answers by `handle`."""

    def __init__(self, handle: Callable[[Mapping[str, Any]], Any]) -> None:
        self._handle = handle

    def run(self, jobs: Iterable[Job], report: Report | None = None) -> Iterator[Outcome]:
        for job in jobs:
            try:
                yield Outcome(job, "done", self._handle(job.request))
            except GsoptError as error:
                yield Outcome(job, "failed", error=str(error))

    def cancel(self, name: str) -> None:
        raise AssertionError(f"{name} runs while nobody else does")
