"""Executes the runs of a suite that have no record yet, one after the other, and writes the file after each."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from gsopt.benchmark.machine import machine
from gsopt.benchmark.suite import result_file, single_run
from gsopt.benchmark.suite.definition import Case, Suite
from gsopt.benchmark.suite.single_run import RunFailed, SuiteContext
from gsopt.events import Report


def work_folder(path: Path) -> Path:
    """Folder of the runs in progress of a result file."""
    return path.with_name(f"{path.stem}-runs")


def run_suite(
    path: Path, suite: Suite, command: str, cases: Sequence[Case], context: SuiteContext, report: Report
) -> list[str]:
    """Brings the result file up to date with `cases` and returns the failed ones. A kill loses only the current run.

    Raises UsageError and InputError for a file of another suite or a broken one, before anything is run.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with result_file.locked(path):
        document = result_file.opened(path, suite, command)
        context.work.mkdir(parents=True, exist_ok=True)
        for stale in context.work.glob("run-*"):  # of a killed call
            shutil.rmtree(stale, ignore_errors=True)
        torch.set_num_threads(1)
        failed: list[str] = []
        for number, case in enumerate(cases, 1):
            document, message = _one(path, document, case, context)
            if message:
                report(f"{number}/{len(cases)} {message}")
            failed += [case.id] if " failed: " in message else []
        return failed


def _one(path: Path, document: dict[str, Any], case: Case, context: SuiteContext) -> tuple[dict[str, Any], str]:
    """(document after one case, written when it changed; line to print)."""
    message, old = "", next((run for run in document["runs"] if result_file.run_id(run) == case.id), None)
    if (reason := single_run.reason_to_skip(case, context)) is not None:
        skip = {**case.fields, "reason": reason}
        if old is not None or skip in document["skipped"]:  # keep a record made on a machine that had a prior
            return document, ""
        document = result_file.with_skip(document, skip)
    else:
        try:
            if old is not None and old["key"] == single_run.key(case, context):
                return document, ""
            record, protocol, images = single_run.measure(case, context)
        except RunFailed as error:
            return document, f"{case.id} failed: {error}"
        document = result_file.with_run(document, record, machine(), protocol)
        if images:
            result_file.write_images(path, {**result_file.read_images(path), **images})
        message = line(record)
    result_file.write(path, document)
    return document, message


def line(record: dict[str, Any]) -> str:
    """A run in one line of the printed table."""
    mean = record["mean"]
    seconds = record["setup_cpu_seconds"] + record["train_cpu_seconds"]
    return (
        f"{record['scene']}, {record['views_in']} views, {record['arm']}, {record['iterations']} steps, "
        f"seed {record['seed']}: {mean['psnr']:.2f} dB, LPIPS {mean['lpips_alex']}, {seconds:.0f} s CPU"
    )
