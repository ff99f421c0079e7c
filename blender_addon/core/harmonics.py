"""Real spherical harmonics of degree 1 to 3 in gsopt's order and signs (gsopt/geometry/sh.py).

They take arrays, and values of nodes, which multiply and add as arrays do.
"""

from __future__ import annotations

import math
from typing import Any

C0 = math.sqrt(1 / math.pi) / 2
C1 = math.sqrt(3 / math.pi) / 2
C2_XY = math.sqrt(15 / math.pi) / 2
C2_ZZ = math.sqrt(5 / math.pi) / 4
C2_XX = math.sqrt(15 / math.pi) / 4
C3_XXX = math.sqrt(35 / (2 * math.pi)) / 4
C3_XYZ = math.sqrt(105 / math.pi) / 2
C3_XZZ = math.sqrt(21 / (2 * math.pi)) / 4
C3_ZZZ = math.sqrt(7 / math.pi) / 4
C3_XXZ = math.sqrt(105 / math.pi) / 4


def degree_1(x: Any, y: Any, z: Any) -> list[Any]:
    return [y * -C1, z * C1, x * -C1]


def degree_2(x: Any, y: Any, z: Any) -> list[Any]:
    xx, yy, zz = x * x, y * y, z * z
    return [x * y * C2_XY, y * z * -C2_XY, (zz * 2.0 - xx - yy) * C2_ZZ, x * z * -C2_XY, (xx - yy) * C2_XX]


def degree_3(x: Any, y: Any, z: Any) -> list[Any]:
    xx, yy, zz = x * x, y * y, z * z
    return [
        y * (xx * 3.0 - yy) * -C3_XXX,
        x * y * z * C3_XYZ,
        y * (zz * 4.0 - xx - yy) * -C3_XZZ,
        z * (zz * 2.0 - xx * 3.0 - yy * 3.0) * C3_ZZZ,
        x * (zz * 4.0 - xx - yy) * -C3_XZZ,
        z * (xx - yy) * C3_XXZ,
        x * (xx - yy * 3.0) * -C3_XXX,
    ]


HARMONICS = {1: degree_1, 2: degree_2, 3: degree_3}
