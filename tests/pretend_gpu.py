"""A GPU for tests of code that only a GPU would run: tensors that say they lie there and whose numbers lie here.

As on a real one, an operation on tensors of both places raises RuntimeError, and a generator of the other place too;
one of Apple has no float64 and not every operation. What goes to and fro is counted.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
import torchgen
import yaml
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

GPU = torch.device("cuda", 0)
APPLE = torch.device("mps", 0)
GENERATORS: set[int] = set()
"""Addresses of the generators there: an operation sees no more of them."""
# Operations that may take tensors of both places: copies, and rows named by numbers of the other place.
MIXED = ("aten::_to_copy", "aten::copy_", "aten::index", "aten::index_put_")


class Place:
    """The memory that holds the pretended tensors."""

    device = GPU
    current = 0
    """torch's current GPU, which "cuda" without a number means."""
    crossings: list[int]
    """How many numbers went to the GPU or came from it, copy by copy."""


class There(Tensor):
    """A tensor on the pretended GPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> There:
        tensor = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device="meta",  # a torch for CPUs refuses to make one of cuda
        )
        tensor.inner = inner
        return tensor

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    @property
    def device(self) -> torch.device:
        """The pretended one."""
        return Place.device

    def data_ptr(self) -> int:
        """The kernels' address."""
        return self.inner.data_ptr()

    def tolist(self) -> Any:
        """The numbers, copied to Python."""
        Place.crossings.append(self.numel())
        return self.inner.tolist()

    def __repr__(self, **_: Any) -> str:
        return f"There({self.inner})"


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class Generator(torch.Generator):
    """A generator, of either place."""

    def __new__(cls, device: Any = "cpu") -> Generator:
        made = super().__new__(cls)
        (GENERATORS.add if is_there(device) else GENERATORS.discard)(made._cdata)
        return made


def is_there(device: Any) -> bool:
    """True for the pretended GPU. Raises RuntimeError for another GPU."""
    wanted = torch.device(device)
    if wanted.type in ("cpu", "meta"):
        return wanted.type == "meta"
    index = Place.current if wanted.index is None else wanted.index
    if (wanted.type, index) != (Place.device.type, Place.device.index):
        raise RuntimeError(
            f"expected all tensors to be on the same device, got {Place.device} and {wanted.type}:{index}"
        )
    return True


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    flat = [leaf for leaf in tree_flatten((args, kwargs))[0] if isinstance(leaf, Tensor)]
    there = [leaf for leaf in flat if isinstance(leaf, There)]
    here = [leaf for leaf in flat if not isinstance(leaf, There) and leaf.dim() > 0]
    name = func._schema.name
    if not there and "device" not in kwargs:
        return func(*args, **kwargs)
    if there and here and name not in MIXED:
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, got {Place.device} and cpu")
    device = kwargs.get("device")
    to_there = bool(there) if device is None else is_there(device)
    generator = kwargs.get("generator")
    if generator is not None and to_there != (generator._cdata in GENERATORS):
        raise RuntimeError(f"{name}: expected a {Place.device.type if to_there else 'cpu'} device type for generator")
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if name == "aten::copy_":
        to_there = isinstance(args[0], There)
    crossing = sum(leaf.numel() for leaf in flat if isinstance(leaf, There) != to_there)
    if crossing or name == "aten::_local_scalar_dense":
        Place.crossings.append(crossing or 1)
    args, kwargs = tree_map(lambda leaf: leaf.inner if isinstance(leaf, There) else leaf, (args, kwargs))
    out = func(*args, **kwargs)
    if to_there and Place.device.type == "mps":
        _require_metal(func, out)
    if func._schema.name.endswith("_") and flat:
        return flat[0]
    if to_there and not device and name == "aten::_local_scalar_dense":
        return out
    return tree_map(lambda leaf: There(leaf) if isinstance(leaf, Tensor) else leaf, out) if to_there else out


def _require_metal(func: Any, out: Any) -> None:
    """Raises what torch raises on Apple's GPU."""
    if any(
        leaf.dtype in (torch.float64, torch.complex128) for leaf in tree_flatten(out)[0] if isinstance(leaf, Tensor)
    ):
        raise TypeError(
            f"{func}: Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64."
        )
    if str(func._schema.name).removeprefix("aten::") + "." + func._overloadname not in metal_operations():
        raise NotImplementedError(f"The operator {func} is not currently implemented for the MPS device.")


@functools.cache
def metal_operations() -> set[str]:
    """`name.overload` of all that torch has for Apple's GPU, from the table that torch is built of."""
    table = Path(torchgen.__file__).parent / "packaged" / "ATen" / "native" / "native_functions.yaml"
    rows = {}
    for row in yaml.load(table.read_text(), Loader=yaml.CSafeLoader):
        name, _, overload = row["func"].partition("(")[0].partition(".")
        rows[f"{name}.{overload or 'default'}"] = row
    return {name for name, row in rows.items() if _has_metal(row, rows)}


def _has_metal(row: dict[str, Any], rows: dict[str, Any]) -> bool:
    if "structured_delegate" in row:
        return _has_metal(rows[row["structured_delegate"]], rows)
    keys = {key.strip() for key_list in row.get("dispatch", {"Composite": ""}) for key in key_list.split(",")}
    return any(key == "MPS" or key.startswith("Composite") for key in keys)


@contextmanager
def _made_current(device: Any) -> Iterator[None]:
    before, wanted = Place.current, torch.device(device)
    Place.current = before if wanted.index is None else wanted.index
    yield
    Place.current = before


@contextmanager
def pretend_gpu(place: torch.device = GPU) -> Iterator[torch.device]:
    """Tensors can be made on `place`, and are moved there and back."""
    Place.device, Place.current, Place.crossings = place, 0, []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torch.cuda._lazy_init", lambda: None)
        patch.setattr("torch.cuda.device", _made_current)
        patch.setattr("torch.Generator", Generator)
        with _Mode():
            yield place
