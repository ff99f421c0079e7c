"""State that one camera's forward pass leaves on the device for its backward pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gsopt.errors import NumericalError, UsageError
from gsopt.gaussians import Gaussians
from gsopt.raster.device.runtime import THREADS

TILE = 16
RECORD_FLOATS = 12
SUM_FIELDS = 12
END_FIELDS = 5
MOST_SHORT_TILES = 32_767
MOST_ENTRIES = 2**31 - 1

Launch = Callable[..., None]


@dataclass
class Splats:
    """Gaussians as one camera sees them."""

    records: Float[Tensor, "N 12"]
    radii: Int[Tensor, "N 2"]
    depths: Int[Tensor, " N"]
    """Bits of the depth; the largest number where it is not seen."""
    tiles: Int[Tensor, " N"]
    """Number of tiles that a splat touches: of its slots."""

    @staticmethod
    def of(count: int, device: torch.device) -> Splats:
        """Room for `count`."""
        whole: dict[str, Any] = {"dtype": torch.int32, "device": device}
        return Splats(
            torch.empty(count, RECORD_FLOATS, device=device),
            torch.empty(count, 2, **whole),
            torch.empty(count, **whole),
            torch.empty(count, **whole),
        )


@dataclass(frozen=True)
class Entries:
    """The splats that every tile lists, front to back."""

    first_slot: Int[Tensor, " N"]
    """First slot of a Gaussian: its slots lie one behind the other."""
    ids: Int[Tensor, " E"]
    """Splat of an entry, tile by tile."""
    slots: Int[Tensor, " E"]
    """Slot of an entry."""
    tile_begin: Int[Tensor, " T+1"]

    @staticmethod
    def of(splats: Splats, tiles_x: int, tiles: int, launch: Launch) -> Entries:
        """Sort by depth, list the tiles of each splat in that order, sort by tile. Both sorts are stable: splats of one
        depth keep the order of their Gaussians."""
        count, device = len(splats.tiles), splats.tiles.device
        order = torch.sort(splats.depths, stable=True).indices
        ends = splats.tiles.index_select(0, order).cumsum(0)
        total = int(ends[-1]) if count else 0
        if total > MOST_ENTRIES:
            raise NumericalError(
                f"{total:,} pairs of a splat and a tile are more than the GPU backend can number ({MOST_ENTRIES:,}). "
                "Draw fewer or smaller splats, or a smaller image (`-r`)."
            )
        first_slot = torch.empty(count, dtype=torch.int64, device=device)
        listed = torch.empty(total, dtype=torch.int32, device=device)
        short = tiles <= MOST_SHORT_TILES
        where = torch.empty(total, dtype=torch.int16 if short else torch.int32, device=device)
        launch(
            "list_tiles",
            count,
            count=count,
            tiles_x=tiles_x,
            no_tile=tiles,
            records=splats.records,
            order=order,
            ends=ends,
            tiles=splats.tiles,
            first_slot=first_slot,
            ids=listed,
            short_tiles=where if short else None,
            long_tiles=None if short else where,
        )
        where, slots = torch.sort(where, stable=True)
        begin = torch.zeros(tiles + 1, dtype=torch.int32, device=device)
        if total:
            bounds = torch.arange(tiles + 1, dtype=where.dtype, device=device)
            torch.searchsorted(where, bounds, out_int32=True, out=begin)
        return Entries(first_slot, listed.index_select(0, slots), slots, begin)


@dataclass
class Segments:
    """Stretches of THREADS splats of the tiles' lists, on the way back a block each: numbered as in frame.h."""

    ends: Float[Tensor, "S 5 256"]
    """State of the pixels of the tile where a segment ends."""
    tile_of: Int[Tensor, " S"]
    """The segment's tile, -1 where nothing is drawn."""

    @staticmethod
    def of(entries: Entries) -> Segments:
        """Room for as many as there can be."""
        count, device = len(entries.ids) // THREADS + len(entries.tile_begin) - 1, entries.ids.device
        ends = torch.empty(count, END_FIELDS, THREADS, device=device)
        return Segments(ends, torch.full((count,), -1, dtype=torch.int32, device=device))


@dataclass
class Context:
    """All that `backward` reads."""

    gaussians: Gaussians
    camera: Any
    parameters: Mapping[str, Any]
    background: tuple[float, ...]
    size: tuple[int, int]
    """Height and width, px."""
    splats: Splats
    entries: Entries
    segments: Segments
    last: Int[Tensor, "H W"]
    used: bool = field(default=False)

    def take(self) -> Context:
        """This, once, as every backend has it."""
        if self.used:
            raise UsageError("This frame was used before. Call `forward` again: a frame serves one `backward`.")
        self.used = True
        return self
