"""Splats of random values."""

from __future__ import annotations

from typing import Any

import numpy as np

from blender_addon.core.splats import Splats


def random_splats(count: int, bands: int = 15, seed: int = 0) -> Splats:
    random = np.random.default_rng(seed)

    def normal(*shape: int) -> Any:
        return random.normal(size=shape).astype(np.float32)

    quaternions = normal(count, 4)
    return Splats(
        positions=normal(count, 3),
        scales=np.exp(0.5 * normal(count, 3) - 3),
        rotations=quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        opacities=random.uniform(0.01, 0.99, count).astype(np.float32),
        base=normal(count, 3),
        sh=0.1 * normal(count, bands, 3),
    )
