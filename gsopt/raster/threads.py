"""Threads: how many cores there are, those of the kernels that prepare a scene, and torch's own switched off."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_preparing: ContextVar[int] = ContextVar("preparing", default=1)


def preparing_threads() -> int:
    """Threads of the kernels that prepare a scene (lookups, stereo, mirror planes), as `one_torch_thread` set them."""
    return _preparing.get()


@contextmanager
def one_torch_thread(preparing: int = 1) -> Iterator[None]:
    """Torch's own threads off: its reductions add up in another order for every number of threads.

    The backend has its own threads and the same bits for any number of them; so have the kernels that prepare a scene,
    which take `preparing` threads. Torch is left a small part of a step.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    token = _preparing.set(preparing)
    try:
        yield
    finally:
        _preparing.reset(token)
        torch.set_num_threads(before)
