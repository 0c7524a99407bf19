"""A pretended CUDA device: its tensors compute on the CPU and refuse what CUDA would refuse.

``pretended_cuda()`` lets code that runs inside believe that there is a GPU ``cuda:0``. A tensor
there wraps one on the CPU. Operations that mix devices, ``numpy()`` and generators of the CPU raise
the errors of CUDA. Every wait of the host for the device and every copy between them is counted,
with the line of cvtgs that caused it. Tensors above a limit do not fit. Sums that CUDA adds in
arbitrary order are refused too, except in gradients, where torch uses such sums.
"""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

CUDA = torch.device("cuda:0")

WAITS = {
    f"aten::{name}"
    for name in (
        "_local_scalar_dense",
        "nonzero",
        "masked_select",
        "_unique2",
        "unique_consecutive",
        "unique_dim",
        "equal",
        "bincount",
        "repeat_interleave",
    )
}
"""Operations after which the host needs a value, or a size that depends on values."""

INDEXING = {"aten::index", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_"}

MOST_EIGENPROBLEMS = 1000
"""cuSOLVER takes half a megabyte for each, and fails with some ten thousand."""

ANY_ORDER = {"cumsum", "cumprod", "logcumsumexp", "index_add", "scatter_add", "histc"}
"""Operations that add floats in arbitrary order on CUDA; ``check_order`` handles others."""

UNSETTLED = {"kthvalue", "median"}
"""Operations with indices of any equal value, refused by ``torch.use_deterministic_algorithms``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """Waits and copies between host and device, by line of cvtgs and operation."""

    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)


class DeviceTensor(Tensor):
    """A tensor that claims to be on CUDA; ``host`` is the real tensor.

    The wrapper is on the meta device, since torch without CUDA cannot make one on CUDA.
    """

    host: Tensor
    device = property(lambda self: CUDA)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]
    is_cpu = property(lambda self: False)  # type: ignore[assignment]
    is_meta = property(lambda self: False)  # type: ignore[assignment]
    is_sparse = property(lambda self: self.host.is_sparse)  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, host: Tensor) -> "DeviceTensor":
        layout = {}
        if not host.is_sparse:
            layout = {"strides": host.stride(), "storage_offset": host.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(
            cls, host.shape, dtype=host.dtype, device="meta", **layout
        )
        made.host = host
        return made

    def __repr__(self) -> str:
        return f"DeviceTensor({self.host!r})"

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    __array__ = numpy

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        """Refuse operations outside of ``pretended_cuda()``."""
        raise RuntimeError(f"{func}: there is no device outside of pretended_cuda()")


class Device(TorchDispatchMode):
    """Computes on the wrapped tensors, refuses what CUDA refuses, and counts waits and copies."""

    def __init__(self, traffic: Traffic, largest: int | None) -> None:
        super().__init__()
        self.traffic, self.largest = traffic, largest

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name, leaves = func._schema.name, tree_flatten((args, kwargs))[0]
        wrapped = [leaf for leaf in leaves if isinstance(leaf, DeviceTensor)]
        target = kwargs.get("device")
        # Without CUDA, torch takes the device of a wrapper to be meta when it copies options.
        is_there = (
            bool(wrapped) if target is None else torch.device(target).type in ("cuda", "meta")
        )
        if target is not None:
            kwargs["device"] = torch.device("cpu")
        if name == "aten::_to_copy":
            if bool(wrapped) != is_there:
                self.traffic.copies[f"{caller()} to {'device' if is_there else 'host'}"] += 1
            copied = func(*tree_map(unwrapped, args), **kwargs)
            return self.placed(copied) if is_there else copied
        if name == "aten::copy_":
            if isinstance(args[0], DeviceTensor) != isinstance(args[1], DeviceTensor):
                self.traffic.copies[f"{caller()} copy_"] += 1
            func(*tree_map(unwrapped, args), **kwargs)
            return args[0]
        if wrapped:
            self.check(name, args, leaves)
            check_order(name, args, kwargs)
            if name == "aten::_linalg_eigh" and args[0].shape[:-2].numel() > MOST_EIGENPROBLEMS:
                raise RuntimeError("cusolver error: CUSOLVER_STATUS_INVALID_VALUE")
            is_mask = name in INDEXING and any(
                i is not None and i.dtype == torch.bool for i in args[1]
            )
            if (name in WAITS and kwargs.get("output_size") is None) or is_mask:
                self.traffic.waits[f"{caller()} {name}"] += 1
        generator = kwargs.get("generator")
        if is_there and generator is not None and generator.device.type == "cpu":
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        found = func(*tree_map(unwrapped, args), **tree_map(unwrapped, kwargs))
        if not is_there:
            return found
        known = {id(tensor.host): tensor for tensor in wrapped}  # in-place operations return it

        def wrap(leaf: Any) -> Any:
            if not isinstance(leaf, Tensor):
                return leaf
            return known[id(leaf)] if id(leaf) in known else self.placed(leaf)

        return tree_map(wrap, found)

    def placed(self, host: Tensor) -> DeviceTensor:
        """Wrap a result as a tensor on the device, if it fits."""
        if self.largest is not None and not host.is_sparse and host.nbytes > self.largest:
            raise torch.OutOfMemoryError(f"CUDA out of memory. Tried to allocate {host.nbytes} B.")
        return DeviceTensor(host)

    def check(self, name: str, args: tuple[Any, ...], leaves: list[Any]) -> None:
        """Refuse CPU tensors except single numbers and indices, which are copied."""
        strangers = [
            leaf
            for leaf in leaves
            if isinstance(leaf, Tensor) and not isinstance(leaf, DeviceTensor) and leaf.dim()
        ]
        if strangers and name in INDEXING and isinstance(args[0], DeviceTensor):
            indices = [index for index in args[1] if index is not None]
            if all(any(one is index for index in indices) for one in strangers):
                self.traffic.copies[f"{caller()} index"] += len(strangers)
                return
        if strangers:
            raise RuntimeError(
                f"{name}: Expected all tensors to be on the same device, but found at least two "
                f"devices, cuda:0 and cpu!"
            )


def check_order(name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Refuse sums that CUDA adds in arbitrary order, since two runs would give different bits."""
    if torch._C._current_graph_task_id() >= 0:  # a gradient
        return
    kind = name.removeprefix("aten::").removesuffix("_")
    floats = isinstance(args[0], Tensor) and args[0].is_floating_point()
    if name in INDEXING:  # self, indices, values, accumulate
        adds = floats and len(args) > 3 and args[3]
    elif kind == "bincount":
        adds = kwargs.get("weights", args[1] if len(args) > 1 else None) is not None
    elif kind == "scatter_reduce":  # self, dim, index, source, kind of reduction
        adds = floats and args[4] not in ("amin", "amax")
    else:
        adds = floats and kind in ANY_ORDER
    if adds:
        raise RuntimeError(f"{kind}: CUDA adds in any order")
    if kind in UNSETTLED and len(args) > 1:
        raise RuntimeError(f"{kind} does not have a deterministic implementation")


class Constructors(TorchFunctionMode):
    """Makes tensors from Python numbers, which torch copies to a device without dispatch."""

    def __init__(self, traffic: Traffic) -> None:
        super().__init__()
        self.traffic = traffic

    def __torch_function__(self, func, types, args=(), kwargs=None):
        args = tuple(numbered(argument) for argument in args)
        kwargs = {name: numbered(argument) for name, argument in (kwargs or {}).items()}
        if func is Tensor.new_tensor and isinstance(args[0], DeviceTensor):
            kwargs = {"dtype": args[0].dtype, "device": CUDA} | kwargs
            func, args = torch.tensor, args[1:]
        if func is Tensor.coalesce and isinstance(args[0], DeviceTensor):
            return DeviceTensor(args[0].host.coalesce())  # torch would ask the wrapper's layout
        if func is Tensor.new and isinstance(args[0], DeviceTensor):  # as SparseAdam does
            return torch.sparse_coo_tensor(*args[1:], check_invariants=True)
        if func is Tensor.tolist and isinstance(args[0], DeviceTensor):
            self.traffic.waits[f"{caller()} tolist"] += 1
            return args[0].host.tolist()
        if func in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], DeviceTensor):
            # Torch would make a list an index without values, on the meta device.
            indices = args[1] if isinstance(args[1], tuple) else (args[1],)
            found = [torch.tensor(i).to(CUDA) if isinstance(i, list) else i for i in indices]
            args = (args[0], tuple(found), *args[2:])
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            device = kwargs.pop("device")
            return func(*args, **kwargs).to(device)
        return func(*args, **kwargs)


def numbered(argument: Any) -> Any:
    """Return ``cuda`` with its number, for which torch would ask a driver."""
    is_name = isinstance(argument, (str, torch.device)) and str(argument) == "cuda"
    return CUDA if is_name else argument


def unwrapped(leaf: Any) -> Any:
    return leaf.host if isinstance(leaf, DeviceTensor) else leaf


def caller() -> str:
    """Return the line of cvtgs that is running."""
    frame = sys._getframe(1)
    while frame.f_back and "/cvtgs/" not in frame.f_code.co_filename:
        frame = frame.f_back
    return f"{frame.f_code.co_filename.rpartition('/cvtgs/')[2]}:{frame.f_lineno}"


@contextmanager
def pretended_cuda(*, largest: int | None = None) -> Iterator[Traffic]:
    """Pretend that there is a CUDA device; count waits for it, and copies.

    ``largest`` is the number of bytes above which a tensor does not fit.
    """
    traffic = Traffic()
    answers: dict[str, Callable[..., Any]] = {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "synchronize": lambda device=None: None,
        "get_device_name": lambda device=None: "a pretended device",
        "get_device_properties": lambda device: SimpleNamespace(total_memory=64 << 30),
        "mem_get_info": lambda device=None: (32 << 30, 64 << 30),
    }
    device = Device(traffic, largest)
    with patch.multiple(torch.cuda, **answers), device, Constructors(traffic):
        yield traffic
