"""`transformers serve`, a real server. Opt-in: GSOPT_SERVE names a Python that has transformers[serving].

With GSOPT_SERVE_MODEL (a folder, or FOLDER:FILE.gguf) a real model answers in place of a random one. `make test-llm`
sets both.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from scripted_server import free_port

from gsopt import cli
from gsopt.sds.prompts import read_set

PYTHON = os.environ.get("GSOPT_SERVE", "")
MODEL = os.environ.get("GSOPT_SERVE_MODEL", "")
pytestmark = pytest.mark.skipif(not PYTHON, reason="opt-in: make test-llm")
PATIENCE = 900.0
"""Seconds for a server to start, and for a model to answer."""
SMALL = Path(__file__).resolve().parents[2] / "docs" / "howto" / "prompts" / "small-models.md"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Address and model of a running server."""
    import tiny_llama

    folder = tmp_path_factory.mktemp("served")
    model = MODEL or str(tiny_llama.build(folder / "tiny"))
    port = free_port()
    command = [PYTHON, "-m", "transformers.cli.transformers", "serve", model, "--host", "127.0.0.1"]
    with open(folder / "log.txt", "wb") as log:
        process = subprocess.Popen(
            [*command, "--port", str(port), "--device", "cpu"],
            stdout=log,
            stderr=log,
            env={**os.environ, "HF_HUB_OFFLINE": "1"},
            start_new_session=True,
        )
        try:
            wait_until_it_answers(f"http://127.0.0.1:{port}/health", process, folder / "log.txt")
            yield f"http://127.0.0.1:{port}/v1", model
        finally:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait(60)


def wait_until_it_answers(url: str, process: subprocess.Popen[bytes], log: Path) -> None:
    begin = time.monotonic()
    while time.monotonic() - begin < PATIENCE:
        assert process.poll() is None, log.read_text(errors="replace")[-3000:]
        try:
            with urllib.request.urlopen(url, timeout=5):
                return
        except OSError:
            time.sleep(0.5)
    raise AssertionError(f"no answer from {url}: {log.read_text(errors='replace')[-3000:]}")


@pytest.mark.parametrize("domain", ["generic", str(SMALL)], ids=["generic", "small-models"])
def test_a_real_server_ends_in_valid_prompts_that_say_who_wrote_them(served, tmp_path: Path, domain: str) -> None:
    url, model = served
    output = tmp_path / "prompts.json"
    few = ["-n", "2", "--negatives", "0", "--temperature", "0.3", "--timeout", str(PATIENCE), "--domain", domain]
    command = ["prompts", "--notes", "worn oak chair", *few, "--llm", url, "--model", model]
    assert cli.main([*command, "--fallback", "-o", str(output)]) == 0
    made = read_set(output)
    record = json.loads((tmp_path / "prompts.raw.json").read_bytes())
    assert 1 <= len(record["rounds"]) <= 3
    answers = [each["answer"] for each in record["rounds"]]
    assert any(answers)
    for prompt in made.prompts:
        if prompt.source.startswith("llm:"):
            assert any(prompt.text[:20] in answer for answer in answers)
    print(json.dumps({"prompts": [[p.source, p.text] for p in made.prompts], "record": record}, indent=1))
    if not MODEL:  # a random model says nothing that can be used
        assert {prompt.source for prompt in made.prompts} == {"user", "template"}
