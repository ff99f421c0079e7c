"""Text of small OBJ files."""

from __future__ import annotations

import numpy as np

CENTERS = ((3.0, 1.0, -2.0), (1.0, 4.0, 1.0))
"""Centers of the two balls, in the coordinates of their file."""
RADIUS = 0.5


def ball(center: tuple[float, float, float], radius: float, first: int, rings: int = 24, steps: int = 48) -> str:
    """OBJ text of a sphere; `first` is the 1-based index of its first vertex."""
    theta = np.pi * np.arange(rings + 1) / rings
    phi = 2 * np.pi * np.arange(steps) / steps
    t, p = np.meshgrid(theta, phi, indexing="ij")
    xyz = np.stack([np.cos(t), np.sin(t) * np.cos(p), np.sin(t) * np.sin(p)], axis=-1).reshape(-1, 3)
    lines = ["v {:.9f} {:.9f} {:.9f}".format(*(np.array(center) + radius * q)) for q in xyz]
    for i in range(rings):
        for j in range(steps):
            a, b = i * steps + j, i * steps + (j + 1) % steps
            lines.append("f " + " ".join(str(first + k) for k in (a, a + steps, b + steps, b)))
    return "\n".join(lines) + "\n"


CUBE = """v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1
f 4/1 3/2 2/3 1/4\nf 5/1 6/2 7/3 8/4\nf 1/1 2/2 6/3 5/4\nf 2/1 3/2 7/3 6/4\nf 3/1 4/2 8/3 7/4\nf 4/1 1/2 5/3 8/4
"""
TEXTURE_RGB = (200, 90, 40)
