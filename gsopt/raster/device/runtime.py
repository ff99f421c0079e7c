"""The protocol of what runs the kernels: a device, and a way to start one of them there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import torch

THREADS = 256
"""Threads of a block: `kThreads` in simt.h."""


class Runtime(Protocol):
    """Compiled kernels on one device."""

    name: str
    """Name of the backend that it makes: "cuda", ..."""
    device: torch.device
    about: dict[str, str]
    """Facts for `gsopt doctor`: device, arch, library, compile time."""

    def launch(self, kernel: str, blocks: int, arguments: Mapping[str, Any]) -> None:
        """Start a kernel of these arguments, tensors among them, behind what torch's current stream holds.

        Nothing waits for it here.
        """
        ...
