"""Has a farm execute the runs of a suite that have no record yet, and writes the file after each."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsopt.benchmark.suite import result_file, single_run
from gsopt.benchmark.suite.definition import Case, Suite
from gsopt.benchmark.suite.estimate import estimate
from gsopt.benchmark.suite.single_run import RunFailed, SuiteContext
from gsopt.events import Report
from gsopt.farm.job import Farm, Job
from gsopt.farm.local import LocalFarm


def work_folder(path: Path) -> Path:
    """Folder of the runs in progress of a result file."""
    return path.with_name(f"{path.stem}-runs")


def run_suite(
    path: Path,
    suite: Suite,
    command: str,
    cases: Sequence[Case],
    context: SuiteContext,
    report: Report,
    farm: Farm | None = None,
) -> list[str]:
    """Brings the result file up to date with `cases` and returns the failed ones. A kill loses only the current runs.

    Without a farm, one run follows the other on this machine. Only this process writes the file. Raises UsageError and
    InputError for a file of another suite or a broken one, before anything is run.
    """
    with _opened(path, suite, command, context) as document:
        document, due, failed = _due(path, document, cases, context, report)
        jobs = [job for _, job in due]
        for number, outcome in enumerate((farm or LocalFarm(context.threads)).run(jobs), 1):
            if outcome.ending == "done":
                document = _written(path, document, outcome.answer)
                message = line(outcome.answer["record"])
            else:
                message = f"{outcome.job.name} failed: {outcome.error}"
                failed.append(outcome.job.name)
            report(f"{number}/{len(jobs)} {message}")
        return failed


def estimate_suite(
    path: Path, suite: Suite, command: str, cases: Sequence[Case], context: SuiteContext, report: Report
) -> list[str]:
    """Reports what the runs without a record will take, makes none of them, and returns those that cannot be made."""
    with _opened(path, suite, command, context) as document:
        _, due, failed = _due(path, document, cases, context, report)
        for message in estimate([case for case, _ in due], context):
            report(message)
        return failed


@contextmanager
def _opened(path: Path, suite: Suite, command: str, context: SuiteContext) -> Iterator[dict[str, Any]]:
    """The result file, this process's alone, and an empty folder for the runs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with result_file.locked(path):
        document = result_file.opened(path, suite, command)
        context.work.mkdir(parents=True, exist_ok=True)
        for stale in context.work.glob("run-*"):  # of a killed call
            shutil.rmtree(stale, ignore_errors=True)
        yield document


def _due(
    path: Path, document: dict[str, Any], cases: Sequence[Case], context: SuiteContext, report: Report
) -> tuple[dict[str, Any], list[tuple[Case, Job]], list[str]]:
    """(document, runs that have no record yet, ids of those that cannot be made)."""
    due: list[tuple[Case, Job]] = []
    failed: list[str] = []
    for case in cases:
        try:
            document, job = _prepared(path, document, case, context)
        except RunFailed as error:
            report(f"{case.id} failed: {error}")
            failed.append(case.id)
        else:
            due += [(case, job)] if job else []
    return document, due, failed


def _prepared(
    path: Path, document: dict[str, Any], case: Case, context: SuiteContext
) -> tuple[dict[str, Any], Job | None]:
    """(document, written when the case is skipped; the job of a run that has no record yet)."""
    old = next((run for run in document["runs"] if result_file.run_id(run) == case.id), None)
    if (reason := single_run.reason_to_skip(case, context)) is not None:
        skip = {**case.fields, "reason": reason}
        if old is None and skip not in document["skipped"]:  # else keep a record made on a machine that had a prior
            document = result_file.with_skip(document, skip)
            result_file.write(path, document)
        return document, None
    run_hash = single_run.key(case, context)
    if old is not None and old["key"] == run_hash:
        return document, None
    return document, single_run.run_job(case, context, run_hash)


def _written(path: Path, document: dict[str, Any], answer: dict[str, Any]) -> dict[str, Any]:
    """The document with a finished run, on the disk; its images first."""
    if answer["images"]:
        result_file.write_images(path, {**result_file.read_images(path), **answer["images"]})
    document = result_file.with_run(document, answer["record"], answer["machine"], answer["protocol"])
    result_file.write(path, document)
    return document


def line(record: dict[str, Any]) -> str:
    """A run in one line of the printed table."""
    mean = record["mean"]
    seconds = record["setup_cpu_seconds"] + record["train_cpu_seconds"]
    return (
        f"{record['scene']}, {record['views_in']} views, {record['arm']}, {record['iterations']} steps, "
        f"seed {record['seed']}: {mean['psnr']:.2f} dB, LPIPS {mean['lpips_alex']}, {seconds:.0f} s CPU"
    )
