"""Turns a point by Hamilton's product: the law that every reading of a quaternion keeps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st

POINTS = st.lists(st.floats(-3, 3), min_size=3, max_size=3)
QUATERNIONS = st.lists(st.floats(-2, 2), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)
"""Of any length but nearly none, w first."""


def turned(quaternion: Sequence[float], point: Sequence[float]) -> Any:
    """The vector part of q p q* / |q|^2."""
    q = np.array(quaternion)
    return product(product(q, np.array([0, *point])), q * [1, -1, -1, -1])[1:] / np.dot(q, q)


def product(a: Any, b: Any) -> Any:
    """Hamilton's product."""
    return np.array([a[0] * b[0] - np.dot(a[1:], b[1:]), *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])
