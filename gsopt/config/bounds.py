"""Types of settings with their bounds or choices."""

from __future__ import annotations

from typing import Annotated, Literal

from gsopt.check import MAX_THREADS, Within

MAX_WEIGHT = 1e9
"""Upper bound of weights and rates: keeps infinities and typing errors out."""

Weight = Annotated[float, Within(0, MAX_WEIGHT)]
Decay = Annotated[float, Within(0, 0.999999)]
Count = Annotated[int, Within(0)]
Threads = Annotated[int, Within(0, MAX_THREADS)]
PositiveCount = Annotated[int, Within(1)]
ShDegree = Annotated[int, Within(0, 3)]
Features = Literal["auto", "sift", "xfeat", "both"]
