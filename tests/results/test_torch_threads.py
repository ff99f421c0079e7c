"""Work on a finished run takes place with one thread of torch, and gives the others back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from finished_runs import splats

from gsopt.errors import InputError
from gsopt.results import clean, decimate
from gsopt.results.mesh import extract


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def stopping(seen: list[int]) -> Callable[..., Any]:
    def stop(*_: Any, **__: Any) -> Any:
        seen.append(torch.get_num_threads())
        raise InputError("Far enough. Stop here.")

    return stop


@pytest.mark.parametrize(
    ("module", "inner", "call"),
    [
        (extract, "require", lambda: extract.extract_mesh("run")),
        (clean, "_weights", lambda: clean.observe(splats(), [None], None)),  # type: ignore[list-item,arg-type]
        (decimate, "_merged_round", lambda: decimate.decimated(splats(), 0.5)),
    ],
)
def test_one_thread_inside_and_as_many_as_before_outside(
    monkeypatch: pytest.MonkeyPatch, two_threads: None, module: Any, inner: str, call: Callable[[], Any]
) -> None:
    seen: list[int] = []
    monkeypatch.setattr(module, inner, stopping(seen))
    with pytest.raises(InputError):
        call()
    assert seen == [1]
    assert torch.get_num_threads() == 2
