"""Files of mkkellogg's viewer, which gsopt reads and does not write."""

from __future__ import annotations

import struct

import numpy as np


def ksplat(level: int, count: int, degree: int, half_range: int = 32767) -> bytes:
    """A .ksplat of one section, put together from its layout: buckets of 2, the last one partly filled.

    Splat i lies at (i + 0.5, -i, 0.25), has scales e^-1 and 1, the rotation (1, 0, 0, -1), color (255, 0, 51), opacity
    0.2, and the coefficient k / 64 for the k-th value of its harmonics in the file.
    """
    rest = 3 * ((degree + 1) ** 2 - 1)
    full, partial = count // 2, count % 2
    real, harmonic = ("<f4", "<f4") if level == 0 else ("<f2", ("<f2", "u1")[level - 1])
    row = np.dtype(
        [
            ("mean", "<f4" if level == 0 else "<u2", 3),
            ("scale", real, 3),
            ("quat", real, 4),
            ("rgba", "u1", 4),
            ("rest", harmonic, rest),
        ]
    )
    rows = np.zeros(count, row)
    means = np.array([(i + 0.5, -i, 0.25) for i in range(count)])
    centers = means[::2].astype("<f4")
    block = 4.0
    steps = (means - centers[np.arange(count) // 2]) / (block / 2) * half_range + half_range
    rows["mean"] = means if level == 0 else np.round(steps)
    rows["scale"] = [np.exp(-1), 1, 1]
    rows["quat"] = [1, 0, 0, -1]
    rows["rgba"] = [255, 0, 51, 51]
    values = np.arange(rest) / 64
    rows["rest"] = np.round((values + 1.5) / 3 * 255) if level == 2 else values
    header = bytearray(4096)
    struct.pack_into("<BB2xIIIIH", header, 0, 0, 1, 1, 1, count, count, level)
    struct.pack_into("<ff", header, 36, -1.5, 1.5)
    section = bytearray(1024)
    struct.pack_into("<IIIIfH2xI", section, 0, count, count, 2, full + partial, block, 12, half_range)
    struct.pack_into("<IIH", section, 32, full, partial, degree)
    sizes = np.full(partial, 1, "<u4")
    return bytes(header + section) + sizes.tobytes() + centers.tobytes() + rows.tobytes()
