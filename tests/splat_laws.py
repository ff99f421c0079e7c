"""The law of every reader of splats: finite Gaussians, or one clear refusal."""

from __future__ import annotations

import warnings
from pathlib import Path

import torch

from gsopt.errors import InputError, InputWarning
from gsopt.formats import load_splats

LONGEST_MESSAGE = 1000


def require_short(error: Exception, path: Path) -> None:
    """A refusal says something, in a bounded number of characters."""
    assert 0 < len(str(error)) < LONGEST_MESSAGE + len(str(path))


def reads_or_refuses(path: Path) -> None:
    """Whatever the file holds, no more Gaussians than bytes, all finite; or an InputError that names it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            splats = load_splats(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017 (what else it may raise breaks the law)
        require_short(error, path)
    else:
        assert len(splats) <= path.stat().st_size
        assert all(tensor.dtype == torch.float32 for _, tensor in splats.items())
        assert all(bool(torch.isfinite(tensor).all()) for _, tensor in splats.items())
