"""Counts the bytes of tensors that are alive: every tensor an operation makes, until nothing holds it any more.

Not counted: what an operation uses inside itself (workspaces of convolutions), and tensors made before it was on.
"""

from __future__ import annotations

import contextlib
import time
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


@dataclass
class Phase:
    """Memory of one call."""

    name: str
    before: int
    """Bytes alive when it began."""
    most: int = 0
    """Most bytes alive while it ran."""
    after: int = 0
    """Bytes alive when it ended: what it keeps for the backward pass, and its answer."""
    cpu_seconds: float = 0.0

    @property
    def peak(self) -> int:
        return self.most - self.before

    @property
    def kept(self) -> int:
        return self.after - self.before


class Meter(TorchDispatchMode):
    """Use as a context; `phase` marks what is to be told apart."""

    def __init__(self) -> None:
        super().__init__()
        self.live = 0
        self.phases: list[Phase] = []
        self._open: list[Phase] = []
        self._known: dict[int, Any] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor):
                self._count(tensor.untyped_storage())
        for phase in self._open:
            phase.most = max(phase.most, self.live)
        return out

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[Phase]:
        phase = Phase(name, self.live, self.live)
        self.phases.append(phase)
        self._open.append(phase)
        began = time.process_time()
        try:
            yield phase
        finally:
            phase.cpu_seconds = time.process_time() - began
            phase.after = self.live
            self._open.remove(phase)

    def _count(self, storage: torch.UntypedStorage) -> None:
        key = storage._cdata
        if key in self._known:
            return
        size = storage.nbytes()
        self.live += size
        self._known[key] = weakref.ref(storage, lambda _, key=key, size=size: self._forget(key, size))

    def _forget(self, key: int, size: int) -> None:
        self.live -= size
        self._known.pop(key, None)
