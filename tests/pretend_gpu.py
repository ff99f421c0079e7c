"""A GPU for tests of code that only a GPU would run: tensors that say they lie on cuda:0 and whose numbers lie here.

As on a real one, an operation on tensors of both places raises RuntimeError, and a generator of the other place too.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

GPU = torch.device("cuda", 0)
GENERATORS: set[int] = set()
"""Addresses of the generators there: an operation sees no more of them."""
# Operations that may take tensors of both places: copies, and rows named by numbers of the other place.
MIXED = ("aten::_to_copy", "aten::copy_", "aten::index", "aten::index_put_")


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
        return GPU

    def data_ptr(self) -> int:
        """The kernels' address."""
        return self.inner.data_ptr()

    def tolist(self) -> Any:
        """The numbers, copied to Python."""
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
        (GENERATORS.add if torch.device(device).type == "cuda" else GENERATORS.discard)(made._cdata)
        return made


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    flat = [leaf for leaf in tree_flatten((args, kwargs))[0] if isinstance(leaf, Tensor)]
    there = [leaf for leaf in flat if isinstance(leaf, There)]
    here = [leaf for leaf in flat if not isinstance(leaf, There) and leaf.dim() > 0]
    name = func._schema.name
    if not there and "device" not in kwargs:
        return func(*args, **kwargs)
    if there and here and name not in MIXED:
        raise RuntimeError(f"{name}: expected all tensors to be on the same device, got cuda:0 and cpu")
    device = kwargs.get("device")
    to_there = bool(there) if device is None else torch.device(device).type in ("cuda", "meta")
    generator = kwargs.get("generator")
    if generator is not None and to_there != (generator._cdata in GENERATORS):
        raise RuntimeError(f"{name}: expected a {'cuda' if to_there else 'cpu'} device type for generator")
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if name == "aten::copy_":
        to_there = isinstance(args[0], There)
    args, kwargs = tree_map(lambda leaf: leaf.inner if isinstance(leaf, There) else leaf, (args, kwargs))
    out = func(*args, **kwargs)
    if func._schema.name.endswith("_") and flat:
        return flat[0]
    if to_there and not device and name == "aten::_local_scalar_dense":
        return out
    return tree_map(lambda leaf: There(leaf) if isinstance(leaf, Tensor) else leaf, out) if to_there else out


@contextmanager
def pretend_gpu() -> Iterator[torch.device]:
    """Tensors can be made on cuda:0, and are moved there and back."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torch.cuda._lazy_init", lambda: None)
        patch.setattr("torch.Generator", Generator)
        with _Mode():
            yield GPU
