"""A packed stream may cost so much by its size, and a .glb may be so large."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from gsopt.errors import InputError
from gsopt.formats import compression, gltf


@pytest.mark.parametrize("packed", [10**6, 10**7, 10**9])
def test_only_a_stream_that_unpacks_to_much_more_is_read_before_it_is_kept(packed: int) -> None:
    plausible = compression._UNCHECKED_RATIO * packed
    assert not compression.needs_check(plausible, packed)
    assert compression.needs_check(plausible + 1, packed)


def test_what_is_small_is_never_read_twice() -> None:
    for packed in (0, 1, 10):
        assert not compression.needs_check(compression._ALWAYS_ALLOWED // 2, packed)
        assert compression.needs_check(compression._ALWAYS_ALLOWED // 2 + 1, packed)


@pytest.mark.parametrize("packed", [0, 1000, 10**6, 10**9])
def test_the_budget_grows_with_the_file_and_has_a_floor(packed: int) -> None:
    limit = max(compression._ALWAYS_ALLOWED, compression._MAX_RATIO * packed)
    compression.check_budget(limit, packed, Path("a.spz"))
    with pytest.raises(InputError, match="hostile"):
        compression.check_budget(limit + 1, packed, Path("a.spz"))


def test_the_largest_glb_is_the_largest_that_its_header_can_name() -> None:
    largest = gltf._MAX_SIZE
    assert gltf.HEADER.unpack(gltf.HEADER.pack(gltf.MAGIC, 2, largest))[2] == largest
    with pytest.raises(struct.error):
        gltf.HEADER.pack(gltf.MAGIC, 2, largest + 1)
