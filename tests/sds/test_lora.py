"""Low-rank changes of a network's weights: read, checked, and merged as their formula says."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from gsopt.errors import InputError
from gsopt.sds.priors import lora

CONFIG = {"peft_type": "LORA", "r": 2, "lora_alpha": 6}


def adapter(folder: Path, tensors: dict[str, torch.Tensor] | None = None, **changed: Any) -> Path:
    """A folder as peft writes it, of a change of the layer `mid.proj`, 3 numbers from 4."""
    random = torch.Generator().manual_seed(0)
    own = {"A": torch.randn(2, 4, generator=random), "B": torch.randn(3, 2, generator=random)}
    named = {f"{lora.PREFIX}mid.proj.lora_{side}.weight": values for side, values in own.items()}
    folder.mkdir(exist_ok=True)
    save_file(named if tensors is None else tensors, folder / lora.WEIGHTS)
    (folder / lora.CONFIG).write_text(json.dumps({**CONFIG, **changed}))
    return folder


class Network(torch.nn.Module):
    def __init__(self, rows: int = 3, columns: int = 4, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.mid = torch.nn.Module()
        self.mid.proj = torch.nn.Linear(columns, rows, dtype=dtype)


@pytest.mark.parametrize(
    ("changed", "scale"),
    [
        ({}, 3.0),
        ({"use_rslora": True}, 6 / math.sqrt(2)),
        ({"lora_alpha": 0.5, "r": 1}, 0.5),
        ({"use_dora": False}, 3.0),
    ],
)
def test_a_change_is_scaled_by_alpha_over_its_rank(tmp_path: Path, changed: dict[str, Any], scale: float) -> None:
    found = lora.read_adapter(adapter(tmp_path / "lora", **changed))
    assert found.scale == pytest.approx(scale)
    assert found.layers == ("mid.proj",)


@pytest.mark.parametrize(
    "changed",
    [
        {"peft_type": "LOHA"}, {"r": 0}, {"r": -1}, {"lora_alpha": math.inf}, {"lora_alpha": "x"}, {"r": None},
        *({name: True} for name in lora.UNSUPPORTED),
    ],
)  # fmt: skip
def test_what_is_no_plain_low_rank_change_is_refused(tmp_path: Path, changed: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="cannot be used"):
        lora.read_adapter(adapter(tmp_path / "lora", **changed))


def test_a_change_is_made_of_pairs(tmp_path: Path) -> None:
    one = {f"{lora.PREFIX}a.lora_A.weight": torch.zeros(1, 1)}
    for tensors in (one, {"x": torch.zeros(1)}, {**one, f"{lora.PREFIX}b.lora_B.weight": torch.zeros(1, 1)}, {}):
        with pytest.raises(InputError, match="not made of pairs"):
            lora.read_adapter(adapter(tmp_path / "lora", tensors))
    (tmp_path / "lora" / lora.WEIGHTS).write_bytes(b"")
    with pytest.raises(InputError, match="cannot be used"):
        lora.read_adapter(tmp_path / "lora")


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_merged_weights_are_the_old_ones_and_the_scaled_product(tmp_path: Path, dtype: torch.dtype) -> None:
    network = Network(dtype=dtype)
    before = network.mid.proj.weight.detach().clone()
    change = lora.read_adapter(adapter(tmp_path / "lora"))
    random = torch.Generator().manual_seed(0)
    A, B = torch.randn(2, 4, generator=random), torch.randn(3, 2, generator=random)
    lora.merge(network, change)
    torch.testing.assert_close(network.mid.proj.weight.detach(), (before.float() + 3 * B @ A).to(dtype))


@pytest.mark.parametrize(("rows", "columns"), [(4, 4), (3, 5)])
def test_a_change_of_another_shape_is_refused(tmp_path: Path, rows: int, columns: int) -> None:
    with pytest.raises(InputError, match="made for another model"):
        lora.merge(Network(rows, columns), lora.read_adapter(adapter(tmp_path / "lora")))


def test_factors_that_do_not_fit_or_are_not_finite_are_refused(tmp_path: Path) -> None:
    def named(down: torch.Tensor, up: torch.Tensor) -> dict[str, torch.Tensor]:
        return {f"{lora.PREFIX}mid.proj.lora_A.weight": down, f"{lora.PREFIX}mid.proj.lora_B.weight": up}

    for down, up in ((torch.zeros(2, 4), torch.zeros(3, 1)), (torch.zeros(4), torch.zeros(3, 4))):
        with pytest.raises(InputError, match="made for another model"):
            lora.merge(Network(), lora.read_adapter(adapter(tmp_path / "lora", named(down, up))))
    broken = named(torch.full((2, 4), math.inf), torch.ones(3, 2))
    with pytest.raises(InputError, match="not finite"):
        lora.merge(Network(), lora.read_adapter(adapter(tmp_path / "lora", broken)))


def test_its_settings_are_read_up_to_a_mebibyte(tmp_path: Path) -> None:
    folder = adapter(tmp_path / "lora")
    text = (folder / lora.CONFIG).read_text()
    (folder / lora.CONFIG).write_text(text.ljust(1 << 20))
    assert lora.read_adapter(folder).scale == 3.0
    (folder / lora.CONFIG).write_text(" " * (1 << 20) + text)
    with pytest.raises(InputError, match="cannot be used"):
        lora.read_adapter(folder)
