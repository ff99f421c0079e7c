"""A mask network gets the right image and its answer becomes a mask: with a network that answers as it is told."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsopt.data.mask_network import IMAGENET, MAX_SIDE, NOTHING, PLAIN, MaskNetwork
from gsopt.errors import InputError


@dataclass
class Session:
    """An opened network whose answer is a function of its input [1, 3, S, S]."""

    answer: Callable[[np.ndarray], np.ndarray]
    given: np.ndarray | None = None

    def get_inputs(self) -> list[Any]:
        return [SimpleNamespace(name="photo")]

    def run(self, outputs: None, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        (self.given,) = inputs.values()
        return [self.answer(self.given)]


def network(answer: Callable[[np.ndarray], np.ndarray], side: int = 32) -> tuple[MaskNetwork, Session]:
    session = Session(answer)
    return MaskNetwork(Path("net.onnx"), session, side), session


def gray(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), 100, np.uint8)


def test_an_answer_is_stretched_to_0_and_1_and_to_the_size_of_the_photo() -> None:
    ramp = np.linspace(0.25, 0.75, 32, dtype=np.float32)
    across = network(lambda x: np.broadcast_to(ramp, (1, 1, 32, 32)))[0].probabilities(gray(48, 64))
    assert across.shape == (48, 64)
    assert (float(across.min()), float(across.max())) == (0.0, 1.0)
    np.testing.assert_allclose(across, np.broadcast_to(np.linspace(0, 1, 64), (48, 64)), atol=0.02)
    down = network(lambda x: np.broadcast_to(ramp[:, None], (1, 1, 32, 32)))[0].probabilities(gray(48, 64))
    np.testing.assert_allclose(down, np.broadcast_to(np.linspace(0, 1, 48)[:, None], (48, 64)), atol=0.02)


@pytest.mark.parametrize("level", [0.0, 0.5 * NOTHING, np.nan, np.inf])
def test_a_photo_without_an_object_has_an_empty_mask(level: float) -> None:
    found = network(lambda x: np.full((1, 1, 32, 32), level, np.float32))[0].probabilities(gray(40, 40))
    assert found.shape == (40, 40)
    assert not found.any()


@pytest.mark.parametrize(("side", "norm"), [(32, IMAGENET), (1024, PLAIN)])
def test_the_input_is_normalized_as_the_authors_of_the_network_do(side: int, norm: Any) -> None:
    photo = np.zeros((50, 50, 3), np.uint8)
    photo[:] = (200, 100, 50)
    made, session = network(lambda x: x[:, :1], side)
    made.probabilities(photo)
    assert session.given is not None
    assert (session.given.shape, session.given.dtype) == ((1, 3, side, side), np.float32)
    mean, deviation = (np.array(values) for values in norm)
    expected = (np.array([1.0, 0.5, 0.25]) - mean) / deviation  # the brightest value of a photo counts as 1
    np.testing.assert_allclose(session.given[0, :, side // 2, side // 2], expected, atol=1e-5)


@pytest.mark.parametrize(
    "answer", [lambda x: np.ones(7), lambda x: np.ones((1, 1, 0, 5)), lambda x: np.ones((2, 3, 5, 5)), lambda x: 1 / 0]
)
def test_a_network_that_gives_no_image_is_named(answer: Callable[[np.ndarray], np.ndarray]) -> None:
    with pytest.raises(InputError, match=r"net\.onnx gives no mask"):
        network(lambda x: np.ones(shape))[0].probabilities(gray(40, 40))


@pytest.mark.parametrize(
    ("shapes", "side"),
    [
        ([[1, 3, 320, 320]], 320),
        ([["batch", 3, "height", "width"]], 320),
        ([[1, 3, 32, 32]], 32),
        ([[1, 3, MAX_SIDE, MAX_SIDE]], MAX_SIDE),
        ([[1, 3, 31, 31]], None),
        ([[1, 3, MAX_SIDE + 1, MAX_SIDE + 1]], None),
        ([[1, 3, 320, 240]], None),
        ([[1, 4, 320, 320]], None),
        ([[3, 320, 320]], None),
        ([[1, 3, 320, 320]] * 2, None),
        ([], None),
    ],
)
def test_a_network_takes_one_square_image(
    shapes: list[list[Any]], side: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs = [SimpleNamespace(shape=shape) for shape in shapes]
    session = SimpleNamespace(get_inputs=lambda: inputs)
    package: Any = SimpleNamespace(SessionOptions=SimpleNamespace, InferenceSession=lambda *_, **__: session)
    monkeypatch.setitem(sys.modules, "onnxruntime", package)
    (tmp_path / "net.onnx").write_bytes(b"onnx")
    if side is None:
        with pytest.raises(InputError, match="one square RGB image is needed"):
            MaskNetwork.open(tmp_path / "net.onnx")
    else:
        assert MaskNetwork.open(tmp_path / "net.onnx").side == side
