"""Messages of errors are bounded, whatever the value that they repeat."""

from __future__ import annotations

import json
import pickle

import pytest

from gsopt.errors import MAX_MESSAGE, GsoptError, InputError, shortened


def nested(depth: int) -> object:
    return json.loads("[" * depth + "]" * depth)


def deeper(value: object, calls: int) -> str:
    """Messages are made further down than files are read."""
    return deeper(value, calls - 1) if calls else shortened(value)


@pytest.mark.parametrize("value", ["x" * 70_000, "\x00" * 70_000, 10**4000, list(range(10_000)), {"a": "b" * 9000}])
def test_a_long_value_is_repeated_in_part(value: object) -> None:
    assert len(shortened(value)) <= 80


def test_a_short_value_is_repeated_as_it_is() -> None:
    assert [shortened(value) for value in ("ab'c", 1.5, None, [1, 2])] == ['"ab\'c"', "1.5", "None", "[1, 2]"]


def test_a_value_nested_as_deep_as_json_goes_is_repeated() -> None:
    depth = 800
    while True:  # the deepest that this interpreter reads here
        try:
            value = nested(depth)
        except RecursionError:
            break
        assert len(deeper(value, calls=20)) <= 80
        depth += 1
        if depth == 1100:
            return


@pytest.mark.parametrize("kind", [GsoptError, InputError])
def test_a_long_message_keeps_its_begin_and_its_advice(kind: type[GsoptError]) -> None:
    error = kind("`a` must be b, got " + "x" * 70_000 + ". Do c.")
    assert len(str(error)) <= MAX_MESSAGE + 10
    assert str(error).startswith("`a` must be b, got x")
    assert str(error).endswith(". Do c.")
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
