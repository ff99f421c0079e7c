"""The memory of a GPU: what a run takes, estimated before the first step, what is free, and its end."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsopt.errors import NumericalError

TILES_PER_SPLAT = 6
"""Tiles of 16 px that a splat touches on average; scenes of the kernel benchmark have 2 to 6."""
ENTRY_BYTES = 116
"""A pair of a splat and a tile: its row of sums, its number, its part of a segment, and what the sort takes."""
SPLAT_BYTES = 160
"""A splat: its record, keys, slots, and what the sort takes."""
PIXEL_BYTES = 136
"""A pixel: the image, its gradient, the loss's maps, a target, and the end of its tile's first segment."""
CONTEXT_BYTES = 600_000_000
"""The driver's own, with the kernels' code."""
PRIOR_BYTES = 1_000_000_000
"""A step of Stable Diffusion at 512 px (docs/howto/guidance.md), beside weights that are loaded by then."""
COPIES = 6
"""Parameters, gradients, two moments, and two more of the largest while rows are added."""


@dataclass(frozen=True)
class Memory:
    """Bytes that a run needs, in parts."""

    gaussians: int
    pixels: int
    targets: int
    prior: int

    @staticmethod
    def of(count: int, sh_degree: int, pixels: int, targets: int, prior: int = 0) -> Memory:
        """`count` Gaussians at most, images of so many `pixels`, `targets` and `prior` bytes beside them."""
        floats = 11 + 3 * (sh_degree + 1) ** 2
        return Memory(
            count * (4 * floats * COPIES + SPLAT_BYTES + ENTRY_BYTES * TILES_PER_SPLAT),
            pixels * PIXEL_BYTES,
            targets,
            prior,
        )

    @property
    def total(self) -> int:
        """All parts, and what the driver takes for itself."""
        return self.gaussians + self.pixels + self.targets + self.prior + CONTEXT_BYTES

    def require(self, device: torch.device, free: int) -> None:
        """Raises NumericalError, with what to lower, where `free` bytes do not suffice."""
        if self.total <= free:
            return
        parts = [("Gaussians", self.gaussians), ("images", self.pixels + self.targets), ("the prior", self.prior)]
        told = ", ".join(f"{size / 1e9:.1f} GB for {what}" for what, size in parts if size)
        raise NumericalError(
            f"This run needs about {self.total / 1e9:.1f} GB on {device} ({told}), which has {free / 1e9:.1f} GB free. "
            "Lower --max-gaussians, scale the images down (-r 2), take another GPU (--device cuda:1), or use "
            "--backend cpu."
        )


def free_bytes(device: torch.device) -> int:
    """Memory of a GPU that nobody holds."""
    if device.type == "mps":
        return torch.mps.recommended_max_memory() - torch.mps.driver_allocated_memory()
    return torch.cuda.mem_get_info(device)[0]


def is_out_of_memory(error: BaseException | None) -> bool:
    """True where a GPU's memory ended: torch has a class for it with CUDA, and words with Metal."""
    words = type(error) is RuntimeError and "out of memory" in str(error)
    return words or isinstance(error, torch.OutOfMemoryError)
